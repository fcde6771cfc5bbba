"""The public names, for editors and type checkers; __init__.py loads them when they are first used."""

from .errors import InputError, SehdrError
from .evaluation.compare import compare_runs
from .evaluation.evaluate import evaluate
from .evaluation.folder import evaluate_folder
from .output.brackets import write_brackets
from .output.cameras.selection import select_cameras
from .output.export.gaussians import export
from .output.export.proxy_mesh import write_proxy_mesh
from .output.export.splat_edits import SplatEdits
from .output.film import write_film
from .output.lighting.environment_map import write_environment_map
from .output.lighting.lights import write_lights
from .output.lighting.unit import meter
from .output.merged_scene import MergedScene, merge_scenes
from .output.render_views import render_views
from .output.report.write import write_report
from .output.scene_page import write_scene_page
from .output.world_transform import write_orientation
from .rasterizer import Rendering, differentiable, rasterize, rasterize_directions, spherical_harmonics, ssim
from .response import Response, response_by_name, response_names
from .runs.config import Config
from .runs.config_files import load_config, preset_names
from .runs.run import Run, Splats, load_run, load_splats
from .scene import Camera, Scene, View, embedded_scenes, load_cameras, load_scene
from .scene.exposure.stack import calibrate
from .training.initialization import match_points
from .training.plan import Plan, make_plan
from .training.train import create_trainer, train
from .training.trainer import Trainer
from .training.training_progress import TrainingProgress

__all__ = [
    "Camera",
    "Config",
    "InputError",
    "MergedScene",
    "Plan",
    "Rendering",
    "Response",
    "Run",
    "Scene",
    "SehdrError",
    "SplatEdits",
    "Splats",
    "Trainer",
    "TrainingProgress",
    "View",
    "calibrate",
    "compare_runs",
    "create_trainer",
    "differentiable",
    "embedded_scenes",
    "evaluate",
    "evaluate_folder",
    "export",
    "load_cameras",
    "load_config",
    "load_run",
    "load_scene",
    "load_splats",
    "make_plan",
    "match_points",
    "merge_scenes",
    "meter",
    "preset_names",
    "rasterize",
    "rasterize_directions",
    "render_views",
    "response_by_name",
    "response_names",
    "select_cameras",
    "spherical_harmonics",
    "ssim",
    "train",
    "write_brackets",
    "write_environment_map",
    "write_film",
    "write_lights",
    "write_orientation",
    "write_proxy_mesh",
    "write_report",
    "write_scene_page",
]

__version__: str
