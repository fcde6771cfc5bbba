"""A training as the viewer shows it: pictures are made between its steps, by the thread that trains."""

import logging
import math
import queue
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager
from typing import Any

import torch

from ..errors import SehdrError
from ..progress import format_seconds
from ..scene import Camera
from .server import Server, Viewer
from .viewer_scene import ViewerScene

log = logging.getLogger(__name__)

SHARE = 0.1  # Of the time goes to pictures, at most
CURVE_EVERY = 0.5  # Seconds between points of the curves: each reads the loss from the device
MOST_POINTS = 500
_WAIT = 0.05


class LiveTraining(ViewerScene):
    """A Trainer, as the one scene of a Viewer and its `training`.

    attend() passes on the training's steps. Between them it renders pictures that browsers wait for, for at most SHARE
    of the time, and no longer than that at a stretch unless one picture takes longer. Nothing the training reads is
    changed: its result is the same as without a viewer.

    Attributes:
        paused: Whether the training waits.
        ended: Whether it is over.
        picture_seconds: Time that pictures took while it was not paused.
    """

    def __init__(self, training: Any, name: str):
        """Show a Trainer under a name."""
        super().__init__(training, name)
        self.paused = self.ended = False
        self._thread: threading.Thread | None = None
        self._steps = 0
        self._requests: queue.Queue[Callable[[], None]] = queue.Queue()
        self._credit = self.picture_seconds = 0.0
        self._curve: list[tuple] = []
        self._progress: dict[str, Any] = {}

    def __getattr__(self, name: str):
        """Return what the viewer reads of a run from the training."""
        field, scene = self.run.field, self.run.scene
        attributes = {"response": field.response, "base_time": field.base_time, "gaussian_count": field.gaussians.count}
        attributes |= {"scene_name": scene.name, "iterations": self.run.iteration, "cameras": scene.views}
        attributes |= {"color_matrix": scene.color_matrix, "world_matrix": None, "reference": None, "up": None}
        if name not in attributes:
            raise AttributeError(name)
        return attributes[name]

    def render(self, camera: Camera, **options: Any):
        """Render between two steps; options change nothing, because a scene under training is never averaged."""
        return self._between_steps(lambda: self.run.render(camera))

    def frame_parts(self, camera: Camera, *, draft: bool = False, clipped: bool = False) -> Iterator[memoryview]:
        """Yield a frame in one part between two steps, since the training goes on between two parts."""
        parts = super().frame_parts(camera, draft=draft, clipped=clipped)
        yield self._between_steps(lambda: [*parts][-1])

    def _between_steps(self, make: Callable[[], Any]) -> Any:
        """Call `make` in the training's thread and return its result; other threads wait for it."""
        if threading.current_thread() is self._thread:
            return make()
        picture: Future[Any] = Future()

        def answer() -> None:
            try:
                with torch.no_grad():
                    picture.set_result(make())
            except Exception as error:  # noqa: BLE001  It is raised where the picture was asked for.
                picture.set_exception(error)

        self._requests.put(answer)
        while not wait([picture], _WAIT).done:
            if self.ended:
                raise SehdrError("the training has ended; `sehdr-warp view` shows the run")
        return picture.result()

    def render_confidence(self, camera: Camera) -> None:
        """Return None: confidence is measured at the end of a training."""

    def control(self, what: str) -> None:
        """Pause, resume, or make one step and then pause."""
        if what not in ("pause", "resume", "step"):
            raise ValueError(f"{what!r} is not one of pause, resume, step")
        self.paused = what != "resume"
        self._steps += what == "step"

    def progress(self) -> dict[str, Any]:
        """Return what the page shows of the training, as plain values."""
        return self._progress | {"paused": self.paused, "ended": self.ended, "curve": list(self._curve)}

    def attend(self) -> Iterator[Any]:
        """Yield the steps of the training, and render pictures in between."""
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
        while self._credit > 0 and not self._requests.empty():
            self._make(self._requests.get())
        while self.paused and not self.run.ending:
            if self._steps:
                self._steps -= 1
                return
            self.run.keep_ranks_waiting()
            try:
                self._make(self._requests.get(timeout=_WAIT))
            except queue.Empty:
                continue

    def _make(self, answer: Callable[[], None]) -> None:
        started = time.perf_counter()
        answer()
        duration = time.perf_counter() - started
        if not self.paused:
            self.picture_seconds += duration
            self._credit -= duration

    def _tell(self, step: Any, elapsed: float) -> None:
        figures = {"loss": step.loss, "psnr": step.psnr, "gaussians": step.gaussians}
        # JSON has no NaN: a loss may be it, and the PSNR of a photo that its mask excludes.
        figures = {key: value if math.isfinite(value) else None for key, value in figures.items()}
        self._curve.append((step.iteration, *figures.values()))
        if len(self._curve) > MOST_POINTS:
            self._curve = self._curve[::2]
        remaining = None if step.seconds_left is None else format_seconds(step.seconds_left)
        share = self.picture_seconds / max(elapsed, 1e-9)
        self._progress = {"iteration": step.iteration, "total": step.total, "left": remaining, "share": share} | figures


@contextmanager
def serve_training(training: Any, name: str) -> Iterator[Iterator]:
    """Serve a page that shows a training while its steps are made; the context is an iterator of the steps."""
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
