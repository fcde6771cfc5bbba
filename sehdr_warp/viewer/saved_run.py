"""A scene as a save renders it."""

from collections.abc import Callable
from functools import partial
from typing import Any

from .clients import Client
from .frames import ViewerScene


class SavedRun:
    """A run for a save: every picture is made on the renderer, and the save ends if its client leaves.

    Attributes:
        client: Whom the save is for.
    """

    def __init__(self, on_renderer: Callable[[Client, Callable[[], Any], int], Any], run: ViewerScene, client: Client):
        """Set the run, and what calls a function on the renderer, see Viewer.on_renderer."""
        self._on_renderer, self._run, self.client = on_renderer, run, client

    def render(self, camera: Any) -> Any:
        """Render a camera."""
        return self._on_renderer(self.client, partial(self._run.render, camera), camera.width * camera.height)

    def render_confidence(self, camera: Any) -> Any:
        """Render confidence."""
        render = partial(self._run.render_confidence, camera)
        return self._on_renderer(self.client, render, camera.width * camera.height)

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the run."""
        return getattr(self._run, name)
