"""A training as the viewer shows it: pictures are made between its steps, by the thread that trains."""

import logging
import queue
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch

from sehdr_warp.scene import Camera

from ..console import format_seconds
from ..errors import SehdrError
from .frames import Rendering
from .server import Server, Viewer

log = logging.getLogger(__name__)

SHARE = 0.1
"""Of the time goes to pictures, at most."""
CURVE_EVERY = 0.5  # Seconds between points of the curves: each reads the loss from the device
MOST_POINTS = 500
_WAIT = 0.05


class LiveTraining(Rendering):
    """A Training, as the one run of a Viewer and its `training`.

    attend() gives the training's steps on; between them pictures are made that browsers wait for, for at most SHARE of
    the time, and no longer than that at a stretch but where one picture takes longer. Nothing is computed that the
    training would read: its result is that without a viewer.
    """

    def __init__(self, training: Any, name: str):
        super().__init__(training, name)
        self.paused = self.ended = False
        self._thread: threading.Thread | None = None
        self._steps = 0
        self._asked: queue.Queue[_Picture] = queue.Queue()
        self._credit = self._spent = 0.0
        self._curve: list[tuple] = []
        self._told: dict[str, Any] = {}

    def __getattr__(self, name: str):
        field = self.run.trainer.field
        known = {"response": field.response, "base_time": field.base_time, "gaussian_count": field.gaussians.count}
        known |= {"scene_name": self.run.scene.name, "iterations": self.run.iteration, "cameras": self.run.scene.views}
        known |= {"color_matrix": self.run.scene.color_matrix}
        if name not in known:
            raise AttributeError(name)
        return known[name]

    def render(self, camera: Camera):
        return self._between_steps(lambda: self.run.render(camera))

    def frame(self, camera: Camera, *, draft: bool = False, clipped: bool = False) -> memoryview:
        return self._between_steps(lambda: super(LiveTraining, self).frame(camera, draft=draft, clipped=clipped))

    def _between_steps(self, make: Callable[[], Any]) -> Any:
        """What `make` gives. A browser's thread waits until the training has made it, in the time for pictures."""
        if threading.current_thread() is self._thread:
            return make()
        picture = _Picture(make)
        self._asked.put(picture)
        while not picture.made.wait(_WAIT):
            if self.ended:
                raise SehdrError("the training has ended; `sehdr-warp view` shows the run")
        if picture.error is not None:
            raise picture.error
        return picture.result

    def render_confidence(self, camera: Camera) -> None:
        """Nothing yet: it is measured at the end."""

    def control(self, what: str) -> None:
        """pause, resume, or step: one step, then a pause."""
        if what not in ("pause", "resume", "step"):
            raise ValueError(f"{what!r} is none of pause, resume, step")
        self.paused = what != "resume"
        self._steps += what == "step"

    def told(self) -> dict[str, Any]:
        """What the page shows of the training: plain values."""
        return self._told | {"paused": self.paused, "ended": self.ended, "curve": list(self._curve)}

    def attend(self) -> Iterator[Any]:
        """The steps of the training, with pictures made in between."""
        started, last = time.perf_counter(), 0.0
        self._thread = threading.current_thread()
        try:
            before = time.perf_counter()
            for step in self.run:
                now = time.perf_counter()
                # Saved up while nobody looked, it would be a standstill when somebody does.
                self._credit = min(self._credit + SHARE / (1 - SHARE) * (now - before), SHARE)
                if now - last > CURVE_EVERY or step.iteration == step.total or self.paused:
                    last = now
                    self._tell(step, now - started)
                yield step
                self._serve()
                before = time.perf_counter()
        finally:
            self.ended, self._thread = True, None

    def _serve(self) -> None:
        while self._credit > 0 and not self._asked.empty():
            self._make(self._asked.get())
        while self.paused and not self.run.ending:
            if self._steps:
                self._steps -= 1
                return
            self.run.pause()
            try:
                self._make(self._asked.get(timeout=_WAIT))
            except queue.Empty:
                continue

    def _make(self, picture: "_Picture") -> None:
        started = time.perf_counter()
        picture.make()
        taken = time.perf_counter() - started
        if not self.paused:
            self._spent += taken
            self._credit -= taken

    def _tell(self, step: Any, elapsed: float) -> None:
        figures = {"loss": step.loss, "psnr": step.psnr, "gaussians": step.gaussians}
        self._curve.append((step.iteration, *figures.values()))
        if len(self._curve) > MOST_POINTS:
            self._curve = self._curve[::2]
        left = None if step.seconds_left is None else format_seconds(step.seconds_left)
        share = self._spent / max(elapsed, 1e-9)
        self._told = {"iteration": step.iteration, "total": step.total, "left": left, "share": share} | figures


class _Picture:
    """Something to be computed by another thread."""

    def __init__(self, function: Callable[[], Any]):
        self.function, self.made = function, threading.Event()
        self.result: Any = None
        self.error: Exception | None = None

    def make(self) -> None:
        try:
            with torch.no_grad():
                self.result = self.function()
        except Exception as error:  # noqa: BLE001  It is raised where it was asked for.
            self.error = error
        self.made.set()


@contextmanager
def viewed(training: Any, name: str) -> Iterator[Iterator]:
    """The steps of a Training, while a server shows it."""
    live = LiveTraining(training, name)
    photos = {view.name: view for view in training.scene.views}
    with Server(Viewer([live], lambda index: photos, live)) as server:
        log.info("%s shows the training", server.url)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield live.attend()
        finally:
            live.ended = True
            server.shutdown()
