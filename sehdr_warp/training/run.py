"""The folder of a training: what it holds, how it begins, and how a trained scene is loaded from it.

config.json         the Config
scene.json          cameras of all views, splits, exposure times, names: enough to render without the photos
run.json            response, base exposure time, version, where the photos were
metrics.jsonl       one line for each evaluation
checkpoints/        see checkpoint.py
confidence.safetensors      how far the photos vouch for each Gaussian, see confidence.py
summary.json        times, memory and counts, when the training ended
"""

import json
import math
import reprlib
import shutil
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from ..errors import InputError, SehdrError
from ..field.gaussians import PARAMETER_NAMES, Gaussians
from ..field.radiance_field import RadianceField, RenderedView
from ..files import atomic_path, write_json, writing
from ..response import Response
from ..scene import Camera, Scene
from ..scene.images import MAX_PIXELS
from .checkpoint import Checkpoint, newest_checkpoint
from .confidence import CONFIDENCE, read_confidence
from .config import Config
from .config_files import config_to_dict, read_config_json
from .initialization import assemble_field

CONFIG, SCENE, RUN, METRICS, SUMMARY, CHECKPOINTS = (
    "config.json",
    "scene.json",
    "run.json",
    "metrics.jsonl",
    "summary.json",
    "checkpoints",
)
FORMAT = 1
_REMEDY = "the run is damaged: train again"


@dataclass(frozen=True)
class CameraEntry:
    """A view of the scene a run was trained on. exposure_time: seconds; split: "train" or "test"."""

    name: str
    split: str
    camera: Camera
    exposure_time: float


class Run:
    """A trained scene.

    path: its folder. config: the choices it was trained with. model: the RadianceField, on `device`.
    cameras: the views of the scene, in its order. response: the camera's curve. exposure_time: the base one, seconds.
    iterations, train_seconds: how far the training was. checkpoint_hash: of the tensors it was loaded from.
    data: where the photos were, for load_scene; may be empty.
    """

    def __init__(
        self,
        path: Path,
        config: Config,
        model: RadianceField,
        cameras: tuple[CameraEntry, ...],
        info: dict,
        values: dict,
    ):
        self.path = path
        self.config = config
        self.model = model
        self.cameras = cameras
        self.iterations: int = values["iteration"]
        self.train_seconds: float = values["seconds"]
        self.checkpoint_hash: str = values["sha256"]
        self.data: dict = info["data"]
        self.scene_name: str = info["scene"]

    @property
    def response(self) -> Response:
        return self.model.response

    @property
    def exposure_time(self) -> float:
        return self.model.base_time

    @property
    def device(self) -> torch.device:
        return self.model.gaussians.means.device

    @property
    def gaussian_count(self) -> int:
        return self.model.gaussians.count

    @cached_property
    def degree(self) -> int:
        """The degree of the harmonics that the training had reached."""
        every = self.config.scaled(self.config.schedule.harmonics_every)
        return min(self.config.model.harmonics_degree, self.iterations // every)

    def render(self, camera: Camera) -> RenderedView:
        """HDR radiance [H, W, 3], alpha [H, W] and depth [H, W] from a camera."""
        return self.model.render(camera, degree=self.degree)

    def render_ldr(self, camera: Camera, exposure_time: float | None = None) -> Tensor:
        """[H, W, 3] in [0, 1]: the simulated photo of exposure_time seconds, by default the base exposure."""
        return self.model.render_ldr(camera, exposure_time, degree=self.degree)

    def render_confidence(self, camera: Camera) -> Tensor | None:
        """[H, W] in [0, 1]: how far the photos vouch for what a camera sees; None where that was not measured."""
        return self.model.render_confidence(camera)

    def metrics(self) -> list[dict]:
        """The evaluations made during training, as in metrics.jsonl."""
        return read_metrics(self.path)

    def summary(self) -> dict:
        """Times, memory and counts of the training; empty if it has not ended."""
        path = self.path / SUMMARY
        return _read_json(path) if path.exists() else {}


def load_run(path: Path | str, *, device: str | torch.device = "cpu") -> Run:
    """The trained scene in a run folder, from its newest complete checkpoint.

    Raises InputError naming file and field if the folder is no run, or has no usable checkpoint.
    """
    path = Path(path)
    require_run(path)
    config, info = read_config_json(path / CONFIG), read_run_info(path)
    checkpoint = newest_checkpoint(path / CHECKPOINTS)
    if checkpoint is None:
        raise InputError(path / CHECKPOINTS, "holds no complete checkpoint", "train again, or continue with --resume")
    model = field_from_checkpoint(checkpoint, config, info)
    model.confidence = read_confidence(path, checkpoint)
    model = model.to(device)
    model.requires_grad_(False)
    return Run(path, config, model, read_cameras(path), info, checkpoint.values)


def field_from_checkpoint(checkpoint: Checkpoint, config: Config, info: dict) -> RadianceField:
    """The RadianceField that a checkpoint holds, on the CPU; raises InputError if tensors are missing or do not fit."""
    try:
        gaussians = Gaussians(*(checkpoint.tensors[f"gaussians.{name}"] for name in PARAMETER_NAMES))
        field = assemble_field(gaussians, config, Response.from_dict(info["response"]), info["base_exposure_time"])
        for name, part in (("fusion.", field.fusion), ("response.", field.response)):
            if isinstance(part, torch.nn.Module):
                states = {k.removeprefix(name): v for k, v in checkpoint.tensors.items() if k.startswith(name)}
                part.load_state_dict(states)
    except (KeyError, ValueError, RuntimeError) as error:
        raise InputError(checkpoint.path, f"its tensors do not fit the config ({error})", _REMEDY) from None
    return field


def check_folder(path: Path, *, resume: bool, overwrite: bool) -> bool:
    """Whether a folder holds a run to continue. Changes nothing.

    Raises InputError if something is there and neither was asked for, or if what is there is no run.
    """
    if path.exists() and not path.is_dir():
        raise InputError(path, "is a file", "choose another folder for the run")
    if not path.exists() or not any(path.iterdir()):
        return False
    if not resume and not overwrite:
        raise InputError(path, "exists and is not empty", "choose another folder, or use --resume or --overwrite")
    require_run(path)
    return resume


def clear_folder(path: Path) -> None:
    """Makes the folder, or removes the run in it. Raises InputError if the folder cannot be made."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(path, f"cannot be made ({error.strerror})", "choose another folder for the run") from None
    for name in (SUMMARY, METRICS, CONFIDENCE, SCENE, RUN, CONFIG):
        (path / name).unlink(missing_ok=True)
    shutil.rmtree(path / CHECKPOINTS, ignore_errors=True)


def require_run(path: Path) -> None:
    """Raises InputError if a folder is not one of a training."""
    if not path.is_dir():
        raise InputError(path, "no such folder", "give the folder that `sehdr-warp train --out` wrote")
    if not (path / CONFIG).is_file():
        raise InputError(path, f"is not a run (no {CONFIG})", "give a folder that `sehdr-warp train --out` wrote")


def describe_scene(scene: Scene) -> dict:
    """What scene.json holds."""
    views = [
        {
            "name": view.name,
            "split": view.split,
            "exposure_time": view.exposure_time,
            "camera": view.camera.to_dict(),
            "has_hdr": view.hdr is not None,
        }
        for view in scene.views
    ]
    return {
        "format": FORMAT,
        "name": scene.name,
        "layout": scene.format,
        "exposure_times_known": scene.exposure_times_known,
        "notes": list(scene.notes),
        "views": views,
    }


def write_start(path: Path, scene: Scene, config: Config, field: RadianceField, data: dict) -> None:
    """Writes scene.json and run.json, and config.json last: its presence says that the folder is a run."""
    from .. import __version__

    info = {
        "format": FORMAT,
        "version": __version__,
        "scene": scene.name,
        "data": data,
        "base_exposure_time": field.base_time,
        "response": field.response.to_dict(),
    }
    write_json(path / SCENE, describe_scene(scene), overwrite=True)
    write_json(path / RUN, info, overwrite=True)
    write_json(path / CONFIG, config_to_dict(config), overwrite=True)


def read_run_info(path: Path) -> dict:
    """What run.json holds; raises InputError."""
    info = _read_json(path / RUN)
    for name, kind in (("scene", str), ("data", dict), ("base_exposure_time", int | float), ("response", dict)):
        if name not in info:
            raise InputError(path / RUN, f"lacks the field {name}", _REMEDY)
        if not isinstance(info[name], kind):
            raise InputError(path / RUN, f"{name} = {reprlib.repr(info[name])} is of the wrong type", _REMEDY)
    time = info["base_exposure_time"]
    if not 0 < time < math.inf or time > 1e300:
        raise InputError(
            path / RUN, f"base_exposure_time = {reprlib.repr(time)} is not a positive number of seconds", _REMEDY
        )
    try:
        Response.from_dict(info["response"])
    except SehdrError as error:
        raise InputError(path / RUN, str(error), _REMEDY) from None
    return info


def read_cameras(path: Path) -> tuple[CameraEntry, ...]:
    """The views in scene.json; raises InputError."""
    values = _read_json(path / SCENE)
    try:
        return tuple(_camera_entry(view) for view in values["views"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(path / SCENE, f"a view is damaged ({error!r:.200})", _REMEDY) from None


def _camera_entry(view: dict) -> CameraEntry:
    camera, time = Camera.from_dict(view["camera"]), float(view["exposure_time"])
    if camera.width * camera.height > MAX_PIXELS:
        raise ValueError(f"{camera.width} x {camera.height} is more than {MAX_PIXELS} pixels")
    if not (math.isfinite(time) and time > 0):
        raise ValueError(f"exposure_time = {time} is not a positive number of seconds")
    return CameraEntry(str(view["name"]), str(view["split"]), camera, time)


def check_same_scene(path: Path, scene: Scene) -> None:
    """Raises InputError if a run was trained on another scene than this one."""
    saved, given = _read_json(path / SCENE), json.loads(json.dumps(describe_scene(scene)))
    for name in ("layout", "views"):
        if saved.get(name) != given[name]:
            raise InputError(
                path / SCENE,
                f"its {name} differ from those of {scene.name}",
                "resume with the same data and --max-size",
            )


def append_metrics(path: Path, line: dict) -> None:
    """Adds a line to metrics.jsonl; raises SehdrError if the disk refuses."""
    with writing(path / METRICS), open(path / METRICS, "a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")


def read_metrics(path: Path) -> list[dict]:
    """The lines of metrics.jsonl; what a killed process left half-written is passed over."""
    file, lines = path / METRICS, []
    for text in file.read_text(encoding="utf-8", errors="replace").splitlines() if file.exists() else ():
        try:
            line = json.loads(text)
        except (ValueError, RecursionError):
            continue
        if isinstance(line, dict) and isinstance(line.get("iteration", 0), int):
            lines.append(line)
    return lines


def rewind_metrics(path: Path, iteration: int) -> None:
    """Drops the evaluations after an iteration: a resumed training makes them again."""
    kept = [line for line in read_metrics(path) if line.get("iteration", 0) <= iteration]
    with atomic_path(path / METRICS, overwrite=True) as beside:
        beside.write_text("".join(json.dumps(line) + "\n" for line in kept), encoding="utf-8")


def _read_json(path: Path) -> dict:
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", _REMEDY) from None
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"not valid JSON ({error})", _REMEDY) from None
    if not isinstance(values, dict):
        raise InputError(path, "is not a JSON object", _REMEDY)
    return values
