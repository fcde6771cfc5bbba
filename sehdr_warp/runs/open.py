"""Open what a command line names: a run, a file of Gaussians, and the photos that a run was trained on.

torch is imported when a function is called, so that the command line can import this module at no cost.
"""

from __future__ import annotations

import logging
import os
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError, SehdrError, missing
from ..subsets import first_names
from .device import pick_device
from .scene_description import changed_photos, in_world_of_run, photo_signature
from .values import SCENE_OPTIONS, LoadArguments

if TYPE_CHECKING:
    from ..response import Response
    from ..scene import Scene
    from .config import Config
    from .run import Run, Splats
    from .run_folder import CameraEntry

log = logging.getLogger(__name__)


def open_run(path: Path, device: str | None) -> Run:
    """Load the run in a folder to "cpu" or "cuda:N", None for pick_device()'s choice.

    Raises InputError if the folder is not a run, or the device is missing.
    """
    _require(path)
    from .run import load_run

    return load_run(path, device=pick_device(device))


def open_scene(path: Path, device: str | None) -> Run | Splats:
    """Load the run in a folder, or the Gaussians in a file of one of splats.SUFFIXES; arguments as of open_run."""
    _require(path, "no such file or folder", "give the folder of a run, or a file of Gaussians")
    from ..splats import SUFFIXES
    from .run import load_splats

    if path.is_file() or path.suffix.lower() in SUFFIXES:
        return load_splats(path, device=pick_device(device))
    return open_run(path, device)


def _require(
    path: Path, problem: str = "no such folder", remedy: str = "give the folder that a training wrote"
) -> None:
    """Raise InputError for a path that is not there, before torch is imported, which takes seconds."""
    if not os.path.lexists(path):
        raise missing(path, problem, remedy)


def load_scene_and_log_notes(data: LoadArguments, **options: Any) -> Scene:
    """Load the scene that arguments with a path, as a run saves them, describe, and log its notes.

    `options` are further arguments of load_scene(), such as response.
    """
    from ..scene import load_scene

    path = data.get("path")
    assert path is not None, "the caller checks the path"
    saved: dict[str, Any] = {name: data.get(name) for name in (*SCENE_OPTIONS, "views")}
    scene = load_scene(path, **saved | options)
    for note in scene.notes:
        log.info("%s", note)
    return scene


@dataclass(frozen=True)
class PhotoRequest:
    """Photos that a training reads, on each of its nodes: all arguments of load_scene()."""

    data: LoadArguments  # Those of the command line, as run.json holds them
    options: dict[str, Any]  # Those of the config, see Config.load_options; or of a run: its response and cameras
    cameras: tuple[CameraEntry, ...] = ()  # Of the run that is resumed, if its splits count

    def of_run(self, config: Config, response: Response, cameras: tuple[CameraEntry, ...]) -> PhotoRequest:
        """Return the request with response, found cameras and splits of a run, so that none of them is decided anew."""
        placed = [entry.placed for entry in cameras if entry.placed is not None]
        options = {"response": response_for_loading(config, response), "cameras": placed}
        return PhotoRequest(self.data, self.options | options, cameras)

    def load(self) -> Scene:
        """Load the scene, held out as in the run that is resumed; log that if other views would be today."""
        scene = load_scene_and_log_notes(self.data, **self.options)
        splits = {entry.name: entry.split for entry in self.cameras}
        views = tuple(replace(view, split=splits.get(view.name, view.split)) for view in scene.views)
        result = replace(scene, views=views)
        if [view.name for view in result.test_views] != [view.name for view in scene.test_views]:
            names = first_names([view.name for view in result.test_views])
            log.info("held out, as when the training began: %s", names or "no photo")
        return result


def load_run_scene(run: Run, data: str | None) -> Scene:
    """Load the photos of a run in the same way as for its training; `data` says where they are now if they have moved.

    Cameras of bare photos, splits and exposure times are those of the training, because another version, or more photos
    in the folder, may decide them otherwise.

    Raises SehdrError if neither it nor the run does, or InputError if they are no longer there, or have other cameras.
    """
    from ..scene import is_embedded

    place = data or run.data.get("path")
    if place is None:
        raise SehdrError(f"{run.path}: does not say where its photos are; give --data")
    if data is None and not is_embedded(place) and not Path(place).exists():
        raise InputError(place, "the photos of the run are no longer here", "say where they are with --data")
    request = PhotoRequest(run.data | {"path": place}, {}).of_run(run.config, run.response, run.cameras)
    saved = {entry.name: entry.camera for entry in run.cameras}
    scene = in_world_of_run(request.load(), saved, run.field.normalization.unit, run.path, place)
    times = {entry.name: entry.exposure_time for entry in run.cameras}
    views = (replace(view, exposure_time=times.get(view.name, view.exposure_time)) for view in scene.views)
    scene = replace(scene, views=tuple(views))
    _name_changed_photos(scene, run, place)
    return scene


def _name_changed_photos(scene: Scene, run: Run, place: str) -> None:
    """Warn if photos are not those that a run was trained with, by the signatures in its scene.json."""
    saved = {view["name"]: view["photo"] for view in run.folder.read_scene()["views"]}
    current = {view.name: photo_signature(view.codes, view.mask) for view in scene.views if view.name in saved}
    if changed := changed_photos(saved, current):
        text = "%s: %d of %d photos are other pictures than in the training of %s (or have other masks): %s"
        log.warning(text, place, len(changed), len(scene.views), run.path, first_names(changed))


def load_run_scene_with_confidence(run: Run, data: str | None) -> Scene:
    """Load the photos of a run as load_run_scene does, and measure and save the run's confidence if it has none."""
    from .run_writer import write_confidence

    scene = load_run_scene(run, data)
    if run.field.confidence is None and scene.train_views:
        evidence = run.measure_confidence(scene)
        try:
            write_confidence(run.folder, evidence, run.checkpoint_hash)
        except SehdrError as error:
            log.warning("the confidence was not saved: %s", error)
    return scene


def enclosing_run_response(folder: Path) -> Response | str | None:
    """Return the response to load photos with that belong to the run around a folder; None if no run is around it."""
    from ..response import Response
    from .run_folder import RunFolder

    for place in map(RunFolder, folder.resolve().parents):
        if place.info_file.is_file() and place.checkpoints.is_dir():
            with suppress(InputError):  # A run.json of another program.
                return response_for_loading(place.read_config(), Response.from_dict(place.read_info()["response"]))
    return None


def response_for_loading(config: Config, response: Response) -> Response | str:
    """Return the response to load a run's photos with.

    A learned response is not known at load time, and linear photos were encoded anew when they were loaded: for both
    the name alone reproduces what the training loaded.
    """
    return config.response.name if config.response.name in ("learned", "linear") else response
