"""Exposure brackets of HDR views: scene-linear EXR files whose ratios are exact, and simulated photos of them."""

import logging
import math
from collections.abc import Iterable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from datetime import datetime
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from sehdr_warp.errors import SehdrError
from sehdr_warp.scene import Camera

from ..files import atomic_folder, atomic_path, write_json
from ..model.exposure import Exposure, Items, read_exposures
from .colorspace import color_space, from_rec709
from .exr import Part, check_finite, exr_header, rgb_channels, stored_pixel_type, write_exr, write_multipart_exr
from .images import exposure_exif, quantize, write_picture
from .names import safe_names

log = logging.getLogger(__name__)
LDR_FORMATS = ("jpeg", "png", "png16")
MANIFEST_FORMAT = 1

# EXIF rationals and 32-bit expTime hold these; real shutters lie far inside.
_SHORTEST, _LONGEST = 1e-6, 1e6


def bracket_exposures(
    base_time: float, *, evs: Items | None = None, exposures: Items | None = None
) -> tuple[Exposure, ...]:
    """The exposures of a bracket, ascending.

    base_time: seconds at 0 EV. exposures: items of field/exposure.py's grammar, such as "1/125, -2ev, 8x"; numbers are
    seconds. evs: shorthand for stops, such as "-4,-2,0" or [-4, -2, 0]. Exactly one of both.

    Raises SehdrError, naming the value, where both or none are given, an item cannot be read or comes twice, or a time
    is outside 1e-6 to 1e6 seconds.
    """
    if evs is not None and exposures is None:
        stops = [ev for ev in evs.split(",") if ev.strip()] if isinstance(evs, str) else evs
        name, made = "evs", read_exposures([_stops_item(ev) for ev in stops], base_time, "evs")
    elif exposures is not None and evs is None:
        name, made = "exposures", read_exposures(exposures, base_time, "exposures")
    else:
        count = "both were given" if evs is not None else "neither was given"
        raise SehdrError(f"brackets need evs or exposures, and {count}; give one of them")
    for exposure in made:
        if not _SHORTEST <= exposure.time <= _LONGEST:
            time = f"{exposure.time:.6g} s ({exposure.ev:+g} EV)"
            raise SehdrError(f"{name}: {time} is outside {_SHORTEST:g} to {_LONGEST:g} seconds")
    return made


def _stops_item(ev: str | float) -> str:
    """The item of the grammar that a number of stops is."""
    text = str(ev).strip()
    try:
        if math.isfinite(float(Fraction(text))):
            return f"{text}ev"
    except (ValueError, ZeroDivisionError, OverflowError):
        pass
    raise SehdrError(f"evs: {ev!r} is no number of stops; write numbers, such as -4,-2,0,2,4")


def write_brackets(
    out: Path | str,
    views: Mapping[str, np.ndarray] | Iterable[tuple[str, np.ndarray]],
    base_time: float,
    *,
    evs: Items | None = None,
    exposures: Items | None = None,
    cameras: Mapping[str, Camera] | None = None,
    colorspace: str = "rec709",
    pixel: str = "half",
    multipart: bool = False,
    by: str = "view",
    ldr: str | None = None,
    response: Any = None,
    overwrite: bool = False,
) -> list[Path]:
    """Writes exposure brackets of HDR views; returns the EXR files.

    Every pixel is E dt, computed in float64 and rounded once. Files: `out/brackets/<view>/<view>_b<i>_ev<+x.x>.exr`
    with i ascending by exposure, by="exposure" `out/brackets/b<i>_ev<+x.x>/<view>.exr`, or `out/brackets/<view>.exr`;
    the like in `out/brackets_ldr` where ldr is given; and `out/brackets.json`. All appear together when the last one is
    written.

    Args:
        out: the folder for the files.
        views: name -> [H, W, 3] scene-linear Rec.709 radiance E, >= 0, not multiplied by an exposure time.
        base_time: seconds at 0 EV.
        evs: stops, such as "-4,-2,0" or [-4, -2, 0]; either these or exposures.
        exposures: seconds, stops or multiples of the base time, such as "1/125, -2ev, 8x"; numbers are seconds.
        cameras: by name, for the EXR attributes.
        colorspace: primaries of the EXR files.
        pixel: "half" (float where half would overflow) or "float".
        multipart: one EXR file with all exposures of a view.
        by: "view" or "exposure", what a folder is of.
        ldr: "jpeg", "png" or "png16" adds simulated photos, through the response.
        response: the camera's, for ldr.
        overwrite: replace folders that an earlier call wrote.

    Raises:
        SehdrError: for unusable exposures or options.
        InputError: where something would be replaced or a pixel is not finite.
    """
    made = bracket_exposures(base_time, evs=evs, exposures=exposures)
    brackets = Brackets(made, base_time, colorspace, pixel, multipart, ldr, response, by=by)
    radiances = dict(views)
    names = zip(safe_names(list(radiances)), radiances.items(), strict=True)
    given = ((safe, radiance, (cameras or {}).get(name)) for safe, (name, radiance) in names)
    return brackets.write(Path(out), given, overwrite)


@dataclass(frozen=True)
class Brackets:
    """What is written of each view.

    exposures: ascending, as from bracket_exposures. base_time: seconds at 0 EV. colorspace: of the EXR files. pixel:
    "half" (float where half would overflow) or "float". multipart: one EXR file with all exposures of a view. ldr: one
    of LDR_FORMATS adds simulated photos through response.encode. captured: local time. provenance: text by key, for the
    EXR attributes. by: "view" or "exposure", what a folder is of; folders by exposure hold sequences.
    """

    exposures: tuple[Exposure, ...]
    base_time: float
    colorspace: str = "rec709"
    pixel: str = "half"
    multipart: bool = False
    ldr: str | None = None
    response: Any = None
    captured: datetime | None = None
    provenance: Mapping[str, str] | None = None
    by: str = "view"

    def __post_init__(self):
        color_space(self.colorspace)
        stored_pixel_type((), self.pixel)
        if self.by not in ("view", "exposure"):
            raise SehdrError(f"folders by {self.by!r} are not one of view, exposure")
        if self.multipart and self.by == "exposure":
            raise SehdrError("a multi-part file holds all exposures of a view; leave out multipart, or by")
        if self.ldr is not None and self.ldr not in LDR_FORMATS:
            raise SehdrError(f"LDR brackets {self.ldr!r} are not one of {', '.join(LDR_FORMATS)}")
        if self.ldr is not None and self.response is None:
            raise SehdrError("LDR brackets need a camera response; give one, or leave out ldr")

    def header(self, view: str, exposure_time: float, camera: Camera | None, **facts: str) -> dict[str, Any]:
        """The EXR attributes of a picture."""
        facts = {**(self.provenance or {}), **facts, "view": view, "baseExposureTime": repr(self.base_time)}
        return exr_header(self.colorspace, exposure_time, camera, self.captured, facts)

    def write(
        self, out: Path, views: Iterable[tuple[str, np.ndarray, Camera | None]], overwrite: bool = False
    ) -> list[Path]:
        """As write_brackets() says, one view at a time: a name that is safe for files, radiance, and camera."""
        with (
            atomic_path(out / "brackets.json", overwrite) as manifest,
            atomic_folder(out / "brackets", overwrite) as folder,
            atomic_folder(out / "brackets_ldr", overwrite) if self.ldr else nullcontext(out) as photos,
        ):
            written = [self._write_view(out, folder, photos, *view) for view in views]
            described = {
                "format": MANIFEST_FORMAT,
                "software": "sehdr-warp",
                "units": "relative scene-linear radiance times exposure_time (seconds)",
                "color_space": self.colorspace,
                "base_exposure_time": self.base_time,
                "multipart": self.multipart,
                "response": getattr(self.response, "name", None),
                "ldr": self.ldr,
                "provenance": dict(self.provenance or {}),
                "views": written,
            }
            write_json(manifest, described)
        return [out / file for file in dict.fromkeys(each["file"] for view in written for each in view["exposures"])]

    def _write_view(
        self, out: Path, folder: Path, photos: Path, name: str, radiance: np.ndarray, camera: Camera | None
    ) -> dict:
        """Writes the bracket of a view; returns its entry in the manifest."""
        radiance = np.asarray(radiance, np.float64)
        if radiance.shape[2:] != (3,):
            raise ValueError(f"radiance has shape {radiance.shape}, not [H, W, 3]")
        check_finite(out / "brackets" / name, radiance, "{count} radiances")
        linear = from_rec709(radiance, self.colorspace)
        pixels = [linear * exposure.time for exposure in self.exposures]
        # One type for all exposures of a view, so that their ratios keep one precision.
        pixel = stored_pixel_type(pixels, self.pixel)
        if pixel != self.pixel:
            log.info("%s: its brackets reach above 65504, which half cannot; written as float", name)
        parts, entries = [], []
        for index, (exposure, image) in enumerate(zip(self.exposures, pixels, strict=True)):
            label, header = f"b{index}_{exposure.label}", self.header(name, exposure.time, camera, ev=repr(exposure.ev))
            parts.append(Part(rgb_channels(image), header, label))
            place = f"{name}/{name}_{label}" if self.by == "view" else f"{label}/{name}"
            file = f"{name}.exr" if self.multipart else f"{place}.exr"
            entry = {"index": index, "exposure_time": exposure.time, "ev": exposure.ev, "file": f"brackets/{file}"}
            if self.multipart:
                entry["part"] = index
            else:
                write_exr(folder / file, parts[-1].channels, pixel=pixel, header=header)
            if self.ldr:
                photo = f"{place}.{'jpg' if self.ldr == 'jpeg' else 'png'}"
                exif = exposure_exif(exposure.time, bias=exposure.ev, captured=self.captured)
                codes = quantize(self.response.encode(radiance * exposure.time), 16 if self.ldr == "png16" else 8)
                write_picture(photos / photo, codes, exif=exif)
                entry["ldr_file"] = f"brackets_ldr/{photo}"
            entries.append(entry)
        if self.multipart:
            write_multipart_exr(folder / f"{name}.exr", parts, pixel=pixel)
        return {"view": name, "pixel": pixel, "exposures": entries}
