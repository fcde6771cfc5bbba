"""A trained scene, loaded from its run folder or from a file of Gaussians."""

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..errors import InputError, SehdrError, path_of
from ..model.baking import field_of
from ..model.color_models import rec709_of
from ..model.confidence import Evidence, gather_evidence
from ..model.lights import Light, find_lights
from ..model.paged_field import PagedField
from ..model.pixel_filter import EPS2D, FocalRange, samples_across_pixel
from ..model.radiance_field import RadianceField
from ..model.renders import DirectionalRender, RenderedView, require_time
from ..response import Response
from ..scene import Camera, Scene, load_cameras
from ..scene.exposure.compensation import ExposureCompensation
from ..scene.gravity import UpDirection
from ..splats import cameras_beside, read_gaussians
from .checkpoint import RENDER_TENSORS
from .config import Config
from .device import pick_device
from .field import field_from_checkpoint
from .light_estimates import light_estimates
from .run_folder import CameraEntry, RunFolder
from .values import LoadArguments

log = logging.getLogger(__name__)

MEMORY_SHARE = 0.8  # Largest part of a GPU's free memory that the Gaussians of a picture take


class RenderableScene:
    """A scene to render: a Run, or Splats from a file of Gaussians.

    Radiance is linear Rec.709; simulated photos have the colors of the photos.

    Attributes:
        path: The run folder, or the file.
        scene_name: Name of the scene.
        cameras: Views of the scene.
        iterations: Iterations of the training; None if it is not known.
        field: The radiance field; a PagedField if is_paged.
        response: Camera response.
        degree: SH degree to render with.
        base_time: Exposure time of the photos, seconds.
        color_matrix: [3, 3] from the field's colors to linear Rec.709, if it was trained on sensor RGB; else None.
        world_matrix: [4, 4] from the photos' coordinates to those of a file of Gaussians, which its cameras and renders
            are in, if the file states it; else None.
        exposure_compensation: Exposure compensation of the training photos, if there was one.
        up: Up direction that photos and poses show; None if it was not looked for.
        reference: Scene whose upright coordinates are those of this one; None for its own.
    """

    path: Path
    scene_name: str
    cameras: tuple[CameraEntry, ...]
    iterations: int | None = None
    field: RadianceField
    response: Response
    degree: int
    base_time: float
    color_matrix: np.ndarray | None = None
    world_matrix: np.ndarray | None = None
    exposure_compensation: ExposureCompensation | None = None
    up: UpDirection | None = None
    reference: "RenderableScene | None" = None

    @property
    def is_paged(self) -> bool:
        """True if the Gaussians do not fit into the GPU: those in view are copied to it for each picture."""
        return isinstance(self.field, PagedField)

    @property
    def device(self) -> torch.device:
        """Device that pictures are rendered on."""
        return self.field.render_device

    def normalize_photos(self, scene: Scene) -> Scene:
        """Return a scene with the exposure compensation that the run was trained with."""
        compensation = self.exposure_compensation
        return scene if compensation is None else compensation.normalize_photos(scene, self.field.response)

    def __repr__(self) -> str:
        """Return path, number of Gaussians, views and device in one line."""
        views = f"{len(self.cameras)} views, " if self.cameras else ""
        return f"{type(self).__name__}({str(self.path)!r}, {self.gaussian_count:,} Gaussians, {views}on {self.device})"

    @property
    def gaussian_count(self) -> int:
        """Number of Gaussians."""
        return self.field.gaussians.count

    def render(self, camera: Camera, *, supersample: bool = True, data: Sequence[str] = ()) -> RenderedView:
        """Render HDR radiance [H, W, 3], alpha [H, W] and depth [H, W] from a camera.

        With `supersample`, a pinhole view coarser than the photos is rendered as finely as they are and averaged.
        Without it, which is faster, lamps smaller than a pixel get 0.7 to 1.6 times their light, and edges are rough.

        `data` are names of further attributes, "confidence" and "clipped": images that render_confidence() and
        render_clipped() return, here in the same rasterization unless a finer one is averaged.

        Raises:
            InputError: for another name.
        """
        sources = {"confidence": lambda: self.field.confidence, "clipped": self.clipped_share}
        data = (data,) if isinstance(data, str) else data
        if unknown := [name for name in data if name not in sources]:
            raise InputError("data", f"has {unknown[0]!r}", f"name any of {', '.join(sources)}")
        factor = self.samples_across_pixel(camera) if supersample else 1
        finer = camera.resized(factor * camera.width, factor * camera.height)
        values = {name: share for name in data if (share := sources[name]()) is not None}
        view = self.field.render(finer, degree=self.degree, data=values if factor == 1 else {})
        view = replace(view, hdr=self.in_rec709(view.hdr)).reduced(factor)
        if factor > 1:
            view = replace(view, **{name: self.field.render_mean(camera, share) for name, share in values.items()})
        return view

    def samples_across_pixel(self, camera: Camera) -> int:
        """Return how many times finer than a camera's pixels render() renders what it averages; at least 1."""
        return samples_across_pixel(self.field, camera)

    def render_directions(
        self, position: np.ndarray, directions: np.ndarray, *, focal_length: float, pixel_angle: float, **more: Any
    ) -> DirectionalRender:
        """Render along unit directions [H, W, 3] from a position [3]; see RadianceField.render_directions."""
        rays = torch.tensor(directions, dtype=torch.float32, device=self.device)
        options = {"focal_length": focal_length, "pixel_angle": pixel_angle, "degree": self.degree, **more}
        surroundings = self.field.render_directions(position, rays, **options)
        return replace(surroundings, hdr=self.in_rec709(surroundings.hdr))

    def in_rec709(self, hdr: Tensor) -> Tensor:
        """Convert radiance [..., 3] from the colors that the scene was trained in to linear Rec.709."""
        return rec709_of(hdr, self.color_matrix, self.field.white)

    def render_ldr(self, camera: Camera, exposure_time: float | None = None) -> Tensor:
        """Render the simulated photo [H, W, 3] in [0, 1] of exposure_time seconds, by default the base exposure."""
        require_time(self.base_time if exposure_time is None else exposure_time)
        return self.field.render_ldr(camera, exposure_time, degree=self.degree)

    def render_confidence(self, camera: Camera) -> Tensor | None:
        """Render the confidence [H, W] in [0, 1] of what a camera sees; None if it was not measured."""
        return self.field.render_confidence(camera)

    def clipped_share(self) -> Tensor | None:
        """Return the fraction [N] of clipped values that show each Gaussian; None if it was not measured."""
        return None

    def find_lights(self) -> list[Light]:
        """Return the lights of the scene that the photos clipped, sorted by their share of light.

        Radiance is in linear Rec.709.

        Raises:
            SehdrError: if it was not measured what clipped.
        """
        clipped = self.clipped_share()
        if clipped is None:
            problem = "holds no record of what the photos clipped"
            raise SehdrError(f"{self.path}: {problem}; lights are found in the folder of a run")
        views = [(entry.camera, entry.exposure_time) for entry in self.cameras if entry.split == "train"]
        lights = find_lights(self.field, clipped, views, degree=self.degree)
        if self.color_matrix is None:
            return lights
        colors = [[light.radiance, light.lower_bound] for light in lights]
        rec709 = self.in_rec709(torch.tensor(np.array(colors).reshape(-1, 2, 3), dtype=torch.float32)).numpy()
        pairs = zip(lights, rec709, strict=True)
        return [replace(light, radiance=pair[0], lower_bound=pair[1]) for light, pair in pairs]

    def render_clipped(self, camera: Camera) -> Tensor | None:
        """Render the fraction [H, W] of clipped values behind what a camera sees; None if it was not measured."""
        share = self.clipped_share()
        return None if share is None else self.field.render_mean(camera, share)


class Splats(RenderableScene):
    """A file of Gaussians as a scene to render, re-expose and export. Its response is sRGB.

    Attributes:
        base_time: Exposure time that the file states, seconds; else 1.
        cameras: Views listed in `<name>.cameras.json` beside the file, as export writes it, or in a cameras.json, as
            the reference release of 3D Gaussian Splatting writes it; else none.
    """

    def __init__(
        self, path: Path, field: RadianceField, cameras: tuple[CameraEntry, ...], world_matrix: np.ndarray | None = None
    ):
        """Wrap a field; load_splats() reads files."""
        self.path, self.field, self.cameras, self.world_matrix = path, field, cameras, world_matrix
        self.response, self.base_time, self.degree = field.response, field.base_time, field.gaussians.degree
        self.scene_name = path.stem
        views, focals = [entry.camera for entry in cameras], field.photo_focals
        if focals is not None:  # Cameras of other focal lengths are not those of the photos.
            views = [view for view in views if focals.variance(view.fx) == EPS2D]
        if focals is not None or field.antialiased:  # Of compensated opacities for maps and ray limits
            field.photo_cameras = views


def load_splats(path: Path | str, *, device: str | torch.device = "cpu") -> Splats:
    """Load the scene in a file of Gaussians.

    Args:
        path: PLY, glTF (.glb) or OpenUSD (.usda, .usdc, .usdz), or another format of sehdr_warp.splats.
        device: "cpu", "cuda:0", ...

    Raises:
        InputError: If the file, or the cameras.json beside it, is missing, damaged or of another kind, or for a device
            that torch cannot use.
    """
    path = path_of(path, "path")
    gaussians = read_gaussians(path)
    field = on_device(field_of(gaussians), pick_device(device))
    beside, cameras = cameras_beside(path), ()
    if beside is not None:
        views = load_cameras(beside)
        if beside.name == "cameras.json":
            text = "%s: %d cameras from %s beside it, which does not say what it belongs to"
            log.info(text, path, len(views), beside)
        cameras = tuple(CameraEntry(name, "train", camera, field.base_time) for name, camera in views)
    return Splats(path, field, cameras, gaussians.world_matrix)


class Run(RenderableScene):
    """A trained scene.

    Attributes:
        folder: The files of the run folder.
        config: Options of the training.
        train_seconds: Duration of the training.
        checkpoint_hash: Hash of the tensors.
        data: Arguments with which the photos were loaded; may be empty.
    """

    def __init__(
        self, folder: RunFolder, config: Config, field: RadianceField, info: dict, values: dict, clipped: Tensor | None
    ):
        """Wrap the parts of a run; load_run() reads them."""
        self.folder, self.path = folder, folder.path
        self.config, self.field, self._clipped = config, field, clipped
        self.response: Response = field.response
        self.base_time = field.base_time
        self.cameras: tuple[CameraEntry, ...] = folder.read_cameras()
        field.photo_cameras = [entry.camera for entry in self.cameras if entry.split == "train"]
        field.photo_focals = FocalRange.of(field.photo_cameras)
        self.iterations: int = values["iteration"]
        self.degree = config.continued_after(folder.finished_at()).degree_at(self.iterations)
        self.train_seconds: float = values["seconds"]
        self.checkpoint_hash: str = values["sha256"]
        self.data: LoadArguments = info["data"]
        self.scene_name: str = info["scene"]
        if info.get("color_matrix"):
            self.color_matrix = np.array(info["color_matrix"], np.float64)
        self.exposure_compensation = exposure_compensation(info)
        self.up = UpDirection.from_dict(info.get("up"))

    def _repr_html_(self) -> str:
        """Return HTML for notebooks."""
        from ..output.notebook import run_html  # A notebook asks the run itself for its HTML.

        return run_html(self)

    def clipped_share(self) -> Tensor | None:
        """Return the fraction [N] of clipped values that show each Gaussian; None if it was not measured."""
        return None if self._clipped is None else self._clipped.to(self.device)

    def metrics(self) -> list[dict[str, Any]]:
        """Return the evaluations during the training, as in metrics.jsonl."""
        return self.folder.read_metrics()

    def summary(self) -> dict[str, Any]:
        """Return times, memory and counts of the training; empty if it has not ended."""
        return self.folder.read_summary()

    def notes(self) -> list[str]:
        """Return what was noted when the photos were read for the training."""
        return list(self.folder.read_scene()["notes"])

    def decisions(self) -> list[dict[str, Any]]:
        """Return the decisions of the run's plan: name, choice, reason and fields of each; empty without a plan."""
        return self.folder.read_decisions()

    def measure_confidence(self, scene: Scene) -> Evidence:
        """Measure the confidence of the Gaussians' light on the training photos of a scene, and keep it in this object.

        HDR truth of the photos counts only if the run was trained on it.
        """
        truth = self.config.loss.uses_hdr
        views = self.normalize_photos(scene).train_views
        response = None if truth or self.field.color_model.display_referred else self.field.response
        estimates = light_estimates(views, response, self.config.loss, self.device)
        certainties = None if estimates is None else [estimate.certainty for estimate in estimates]
        evidence = gather_evidence(self.field, views, degree=self.degree, truth=truth, certainties=certainties)
        self.set_evidence(evidence)
        return evidence

    def set_evidence(self, evidence: Evidence) -> None:
        """Set confidence and clipped fractions from the evidence of the training photos, in this object alone."""
        self.field.confidence, self._clipped = evidence.confidence(), evidence.clipped
        self.field.clipped_stops = evidence.clipped_stops


def load_run(path: Path | str, *, device: str | torch.device = "cpu") -> Run:
    """Load the trained scene in a run folder, from its newest complete checkpoint.

    Args:
        path: Run folder.
        device: "cpu", "cuda:0", ...

    Raises:
        InputError: With file and field, if the folder is not a run, or has no usable checkpoint; for a device that
            torch cannot use.
    """
    folder = RunFolder(path_of(path, "path"))
    folder.require()
    info, config = folder.read_info(), folder.read_config()
    checkpoint = folder.newest_checkpoint(RENDER_TENSORS)
    field, clipped = field_from_checkpoint(checkpoint, config, info).requires_grad_(False), None
    if (evidence := folder.read_evidence(checkpoint)) is not None:
        field.confidence, clipped, field.clipped_stops = evidence.confidence(), evidence.clipped, evidence.clipped_stops
    return Run(folder, config, on_device(field, pick_device(device)), info, checkpoint.values, clipped)


def on_device(field: RadianceField, device: torch.device, budget: int | None = None) -> RadianceField:
    """Return a field on a device; if its Gaussians are too many for a GPU, one that copies those that are in view.

    Pictures may take `budget` bytes of the device's memory, by default MEMORY_SHARE of what is free on a GPU.
    """
    if budget is None and device.type == "cuda":
        budget = int(MEMORY_SHARE * torch.cuda.mem_get_info(device)[0])
    paged = None if budget is None else PagedField(field, device, budget)
    if paged is None or paged.row_bytes * field.gaussians.count <= paged.budget:
        return field.to(device)
    text = "%d Gaussians do not fit into %.1f GB of %s: those in view are copied to it, far ones at less detail"
    log.info(text, field.gaussians.count, paged.budget / 1e9, device)
    return paged.requires_grad_(False)


def exposure_compensation(info: dict) -> ExposureCompensation | None:
    """Return the exposure compensation that run.json contains, if any."""
    return ExposureCompensation.from_dict(fields) if (fields := info.get("exposure_compensation")) else None
