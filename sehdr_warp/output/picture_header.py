"""The EXR attributes that all pictures of a render share: exposure, colors, time, and where the scene came from."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import TYPE_CHECKING, Any

from ..scene import Camera
from .images.colorspace import color_space
from .images.exr import exr_header
from .lighting.unit import luminance_of_one, read_light_unit
from .world_transform import WorldTransform, photos_to_file

if TYPE_CHECKING:
    from ..runs.run import RenderableScene


@dataclass(frozen=True)
class PictureHeader:
    """EXR attributes that all pictures of a render share."""

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

    def attributes(self, exposure_time: float, camera: Camera | None, **provenance: str) -> dict[str, Any]:
        """Return the EXR attributes of a picture; `provenance` is of this one alone."""
        values = {**self.provenance, **provenance, "baseExposureTime": repr(float(self.base_time))}
        luminance = None if self.luminance_of_one is None else self.luminance_of_one / exposure_time
        return exr_header(self.colorspace, exposure_time, camera, self.captured, values, luminance)


def provenance(run: "RenderableScene") -> dict[str, str]:
    """Return where a picture came from, as text by key."""
    unit = read_light_unit(run)
    values = {"scene": run.scene_name, "iterations": run.iterations, "units": str(unit or "relative radiance")}
    values["response"] = getattr(run.response, "name", None)
    return {key: str(value) for key, value in values.items() if value not in (None, "")}
