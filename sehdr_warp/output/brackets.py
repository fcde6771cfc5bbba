"""Exposure brackets of HDR views: scene-linear EXR files whose ratios are exact, and simulated photos of them."""

import logging
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import SehdrError, path_of
from ..files import atomic_folder, atomic_path, remove, write_json
from ..model.exposure import Exposure, Exposures, read_exposures
from ..own_files import is_own
from ..scene import Camera
from ..scene.camera import require_camera
from ..scene.file_names import safe_names
from .images.colorspace import from_rec709
from .images.exr import PAST_HALF, check_finite, check_pixel_type, stored_pixel_type, write_multipart_exr
from .images.ldr_files import exposure_exif, quantize, write_picture
from .picture_header import PictureHeader

log = logging.getLogger(__name__)
LDR_FORMATS = ("jpeg", "png", "png16")
MANIFEST_FORMAT = 1

_SHORTEST, _LONGEST = 1e-6, 1e6  # EXIF rationals and 32-bit expTime hold these; real shutters lie far inside


def bracket_exposures(
    base_time: float, *, evs: Exposures | None = None, exposures: Exposures | None = None
) -> tuple[Exposure, ...]:
    """Return the exposures of a bracket, ascending.

    Args:
        base_time: Seconds at 0 EV.
        evs: Stops, such as "-4,-2,0" or [-4, -2, 0]. Set either evs or exposures.
        exposures: Seconds, stops or multiples of the base time, such as "1/125, -2ev, 8x"; numbers are seconds.

    Raises:
        SehdrError: With the value, if both or none are set, an item cannot be read or appears twice, or a time is
            outside 1e-6 to 1e6 seconds.
    """
    if evs is not None and exposures is None:
        if not isinstance(evs, str | Iterable):
            raise TypeError(f"evs is {evs!r:.60}, expected a list of stops, or text with commas")
        stops = [ev for ev in evs.split(",") if ev.strip()] if isinstance(evs, str) else evs
        name, bracket = "evs", read_exposures([_stops_item(ev) for ev in stops], base_time, "evs")
    elif exposures is not None and evs is None:
        name, bracket = "exposures", read_exposures(exposures, base_time, "exposures")
    else:
        count = "both are set" if evs is not None else "neither is set"
        raise SehdrError(f"brackets need either evs or exposures, and {count}; set one of them")
    for exposure in bracket:
        if not _SHORTEST <= exposure.time <= _LONGEST:
            time = f"{exposure.time:.6g} s ({exposure.ev:+g} EV)"
            raise SehdrError(f"{name}: {time} is outside {_SHORTEST:g} to {_LONGEST:g} seconds")
    return bracket


def _stops_item(ev: str | float) -> str:
    """Return a number of stops as an item of read_exposures."""
    text = str(ev).strip()
    try:
        if math.isfinite(float(Fraction(text))):
            return f"{text}ev"
    except (ValueError, ZeroDivisionError, OverflowError):
        pass
    raise SehdrError(f"evs: {ev!r} is not a number of stops; write numbers, such as -4,-2,0,2,4")


def write_brackets(
    out: Path | str,
    views: Mapping[str, np.ndarray] | Iterable[tuple[str, np.ndarray]],
    base_time: float,
    *,
    evs: Exposures | None = None,
    exposures: Exposures | None = None,
    cameras: Mapping[str, Camera] | None = None,
    colorspace: str = "rec709",
    pixel: str = "half",
    multipart: bool = False,
    group_by: str = "view",
    ldr: str | None = None,
    response: Any = None,
    overwrite: bool = False,
) -> list[Path]:
    """Write exposure brackets of HDR views and return the paths of the EXR files.

    Every pixel is radiance times exposure time, computed in float64 and rounded once. The files are
    `out/brackets/<view>/<view>_b<i>_ev<+x.x>.exr` with i ascending by exposure (group_by="exposure":
    `out/brackets/b<i>_ev<+x.x>/<view>.exr`; multipart: `out/brackets/<view>.exr`), the same in `out/brackets_ldr` if
    ldr is set, and `out/brackets.json`. All appear together once the last one is written.

    Args:
        out: Folder for the files.
        views: Name -> [H, W, 3] scene-linear Rec.709 radiance, >= 0, not multiplied by an exposure time. Files of a
            repeated name get a number.
        base_time: Seconds at 0 EV.
        evs: Stops, such as "-4,-2,0" or [-4, -2, 0]. Set either evs or exposures.
        exposures: Seconds, stops or multiples of the base time, such as "1/125, -2ev, 8x"; numbers are seconds.
        cameras: Camera of each view by name, for the EXR attributes.
        colorspace: Primaries of the EXR files.
        pixel: "half" (float if half would overflow) or "float".
        multipart: Write one EXR file with all exposures of a view.
        group_by: "view" or "exposure": what one folder holds.
        ldr: "jpeg", "png" or "png16" adds simulated photos through the response.
        response: Camera response for ldr.
        overwrite: Replace the files that an earlier call wrote.

    Raises:
        SehdrError: For unusable exposures or options.
        InputError: If a file would be replaced or a pixel is not finite.
        TypeError: For pictures that are not floats, such as a photo's codes.
    """
    writer = BracketWriter(
        out=path_of(out, "out"),
        exposures=bracket_exposures(base_time, evs=evs, exposures=exposures),
        header=PictureHeader(base_time, colorspace),
        pixel=pixel,
        multipart=multipart,
        ldr=ldr,
        response=response,
        group_by=group_by,
    )
    radiances = _radiances(views)
    cameras = {} if cameras is None else cameras
    if not isinstance(cameras, Mapping):
        raise TypeError(f"cameras is a {type(cameras).__name__}, expected a dict of names and Cameras")
    names = [name for name, _ in radiances]
    for name, camera in cameras.items():
        require_camera(camera)
        if name not in names:
            raise SehdrError(f"cameras has {name!r:.60}, which is not one of the views")
    with writer.open(overwrite):
        for file_name, (name, radiance) in zip(safe_names(names), radiances, strict=True):
            writer.write(file_name, radiance, cameras.get(name))
    if overwrite and ldr is None:
        remove_earlier(writer.out, ["brackets_ldr"])
    return writer.files()


def _radiances(views: Any) -> list[tuple[str, Any]]:
    """Return the pairs of names and radiance of views; raise TypeError for another value, SehdrError for none."""
    pairs = views.items() if isinstance(views, Mapping) else views
    radiances = list(pairs) if isinstance(pairs, Iterable) else [pairs]
    for pair in radiances:
        if not (isinstance(pair, tuple | list) and len(pair) == 2 and isinstance(pair[0], str)):
            raise TypeError("views is neither a dict of names and their radiance [H, W, 3] nor a list of such pairs")
    if not radiances:
        raise SehdrError("views is empty; give the radiance of a view at least")
    return radiances


def remove_earlier(out: Path, names: Iterable[str]) -> None:
    """Remove files and folders of `out` that an earlier call wrote and this one does not.

    What was changed since, or is not this program's, stays, and a warning names it.
    """
    for path in (out / name for name in names):
        if is_own(path):
            remove(path)
            log.info("%s: removed, because an earlier call wrote it and this one does not", path)
        elif os.path.lexists(path):
            log.warning("%s: kept, although this call did not write it: it is yours, or was changed", path)


@dataclass
class BracketWriter:
    """Writes the brackets of views one at a time, within open()."""

    out: Path  # Folder that the files belong to
    exposures: tuple[Exposure, ...]  # Ascending, as from bracket_exposures
    header: PictureHeader  # Of the pictures
    pixel: str = "half"  # "half" (float if half would overflow) or "float"
    multipart: bool = False  # One EXR file with all exposures of a view
    ldr: str | None = None  # One of LDR_FORMATS to add simulated photos through response.encode, or None
    response: Any = None  # Camera response for ldr
    group_by: str = "view"  # "view" or "exposure": what one folder holds. Folders by exposure hold image sequences.
    manifest_views: list[dict] = field(default_factory=list)  # Entries of brackets.json so far

    def __post_init__(self):
        """Raise SehdrError for options that contradict each other."""
        check_pixel_type(self.pixel)
        if self.group_by not in ("view", "exposure"):
            raise SehdrError(f"group_by {self.group_by!r} is not one of view, exposure")
        if self.multipart and self.group_by == "exposure":
            raise SehdrError("a multi-part file holds all exposures of a view; leave out multipart, or group_by")
        if self.ldr is not None and self.ldr not in LDR_FORMATS:
            raise SehdrError(f"LDR brackets {self.ldr!r} are not one of {', '.join(LDR_FORMATS)}")
        if self.ldr is not None and self.response is None:
            raise SehdrError("LDR brackets need a camera response; pass response, or leave out ldr")
        if self.response is not None and (isinstance(self.response, str) or not hasattr(self.response, "encode")):
            raise TypeError(f"response is {self.response!r:.60}, expected a curve, as response_by_name() returns it")

    @contextmanager
    def open(self, overwrite: bool = False) -> Iterator[None]:
        """Let write() be called; the files appear together when the context ends without an error.

        overwrite: Replace folders that an earlier call wrote.
        """
        with (
            atomic_path(self.out / "brackets.json", overwrite) as manifest,
            atomic_folder(self.out / "brackets", overwrite) as self._folder,
            atomic_folder(self.out / "brackets_ldr", overwrite) if self.ldr else nullcontext(self.out) as self._photos,
        ):
            yield
            described = {
                "format": MANIFEST_FORMAT,
                "software": "sehdr-warp",
                "units": "scene-linear radiance times exposure_time (seconds)",
                "color_space": self.header.colorspace,
                "base_exposure_time": self.header.base_time,
                "multipart": self.multipart,
                "response": getattr(self.response, "name", None),
                "ldr": self.ldr,
                "provenance": dict(self.header.provenance),
                "views": self.manifest_views,
            }
            write_json(manifest, described)

    def files(self) -> list[Path]:
        """Return the paths of the EXR files and of the photos beside them."""
        entries = [entry for view in self.manifest_views for entry in view["exposures"]]
        names = dict.fromkeys(entry[kind] for kind in ("file", "ldr_file") for entry in entries if kind in entry)
        return [self.out / name for name in names]

    def write(self, name: str, radiance: Any, camera: Camera | None) -> None:
        """Write the bracket of a view: its radiance, [H, W, 3] scene-linear Rec.709; `name` is safe for files.

        Simulated photos encode this radiance, so that merging them by the response gives it back.

        Raises:
            TypeError: For values that are not floats.
            ValueError: For another shape.
        """
        values = radiance
        if hasattr(radiance, "detach"):  # A tensor, perhaps of a GPU or with half precision
            values = radiance.detach().cpu()
            values = values.double() if values.is_floating_point() else values
        dtype = np.asarray(values).dtype
        if dtype.kind != "f":
            remedy = "pass radiance as floats, such as response.decode(codes / 255) / exposure_time of a photo's codes"
            raise TypeError(f"views[{name!r:.90}] has dtype {dtype}, which is not radiance; {remedy}")
        radiance = np.asarray(values, np.float64)
        if radiance.shape[2:] != (3,) or not radiance.size:
            raise ValueError(f"radiance has shape {radiance.shape}, not [H, W, 3]")
        if camera is not None and (camera.height, camera.width) != radiance.shape[:2]:
            size = f"{radiance.shape[1]} x {radiance.shape[0]}"
            problem = f"the camera of view {name} is {camera.width} x {camera.height}, its radiance {size}"
            raise ValueError(f"{problem}; pass camera.resized(width, height)")
        check_finite(self.out / "brackets" / name, radiance, "{count} radiances")
        # One type for all exposures of a view, so that their ratios keep one precision.
        pixel = stored_pixel_type([from_rec709(radiance, self.header.colorspace) * self.exposures[-1].time], self.pixel)
        # write_multipart_exr() sees one exposure, so it cannot tell why the type is another one.
        reason = {"pixelType": PAST_HALF} if pixel != self.pixel else {}
        if reason:
            log.info("%s: its brackets reach above 65504, which half cannot; written as float", name)
        parts, entries = [], []
        digits = len(str(len(self.exposures) - 1))  # Tools sort files by name.
        for index, exposure in enumerate(self.exposures):
            label = f"b{index:0{digits}d}_{exposure.label}"
            facts = {"view": name, "ev": repr(exposure.ev), **reason}
            title = label if self.multipart else ""
            part = self.header.part(radiance, exposure.time, camera, {}, title, **facts)
            place = f"{name}/{name}_{label}" if self.group_by == "view" else f"{label}/{name}"
            file = f"{name}.exr" if self.multipart else f"{place}.exr"
            entry = {"index": index, "exposure_time": exposure.time, "ev": exposure.ev, "file": f"brackets/{file}"}
            if self.multipart:
                entry["part"] = index
                parts.append(part)
            else:
                write_multipart_exr(self._folder / file, [part], pixel=pixel)
            if self.ldr:
                photo = f"{place}.{'jpg' if self.ldr == 'jpeg' else 'png'}"
                exif = exposure_exif(exposure.time, bias=exposure.ev, captured=self.header.captured)
                codes = quantize(self.response.encode(radiance * exposure.time), 16 if self.ldr == "png16" else 8)
                write_picture(self._photos / photo, codes, exif=exif)
                entry["ldr_file"] = f"brackets_ldr/{photo}"
            entries.append(entry)
        if self.multipart:
            write_multipart_exr(self._folder / f"{name}.exr", parts, pixel=pixel)
        self.manifest_views.append({"view": name, "pixel": pixel, "exposures": entries})
