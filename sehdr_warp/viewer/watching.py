"""Runs that change while they are looked at: what is newer on disk is loaded and shown."""

import logging
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ..errors import SehdrError
from .viewer_scene import ViewerScene

log = logging.getLogger(__name__)
PATIENCE = 2.0  # Seconds between looks


class Watch(threading.Thread):
    """Scenes that are loaded again when their files change.

    Once started, it looks every PATIENCE seconds whether the files have changed. A scene that cannot be read stays as
    it was, and a line says why.
    """

    def __init__(self, paths: Sequence[Path], load: Callable[[Path], Any]):
        """Load the scene at each path; `load` returns it, or raises SehdrError."""
        super().__init__(daemon=True)
        self._load, self._ended = load, threading.Event()
        self._states = [_state(path) for path in paths]  # Before they are read: what comes between is not missed.
        runs = [load(path) for path in paths]
        self.scenes = [ViewerScene(run, str(path), run.clipped_share()) for run, path in zip(runs, paths, strict=True)]

    def run(self) -> None:
        """Look for changes until stop() is called."""
        while not self._ended.wait(PATIENCE):
            self.look()

    def look(self) -> None:
        """Load again the scenes whose files have changed."""
        for index, scene in enumerate(self.scenes):
            path, last_state = Path(scene.name), self._states[index]
            self._states[index] = state = _state(path)
            if state == last_state:
                continue
            try:
                if not state:
                    raise SehdrError(f"{path}: was removed")
                run = self._load(path)
                scene.replace(run, run.clipped_share())
            except SehdrError as error:
                log.warning("%s; the viewer keeps what it has read", error)
            else:
                log.debug("%s has changed and is shown as it is now", path)

    def stop(self) -> None:
        """End the thread and wait for it."""
        self._ended.set()
        if self.is_alive():
            self.join(30)


def _state(path: Path) -> dict[Path, int]:
    """Return the files that a scene is read from with their times of change; empty if it is gone."""
    files = [path] if path.is_file() else [*path.glob("checkpoints/*/checkpoint.json"), path / "confidence.safetensors"]
    try:
        return {file: file.stat().st_mtime_ns for file in files if file.exists()}
    except OSError:  # One has gone in between.
        return {}
