"""The folder of a run, as one training writes it.

A checkpoint is written beside its final place, flushed to the disk and renamed, so what a killed process leaves is
never mistaken for one. A new run, too, is complete with a checkpoint of its start before it replaces another. Only the
names that RunFolder lists are ever replaced, only by the training that holds the lock, and never through a link.
"""

import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout
from torch import Tensor

from ..errors import InputError, SehdrError
from ..files import atomic_folder, atomic_path, make_parents, remove_stale, require_text, write_json, writing
from ..model.confidence import Evidence
from ..model.radiance_field import RadianceField
from ..scene import Scene
from ..scene.exposure.compensation import ExposureCompensation
from ..scene.gravity import find_up
from .checkpoint import TENSORS, VALUES, Checkpoint, read_checkpoint, remove_checkpoint
from .config import Config
from .run_folder import EVIDENCE_TENSORS, NEW, READY, RunFolder, confidence_metadata
from .scene_description import describe_scene
from .values import FORMAT, LoadArguments, read_object, require_readable

_LOCK = ".lock"
_NEW_NAMES = re.compile(
    r"(config|scene|run|plan)\.json|checkpoints(/iteration_[0-9]{8}(/(state\.safetensors|checkpoint\.json))?)?"
)
"""Contents of a new run before it takes its place."""
_CHOOSE_OTHER = "choose another folder, or remove this one yourself"


class RunWriter(RunFolder):
    """The files of a run, which this process writes.

    Raises what RunFolder does, and SehdrError for what cannot be written.

    Attributes:
        checkpoint_hash: Of the tensors of the checkpoint that this process wrote last; None before.
    """

    def __init__(self, path: Path | str):
        """Name the files of a run; lock() and begin() create them."""
        super().__init__(path)
        self._lock = FileLock(self.path / _LOCK, thread_local=False)
        self._lock_identity: tuple[int, int] | None = None
        self.checkpoint_hash: str | None = None

    def lock(self) -> None:
        """Lock the folder, which is made if it is missing, until unlock() or the end of the process.

        Raises InputError if another training holds the lock.
        """
        if self._lock.is_locked:
            return
        file = self.path / _LOCK
        self.refuse_links()
        with writing(self.path):
            make_parents(file)
            try:
                self._lock.acquire(timeout=0)
            except Timeout:
                problem = "another training is at work in it"
                raise InputError(self.path, problem, "wait for its end, or choose another folder") from None
            self._lock_identity = _identity(file)

    def unlock(self) -> None:
        """Release the lock, and remove the folder if no run was begun in it."""
        if self._lock.is_locked:
            self._lock.release()
            with suppress(OSError):
                if self._is_empty():
                    (self.path / _LOCK).unlink()
                    self.path.rmdir()

    def check_start(self, *, resume: bool, overwrite: bool) -> bool:
        """Check that a training may start here, and return whether it continues a run.

        A run that a killed training had begun to replace is replaced first.

        Raises InputError if the folder holds something other than a run, if neither resume nor overwrite was asked
        for, or if another training is at work in it.
        """
        if self.path.exists() and not self.path.is_dir():
            raise InputError(self.path, "is a file", "choose another folder for the run")
        require_text(self.path)
        self.refuse_links()
        remove_stale(self.config_file)
        if not self.path.exists() or self._is_empty():
            place = next(place for place in (self.path, *self.path.absolute().parents) if place.exists())
            if not os.access(place, os.W_OK):
                problem = f"cannot be written, because {place} is read-only or belongs to others"
                raise InputError(self.path, problem, "choose another folder for the run")
            return False
        if not resume and not overwrite:
            raise InputError(self.path, "exists and is not empty", "choose another, or use --resume or --overwrite")
        if any((self.path / name).is_dir() for name in (NEW, READY)):
            with self._lock_held():
                self._finish_replacement()
        if resume:
            self.require()
        else:
            self.require("choose another folder for the run; --overwrite replaces runs alone")
        info = read_object(self.info_file, _CHOOSE_OTHER)
        if not {"format", "base_time", "response"} <= info.keys():
            raise InputError(self.info_file, "is not that of a run of sehdr-warp", _CHOOSE_OTHER)
        with self._lock_held():  # Only to see that no other training holds it.
            return resume

    @contextmanager
    def _lock_held(self) -> Iterator[None]:
        """Hold the lock within the block, and release it if it was not held before."""
        had_lock = self._lock.is_locked
        self.lock()
        try:
            yield
        finally:
            if not had_lock:
                self.unlock()

    def begin(
        self,
        scene: Scene,
        config: Config,
        field: RadianceField,
        data: LoadArguments,
        plan: dict | None,
        state: Checkpoint,
        *,
        compensation: ExposureCompensation | None = None,
        overwrite: bool = False,
    ) -> None:
        """Lock the folder and write all that does not change during the training, and a checkpoint of the start.

        All of it is on the disk before anything of a run to be overwritten is removed.
        """
        for name in (scene.name, data.get("path") or "", *(view.name for view in scene.views)):
            require_text(name)
        require_readable(data)
        self.lock()
        self.check_start(resume=False, overwrite=overwrite)  # Another training may have begun here meanwhile.
        info = {"scene": scene.name, "data": data}
        info |= {"base_time": field.base_time, "response": field.response.to_dict()}
        info["normalization"] = field.normalization.to_dict()
        if scene.color_matrix is not None:
            info["color_matrix"] = scene.color_matrix.tolist()
        if compensation is not None:
            info["exposure_compensation"] = compensation.to_dict()
        info["up"] = find_up(scene).to_dict()
        self.replace_run(describe_scene(scene), info, config, plan, state)

    def replace_run(self, scene: dict, info: dict, config: Config, plan: dict | None, state: Checkpoint) -> None:
        """Write the files of a new run in the locked folder, in place of those of an earlier one.

        `scene` is as from describe_scene(), `info` for run.json without format and version, `plan` for plan.json;
        `state` is the first checkpoint.
        """
        from .. import __version__

        info = {"format": FORMAT, "version": __version__} | info
        with atomic_folder(self.path / NEW, internal=True) as beside:
            new = RunWriter(beside)
            if plan is not None:
                write_json(new.plan_file, plan)
            write_json(new.scene_file, scene)
            write_json(new.info_file, info)
            write_json(new.config_file, config.model_dump())
            new.write_checkpoint(state.tensors, state.values, keep=1)
        self._finish_replacement()
        self._hashes, self.checkpoint_hash = new._hashes, new.checkpoint_hash

    def _finish_replacement(self) -> None:
        """Replace the run by a new one that is complete. Each step can be repeated after a kill."""
        new, ready = self.path / NEW, self.path / READY
        self._check_lock()
        for folder in (new, ready):
            _refuse_foreign(folder)
        with writing(self.path):
            if new.is_dir():
                files = [self.summary_file, self.metrics, self.confidence, self.plan_file]
                files += [self.extension, self.orientation, self.light_unit]
                files += self.tensorboard.glob("events.out.tfevents.*")  # TensorBoard would mix their curves.
                files += [self.scene_file, self.info_file, self.config_file]
                for file in files:
                    file.unlink(missing_ok=True)
                for checkpoint in self._checkpoint_folders():
                    remove_checkpoint(checkpoint)
                os.rename(new, ready)
            if ready.is_dir():
                self.checkpoints.mkdir(exist_ok=True)
                for part in (*ready.glob("checkpoints/*"), *(path for path in ready.iterdir() if path.is_file())):
                    os.replace(part, self.path / part.relative_to(ready))
                shutil.rmtree(ready)

    def _check_lock(self) -> None:
        """Raise SehdrError if the lock file was removed or replaced: another training may be at work here by now."""
        if self._lock.is_locked and _identity(self.path / _LOCK) != self._lock_identity:
            raise SehdrError(
                f"{self.path / _LOCK}: was removed during the training, and another may have begun here; nothing more "
                "is written; train again in a folder of its own"
            )

    def _is_empty(self) -> bool:
        return not {path.name for path in self.path.iterdir()} - {_LOCK}

    def extend(self, iterations: int, finished_at: int) -> None:
        """Set more iterations for a training that goes on; its config and checkpoints stay as they are.

        finished_at: as RunFolder.finished_at() will return it.
        """
        self._check_lock()
        write_json(self.extension, {"iterations": iterations, "finished_at": finished_at}, internal=True)

    def set_photo_path(self, path: str) -> None:
        """Write where the photos are now, if they have moved since the training began."""
        info = read_object(self.info_file)
        if info["data"].get("path") != path:
            self._check_lock()
            write_json(self.info_file, info | {"data": info["data"] | {"path": path}}, internal=True)

    def write_summary(self, values: dict) -> None:
        """Write times, memory and counts of the training; see SummaryValues."""
        self._check_lock()
        write_json(self.summary_file, values, internal=True)

    def append_metrics(self, line: dict) -> None:
        """Add the figures of an evaluation; see MetricsValues."""
        self._check_lock()
        with writing(self.metrics), open(self.metrics, "a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    def rewind_metrics(self, iteration: int) -> None:
        """Remove the evaluations after an iteration, because a resumed training makes them again."""
        self._check_lock()
        lines = [line for line in self.read_metrics() if line["iteration"] <= iteration]
        with atomic_path(self.metrics, internal=True) as beside:
            beside.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")

    def write_checkpoint(self, tensors: dict[str, Tensor], values: dict, *, keep: int) -> Path:
        """Write the checkpoint of a state unless it is there and sound; return its folder.

        Deletes all but the newest `keep`, and those of later iterations, which were damaged if a training goes on from
        this one. values: plain values, with the "iteration".
        """
        from safetensors.torch import save

        self._check_lock()
        final = self.checkpoints / f"iteration_{values['iteration']:08d}"
        try:
            self.checkpoint_hash = read_checkpoint(final).values["sha256"]  # It is there and sound.
        except InputError:
            self._hashes = self._hashes or self.hashes()
            data = save({name: value.detach().cpu().contiguous() for name, value in tensors.items()})
            self.checkpoint_hash = hashlib.sha256(data).hexdigest()
            plain = values | {"format": FORMAT, "sha256": self.checkpoint_hash, "run": self._hashes}
            remove_checkpoint(final)
            with atomic_folder(final, internal=True) as beside:
                (beside / TENSORS).write_bytes(data)
                (beside / VALUES).write_text(json.dumps(plain, indent=1) + "\n", encoding="utf-8")
        folders = self._checkpoint_folders()
        end = folders.index(final) + 1
        for other in folders[: max(0, end - keep)] + folders[end:]:
            remove_checkpoint(other)
        return final


def write_confidence(folder: RunFolder, evidence: Evidence, checkpoint_hash: str) -> None:
    """Write the evidence for a checkpoint's Gaussians, which decides their confidence, in place of an earlier one.

    Not only a training does: a report measures what a run lacks, once it has the photos.
    """
    from safetensors.torch import save

    folder.refuse_links()
    tensors = {name: getattr(evidence, field) for field, name in EVIDENCE_TENSORS.items()}
    # One key: safetensors writes several in any order, and the same run is to give the same file.
    metadata = {"sehdr_warp": json.dumps(confidence_metadata(checkpoint_hash), sort_keys=True)}
    data = save({name: value.float().cpu().contiguous() for name, value in tensors.items()}, metadata)
    with atomic_path(folder.confidence, internal=True) as beside:
        beside.write_bytes(data)


def _refuse_foreign(folder: Path) -> None:
    """Raise InputError if a folder with the name of a new run holds something that a training does not write."""
    for path in sorted(folder.rglob("*")):
        if not _NEW_NAMES.fullmatch(path.relative_to(folder).as_posix()):
            raise InputError(path, "lies in the folder of a new run, but is no file of a run", "move it away")


def _identity(file: Path) -> tuple[int, int] | None:
    """Return device and inode of a file, None if it is missing."""
    try:
        status = os.stat(file, follow_symlinks=False)
    except OSError:
        return None
    return status.st_dev, status.st_ino
