"""sehdr-warp: scene-linear HDR Gaussian scenes from photos of one exposure (SeHDR, ICCV 2025).

    import sehdr_warp as sw

    scene = sw.load_scene("photos/")
    run = sw.train(scene, "run/")
    sw.render_views(run, "renders/", cameras="test", evs=(-4, -2, 0, 2, 4))

A name loads its module when it is first used, so importing the package takes a fraction of a second. `__init__.pyi`
lists the same names for editors and type checkers.
"""

from importlib import import_module

__version__ = "0.3.0"

_HOMES = {
    "errors": ("InputError", "SehdrError"),
    "evaluation.compare": ("compare_runs",),
    "evaluation.evaluate": ("evaluate",),
    "evaluation.folder": ("evaluate_folder",),
    "output.brackets": ("write_brackets",),
    "output.export.gaussians": ("export",),
    "output.lighting.environment_map": ("write_environment_map",),
    "output.film": ("write_film",),
    "output.lighting.lights": ("write_lights",),
    "output.merged_scene": ("MergedScene", "merge_scenes"),
    "output.export.proxy_mesh": ("write_proxy_mesh",),
    "output.render_views": ("render_views",),
    "output.cameras.selection": ("select_cameras",),
    "output.report.write": ("write_report",),
    "output.scene_page": ("write_scene_page",),
    "output.export.splat_edits": ("SplatEdits",),
    "output.world_transform": ("write_orientation",),
    "response": ("Response", "response_by_name", "response_names"),
    "scene": ("Camera", "Scene", "View", "embedded_scenes", "load_cameras", "load_scene"),
    "scene.exposure.stack": ("calibrate",),
    "rasterizer": ("Rendering", "differentiable", "rasterize", "rasterize_directions", "spherical_harmonics", "ssim"),
    "runs.config": ("Config",),
    "runs.config_files": ("load_config", "preset_names"),
    "training.initialization": ("match_points",),
    "training.plan": ("Plan", "make_plan"),
    "runs.run": ("Run", "Splats", "load_run", "load_splats"),
    "training.train": ("create_trainer", "train"),
    "training.trainer": ("Trainer",),
    "training.training_state": ("TrainingProgress",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}
__all__ = sorted(_HOME_OF)  # noqa: PLE0605 # pyright: ignore[reportUnsupportedDunderAll]


_RENAMED = {
    "Step": "TrainingProgress",
    "Training": "create_trainer",
    "score_folder": "evaluate_folder",
    "write_panorama": "write_environment_map",
}


def __getattr__(name: str):
    if name in _RENAMED:
        raise AttributeError(f"{__name__}.{name} is now {__name__}.{_RENAMED[name]}")
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME_OF})
