"""Decisions that all blocks of a set share, made once and written to blocks.json in the folder of the merged run.

Response, exposure times, exposure compensation, base time and coordinates are those of the whole set, measured on
reduced photos. They are decided before any block is trained, so colors agree at the borders between blocks.
"""

import logging
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from PIL import Image
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from ..errors import InputError, SehdrError
from ..files import read_json, refuse_links, write_json
from ..json_values import damage
from ..response import Response
from ..runs.config import REFERENCE_ITERATIONS, Config
from ..runs.config_files import config_of_run, field_and_problem, override_config
from ..runs.open import load_scene_and_log_notes, response_for_loading
from ..runs.scene_description import SFM_LAYOUTS, in_world_of_run
from ..runs.values import DataValues, GainValues, LoadArguments, NormalizationValues
from ..scene import Camera, Scene, View
from ..scene.camera import MAX_SIDE
from ..scene.exposure.compensation import ExposureCompensation
from ..scene.normalization import Normalization, normalization_of
from ..scene.wide_camera import perspective_cameras
from ..subsets import every_nth
from ..training.compensation import SharedDecisions, estimate_compensation, estimates_compensation
from ..training.cost import OVERLAP
from ..training.initialization import base_time_of, check_views, match_points, response_for_training
from ..training.matching import LARGEST_SIDE
from ..training.plan import STEPS_PER_PHOTO, antialiasing
from ..training.scene_facts import focal_ratio
from .division import Cell, Division, divide, largest_count, thin_out, weights_of

log = logging.getLogger(__name__)

FORMAT = 1
FILE = "blocks.json"
MOST_BLOCKS = 10_000  # Largest number of blocks; more than that many trainings are never one set
FEWEST_POINTS, MATCHED = 500, 4000  # With fewer points in the set, pixels are matched to divide by
MOST_MATCHED = 400  # Photos that are matched for that

_THREE = Field(min_length=3, max_length=3)


class Block(BaseModel):
    """A block, as blocks.json holds it."""

    model_config = ConfigDict(strict=True, frozen=True, allow_inf_nan=True)
    name: Annotated[str, Field(pattern=r"^block_[0-9]{1,9}$")]
    """Name of the folder of its run, below `blocks/`; it must not lead to another place."""
    views: list[str]  # Names of its views, training and held-out
    fraction: Annotated[float, Field(gt=0, le=1)]  # Pixels of its training photos, relative to those of all
    low: Annotated[list[float | None], _THREE]
    """Lower bounds of its core, in the axes of the plan; None for an infinite one."""
    high: Annotated[list[float | None], _THREE]  # Upper bounds of its core
    margin: Annotated[list[FiniteFloat], _THREE]  # Enlargement of the core

    @property
    def cell(self) -> Cell:
        """Its core."""
        bounds = (self.low, -np.inf), (self.high, np.inf)
        return Cell(*(np.array([end if bound is None else bound for bound in face]) for face, end in bounds))


class BlockPlanValues(BaseModel):
    """The object in blocks.json."""

    model_config = ConfigDict(strict=True)
    format: int
    scene: str
    data: DataValues
    response: dict[str, Any]
    base_time: Annotated[float, Field(gt=0)]
    normalization: NormalizationValues
    exposure_compensation: GainValues | None
    antialiased: bool | None = None
    exposure_times: dict[str, Annotated[float, Field(gt=0)]]
    photo_bytes: dict[str, Annotated[int, Field(ge=0)]] = {}
    cameras: dict[str, dict[str, Any]] = {}
    config: dict[str, Any]
    axes: Annotated[list[Annotated[list[FiniteFloat], _THREE]], _THREE]
    blocks: Annotated[list[Block], Field(min_length=1)]


@dataclass(frozen=True)
class BlockPlan:
    """The blocks of a set, and what they share."""

    scene: str  # Name of the set
    data: LoadArguments  # Arguments of load_scene() for the whole set
    response: Response  # The camera response
    normalization: Normalization  # Coordinates of the merged run
    shared: SharedDecisions  # Base time and exposure compensation
    exposure_times: Mapping[str, float]  # By view, seconds, before the compensation
    photo_bytes: Mapping[str, int]  # By view, size of its photo's file, by which nodes with other photos are found
    cameras: Mapping[str, Camera]  # By view, if structure from motion found them: all blocks are in their world
    config: Config  # Requested options of each block, before its own plan
    axes: np.ndarray  # [3, 3] rows are the axes of the cells in scene coordinates
    blocks: tuple[Block, ...]  # The blocks

    @property
    def division(self) -> Division:
        """The division of space, without the photos."""
        margins = np.array([block.margin for block in self.blocks])
        return Division(self.axes, tuple(block.cell for block in self.blocks), margins, ())

    def config_of(self, block: Block) -> Config:
        """Return the config of a block: its part of the budget of Gaussians, and model.antialiased as of the set.

        The budget is that of the requested mcmc.cap_density, 120 by default, on a GPU too. The plan of a training with
        many photos raises the default to training.plan.GPU_CAP_DENSITY and leaves the smaller value of a block; only a
        block that has all photos is planned as one training.
        """
        root = math.sqrt(block.fraction)
        fields: dict[str, object] = {"plan.keep": sorted({*self.config.plan.keep, "model.antialiased"})}
        fields["model.antialiased"] = self.shared.antialiased
        # These are multiples of the root of the block's pixels, and the budget of the set is divided by its pixels.
        for path in ("mcmc.cap_density", "model.initial_density"):
            table, name = path.split(".")
            fields[path] = getattr(getattr(self.config, table), name) * root
        if "densification.cap_max" in self.config.plan.keep:
            fields["densification.cap_max"] = max(1, round(self.config.densification.cap_max * block.fraction))
        return override_config(self.config, fields, block.name)

    def load_scene(self, names: list[str]) -> Scene:
        """Load views of the set with the plan's response, exposure times and world.

        Raises:
            InputError: If they cannot be read, or have other cameras than when the set was divided.
        """
        response = response_for_loading(self.config, self.response)
        storage = self.config.load_options["photo_storage"]
        scene = load_scene_and_log_notes(self.data | {"views": names}, response=response, photo_storage=storage)
        place = self.data.get("path") or self.scene
        scene = in_world_of_run(scene, self.cameras, self.normalization.unit, "the set", place)
        views = tuple(replace(view, exposure_time=self.exposure_times[view.name]) for view in scene.views)
        return replace(scene, views=views)

    def check_photos(self, views: Sequence[View]) -> None:
        """Raise InputError if the files of photos are not those of the plan."""
        for name, size in _photo_bytes(views).items():
            if size != (before := self.photo_bytes.get(name, size)):
                problem = f"{name} has {size} bytes, and had {before} when the set was divided"
                remedy = "copy the same set to all nodes, or train again with --overwrite"
                raise InputError(self.data.get("path") or self.scene, problem, remedy)

    def write(self, folder: Path) -> None:
        """Write blocks.json."""
        compensation = self.shared.compensation
        values = {
            "format": FORMAT,
            "scene": self.scene,
            "data": self.data,
            "response": self.response.to_dict(),
            "base_time": self.shared.base_time,
            "normalization": self.normalization.to_dict(),
            "exposure_compensation": None if compensation is None else compensation.to_dict(),
            "antialiased": self.shared.antialiased,
            "exposure_times": dict(self.exposure_times),
            "photo_bytes": dict(self.photo_bytes),
            "cameras": {name: camera.to_dict() for name, camera in self.cameras.items()},
            "config": self.config.model_dump(),
            "axes": self.axes.tolist(),
            "blocks": [block.model_dump() for block in self.blocks],
        }
        write_json(folder / FILE, values, internal=True)

    @staticmethod
    def read(folder: Path) -> "BlockPlan":
        """Read blocks.json; raise InputError if it cannot be used."""
        path = folder / FILE
        refuse_links(path, folder)
        values, remedy = read_json(path, 256 << 20), "train again, with --overwrite"
        try:
            blocks = _check_blocks(BlockPlanValues.model_validate(values))
            response = Response.from_dict(values["response"])
            cameras = _cameras_of(values)
        except ValidationError as error:
            raise InputError(path, field_and_problem(error)[1], remedy) from None
        except (SehdrError, ValueError) as error:
            raise InputError(path, str(error), remedy) from None
        if values["format"] != FORMAT:
            raise InputError(path, f"is of format {values['format']}, not {FORMAT}", remedy)
        compensation, config = values["exposure_compensation"], config_of_run(values["config"], path)
        shared = SharedDecisions(
            values["base_time"],
            None if compensation is None else ExposureCompensation.from_dict(compensation),
            config.model.antialiased if (own := values.get("antialiased")) is None else own,  # None in older plans
        )
        return BlockPlan(
            values["scene"],
            values["data"],
            response,
            Normalization.from_dict(values["normalization"]),
            shared,
            values["exposure_times"],
            values.get("photo_bytes", {}),
            cameras,
            config,
            np.array(values["axes"], np.float64),
            blocks,
        )


def make_block_plan(data: LoadArguments, config: Config, device: torch.device, count: int | None) -> BlockPlan | None:
    """Decide what all blocks of a set share, and divide the set into `count` blocks; None chooses their number.

    `data` are arguments of load_scene().

    Returns:
        The plan; None if `count` is None and one training is enough.

    Raises:
        InputError: If the set cannot be divided, or nothing can be shared between its blocks.
    """
    _check(config, data)
    size = min(data.get("max_size") or LARGEST_SIDE, LARGEST_SIDE)
    scene = load_scene_and_log_notes(data | {"max_size": size}, **config.load_options)
    check_views(scene)
    response = response_for_training(scene, config)
    times = {view.name: view.exposure_time for view in scene.views}
    normalization = normalization_of(scene)
    compensation = None
    if config.plan.enabled and estimates_compensation(scene, config, response):
        result = estimate_compensation(normalization.scene(scene), config, response, device)
        compensation = result.compensation
        log.info("plan: %s: %s (%s)", result.decision.name, result.decision.choice, result.decision.reason)
    compensated = scene if compensation is None else compensation.normalize_photos(scene, response)
    training_cameras = [_camera_of_training(view, data.get("max_size")) for view in scene.train_views]
    shared = SharedDecisions(base_time_of(compensated), compensation, _antialiased(training_cameras, config))
    cameras = [view.camera for view in scene.train_views]
    points = _places(compensated, response, device)
    if count is None:
        count = blocks_for(len(training_cameras), sum(each.pixel_count for each in training_cameras), config)
        division = largest_count(scene.name, cameras, points, count) if count > 1 else None
        if division is None:
            reason = "its photos do not show different places" if count > 1 else "its photos are few enough"
            log.info("plan: blocks: none: one training is enough for this set: %s", reason)
            return None
    else:
        division = divide(scene.name, cameras, points, count)
    plan = BlockPlan(
        scene.name,
        data,
        response,
        normalization,
        shared,
        times,
        _photo_bytes(scene.views),
        {view.name: view.camera for view in scene.views} if scene.format in SFM_LAYOUTS else {},
        config,
        division.axes,
        _blocks(scene, division, points),
    )
    sizes = ", ".join(str(len(own)) for own in division.photos)
    log.info("plan: blocks: %d, with %s of %d training photos", len(plan.blocks), sizes, len(training_cameras))
    return plan


def blocks_for(photos: int, pixels: float, config: Config) -> int:
    """Return the number of blocks for a set of photos with `pixels` in all.

    Each block gets what one training has steps and Gaussians for, even if a preset for a quick look has fewer.
    """
    by_photos = OVERLAP * photos * STEPS_PER_PHOTO / REFERENCE_ITERATIONS
    gaussians = config.mcmc.cap_density * math.sqrt(pixels)
    by_gaussians = OVERLAP * gaussians / max(config.densification.cap_max, Config().densification.cap_max)
    if "densification.cap_max" in config.plan.keep or config.densification.strategy != "mcmc":
        by_gaussians = 0.0
    return max(1, math.ceil(max(by_photos, by_gaussians) - OVERLAP + 1))


def _check(config: Config, data: LoadArguments) -> None:
    """Raise InputError for options whose networks would differ between blocks."""
    path = data.get("path") or "photos"
    if config.response.name == "learned":
        problem = "each block would learn a response of its own, and colors would differ at borders"
        raise InputError(path, f"--blocks with a learned response: {problem}", "use --response auto or a name")
    if config.fusion.enabled and (not config.plan.enabled or "fusion.enabled" in config.plan.keep):
        problem = "--blocks with fusion.enabled: each block would train a fusion of its own"
        raise InputError(path, problem, "leave the fusion out, or train without --blocks")
    if config.model.init_file:
        problem = "--blocks with model.init_file: all blocks would start from the whole file"
        raise InputError(path, problem, "leave the file out, or train without --blocks")


def _places(scene: Scene, response: Response, device: torch.device) -> np.ndarray:
    """Return points [P, 3] of what the training photos show: those of the set, or matched ones if it has few."""
    if len(scene.points) >= FEWEST_POINTS or any(not view.camera.is_pinhole for view in scene.train_views):
        if len(scene.points) == 0:
            return np.stack([view.camera.position for view in scene.train_views])
        return scene.points
    part = replace(scene, views=every_nth(scene.train_views, MOST_MATCHED))
    return match_points(part, MATCHED, response=response, device=device)[0]


def _camera_of_training(view: View, max_size: int | None) -> Camera:
    """Return the camera of a photo that was reduced to LARGEST_SIDE, at the size of the training."""
    camera, longest = view.camera, 0
    if view.source is not None and max(camera.width, camera.height) == LARGEST_SIDE:
        with suppress(OSError), Image.open(view.source) as photo:  # RAW and float photos: as the reduced ones.
            longest = min(max(photo.size), max_size or MAX_SIDE)
    scale = max(1.0, longest / LARGEST_SIDE)
    return camera.resized(round(scale * camera.width), round(scale * camera.height))


def _antialiased(cameras: Sequence[Camera], config: Config) -> bool:
    """Return model.antialiased for a set, as the plan of one training decides it."""
    decision = antialiasing(focal_ratio(perspective_cameras(cameras)), config)
    if not decision.fields or not config.plan.enabled or "model.antialiased" in config.plan.keep:
        return config.model.antialiased
    log.info("plan: antialiasing: %s (%s)", decision.choice, decision.reason)
    return True


def _photo_bytes(views: Sequence[View]) -> dict[str, int]:
    """Return the sizes of the files of photos by the names of their views; without those that are not files."""
    files = {view.name: view.source for view in views if view.source is not None}
    return {name: file.stat().st_size for name, file in files.items() if file.is_file()}


def _blocks(scene: Scene, division: Division, points: np.ndarray) -> tuple[Block, ...]:
    """Return the blocks of a division; a held-out view belongs to the block that it shows most of."""
    views = scene.train_views
    sizes = np.array([view.camera.pixel_count for view in views], np.float64)
    names: list[list[str]] = [[views[index].name for index in own] for own in division.photos]
    points = thin_out(points, len(views))
    owner = division.block_of(points)
    for view in scene.test_views:
        weights = np.bincount(owner, weights_of(view.camera, points), len(division.cells))
        names[int(weights.argmax())].append(view.name)
    digits = max(2, len(str(len(names))))
    faces = [
        [[float(bound) if np.isfinite(bound) else None for bound in face] for face in (cell.low, cell.high)]
        for cell in division.cells
    ]
    return tuple(
        Block(
            name=f"block_{index + 1:0{digits}d}",
            views=sorted(names[index]),
            fraction=float(sizes[own].sum() / sizes.sum()),
            low=faces[index][0],
            high=faces[index][1],
            margin=division.margins[index].tolist(),
        )
        for index, own in enumerate(division.photos)
    )


def _cameras_of(values: Mapping[str, Any]) -> dict[str, Camera]:
    """Return the cameras in blocks.json by view, none of older plans; raise ValueError for one that is damaged."""
    try:
        return {name: Camera.from_dict(camera) for name, camera in values.get("cameras", {}).items()}
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"cameras: one is damaged ({damage(error)})") from None


def _check_blocks(plan: BlockPlanValues) -> tuple[Block, ...]:
    """Return the blocks; raise ValueError for too many, two of one name, no box, or a view without exposure time."""
    if len(plan.blocks) > MOST_BLOCKS:
        raise ValueError(f"blocks has {len(plan.blocks)} entries, and at most {MOST_BLOCKS} can be")
    names = [block.name for block in plan.blocks]
    if len(set(names)) < len(names):
        raise ValueError("two blocks have the same name")
    if unknown := {view for block in plan.blocks for view in block.views} - plan.exposure_times.keys():
        raise ValueError(f"exposure_times lacks {min(unknown):.80}")
    if wrong := [block.name for block in plan.blocks if not (block.cell.low < block.cell.high).all()]:
        raise ValueError(f"the core of {wrong[0]} is not a box")
    return tuple(plan.blocks)
