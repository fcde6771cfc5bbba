"""The folder of a run, as it is read. RunWriter writes it.

config.json                 the Config
scene.json                  cameras of all views, splits, exposure times, names: enough to render without the photos
run.json                    response, base exposure time, version, where the photos were
plan.json                   what was left out and why, if a plan was made
metrics.jsonl               one line for each evaluation
checkpoints/iteration_N/    tensors as safetensors, values as JSON with the hash of the tensors
confidence.safetensors      how far photos support each Gaussian, and of which checkpoint
summary.json                times, memory and counts, once the training has ended
extension.json              more iterations than config.json has, of a training that was extended, and those it had
orientation.json            up direction and scale of the files, set after the training
light_unit.json             cd/m^2 of a radiance of 1, set after the training (`sehdr-warp meter`)
blocks.json                 the blocks of a survey that the run was merged from
tensorboard/                curves of the training, if tensorboard is installed

Nothing is pickled. A run may come from anybody: reading one changes nothing in it, follows no link in it (the folder
itself may be one), and checks every value (see values.py). A checkpoint holds hashes of the other files that decide the
picture.
"""

import hashlib
import json
import math
import os
import re
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from ..errors import MOST_LISTED, InputError, SehdrError
from ..files import UnreadableError, has_file, refuse_links
from ..json_values import damage
from ..model.confidence import MAX_STOPS, Evidence
from ..response import Response
from ..scene import Camera, Scene
from ..scene.dataparser import PlacedPhoto
from ..scene.images.ldr_files import MAX_PIXELS
from ..scene.lens import Lens
from .checkpoint import Checkpoint, read_checkpoint
from .config import Config
from .config_files import config_of_run, override_config
from .scene_description import describe_scene, scene_difference
from .values import (
    FORMAT,
    LIGHT_UNIT_FILE,
    ORIENTATION_FILE,
    REMEDY,
    PlanValues,
    RunValues,
    SceneValues,
    SummaryValues,
    read_metrics_lines,
    read_object,
    read_values,
)

NEW, READY = ".new", ".ready"  # A new run while it is written, and while its files take their places
_GIVE_RUN = "give the folder that a training wrote"
_TRAIN_AGAIN = "train again, with --overwrite"
_REMOVE_FILE = "remove this file, which a run does not need, or train again"
_MAKE_AGAIN = "remove this file; `sehdr-warp report` makes it again from the photos"
EVIDENCE_TENSORS = {"weight_sum": "seen"} | {name: name for name in ("stops", "clipped", "peak", "clipped_stops")}
"""Name in confidence.safetensors of each field of Evidence."""
_MOST_STOPS = 2.5 * MAX_STOPS  # A misfit and a deviation, each at most MAX_STOPS, and rounding


@dataclass(frozen=True)
class CameraEntry:
    """A view of the scene that a run was trained on."""

    name: str
    split: str  # "train" or "test"
    camera: Camera
    exposure_time: float  # Seconds
    placed: PlacedPhoto | None = None  # Its photo, if structure from motion found the camera


class RunFolder:
    """The files of a run; each is read by a function of its own.

    Raises InputError, with the file and the field if there is one, for whatever cannot be read.

    Attributes:
        path: of the folder; the others are paths of the files and folders in it.
    """

    def __init__(self, path: Path | str):
        """Name the files of a run; nothing is read or written."""
        self.path = Path(path)
        self.config_file, self.scene_file, self.info_file, self.plan_file, self.summary_file = (
            self.path / f"{name}.json" for name in ("config", "scene", "run", "plan", "summary")
        )
        self.extension, self.orientation = self.path / "extension.json", self.path / ORIENTATION_FILE
        self.light_unit = self.path / LIGHT_UNIT_FILE
        self.blocks = self.path / "blocks.json"
        self.metrics = self.path / "metrics.jsonl"
        self.checkpoints = self.path / "checkpoints"
        self.confidence = self.path / "confidence.safetensors"
        self.tensorboard = self.path / "tensorboard"
        self._hashes: dict[str, str] | None = None

    def require(self, remedy: str = _GIVE_RUN) -> None:
        """Raise InputError if this is not the folder of a run, or if one of its files is a link."""
        self.refuse_links()
        for file in (self.config_file, self.info_file):
            if not file.is_file():
                if self.path.is_dir() and any((self.path / name).is_dir() for name in (NEW, READY)):
                    problem = "holds a run that is being replaced, or whose beginning was interrupted"
                    raise InputError(self.path, problem, "wait for it, or continue with `sehdr-warp train --resume`")
                problem = "is a file, not a run" if self.path.is_file() else "no such folder"
                problem = f"is not a run (no {file.name})" if self.path.is_dir() else problem
                if remedy == _GIVE_RUN and (inner := self._run_within()) is not None:
                    remedy = f"did you mean {inner}?"
                raise InputError(self.path, problem, remedy)

    def _run_within(self) -> Path | None:
        """Return the run in this folder whose training began last, of MOST_LISTED entries; None without one."""
        with suppress(OSError):
            configs = (entry / self.config_file.name for entry in islice(self.path.iterdir(), MOST_LISTED))
            runs = [
                config for config in configs if config.is_file() and (config.parent / self.info_file.name).is_file()
            ]
            return max(runs, key=lambda config: config.stat().st_mtime).parent if runs else None
        return None

    def refuse_links(self) -> None:
        """Raise InputError if anything of a run in this folder is a link, whose target is not the run's.

        What has the name of one of its files must be a plain file: a pipe or a device would be taken for a missing one.
        """
        files = self.config_file, self.scene_file, self.info_file, self.plan_file, self.summary_file, self.metrics
        files += self.confidence, self.extension, self.orientation, self.light_unit, self.blocks
        for path in files:
            refuse_links(path, self.path)
            has_file(path)
        for path in (self.checkpoints, self.tensorboard, *(self.path / n for n in (".lock", NEW, READY))):
            refuse_links(path, self.path)
        for folder in (*self._checkpoint_folders(), self.path / NEW, self.path / READY):
            for place, folders, names in os.walk(folder):
                for name in (*folders, *names):
                    refuse_links(Path(place, name), folder.parent)

    def _checkpoint_folders(self) -> list[Path]:
        """Return the folders with names of checkpoints, the oldest first."""
        refuse_links(self.checkpoints, self.path)
        try:
            names = sorted(name for name in os.listdir(self.checkpoints) if re.fullmatch(r"iteration_[0-9]{8}", name))
        except (FileNotFoundError, NotADirectoryError):
            return []
        except OSError as error:
            raise UnreadableError(self.checkpoints, error) from None
        return [self.checkpoints / name for name in names]

    def hashes(self) -> dict[str, str]:
        """Return hashes of the files that decide the picture beside the checkpoint, by their names.

        The place of the photos in run.json does not count.
        """
        files = (file for file in (self.config_file, self.scene_file, self.info_file) if file.is_file())
        values = {file.name: read_object(file) for file in files}
        values.get(self.info_file.name, {}).pop("data", None)
        return {
            name: hashlib.sha256(json.dumps(each, sort_keys=True).encode()).hexdigest() for name, each in values.items()
        }

    def read_config(self) -> Config:
        """Return the config of the training, with the iterations that it was extended to; see also finished_at()."""
        self.read_info()  # It names a run of another version as such.
        config = config_of_run(read_object(self.config_file), self.config_file)
        if not self.extension.is_file():
            return config
        iterations = self._extension("iterations", config.schedule.iterations)
        return override_config(config, {"schedule.iterations": iterations})

    def finished_at(self) -> int:
        """Return the iterations after which the training had finished before it was extended; 0 if it had not."""
        return self._extension("finished_at") if self.extension.is_file() else 0

    def _extension(self, name: str, least: int = 0) -> int:
        """Return a number of extension.json."""
        value = read_object(self.extension).get(name)
        if not isinstance(value, int) or value < least:
            raise InputError(self.extension, f"{name} = {value!r:.40} is not usable", REMEDY)
        return value

    def read_info(self) -> dict:
        """Return the values of run.json; see RunValues."""
        info = read_values(self.info_file, RunValues)
        try:
            Response.from_dict(info["response"])
        except SehdrError as error:
            raise InputError(self.info_file, str(error), REMEDY) from None
        return info

    def read_scene(self) -> dict:
        """Return the values of scene.json, see describe_scene()."""
        return read_values(self.scene_file, SceneValues)

    def read_cameras(self) -> tuple[CameraEntry, ...]:
        """Return the views of the scene, in its order."""
        views = self.read_scene()["views"]
        try:
            return tuple(_camera_entry(view, self.scene_file) for view in views)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise InputError(self.scene_file, f"a view is damaged ({damage(error)})", REMEDY) from None

    def check_same_scene(self, scene: Scene) -> None:
        """Raise InputError if the run was trained on other views, cameras or photos than a scene's."""
        difference = scene_difference(self.read_scene(), describe_scene(scene))
        if difference is None:
            return
        if difference.photos:
            problem = f"photos or masks were changed since the training began: {difference.what}"
            raise InputError(self.scene_file, problem, "put them back as they were, or train anew with --overwrite")
        problem = f"its {difference.what} differ from those of {scene.name}"
        remedy = "resume with the same data, --max-size and --holdout"
        remedy += ", or train anew with --overwrite if another version decided these otherwise"
        raise InputError(self.scene_file, problem, remedy)

    def read_decisions(self) -> list[dict]:
        """Return the decisions of the run's plan, see DecisionValues; none without a plan."""
        if not self.plan_file.exists():
            return []
        return read_values(self.plan_file, PlanValues, _REMOVE_FILE)["decisions"]

    def read_summary(self) -> dict:
        """Return times, memory and counts of the training, see SummaryValues; empty if it has not ended."""
        if not self.summary_file.exists():
            return {}
        return read_values(self.summary_file, SummaryValues, _REMOVE_FILE)

    def read_metrics(self) -> list[dict]:
        """Return the evaluations during the training, see MetricsValues; lines that a kill cut are left out."""
        if not self.metrics.is_file() or self.metrics.stat().st_size == 0:
            return []
        return list(read_metrics_lines(self.metrics))

    def newest_checkpoint(self, parts: tuple[str, ...] = ("",), remedy: str = _TRAIN_AGAIN) -> Checkpoint:
        """Return the newest sound checkpoint.

        Args:
            parts: Beginnings of the names of the tensors to read, as in read_checkpoint().
            remedy: What to do if there is none at all.

        Raises:
            InputError: if there is none; of the newest, if all are damaged or hold numbers that are not finite; or if a
                file that decides the picture was changed since the checkpoint was written.
        """
        newest: InputError | None = None
        for path in reversed(folders := self._checkpoint_folders()):
            try:
                checkpoint = read_checkpoint(path, parts)
            except InputError as error:
                newest = newest or error
                continue
            self._hashes = self.hashes()
            for name, value in checkpoint.values.get("run", {}).items():
                if self._hashes.get(name) != value:
                    problem = "was changed since its checkpoint was written"
                    raise InputError(self.path / name, problem, "put it back as it was, or train again")
            return checkpoint
        if folders != self._checkpoint_folders():  # A running training has written another and removed these.
            return self.newest_checkpoint(parts, remedy)
        raise newest or InputError(self.checkpoints, "holds no complete checkpoint", remedy)

    def read_evidence(self, checkpoint: Checkpoint) -> Evidence | None:
        """Return the evidence of the training photos for a checkpoint's Gaussians; None if there is none for it."""
        from safetensors import SafetensorError, safe_open

        path = self.confidence
        refuse_links(path, self.path)
        if not path.is_file():
            return None
        try:
            with safe_open(str(path), framework="pt") as file:
                metadata = json.loads((file.metadata() or {}).get("sehdr_warp", "{}"))
                if metadata != confidence_metadata(checkpoint.values["sha256"]):
                    return None
                stored = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118
            tensors = {field: stored[name] for field, name in EVIDENCE_TENSORS.items()}
        except PermissionError as error:
            raise UnreadableError(path, error) from None
        except (SafetensorError, OSError, ValueError, KeyError, RuntimeError, RecursionError) as error:
            raise InputError(path, f"is not a file of confidence ({error!s:.200})", _MAKE_AGAIN) from None
        expected = checkpoint.tensors["gaussians.means"].shape[:1]
        for name, values in tensors.items():
            if values.shape != expected:
                problem = f"{EVIDENCE_TENSORS[name]} has shape {tuple(values.shape)}, not {tuple(expected)}"
                raise InputError(path, problem, _MAKE_AGAIN)
            most = {"clipped": 1.0, "stops": _MOST_STOPS, "clipped_stops": _MOST_STOPS}.get(name, math.inf)
            if not bool(((values >= 0) & (values <= most) & values.isfinite()).all()):
                problem = f"{EVIDENCE_TENSORS[name]} holds values outside of 0 to {most:g}"
                raise InputError(path, problem, _MAKE_AGAIN)
        return Evidence(**tensors)


def confidence_metadata(checkpoint_hash: str) -> dict[str, str | int]:
    """Return the header of confidence.safetensors: its format, and the checkpoint that was measured."""
    return {"checkpoint": checkpoint_hash, "format": FORMAT}


def _camera_entry(view: dict, source: Path) -> CameraEntry:
    camera = Camera.from_dict(view["camera"])
    if camera.pixel_count > MAX_PIXELS:
        raise ValueError(f"{camera.width} x {camera.height} is more than {MAX_PIXELS} pixels")
    placed, time = None, float(view["exposure_time"])
    if values := view.get("lens"):
        lens = Lens(values["model"], values["width"], values["height"], tuple(values["params"]), source)
        placed = PlacedPhoto(values["file"], lens, camera.world_to_camera, view["split"], time)
    return CameraEntry(view["name"], view["split"], camera, time, placed)
