"""Pictures as parts of EXR files: colors that are radiance times `expTime`, and attributes that a render's share."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import TYPE_CHECKING

import numpy as np

from ..scene import Camera
from .images.colorspace import color_space, from_rec709
from .images.exr import Part, exr_header, rgb_channels
from .lighting.unit import luminance_of_one, read_light_unit
from .world_transform import WorldTransform, photos_to_file

if TYPE_CHECKING:
    from ..runs.run import RenderableScene


@dataclass(frozen=True)
class PictureHeader:
    """Attributes that all pictures of a render share."""

    base_time: float  # Seconds at 0 EV
    colorspace: str = "rec709"  # Primaries of the EXR files
    captured: datetime | None = None  # Local time that the files state as that of the picture
    provenance: Mapping[str, str] = field(default_factory=dict)  # Text by key
    luminance_of_one: float | None = None  # cd/m^2 of a radiance of 1; None if it is not known

    def __post_init__(self) -> None:
        """Raise SehdrError for an unknown color space."""
        color_space(self.colorspace)

    @staticmethod
    def of(run: "RenderableScene", transform: WorldTransform, colorspace: str) -> "PictureHeader":
        """Return the header of pictures of a run that are made now; `transform` leads to the files' coordinates."""
        facts = provenance(run) | {"worldMatrix": json.dumps(photos_to_file(run, transform).tolist())}
        now = datetime.now().replace(microsecond=0)
        return PictureHeader(run.base_time, colorspace, now, facts, luminance_of_one(run))

    def part(
        self,
        radiance: np.ndarray,
        exposure: float,
        camera: Camera | None,
        others: Mapping[str, np.ndarray],
        name: str = "",
        **provenance: str,
    ) -> Part:
        """Return a picture as a part of a file; its colors are radiance times exposure, in the header's primaries.

        Args:
            radiance: [H, W, 3] linear Rec.709.
            exposure: Seconds, 1 for a picture of radiance; `expTime` states it.
            camera: Camera of the picture, if it has one.
            others: Channels beside the colors.
            name: Name of the part.
            **provenance: Of this picture alone, text by key.
        """
        values = {**self.provenance, **provenance, "baseExposureTime": repr(float(self.base_time))}
        white = None if self.luminance_of_one is None else self.luminance_of_one / exposure
        attributes = exr_header(self.colorspace, exposure, camera, self.captured, values, white)
        colors = rgb_channels(from_rec709(radiance, self.colorspace) * exposure)
        return Part({**colors, **others}, attributes, name)


def provenance(run: "RenderableScene") -> dict[str, str]:
    """Return where a picture came from, as text by key."""
    unit = read_light_unit(run)
    values = {"scene": run.scene_name, "iterations": run.iterations, "units": str(unit or "relative radiance")}
    values["response"] = getattr(run.response, "name", None)
    return {key: str(value) for key, value in values.items() if value not in (None, "")}
