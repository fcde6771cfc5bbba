"""EXIF of photos: exposure, lens and camera, as cameras and tools write them."""

import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from PIL import Image

from ...errors import InputError
from ..raw.decode import read_header
from .heif import HEIF_SUFFIXES
from .ldr_files import HDR_SUFFIXES, JPEG_SUFFIXES, PILLOW_ERRORS, RAW_SUFFIXES, exif_of, open_image
from .xmp import xmp_of, xmp_values

SHORTEST, LONGEST = 1e-12, 1e12  # Seconds: what an exposure time may be
_LONGEST_EXPOSURE = 86_400  # Seconds that a camera exposes; EXIF's 4294967295 stands for unknown
_EXIF_IFD = 0x8769
_CAMERA, _LENS = (271, 272), (42036, 37386, 33437)  # Make and model; lens, focal length, f-number
_EXPOSURE_TIME, _SHUTTER_APEX = 33434, 37377
_F_NUMBER, _APERTURE_APEX = 33437, 37378
_ISO_TAGS = (34855, 34866, 34867, 34865)
"""PhotographicSensitivity, and what holds the ISO speed above its 16 bits: RecommendedExposureIndex, ISOSpeed,
StandardOutputSensitivity (EXIF 2.3)."""
_FLASH = 37385  # Its lowest bit: the flash fired
_LARGEST_SHORT = 65535
_UNITS = {"": 1.0, "s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6}
_LETTERS = " " + "".join(_UNITS)  # Seconds of a unit behind a number, and what may stand there
_IN_XMP = {
    _EXPOSURE_TIME: "exif:ExposureTime", _SHUTTER_APEX: "exif:ShutterSpeedValue", _F_NUMBER: "exif:FNumber",
    _APERTURE_APEX: "exif:ApertureValue", 34855: "exif:ISOSpeedRatings", 34867: "exifEX:PhotographicSensitivity",
}  # fmt: skip
"""Names of tags in XMP, where editors copy them: PNG and WebP files often have XMP alone."""


class ExifExposure(NamedTuple):
    """Exposure that EXIF states."""

    time: float | None = None  # Seconds
    iso: float | None = None  # ISO speed
    f_number: float | None = None  # Focal length over aperture
    flash: bool = False  # It fired


def exif_exposure(path: Path) -> ExifExposure:
    """Read the exposure that a photo states; None for what it does not state, or states as a value that cannot be.

    Times and f-numbers are also read from their APEX tags, from the first IFD, from XMP, and from text with commas or
    fractions.

    Raises:
        InputError: if the file is not an image.
    """
    if path.suffix.lower() in HDR_SUFFIXES:
        return ExifExposure()
    try:
        if path.suffix.lower() in RAW_SUFFIXES:
            header = read_header(path)
            return ExifExposure(header.exposure_time, header.iso, header.f_number)
        with open_image(path) as image:
            first = exif_of(image)
            tables = first.get_ifd(_EXIF_IFD), first, _xmp_table(image)
            numbers = {tag: _of_tag(tables, tag) for tag in (_EXPOSURE_TIME, _SHUTTER_APEX, _F_NUMBER, _APERTURE_APEX)}
            speeds = [_of_tag(tables, tag) for tag in _ISO_TAGS]
            flash = bool(int(_of_tag(tables, _FLASH) or 0) & 1)
    except PILLOW_ERRORS:
        return ExifExposure()
    time = _within(numbers[_EXPOSURE_TIME], SHORTEST, _LONGEST_EXPOSURE)
    if time is None and (apex := _within(numbers[_SHUTTER_APEX], -64, 64)) is not None:
        time = 2.0**-apex
    f_number = _within(numbers[_F_NUMBER], 1e-3, 1e4)
    if f_number is None and (apex := _within(numbers[_APERTURE_APEX], 1e-3, 64)) is not None:
        f_number = 2.0 ** (apex / 2)
    speeds[0] = None if speeds[0] == _LARGEST_SHORT else speeds[0]
    iso = next((speed for speed in speeds if _within(speed, 1e-3, 1e9) is not None), None)
    return ExifExposure(time, iso, f_number, flash)


@lru_cache(maxsize=4096)
def exif_lens(path: Path | None) -> tuple[str, ...]:
    """Return what EXIF states of how a photo's corners darken: camera, lens, focal length and f-number.

    The result is empty if EXIF states none of them, or there is no such file.
    """
    if path is None or path.suffix.lower() in (*HDR_SUFFIXES, *RAW_SUFFIXES) or not path.is_file():
        return ()
    try:
        with open_image(path) as image:
            first = exif_of(image)
            table = first.get_ifd(_EXIF_IFD)
            values = [first.get(tag) for tag in _CAMERA] + [table.get(tag) for tag in _LENS]
    except (*PILLOW_ERRORS, InputError):
        return ()
    return exif_texts(*values) if set(values) != {None} else ()


def exif_texts(*values: Any) -> tuple[str, ...]:
    """Return values of EXIF as texts, without the spaces and zeros with which some cameras and tools fill them up."""
    return tuple(str(value).strip(" \0") for value in values)


def are_camera_files(sources: Sequence[Path | None]) -> bool:
    """Return whether most of the files are JPEG or HEIC of a camera: their EXIF states an exposure time or f-number."""
    kinds = JPEG_SUFFIXES + HEIF_SUFFIXES
    photos = (path for path in sources if path and path.suffix.lower() in kinds and path.is_file())
    exposures = [exif_exposure(photo) for photo in photos]
    return 2 * sum(bool(exposure.time or exposure.f_number) for exposure in exposures) > len(sources)


def _xmp_table(image: Image.Image) -> dict[int, list[str]]:
    """Return what the XMP of an image states by the numbers of EXIF's tags."""
    try:
        xmp = xmp_of(image)
    except ValueError:
        return {}
    return {tag: xmp_values(xmp, name) for tag, name in _IN_XMP.items()} if xmp else {}


def _of_tag(tables: Iterable[Any], tag: int) -> float | None:
    """Return the first usable number of a tag in EXIF's own table or, as some tools write it, another one."""
    for table in tables:
        value = table.get(tag)
        for item in value if isinstance(value, tuple | list) else [value]:
            number = _number(item)
            if number is not None and math.isfinite(number):
                return number
    return None


def _number(value: Any) -> float | None:
    if isinstance(value, bytes):
        value = value.decode("latin-1")
    if isinstance(value, str):
        return parse_number(value)
    try:
        return float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None


def parse_number(text: str) -> float | None:
    """Return the number that a text states as photographers write it, None if it is not a number.

    `1/125`, `0,008` and `8 ms` are seconds.
    """
    number = text.strip(" \0").rstrip(_LETTERS)
    unit = text.strip(" \0").removeprefix(number).strip()
    whole, _, parts = number.replace(",", ".").partition("/")
    try:
        return float(whole) / float(parts or 1) * _UNITS[unit]
    except (KeyError, ValueError, ZeroDivisionError, OverflowError):
        return None


def _within(number: float | None, least: float, most: float) -> float | None:
    return number if number is not None and least <= number <= most else None
