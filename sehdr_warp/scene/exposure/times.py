"""Exposure times: from the set's own files, from EXIF, and the choice of one exposure if a view has several."""

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from statistics import median

from ...errors import InputError
from ...files import has_file, read_bytes, unique_keys
from ...json_values import damage, description_of, json_object, text
from ...subsets import counted, first_names
from ..dataparser import ImageRecord
from ..file_names import lies_at, plain_path
from ..images.exif import LONGEST, SHORTEST, exif_exposure, parse_number
from ..images.ldr_files import PHOTO_SUFFIXES
from ..photo_names import PhotoNames, fold_name, names_below

EXPOSURES = "exposures.json"
_LISTS = ("exposures", "exposure_times", "exposure")  # Names under which people list times in other files
_LIST_SUFFIXES = (".csv", ".txt", ".tsv")
_GUESS_ERROR = 0.2  # Stops by which exposures that are found by light are off; 0.15 to 0.25 on a capture without points
_CONTRADICTION = 0.3  # Stops by which rounded times in EXIF may differ from those that a set states


def choose_exposure(
    records: Sequence[ImageRecord], index: int | None, source: Path
) -> tuple[list[ImageRecord], list[str]]:
    """Choose one photo of each view.

    Args:
        records: the photos of all exposures.
        index: the exposure's number in the file names; None takes the middle one (of an even count the longer).
        source: to name in errors.

    Returns:
        The photos, and notes.

    Raises:
        InputError: if no view has the number.
    """
    keys = sorted({record.exposure_key for record in records if record.exposure_key is not None})
    request = f"exposure index {index} asked for"
    if not keys:
        if index not in (None, 0):
            raise InputError(source, f"{request}, but each view has one exposure", "leave the exposure index out")
        return list(records), []
    key, notes = keys[len(keys) // 2] if index is None else index, []
    if key not in keys:
        raise InputError(source, f"{request}, but the exposures are {keys}", f"choose one of {keys[0]} to {keys[-1]}")
    if index is None and len(keys) > 1:
        notes = [f"each view has {len(keys)} exposures {keys}; took the middle one, index {key}"]
    selected = [record for record in records if record.exposure_key in (None, key)]
    missing = sorted({record.view for record in records} - {record.view for record in selected})
    if missing:
        count = counted(len(missing), f"view without exposure {key} was", f"views without exposure {key} were")
        notes.append(f"{count} left out: {first_names(missing, 5)}")
    return selected, notes


def with_exposure_times(records: list[ImageRecord], source: Path) -> tuple[list[ImageRecord], bool, list[str]]:
    """Give each photo its exposure time.

    The set's own seconds come first, then exposures.json in the data folder or beside the images, then EXIF. An EXIF
    time counts as t (ISO / ISO_0) (N_0 / N)^2 with the first photo's ISO_0 and f-number N_0, so that photos that differ
    in sensitivity or aperture keep their ratio of recorded light; t is 1 s if no photo states a time. If most photos
    have a time, the others get the geometric mean and `time_known` False: their light is compared with the others'
    later. If most have none, each is 1 second.

    Args:
        records: the photos.
        source: the data folder.

    Returns:
        The photos, whether times are known, and notes.

    Raises:
        InputError: if exposures.json is damaged or states an impossible time.
    """
    times, notes = stated_times(records, source)
    by_exif, exif_notes = _exif_times(records, times)
    times, contradictions = _compared_with_exif(times, by_exif)
    notes = [*notes, *contradictions, *(exif_notes if None in times else ())]
    times = [other if time is None else time for time, other in zip(times, by_exif, strict=True)]
    known_times = [time for time in times if time is not None]
    for record, time in zip(records, times, strict=True):
        if time is not None and not SHORTEST <= time <= LONGEST:
            remedy = f"correct it, or state every image's seconds in {EXPOSURES}"
            raise InputError(record.image, f"exposure time {time} s is not in {SHORTEST} to {LONGEST}", remedy)
    if 2 * len(known_times) <= len(records):
        ignored = f"; times of {len(known_times)} are not counted" if known_times else ""
        state = "no exposure times were found" if not known_times else "most photos state no exposure time"
        notes.append(f"{state}: each view counts as 1 s{ignored}")
        return [replace(record, exposure_time=1.0) for record in records], False, notes
    middle = math.exp(sum(map(math.log, known_times)) / len(known_times))
    timed = [
        replace(record, exposure_time=middle if time is None else time, time_known=time is not None)
        for record, time in zip(records, times, strict=True)
    ]
    return timed, True, notes


def exposures_note(records: Sequence[ImageRecord]) -> tuple[str, ...]:
    """Return a note on the range of known exposure times of the photos that are used, if they differ."""
    times = [record.seconds / (record.gain_map_scale or 1) for record in records if record.time_known]
    if not times or max(times) <= min(times) * 1.01:
        return ()
    span = f"{shutter(min(times))} to {shutter(max(times))}".replace(" s to", " to")
    return (f"exposures differ: {span} ({math.log2(max(times) / min(times)):.1f} stops); each view keeps its own",)


def stated_times(records: Sequence[ImageRecord], source: Path) -> tuple[list[float | None], list[str]]:
    """Return the seconds of each photo by the set's own files, then by exposures.json, None without; and notes.

    Raises:
        InputError: if exposures.json is damaged or states an impossible time.
    """
    times = [record.exposure_time for record in records]
    if None not in times:
        return times, []
    table, notes = _listed_times(records, source)
    pairs = zip(times, records, strict=True)
    return [table.get(record.image) if time is None else time for time, record in pairs], notes


def shutter(time: float) -> str:
    """Return an exposure time as photographers write it: `1/640 s`, `0.4 s`, `2 s`."""
    parts = round(1 / time)
    return f"1/{parts} s" if time < 0.3 and abs(parts * time - 1) < 0.02 else f"{time:.3g} s"


def parse_seconds(value, source: Path, field: str, unit: str = "") -> float:
    """Return the seconds that JSON states as a number or as photographers write them; `unit` is "ms", "us" or "".

    Raises:
        InputError: if they are not positive and finite.
    """
    seconds = parse_number(f"{value}{unit}")
    if isinstance(value, bool) or seconds is None or not SHORTEST <= seconds <= LONGEST:
        remedy = 'state seconds above zero, such as 0.008 or "1/125"'
        raise InputError(source, f"exposure time of {field!r:.90} is {description_of(value)}", remedy)
    return seconds


def _listed_times(records: Sequence[ImageRecord], source: Path) -> tuple[dict[Path, float], list[str]]:
    """Return the seconds of photos by exposures.json, and notes on names that it could not be matched with.

    The file is {"path": seconds} or a list of {"file": path, "exposure_time": seconds}. A path is a name of the photo
    (PhotoNames), relative to the folder of exposures.json, or absolute, as in a set that was copied. The suffix may be
    that of another kind of photo.
    """
    photo_names = PhotoNames(records, source)
    parents = dict.fromkeys(record.image.parent for record in records)
    places = dict.fromkeys((source, *photo_names.bases, *parents))
    times, notes = {}, _unread_lists(places)
    for place in places:
        if not has_file(place / EXPOSURES):
            continue
        table = _read_times(place / EXPOSURES)
        spellings = {name: _spellings(name) for name in table}
        entries = {each: name for name, ways in reversed(spellings.items()) for each in reversed(ways)}
        entries |= {ways[0]: name for name, ways in spellings.items()}
        photo_spellings = set()
        for record in records:
            names = [*photo_names.of(record), *names_below(record.image, [place])]
            photo_spellings.update(names)
            if entry := next((entries[name] for name in names if name in entries), None):
                times[record.image] = table[entry]
        strange, ambiguous = [], []
        for name in (name for name, ways in spellings.items() if photo_spellings.isdisjoint(ways)):
            if images := next(filter(None, map(photo_names.sharing, spellings[name])), None):
                two = ", ".join(image.relative_to(photo_names.bases[0]).as_posix() for image in images[:2])
                ambiguous.append(f"{name:.90} ({two})")
            elif not any(lies_at(f"{base}/{plain_path(name)}") for base in places):
                strange.append(name)
        if strange:
            text = first_names([f"{name:.90}" for name in strange])
            notes.append(f"{EXPOSURES}: {len(strange)} of its {len(table)} names belong to no photo: {text}")
        if ambiguous:
            text = first_names(ambiguous)
            fit = "fits several photos, and needs its folder", "fit several photos, and need their folders"
            notes.append(f"{EXPOSURES}: {counted(len(ambiguous), f'name {fit[0]}', f'names {fit[1]}')}: {text}")
    return times, notes


def _unread_lists(places: Iterable[Path]) -> list[str]:
    """Return a note on each file that seems to list times and is not read, such as exposures.csv."""
    files = (file for place in places if place.is_dir() for file in sorted(place.iterdir()) if file.suffix)
    lists = (file.name for file in files if file.stem.lower() in _LISTS and file.name != EXPOSURES)
    unread = (name for name in lists if name.lower() == EXPOSURES or name.lower().endswith(_LIST_SUFFIXES))
    return [f'{name} is not read: write {EXPOSURES}, {{"file name": seconds, ...}}' for name in unread]


def _read_times(path: Path) -> Mapping[str, float]:
    try:
        values = json.loads(read_bytes(path, 1 << 24), object_pairs_hook=unique_keys)
        if isinstance(values, list):
            listed = [json_object(entry, f"entry {place}") for place, entry in enumerate(values)]
            values = unique_keys([(text(entry, "file"), entry["exposure_time"]) for entry in listed])
        entries = json_object(values, "it").items()
    except (ValueError, RecursionError, KeyError) as error:
        problem = f"is not a table of exposure times ({damage(error)})"
        raise InputError(path, problem, 'write {"file name": seconds, ...}') from None
    return {str(name): parse_seconds(value, path, str(name)) for name, value in entries}


def _spellings(name: str) -> list[str]:
    """Return the ways to look up a name of exposures.json: as it is, without suffix, and if absolute its last parts."""
    plain = fold_name(plain_path(name))
    path = PurePosixPath(plain)
    ends = [plain]
    if path.is_absolute() or re.match("[a-z]:/", plain):
        ends += ["/".join(path.parts[start:]) for start in range(1, len(path.parts))]
    stems = [end.removesuffix(path.suffix) for end in ends if path.suffix in PHOTO_SUFFIXES]
    return [*ends, *stems]


def _exif_times(records: Sequence[ImageRecord], stated: Sequence[float | None]) -> tuple[list[float | None], list[str]]:
    """Return the times of photos by EXIF, and notes.

    If most photos with a time state an ISO or f-number, the median counts for the others, or, if it differs much among
    photos, the others have no time. If most do not state it, it is not counted.
    If no photo has a time, `stated` by the set or in EXIF, each has 1 s: ISO and f-number still tell how their
    exposures differ. If half of the photos or more have none, no times count, so ISO and f-number do not, either.
    """
    exposures = [exif_exposure(record.image) for record in records]
    times = [exposure.time for exposure in exposures]
    timed_count = sum(time is not None or own is not None for time, own in zip(stated, times, strict=True))
    timeless = timed_count == 0
    notes, factors = [], [1.0] * len(records)
    settings = (("ISO", "iso", 1.0), ("f-number", "f_number", -2.0))
    for name, field, power in settings if timeless or 2 * timed_count > len(records) else ():
        relevant = [i for i, exposure in enumerate(exposures) if timeless or exposure.time is not None]
        values = [value for i in relevant if (value := getattr(exposures[i], field)) is not None]
        if len(set(values)) <= 1:
            continue
        lacking = {i for i in relevant if getattr(exposures[i], field) is None}
        if lacking and (timeless or 2 * len(lacking) >= len(relevant)):
            notes.append(f"{name} is not stated by {len(lacking)} of {len(relevant)} photos and was not counted")
            continue
        usual = median(values)
        note = f"{name} differs ({min(values):g} to {max(values):g}); exposure times are relative to {values[0]:g}"
        if lacking:
            note += f"; {counted(len(lacking), 'photo does', 'photos do')} not state it"
            without = [None if i in lacking else time for i, time in enumerate(times)]
            deviation = sum(abs(power * math.log2(value / usual)) for value in values) / len(values)
            if deviation > _GUESS_ERROR and 2 * sum(time is not None for time in without) > len(records):
                times = without
            else:
                note += f", for which {usual:g} counts"
        notes.append(note)
        factors = [
            f * ((getattr(exposure, field) or usual) / values[0]) ** power
            for f, exposure in zip(factors, exposures, strict=True)
        ]
    if flashed := [record.image.name for record, e in zip(records, exposures, strict=True) if e.flash]:
        count = f"{len(flashed)} of {len(records)} photos"
        notes.append(f"the flash fired in {count}, so their light is not the scene's: {first_names(flashed)}")
    if timeless and max(factors) > min(factors):
        return list(factors), [*notes, "photos state no exposure time, and count as 1 s at the first one's settings"]
    return [time and time * factor for time, factor in zip(times, factors, strict=True)], notes


def _compared_with_exif(
    times: Sequence[float | None], by_exif: Sequence[float | None]
) -> tuple[list[float | None], list[str]]:
    """Return stated times, in seconds if EXIF shows that they have another unit, and a note if EXIF contradicts."""
    pairs = [(time, other) for time, other in zip(times, by_exif, strict=True) if time and other]
    stops = [math.log2(time / other) for time, other in pairs if SHORTEST <= time <= LONGEST]
    middle = median(stops) if stops else 0.0
    if (most := max((abs(each - middle) for each in stops), default=0.0)) > _CONTRADICTION:
        note = f"stated exposure times differ by up to {most:.1f} stops from EXIF, which counts ISO and f-number"
        return list(times), [f"{note}; the stated ones count"]
    for unit, factor in (("milliseconds", 1e3), ("microseconds", 1e6)):
        if abs(middle - math.log2(factor)) < _CONTRADICTION:
            note = f"stated exposure times are {factor:g} times those of EXIF, and count as {unit}"
            return [time and time / factor for time in times], [note]
    return list(times), []
