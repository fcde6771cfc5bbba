"""The folder of a training: every name in it, and all that writes and reads it.

config.json                 the Config
scene.json                  cameras of all views, splits, exposure times, names: enough to render without the photos
run.json                    response, base exposure time, version, where the photos were
plan.json                   what was left out and why, where a plan was made
metrics.jsonl               one line for each evaluation
checkpoints/iteration_N/    tensors as safetensors, values as JSON with the hash of the tensors
confidence.safetensors      how far the photos vouch for each Gaussian, and of which checkpoint
summary.json                times, memory and counts, when the training ended

A checkpoint is written beside its final place, flushed to the disk and renamed: what a killed process left is never
mistaken for one. So is a new run, with a checkpoint of its start, before it takes the place of another. A checkpoint
holds the hashes of what else decides the picture. Only names of this list are ever replaced. Nothing is pickled.
"""

import hashlib
import json
import math
import os
import re
import shutil
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock, Timeout
from torch import Tensor

from ..errors import InputError, SehdrError
from ..files import atomic_folder, atomic_path, make_parents, read_json, remove_stale, write_json, writing
from ..model.confidence import Evidence
from ..model.radiance_field import RadianceField
from ..response import Response
from ..scene import Camera, Scene
from ..scene.exposure_compensation import ExposureCompensation
from ..scene.images import MAX_PIXELS
from .checkpoint import (
    FORMAT,
    REMEDY,
    TENSORS,
    VALUES,
    Checkpoint,
    RunValues,
    read_checkpoint,
    read_run_json,
    read_values,
    remove_checkpoint,
)
from .config import Config
from .config_files import config_from_dict

_LOCK, _NEW, _READY = ".lock", ".new", ".ready"
_OWN = "choose another folder, or remove this one yourself"
_GIVE_RUN = "give the folder that `sehdr-warp train --out` wrote"


@dataclass(frozen=True)
class CameraEntry:
    """A view of the scene a run was trained on. exposure_time: seconds; split: "train" or "test"."""

    name: str
    split: str
    camera: Camera
    exposure_time: float


class RunFolder:
    """The files of one training at a path, read and made when asked for. What cannot be read is an InputError with the
    file, and the field where there is one; what cannot be written an SehdrError."""

    def __init__(self, path: Path | str):
        self.path = Path(path)
        self.config, self.scene, self.info, self.plan, self.summary = (
            self.path / f"{name}.json" for name in ("config", "scene", "run", "plan", "summary")
        )
        self.metrics = self.path / "metrics.jsonl"
        self.checkpoints = self.path / "checkpoints"
        self.confidence = self.path / "confidence.safetensors"
        self.tensorboard = self.path / "tensorboard"
        self._lock = FileLock(self.path / _LOCK, thread_local=False)
        self._hashes: dict[str, str] | None = None

    def lock(self) -> None:
        """Keeps the folder, made where it is missing, for one training until unlock() or the end of the process; raises
        InputError where another training has it."""
        if self._lock.is_locked:
            return
        with writing(self.path):
            make_parents(self._lock_file)
            try:
                self._lock.acquire(timeout=0)
            except Timeout:
                problem = "another training is at work in it"
                raise InputError(self.path, problem, "wait for its end, or choose another folder") from None

    def unlock(self) -> None:
        """Lets go of the folder, which goes where no run was begun in it."""
        if self._lock.is_locked:
            self._lock.release()
            with suppress(OSError):
                if self._is_empty():
                    self._lock_file.unlink()
                    self.path.rmdir()

    def check(self, *, resume: bool, overwrite: bool) -> bool:
        """Whether there is a run to continue; raises InputError for what is there and no run of ours, not asked for, or
        being trained."""
        if self.path.exists() and not self.path.is_dir():
            raise InputError(self.path, "is a file", "choose another folder for the run")
        remove_stale(self.config)
        if not self.path.exists() or self._is_empty():
            if resume:
                raise InputError(self.path, "holds nothing to resume", "leave --resume out to begin a training")
            return False
        if not resume and not overwrite:
            raise InputError(self.path, "exists and is not empty", "choose another, or use --resume or --overwrite")
        self.require(_GIVE_RUN if resume else "choose another folder for the run; --overwrite replaces runs alone")
        if self.checkpoints.is_symlink():
            raise InputError(self.checkpoints, "is a link, and what it leads to is not replaced", _OWN)
        if not {"format", "base_time", "response"} <= read_run_json(self.info, _OWN).keys():
            raise InputError(self.info, "is not that of a run of sehdr-warp", _OWN)
        if not self._lock.is_locked:
            self.lock()
            self.unlock()
        return resume

    def require(self, remedy: str = _GIVE_RUN) -> None:
        """Raises InputError if this is not the folder of a training; finishes what a killed process had begun."""
        if any((self.path / name).is_dir() for name in (_NEW, _READY)):
            held = self._lock.is_locked
            with suppress(InputError):  # Whoever has the lock does it.
                self.lock()
                self._settle()
            if not held:
                self.unlock()
        for file in (self.config, self.info):
            if not file.is_file():
                problem = "is a file, not a run" if self.path.is_file() else "no such folder"
                problem = f"is not a run (no {file.name})" if self.path.is_dir() else problem
                raise InputError(self.path, problem, remedy)

    def begin(
        self,
        scene: Scene,
        config: Config,
        field: RadianceField,
        data: dict,
        plan: dict | None,
        state: tuple[dict[str, Tensor], dict],
        *,
        gains: ExposureCompensation | None = None,
        overwrite: bool = False,
    ) -> None:
        """Makes the folder, locked, with all that does not change and a checkpoint of the start. All of it is there
        before anything of a run to be overwritten goes."""
        from .. import __version__

        self.lock()
        self.check(resume=False, overwrite=overwrite)  # Photos were read since.
        info = {"format": FORMAT, "version": __version__, "scene": scene.name, "data": data}
        info |= {"base_time": field.base_time, "response": field.response.to_dict()}
        info["normalization"] = field.normalization.to_dict()
        if scene.color_matrix is not None:
            info["color_matrix"] = scene.color_matrix.tolist()
        if gains is not None:
            info["photo_gains"] = gains.to_dict()
        with atomic_folder(self.path / _NEW, ours=True) as beside:
            new = RunFolder(beside)
            if plan is not None:
                write_json(new.plan, plan)
            write_json(new.scene, describe_scene(scene))
            write_json(new.info, info)
            write_json(new.config, config.model_dump())
            new.write_checkpoint(*state, kept=1)
        self._settle()
        self._hashes = new._hashes

    def _settle(self) -> None:
        """Puts a new run that is whole in the place of the one before; each step can be done again after a kill."""
        new, ready = self.path / _NEW, self.path / _READY
        with writing(self.path):
            if new.is_dir():
                for name in ("summary", "metrics", "confidence", "plan", "scene", "info", "config"):
                    getattr(self, name).unlink(missing_ok=True)
                for checkpoint in self._found_checkpoints():
                    remove_checkpoint(checkpoint)
                os.rename(new, ready)
            if ready.is_dir():
                self.checkpoints.mkdir(exist_ok=True)
                for part in (*ready.glob("checkpoints/*"), *(path for path in ready.iterdir() if path.is_file())):
                    os.replace(part, self.path / part.relative_to(ready))
                shutil.rmtree(ready)

    @property
    def _lock_file(self) -> Path:
        return self.path / _LOCK

    def _is_empty(self) -> bool:
        return not {path.name for path in self.path.iterdir()} - {_LOCK}

    def _found_checkpoints(self) -> list[Path]:
        """The folders with names of checkpoints, the oldest first."""
        found = (path for path in self.checkpoints.glob("iteration_*") if re.fullmatch(r"iteration_\d{8}", path.name))
        return sorted(found)

    def hashes(self) -> dict[str, str]:
        """Of the values in the files that decide the picture beside the checkpoint; run.json's place of the photos is
        none of them."""
        values = {file.name: read_run_json(file) for file in (self.config, self.scene, self.info) if file.is_file()}
        values.get(self.info.name, {}).pop("data", None)
        return {
            name: hashlib.sha256(json.dumps(each, sort_keys=True).encode()).hexdigest() for name, each in values.items()
        }

    def read_config(self) -> Config:
        """The config of the training."""
        self.read_info()
        return config_from_dict(read_run_json(self.config), self.config)

    def read_info(self) -> dict:
        """What run.json holds; InputError also for a run of another version's format."""
        info = read_values(self.info, RunValues)
        try:
            Response.from_dict(info["response"])
        except SehdrError as error:
            raise InputError(self.info, str(error), REMEDY) from None
        return info

    def read_cameras(self) -> tuple[CameraEntry, ...]:
        """The views in scene.json."""
        try:
            return tuple(_camera_entry(view) for view in read_run_json(self.scene)["views"])
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise InputError(self.scene, f"a view is damaged ({error!r:.200})", REMEDY) from None

    def check_same_scene(self, scene: Scene) -> None:
        """Raises InputError if the run was trained on another scene than this one."""
        saved, given = read_run_json(self.scene), json.loads(json.dumps(describe_scene(scene)))
        for name in ("layout", "views"):
            if saved.get(name) != given[name]:
                problem = f"its {name} differ from those of {scene.name}"
                raise InputError(self.scene, problem, "resume with the same data, --max-size and --holdout")

    def read_decisions(self) -> list[dict]:
        """The decisions of the run's plan, as Plan.to_dict gave them; none without a plan, or where it is damaged."""
        try:
            decisions = read_json(self.plan)["decisions"]
            told = ("name", "choice", "reason")
            return [{name: d[name] for name in told} | {"fields": dict(d["fields"])} for d in decisions]
        except (InputError, ValueError, KeyError, TypeError):
            return []

    def read_summary(self) -> dict:
        """Times, memory and counts of the training; empty if it has not ended."""
        return read_run_json(self.summary) if self.summary.exists() else {}

    def write_summary(self, values: dict) -> None:
        write_json(self.summary, values, ours=True)

    def append_metrics(self, line: dict) -> None:
        with writing(self.metrics), open(self.metrics, "a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def read_metrics(self) -> list[dict]:
        """The lines of metrics.jsonl; what a killed process left half-written is passed over."""
        lines = []
        text = self.metrics.read_text(encoding="utf-8", errors="replace") if self.metrics.is_file() else ""
        for line in text.splitlines():
            with suppress(ValueError, RecursionError, TypeError, KeyError, AttributeError, OverflowError):
                values = json.loads(line)
                figures = [values.get(name, 0.0) for name in ("seconds", "psnr_ldr", "psnr_mu", "gaussians")]
                if type(values["iteration"]) is int and all(map(math.isfinite, figures)):
                    lines.append(values)
        return lines

    def rewind_metrics(self, iteration: int) -> None:
        """Drops the evaluations after an iteration: a resumed training makes them again."""
        kept = [line for line in self.read_metrics() if line["iteration"] <= iteration]
        with atomic_path(self.metrics, ours=True) as beside:
            beside.write_text("".join(json.dumps(line) + "\n" for line in kept), encoding="utf-8")

    def write_checkpoint(self, tensors: dict[str, Tensor], values: dict, *, kept: int) -> Path:
        """Writes iteration_N from a state with the value "iteration", unless it is there and sound; then deletes all
        but the newest `kept`, and later ones: a training that is at N was resumed because they are damaged."""
        from safetensors.torch import save

        final = self.checkpoints / f"iteration_{values['iteration']:08d}"
        try:
            read_checkpoint(final)
        except InputError:
            self._hashes = self._hashes or self.hashes()
            data = save({name: value.detach().cpu().contiguous() for name, value in tensors.items()})
            stated = values | {"format": FORMAT, "sha256": hashlib.sha256(data).hexdigest(), "run": self._hashes}
            remove_checkpoint(final)
            with atomic_folder(final, ours=True) as beside:
                (beside / TENSORS).write_bytes(data)
                (beside / VALUES).write_text(json.dumps(stated, indent=1) + "\n", encoding="utf-8")
        folders = self._found_checkpoints()
        end = folders.index(final) + 1
        for other in folders[: max(0, end - kept)] + folders[end:]:
            remove_checkpoint(other)
        return final

    def newest_checkpoint(self) -> Checkpoint | None:
        """The newest sound checkpoint, None if there is none at all; where all are damaged, or hold numbers that are
        not finite, the newest one's InputError is raised, and one where the files beside it were changed since."""
        newest: InputError | None = None
        for path in reversed(found := self._found_checkpoints()):
            try:
                checkpoint = read_checkpoint(path)
            except InputError as error:
                newest = newest or error
                continue
            self._hashes = self.hashes()
            for name, value in checkpoint.values.get("run", {}).items():
                if self._hashes.get(name) != value:
                    problem = "was changed since its checkpoint was written"
                    raise InputError(self.path / name, problem, "put it back as it was, or train again")
            return checkpoint
        if found != self._found_checkpoints():  # A training that runs has written another and removed these.
            return self.newest_checkpoint()
        if newest is not None:
            raise newest
        return None

    def write_confidence(self, evidence: Evidence, checkpoint_hash: str) -> None:
        """Writes the evidence, in place of an earlier one."""
        from safetensors.torch import save

        tensors = {**vars(evidence), "confidence": evidence.confidence()}
        stated = {"format": str(FORMAT), "checkpoint": checkpoint_hash}
        data = save({name: value.float().cpu().contiguous() for name, value in tensors.items()}, stated)
        with atomic_path(self.confidence, ours=True) as beside:
            beside.write_bytes(data)

    def read_confidence(self, checkpoint: Checkpoint) -> Tensor | None:
        """[N] in [0, 1] of a checkpoint's Gaussians; None where there is none, or one of another checkpoint."""
        from safetensors import SafetensorError, safe_open

        path = self.confidence
        if not path.is_file():
            return None
        remedy = "remove this file; `sehdr-warp report` makes it again from the photos"
        try:
            with safe_open(str(path), framework="pt") as file:
                stated = file.metadata() or {}
                if stated.get("format") != str(FORMAT) or stated.get("checkpoint") != checkpoint.values["sha256"]:
                    return None
                confidence = file.get_tensor("confidence")
        except (SafetensorError, OSError, ValueError, KeyError, RuntimeError) as error:
            raise InputError(path, f"not safetensors ({error!s:.200})", remedy) from None
        expected = checkpoint.tensors["gaussians.means"].shape[:1]
        if confidence.shape != expected:
            raise InputError(path, f"confidence has shape {tuple(confidence.shape)}, not {tuple(expected)}", remedy)
        if not bool(((confidence >= 0) & (confidence <= 1)).all()):  # as NaN is not
            raise InputError(path, "confidence holds values outside of 0 to 1", remedy)
        return confidence.float()

    def read_clipped(self) -> Tensor | None:
        """[N] the share of clipped values, beside the confidence that was read; None where there is none."""
        from safetensors import SafetensorError, safe_open

        with suppress(SafetensorError, OSError), safe_open(str(self.confidence), framework="pt") as file:
            return file.get_tensor("clipped")
        return None


def describe_scene(scene: Scene) -> dict:
    """What scene.json holds."""
    views = [
        {name: getattr(view, name) for name in ("name", "split", "exposure_time")}
        | {"camera": view.camera.to_dict(), "has_hdr": view.hdr is not None}
        for view in scene.views
    ]
    known = {"exposure_times_known": scene.exposure_times_known, "notes": list(scene.notes)}
    return {"format": FORMAT, "name": scene.name, "layout": scene.format, **known, "views": views}


def _camera_entry(view: dict) -> CameraEntry:
    camera, time = Camera.from_dict(view["camera"]), float(view["exposure_time"])
    if camera.width * camera.height > MAX_PIXELS:
        raise ValueError(f"{camera.width} x {camera.height} is more than {MAX_PIXELS} pixels")
    if not (math.isfinite(time) and time > 0):
        raise ValueError(f"exposure_time = {time} is not a positive number of seconds")
    return CameraEntry(str(view["name"]), str(view["split"]), camera, time)
