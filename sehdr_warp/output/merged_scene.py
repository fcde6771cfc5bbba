"""Several scenes of the same coordinates as one."""

import json
import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ..errors import SehdrError, require_loaded
from ..model.baking import field_of, gaussians_of, with_photo_filters
from ..runs.run import RenderableScene, on_device
from ..scene.camera_focus import camera_positions
from ..splats import GaussianArrays
from ..splats.arrays import join_gaussians
from .cameras.scene_cameras import training_cameras
from .world_transform import WorldTransform, photos_to_scene

log = logging.getLogger(__name__)


class MergedScene(RenderableScene):
    """The Gaussians of several scenes as one scene to render, edit and export.

    Cameras are those of all scenes. Path, name, response, exposure and coordinates are those of the first one.
    """

    def __init__(self, scenes: Sequence[RenderableScene]):
        """Join scenes; merge_scenes() says how."""
        first = scenes[0]
        self.reference, self.world_matrix = first, first.world_matrix
        self.path, self.scene_name, self.response = first.path, first.scene_name, first.response
        self.base_time = first.base_time
        moves = [_to_coordinates_of(first, scene) for scene in scenes]
        self.cameras = tuple(
            replace(entry, camera=move.camera(entry.camera))
            for scene, move in zip(scenes, moves, strict=True)
            for entry in scene.cameras
        )
        field = field_of(_joined_gaussians(scenes, moves))
        field.response, field.deterministic = first.field.response, first.field.deterministic
        field.confidence, field.clipped_stops = (
            _joined([getattr(scene.field, name) for scene in scenes]) for name in ("confidence", "clipped_stops")
        )
        self.field = on_device(field, first.device)
        photos = [
            [move.camera(camera) for camera in scene.field.photo_cameras]
            for scene, move in zip(scenes, moves, strict=True)
        ]
        self.field.photo_cameras = [camera for each in photos for camera in each] if all(photos) else ()
        self.degree = self.field.gaussians.degree
        self._clipped = _joined([scene.clipped_share() for scene in scenes])

    def clipped_share(self) -> Tensor | None:
        """Return the fraction [N] of clipped values that show each Gaussian; None if a scene does not state it."""
        return None if self._clipped is None else self._clipped.to(self.device)


def merge_scenes(run: RenderableScene, *others: RenderableScene) -> MergedScene:
    """Return one scene with the Gaussians of several scenes that have the same coordinates.

    A file of Gaussians that states how it was turned and scaled is turned back. Nothing is left out where scenes
    overlap: see SplatEdits. Colors stay as they are if all scenes have the same color model, as after trainings with
    one preset; else log radiance is fitted to them.

    Args:
        run: From load_run, train or load_splats; the result has its response, exposure and coordinates.
        others: Further ones.

    Raises:
        SehdrError: If some scenes are rendered with opacity compensation, as small files are, and the low-pass filter
            of another one is not known, which would have to be included in its sizes.
    """
    require_loaded("load_run", run, *others)
    for other in others:
        if _have_own_worlds(run, other):
            problem = "were found apart, so their coordinates differ, and the scenes do not fit together"
            remedy = "train both with cameras of one set, as of COLMAP"
            log.warning("%s: its cameras and those of %s %s; %s", other.path, run.path, problem, remedy)
    return MergedScene((run, *others))


def _have_own_worlds(first: RenderableScene, second: RenderableScene) -> bool:
    """Return whether structure from motion placed the photos of each scene, and none of them alike in both."""
    placed, others = (
        {entry.placed.file: entry.placed.world_to_camera for entry in scene.cameras if entry.placed is not None}
        for scene in (first, second)
    )
    alike = (np.allclose(placed[file], pose, atol=1e-3) for file, pose in others.items() if file in placed)
    return bool(placed and others) and not any(alike)


def _to_coordinates_of(first: RenderableScene, scene: RenderableScene) -> WorldTransform:
    """Return the map from a scene's coordinates to those of the first scene, by what their files state."""
    if scene is first:
        return WorldTransform.identity()
    return WorldTransform.from_matrix(photos_to_scene(first).matrix @ photos_to_scene(scene).inverse().matrix)


def _joined_gaussians(scenes: Sequence[RenderableScene], moves: Sequence[WorldTransform]) -> GaussianArrays:
    """Return the moved Gaussians of all scenes in one color model."""
    names = {scene.field.color_model.name for scene in scenes}
    responses = {json.dumps(scene.response.to_dict()) for scene in scenes}
    if "display" in names and (len(responses) > 1 or any(scene.color_matrix is not None for scene in scenes)):
        names.add("log")  # Codes of different responses or primaries have light alone in common.
    color_model = names.pop() if len(names) == 1 else "log"
    time = scenes[0].base_time if color_model == "display" else None
    parts = []
    for scene, move in zip(scenes, moves, strict=True):
        positions = camera_positions(training_cameras(scene))
        gaussians = gaussians_of(scene.field, color_model, positions, time, scene.color_matrix)
        gaussians = with_photo_filters(gaussians, training_cameras(scene))
        parts.append(gaussians if move.is_identity else gaussians.transformed(move.matrix))
    if any(part.antialiased for part in parts):
        parts = [part.with_filter() for part in parts]
        for scene, part in zip(scenes, parts, strict=True):
            if not part.antialiased:
                problem = "is rendered without opacity compensation, unlike another scene to merge"
                remedy = "merge the run of that scene, or a .ply, .glb or USD file of it, in place of a smaller file"
                raise SehdrError(f"{scene.path}: {problem}; {remedy}")
    return join_gaussians(parts)


def _joined(parts: Sequence[Tensor | None]) -> Tensor | None:
    """Return tensors [N] of all scenes as one on the CPU; None if one is missing."""
    tensors = [part.cpu() for part in parts if part is not None]
    return torch.cat(tensors) if len(tensors) == len(parts) else None
