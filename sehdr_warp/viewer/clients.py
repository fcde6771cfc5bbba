"""Requests of clients: their paths, refusals, and a run while files of it are saved for a client."""

import ipaddress
import re
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from ..json_values import description_of, json_list, whole_number
from ..output.cameras.paths import interpolate
from ..scene import Camera
from .connections import Connection
from .viewer_scene import ViewerScene, camera_of

MOST_VIEWS = 2000  # Cameras of a request


class Refusal(Exception):
    """An error answer: an HTTP status and one line."""

    def __init__(self, status: int, line: str):
        """Set the status and the line."""
        self.status = status
        super().__init__(line)


def choice(request: dict, field: str, names: Sequence[str]) -> str:
    """Return a field of a request that is one of some names; raise Refusal for any other value."""
    value = request.get(field)
    if value not in names:
        raise Refusal(400, f"{field} is {description_of(value)}, not one of {', '.join(names)}")
    return str(value)


def index_of(request: dict, field: str, absent: int | None = None) -> int:
    """Return a field of a request that counts from 0; `absent` if it is not set, where there is such a value.

    Raises ValueError or KeyError, as json_values does.
    """
    return absent if absent is not None and field not in request else whole_number(request, field)


def cameras_of(request: dict) -> list[Camera]:
    """Return the cameras of a request, or as many between them as it counts; raise Refusal without one.

    Raises ValueError or KeyError for a camera that cannot be, as json_values does.
    """
    cameras = [camera_of(camera) for camera in json_list(request["cameras"], "cameras")[:MOST_VIEWS]]
    if not cameras:
        raise Refusal(400, "the request has no cameras")
    return interpolate(cameras, min(whole_number(request, "count"), MOST_VIEWS)) if request.get("count") else cameras


def own_path(path: str) -> str:
    """Return the path of a request without its query, and without the prefix that some proxies leave there."""
    match = re.search(r"/(photo/[^/]+/[^/]+|[^/]*)$", path.partition("?")[0])
    return match[0] if match else path


def is_local(host: str) -> bool:
    """Return whether only this machine reaches a host's name or address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost" or host.endswith(".localhost")


class ClientRun:
    """A run while a client saves files: the renderer's thread renders pictures, until the client disconnects."""

    def __init__(
        self, on_renderer: Callable[[Connection, Callable[[], Any], int], Any], run: ViewerScene, client: Connection
    ):
        """Set the run, and what calls a function on the renderer, see Viewer.on_renderer."""
        self._on_renderer, self._run, self._client = on_renderer, run, client

    def render(self, camera: Any, *, supersample: bool = True, **options: Any) -> Any:
        """Render a camera, as RenderableScene.render(); its turn comes by the pixels that are averaged."""
        samples = getattr(self._run, "samples_across_pixel", None) if supersample else None  # A training has none.
        factor = 1 if samples is None else samples(camera)
        render = partial(self._run.render, camera, supersample=supersample, **options)
        return self._on_renderer(self._client, render, factor**2 * camera.pixel_count)

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the run."""
        return getattr(self._run, name)
