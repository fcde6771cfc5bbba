"""A scene as the viewer shows it: its edits and gains, float frames of a camera, and what the page knows of it."""

import json
import shlex
from collections.abc import Iterator, Sequence
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from ..errors import SehdrError
from ..model.lights import Light, light_name
from ..output.cameras.opening import camera_facts, opening_facts
from ..output.export.splat_edits import SplatEdits
from ..output.images.display import display_gain
from ..output.light_pictures import curve_table
from ..output.lighting.unit import luminance_of_one
from ..output.merged_scene import merge_scenes
from ..output.world_transform import photos_to_scene, world_transform
from ..scene import Camera
from .edits import EditedOpacities, LightGains
from .scene_lock import SceneLock

MOST_PIXELS = 4096 * 2304
_HALF_MOST = 65504.0


class ViewerScene:
    """A run that several threads may render from; other attributes are the run's.

    Attributes:
        run: The scene that is shown.
        name: Its path, as on the command line.
        clipped: [N] share of photographed values that were clipped, for each Gaussian; None if unknown.
        lock: Held while the scene is rendered or changed.
        version: Counts replacements.
    """

    run: Any

    def __init__(self, run: Any, name: str, clipped: Tensor | None = None):
        """Show a run under a name."""
        self.run, self.name, self.clipped = run, name, clipped
        self._own = run, clipped
        self.lock, self.version = SceneLock(), 0
        self._opened: list[dict[str, Any]] = []
        self.history: list[dict[str, Any]] = [{}]  # Edits that a page can undo, as pages draw them, the newest last
        self._start_edits()

    def _start_edits(self) -> None:
        """Forget edits, lights and gains, because another scene is shown."""
        self.opacities, self.visible_count = EditedOpacities(), None
        self._edits: SplatEdits | None = None
        self._merged: tuple[ViewerScene, ...] = ()
        self.light_gains, self._lights = LightGains(), None
        self._stops: dict[int, float] = {}

    def replace(self, run: Any, clipped: Tensor | None) -> None:
        """Show another run from now on."""
        with self.lock.changing():
            self.run, self.clipped = self._own = run, clipped
            self._start_edits()
            self.history = [{}]
            self.version += 1

    def lights(self) -> list[Light]:
        """Return the lights of the scene, found at the first call; none if it does not state what clipped."""
        with self.lock.changing():
            if self._lights is None:
                self._lights = [] if self.clipped is None else self.run.find_lights()
            return self._lights

    def set_gain(self, light: int, stops: float) -> None:
        """Show a light brighter by so many stops than it was trained; see LightGains.apply."""
        lights = self.lights()
        with self.lock.changing():
            gains = {index: value for index, value in (self._stops | {light: stops}).items() if value != 0}
            self.light_gains.apply(self.run, lights, gains)
            self._stops = gains
            self.version += 1

    def describe_lights(self) -> dict[str, Any]:
        """Return what the page lists of the lights, as plain values."""
        rows = [
            {
                "name": light_name(index),
                "position": light.shape.position.tolist(),
                "size": max(light.shape.size),
                "radiance": float(np.mean(light.radiance)),
                "certain": float(np.mean(light.lower_bound)),
                "deviation": light.deviation,
                "share": light.share,
                "stops": self._stops.get(index, 0.0),
            }
            for index, light in enumerate(self.lights())
        ]
        return {"lights": rows, "unit": luminance_of_one(self.run)}

    def edit(
        self, edits: SplatEdits | None, merged: Sequence["ViewerScene"] = (), history: Sequence[dict[str, Any]] = ({},)
    ) -> None:
        """Show what edits leave of the scene and of scenes that are merged with it, or all of them for None.

        Gains of lights end when other scenes are merged, because the lights are others. Raises SehdrError if nothing is
        left, a merged scene is this one or has edits, or merge_scenes() refuses it; what is shown then stays.
        `history` is what pages know these edits by.
        """
        for other in merged:
            if other is self or other.visible_count is not None:
                problem = "is the scene that is shown" if other is self else "has edits of its own; undo these first"
                raise SehdrError(f"{other.name}: {problem}")
        with self.lock.changing():
            before = self._edits, self._merged
            try:
                self._show(edits, tuple(merged))
            except SehdrError:
                self._show(*before)
                raise
            self.history = list(history)
            self.version += 1

    def _show(self, edits: SplatEdits | None, merged: tuple["ViewerScene", ...]) -> None:
        if merged != self._merged:
            self.opacities.apply(self.run, None)  # A merged scene is a copy, which hides nothing yet.
            if self._stops:
                self.light_gains.apply(self.run, [], {})
            own, clipped = self._own
            run = merge_scenes(own, *(other.run for other in merged)) if merged else own
            self.run, self.clipped = run, run.clipped_share() if merged else clipped
            self._start_edits()
            self._merged = merged
        count = self.opacities.apply(self.run, edits)
        self.visible_count = None if edits is None and not merged else count
        self._edits = edits

    def __getattr__(self, name: str):
        """Return an attribute of the run."""
        return getattr(self.run, name)

    @property
    def on_cpu(self) -> bool:
        """True if pictures are made on the CPU."""
        return str(getattr(self.run, "device", "cpu")) == "cpu"

    def render(self, camera: Camera, **options: Any):
        """Render a camera, with options of RenderableScene.render(), while no other thread changes the scene."""
        with self.lock.rendering():
            return self.run.render(camera, **options)

    def render_confidence(self, camera: Camera) -> Tensor | None:
        """Render confidence while no other thread changes the scene."""
        with self.lock.rendering():
            return self.run.render_confidence(camera)

    def frame_parts(self, camera: Camera, *, draft: bool = False, clipped: bool = False) -> Iterator[memoryview | None]:
        """Render a camera as half floats, row by row.

        The planes are [H, W, 4] exposure at the base time and confidence (1 in a draft, -1 if unknown), [H, W] depth,
        and with `clipped` [H, W] the share of clipped values.

        Yields:
            None between parts of the work, where other pictures can be made, and the frame at the end.
        """
        run, shares, size = self.run, self.clipped if clipped else None, (camera.height, camera.width)
        with torch.no_grad():
            rendered = self.render(camera, supersample=False)
            light, depth = torch.as_tensor(rendered.hdr), torch.as_tensor(rendered.depth)
            frame = torch.empty((5 + (shares is not None), *size), dtype=torch.float16, device=light.device)
            picture = frame[:4].view(*size, 4)
            torch.mul(light, self.base_time, out=picture[..., :3])
            picture[..., :3].clamp_(0, _HALF_MOST)
            picture[..., 3] = 1.0
            frame[4].copy_(depth).clamp_(0, _HALF_MOST)
        del rendered, light, depth  # What is not needed any more must not add to what the next part takes.
        for part in ("clipped",) * (shares is not None) + ("confidence",) * (not draft):
            yield None
            if self.run is not run:  # Another took its place meanwhile.
                yield from self.frame_parts(camera, draft=draft, clipped=clipped)
                return
            with torch.no_grad():
                if part == "clipped":
                    with self.lock.rendering():
                        assert shares is not None
                        frame[5].copy_(run.field.render_mean(camera, shares)).clamp_(0, _HALF_MOST)
                else:
                    confidence = self.render_confidence(camera)
                    picture[..., 3] = -1.0 if confidence is None else torch.as_tensor(confidence)
        if frame.is_cuda:  # Into pages that the device writes to itself: several times as fast
            frame = torch.empty(frame.shape, dtype=frame.dtype, pin_memory=True).copy_(frame)
        yield frame.numpy().data.cast("B")

    def _opening(self) -> dict[str, Any]:
        """Return what the page opens with, found at the first call; see opening_facts."""
        if not self._opened:
            self._opened = [opening_facts(cast(Any, self))]
        return self._opened[0]

    def facts(self) -> dict[str, Any]:
        """Return what the page knows of the run, as plain values."""
        own = {}
        if hasattr(self, "path"):  # A training has no folder yet.
            transform = world_transform(cast(Any, self))
            own = {"up": transform.rotation[1].tolist(), "upright": transform.matrix.tolist(), **self._opening()}
        facts = {
            "name": self.name,
            "argument": shlex.quote(self.name),
            "version": self.version,
            "scene": self.scene_name,
            "gaussians": self.gaussian_count if self.visible_count is None else self.visible_count,
            "edited": self.visible_count is not None,
            "history": self.history,
            "merged": len(self._merged),
            "iterations": self.iterations,
            "response": self.response.name,
            "base_time": self.base_time,
            "grey": display_gain(self.response),
            "curve": curve_table(self.response),
            "clipped": self.clipped is not None,
        }
        return facts | camera_facts((self.reference or self).cameras) | own


def camera_of(values: dict) -> Camera:
    """Return the camera that a page describes.

    Raises ValueError for a bad value or too large a picture, KeyError for a missing field.
    """
    camera = Camera.from_dict(values)
    if camera.pixel_count > MOST_PIXELS:
        raise ValueError(f"{camera.width} x {camera.height} is more than {MOST_PIXELS} pixels")
    return camera


def frame_bytes(camera: Camera, clipped: bool) -> int:
    """Return the size of a frame in bytes; see ViewerScene.frame_parts."""
    return 2 * (6 if clipped else 5) * camera.pixel_count


def camera_file(run: Any, cameras: Sequence[Camera]) -> str:
    """Return cameras of a page as JSON that `render --cameras` reads, in the photos' coordinates."""
    digits, to_photos = max(3, len(str(len(cameras) - 1))), photos_to_scene(run).inverse()
    views = [{"name": f"view_{i:0{digits}d}"} | to_photos.camera(camera).to_dict() for i, camera in enumerate(cameras)]
    return json.dumps({"cameras": views}, indent=1)
