"""The training photos on the device, uploaded once."""

from collections.abc import Collection
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ..errors import InputError
from ..field.radiance_field import CameraTensors
from ..response import Response
from ..scene import Scene, View
from .config import LossConfig
from .losses import CODE, Target, one_of, values_of


@dataclass(frozen=True)
class TrainingView:
    """A photo to train on: camera, exposure time in seconds, and what its target at the camera's size is made of.

    images: as in Target, as it is stored. photo: uint8 where all values are whole codes; clipped and black: bool in the
    place of a mask says whether any value is 255, or 0, and then the codes tell where.
    index: as in Target, of a photo that is still one of a stack.
    """

    camera: CameraTensors
    exposure_time: float | Tensor
    images: dict[str, Tensor | bool | None]
    index: Tensor | None = None

    @property
    def target(self) -> Target:
        """Made anew whenever it is asked for."""
        told = {name: noted for name in MASKS if isinstance(noted := self.images[name], bool)}
        codes = one_of(self.images["photo"], self.index) if any(told.values()) else None
        masks = {name: codes == MASKS[name] if noted else None for name, noted in told.items()}
        return Target(**self.images | masks, index=self.index)


MASKS = {"clipped": 255, "black": 0}
"""The codes that masks mark."""
STORED = tuple(field.name for field in fields(Target) if field.name != "index")


@dataclass(frozen=True)
class ViewStack:
    """V training views of one size in shared memory: [i] is view i; at() takes the view whose number is on the device.

    cameras: [V, 24], each view's pose [4, 4], intrinsics [4], position [3] and a 0; times: exposure times in seconds
    [V], float32, or one float where all are equal; images: as in TrainingView, each [V, ...], bool or None.
    """

    width: int
    height: int
    cameras: Tensor
    times: Tensor | float
    images: dict[str, Tensor | bool | None]

    @staticmethod
    def of(views: list[TrainingView]) -> "ViewStack | None":
        """The views stacked; None where their sizes differ or only some have HDR truth."""
        kinds = {(view.camera.width, view.camera.height, view.images["exposure_truth"] is None) for view in views}
        if len(kinds) > 1:
            return None
        as_codes = all(view.images["photo"].dtype == torch.uint8 for view in views)
        stored = [view.images if as_codes else _decoded(view) for view in views]
        images = {name: _stacked(name, [image[name] for image in stored]) for name in STORED}
        times = [view.exposure_time for view in views]
        cameras = [view.camera for view in views]
        return ViewStack(
            cameras[0].width,
            cameras[0].height,
            # A multiple of 16 bytes each: kernels may read four numbers at once.
            torch.stack(
                [
                    functional.pad(torch.cat([c.world_to_camera.flatten(), c.intrinsics, c.position]), (0, 1))
                    for c in cameras
                ]
            ),
            times[0] if len(set(times)) == 1 else torch.tensor(times, device=cameras[0].position.device),
            images,
        )

    def __len__(self) -> int:
        return len(self.cameras)

    def __getitem__(self, index: int) -> TrainingView:
        time = self.times if isinstance(self.times, float) else float(self.times[index])
        return self._view(lambda values: values[index], time)

    def at(self, index: Tensor) -> TrainingView:
        """The view whose number is in index [1], int64, on the views' device; its exposure time may be a tensor. The
        photo stays in the stack until it is asked for: here taking is copying."""
        time = self.times if isinstance(self.times, float) else one_of(self.times, index)
        return replace(self._view(lambda values: one_of(values, index), time, {"photo"}), index=index)

    def _view(self, take, time, left: Collection[str] = ()) -> TrainingView:
        """take: gives one of a tensor [V, ...]; left: images that it is not asked for."""
        pose, intrinsics, position = take(self.cameras)[:23].split((16, 4, 3))
        camera = CameraTensors(self.width, self.height, pose.view(4, 4), intrinsics, position)
        images = {name: take(v) if isinstance(v, Tensor) and name not in left else v for name, v in self.images.items()}
        return TrainingView(camera, time, images)


def _decoded(view: TrainingView) -> dict[str, Tensor | None]:
    target = view.target
    return {name: getattr(target, name) for name in STORED} | {"photo": target.encoded}


def _stacked(name: str, values: list[Tensor | bool | None]) -> Tensor | bool | None:
    given = next((value for value in values if isinstance(value, Tensor)), None)
    if given is None:
        return any(values) if name in MASKS else None
    # A view without clipped or black pixels has none of them; one without a mask counts everywhere.
    empty = torch.ones_like(given) if name == "mask" else torch.zeros_like(given)
    return torch.stack([value if isinstance(value, Tensor) else empty for value in values])


def largest_truth(scene: Scene, loss: LossConfig) -> float:
    """The greatest radiance in the HDR truth of the training views, where it counts; 1.0 where the loss needs none.

    Raises InputError naming the scene and the field of the config where truth that the loss needs is missing or black.
    """
    if not loss.uses_hdr:
        return 1.0
    field = f"loss.hdr_weight = {loss.hdr_weight}" if loss.hdr_weight > 0 else "loss.hdr_truth = true"
    remedy = "take a scene with HDR truth, a preset that needs none, or --predict-hdr"
    given = [view for view in scene.train_views if view.hdr is not None]
    if not given:
        raise InputError(scene.name, f"no training view has the HDR truth that {field} needs", remedy)
    if loss.ldr_weight == 0:
        for view in scene.train_views:
            if view.hdr is None:
                problem = f"view {view.name} lacks the HDR truth that {field} needs where loss.ldr_weight = 0.0"
                raise InputError(scene.name, problem, remedy)
    counted = (view.hdr if view.mask is None else view.hdr[view.mask > 0] for view in given)
    largest = max((float(radiance.max()) for radiance in counted if radiance.size), default=0.0)
    if not largest > 0:
        raise InputError(scene.name, f"the HDR truth that {field} needs is black in every training view", remedy)
    return largest


def training_views(
    views: tuple[View, ...],
    base_time: float,
    device,
    *,
    truth: bool,
    bounds: bool = True,
    light: Response | None = None,
) -> list[TrainingView]:
    """The views on a device. truth: also upload HDR truth; bounds: note where they are clipped and black; light: keep
    the exposures that this response decodes from the photos."""
    made = []
    for view in views:
        images = _images(view, base_time, device, truth, bounds)
        images["light"] = None if light is None else light.decode(values_of(images["photo"]))
        made.append(TrainingView(CameraTensors.of(view.camera, device), view.exposure_time, images))
    return made


def _images(view: View, base_time: float, device, truth: bool, bounds: bool) -> dict:
    encoded = _upload(view.image, device)
    masks = {"clipped": encoded >= 1 - CODE / 2, "black": encoded <= CODE / 2} if bounds else {}
    mask = None if view.mask is None else _upload(view.mask[..., None], device)
    exposure_truth = _upload(view.hdr, device) * base_time if truth and view.hdr is not None else None
    codes = (255 * encoded).round_().clamp_(0, 255).to(torch.uint8)
    told = all(torch.equal(noted, codes == MASKS[name]) for name, noted in masks.items())
    photo = codes if told and torch.equal(values_of(codes), encoded) else encoded
    # As TrainingView has them: False where there are none, and True in the place of a mask that the codes tell.
    masks = {name: bool(noted.any()) and (photo is codes or noted) for name, noted in masks.items()}
    return {"photo": photo, **dict.fromkeys(MASKS, False), **masks, "mask": mask, "exposure_truth": exposure_truth}


def _upload(array: np.ndarray, device) -> Tensor:
    return torch.tensor(np.ascontiguousarray(array), dtype=torch.float32, device=device)
