"""Exposure times: from the set's own files, from EXIF, and the choice of one exposure where a view has several."""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..files import read_bytes
from .dataparser import ImageRecord
from .images import HDR_SUFFIXES, PILLOW_ERRORS, RAW_SUFFIXES, exif_of, open_image

_EXIF_IFD = 0x8769
_CAMERA, _LENS = (271, 272), (42036, 37386, 33437)  # Make and model; lens, focal length, f-number
_EXPOSURE_TIME, _F_NUMBER, _SPEED, _SHUTTER_APEX = 33434, 33437, 34855, 37377
SHORTEST, LONGEST = 1e-12, 1e12
"""Seconds: what an exposure time may be."""
_REMEDY = "correct it, or state every image's seconds in exposures.json"


def choose_exposure(
    records: Sequence[ImageRecord], index: int | None, source: Path
) -> tuple[list[ImageRecord], list[str]]:
    """One record of each view, and notes.

    index: the exposure's number in the file names; None takes the middle one (of an even count the longer).
    Raises InputError where no view has the number.
    """
    keys = sorted({record.exposure_key for record in records if record.exposure_key is not None})
    asked = f"exposure index {index} asked for"
    if not keys:
        if index not in (None, 0):
            raise InputError(source, f"{asked}, but each view has one exposure", "leave the exposure index out")
        return list(records), []
    chosen, notes = keys[len(keys) // 2] if index is None else index, []
    if chosen not in keys:
        raise InputError(source, f"{asked}, but the exposures are {keys}", f"choose one of {keys[0]} to {keys[-1]}")
    if index is None and len(keys) > 1:
        notes = [f"each view has {len(keys)} exposures {keys}; took the middle one, index {chosen}"]
    taken = [record for record in records if record.exposure_key in (None, chosen)]
    missing = sorted({record.view for record in records} - {record.view for record in taken})
    if missing:
        notes.append(f"{len(missing)} views without exposure {chosen} were left out: {', '.join(missing[:5])}")
    return taken, notes


def with_exposure_times(records: list[ImageRecord], source: Path) -> tuple[list[ImageRecord], bool, list[str]]:
    """The records with a time each, whether the times are known, and notes.

    The set's own seconds come first, then `exposures.json` beside the images or in the data folder, then EXIF. An
    EXIF time counts as t (ISO / ISO_0) (N_0 / N)^2 with the first photo's ISO_0 and f-number N_0, so that photos that
    differ in sensitivity or aperture keep their ratio of recorded light. With none at all, each is 1 second.
    Raises InputError for a time that is not positive and finite, and where only some photos state one.
    """
    stated, strange, notes = [record.exposure_time for record in records], [], []
    if None in stated:
        listed, strange = _listed_times(records, source)
        stated = [listed.get(s.image.name) if time is None else time for time, s in zip(stated, records, strict=True)]
    if set(stated) == {None}:
        stated, notes = _exif_times(records)
    notes = [*strange, *notes]
    times = [float(time) for time in stated if time is not None]
    for record, time in zip(records, stated, strict=True):
        if time is None and times:
            problem = f"exposure time is absent in {len(records) - len(times)} of {len(records)} images"
            problem += "".join(f" ({note})" for note in strange)
            raise InputError(record.image, problem, "state all in exposures.json, or strip them all")
        if time is not None and not SHORTEST <= time <= LONGEST:
            raise InputError(record.image, f"exposure time {time} s is not in {SHORTEST} to {LONGEST}", _REMEDY)
    if not times:
        notes.append("no exposure times were found: each view counts as 1 s")
        return [replace(record, exposure_time=1.0) for record in records], False, notes
    shortest, longest = min(times), max(times)
    if longest > shortest * 1.01:
        stops = math.log2(longest / shortest)
        span = f"{shutter(shortest)} to {shutter(longest)}".replace(" s to", " to")
        notes.append(f"exposures differ: {span} ({stops:.1f} stops); each view keeps its own")
    return [replace(record, exposure_time=time) for record, time in zip(records, times, strict=True)], True, notes


def shutter(time: float) -> str:
    """An exposure time as photographers write it: `1/640 s`, `0.4 s`, `2 s`."""
    parts = round(1 / time)
    return f"1/{parts} s" if time < 0.3 and abs(parts * time - 1) < 0.02 else f"{time:.3g} s"


def parse_seconds(value, source: Path, field: str) -> float:
    """A positive, finite number of seconds from JSON, or a text as photographers write it; InputError otherwise."""
    try:
        whole, _, parts = str(value).partition("/")
        seconds = float(whole) / float(parts or 1)
    except (TypeError, ValueError, OverflowError, ZeroDivisionError):
        seconds = math.nan
    if not SHORTEST <= seconds <= LONGEST:
        remedy = 'state seconds above zero, such as 0.008 or "1/125"'
        raise InputError(source, f"exposure time of {field!r:.90} is {value!r:.40}", remedy)
    return seconds


def _listed_times(records: list[ImageRecord], source: Path) -> tuple[dict[str, float], list[str]]:
    """exposures.json, {"file name": seconds} or a list of {"file": ..., "exposure_time": seconds}; and a note, if it
    names what is not there."""
    places = (folder / "exposures.json" for folder in (records[0].image.parent, source))
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        return {}, []
    try:
        values = json.loads(read_bytes(path, 1 << 24))
        if isinstance(values, list):
            values = {entry["file"]: entry["exposure_time"] for entry in values}
        entries = values.items()
    except (ValueError, RecursionError, TypeError, KeyError, AttributeError) as error:
        problem = f"is not a table of exposure times ({error!r:.80})"
        raise InputError(path, problem, 'write {"file name": seconds, ...}') from None
    listed = {Path(str(name)).name: parse_seconds(value, path, str(name)) for name, value in entries}
    folders = {record.image.parent for record in records} | {source}
    strange = [name for name in listed if not any((folder / name).exists() for folder in folders)]
    named = ", ".join(strange[:3]) + (" ..." if len(strange) > 3 else "")
    note = f"{path.name}: {len(strange)} of its {len(listed)} names belong to no photo: {named}"
    return listed, [note] * bool(strange)


def _exif_times(records: list[ImageRecord]) -> tuple[list[float | None], list[str]]:
    settings = [exif_exposure(record.image) for record in records]
    notes, factors = [], [1.0] * len(records)
    for name, place, power in (("ISO", 1, 1.0), ("f-number", 2, -2.0)):
        values = [value for setting in settings if (value := setting[place]) is not None]
        if 0 < len(values) < len(records):
            notes.append(f"{name} is not stated for all photos and was not counted")
        elif len(set(values)) > 1:
            factors = [f * (v / values[0]) ** power for f, v in zip(factors, values, strict=True)]
            span = f"{min(values):g} to {max(values):g}"
            notes.append(f"{name} differs ({span}); exposure times are relative to {values[0]:g}")
    return [None if t is None else t * f for (t, _, _), f in zip(settings, factors, strict=True)], notes


def exif_exposure(path: Path) -> tuple[float | None, float | None, float | None]:
    """Exposure time in seconds, ISO speed and f-number as EXIF states them, None where it does not.

    Raises InputError for an exposure time of zero or one that is not a number, and where the file is no image.
    """
    if path.suffix.lower() in HDR_SUFFIXES:
        return None, None, None
    try:
        if path.suffix.lower() in RAW_SUFFIXES:
            from .linear_photos import raw_exposure

            return raw_exposure(path)
        with open_image(path) as image:
            table = exif_of(image).get_ifd(_EXIF_IFD)
            tags = (_EXPOSURE_TIME, _SHUTTER_APEX, _SPEED, _F_NUMBER)
            time, apex, speed, aperture = (_number(table.get(tag)) for tag in tags)
    except PILLOW_ERRORS:
        return None, None, None
    if time is None and apex is not None and math.isfinite(apex) and abs(apex) < 64:
        time = 2.0**-apex
    if time is not None and not (math.isfinite(time) and time > 0):
        raise InputError(path, f"EXIF exposure time is {time}", _REMEDY)
    return time, speed if speed and 0 < speed < 1e9 else None, aperture if aperture and 0 < aperture < 1e4 else None


@lru_cache(maxsize=4096)
def exif_lens(path: Path | None) -> tuple[str, ...]:
    """What EXIF states of how a photo's corners darken: camera, lens, focal length and f-number; empty where it states
    none of them, and where there is no such file."""
    if path is None or path.suffix.lower() in (*HDR_SUFFIXES, *RAW_SUFFIXES) or not path.is_file():
        return ()
    try:
        with open_image(path) as image:
            first = exif_of(image)
            table = first.get_ifd(_EXIF_IFD)
            stated = [first.get(tag) for tag in _CAMERA] + [table.get(tag) for tag in _LENS]
    except (*PILLOW_ERRORS, InputError):
        return ()
    return tuple(map(str, stated)) if set(stated) != {None} else ()


def are_camera_jpegs(sources: Sequence[Path | None]) -> bool:
    """Whether most of the files are a camera's own: JPEGs whose EXIF states an exposure time or f-number."""
    photos = (path for path in sources if path and path.suffix.lower() in (".jpg", ".jpeg") and path.is_file())
    made = sum(any(exif_exposure(photo)[::2]) for photo in photos)
    return 2 * made > len(sources)


def _number(value: Any) -> float | None:
    value = value[0] if isinstance(value, tuple) and value else value
    try:
        return float(value)
    except ZeroDivisionError:
        return math.nan
    except (TypeError, ValueError):
        return None
