"""Photos of any kind (encoded, RAW, float), by their suffix: sizes, codes, and checks by their headers.

What cannot be used is left out and named before anything is decoded.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..subsets import first_names
from .color.encoding import encoding_of, note_of
from .dataparser import UNPLACED, ImageRecord
from .file_names import MASK_FOLDERS
from .float_photos import tone_mapped
from .images.hdr_files import hdr_size, pixel_aspect
from .images.heif import avif_bits
from .images.ldr_files import EncodedImage, file_kind, image_sizes, open_image, orientation_of, read_ldr, require_file
from .lens import Lens
from .raw.decode import read_header, read_raw

FEWEST_PHOTOS = 3  # A training needs at least as many
_MOST_EXPLAINED = 3  # Photos of which a note says why they cannot be used
_SMALLEST, _LARGEST = 1 / 32, 8  # Size of a photo in parts of its camera's
_LEAST_SQUARE = 0.01  # Part by which the sides of a pixel may differ and count as equal
_KINDS = {"encoded": "JPEG and similar photos", "raw": "RAW photos", "float": "float images"}
_ENCODED = {b"\xff\xd8\xff": ("JPEG", ".jpg"), b"\x89PNG\r\n": ("PNG", ".png")}
BRIGHTENING = 0.3, 0.4, 3 / 255
"""Values of brightened_codes(): midtone and least exponent as in training.matching, and noise of a black background."""


def usable_photos(records: Sequence[ImageRecord]) -> tuple[list[ImageRecord], str, list[str]]:
    """Check photos by their headers, and read what they state of their colors.

    Photos that cannot be opened, do not fit their camera's size, or are of another kind than most are left out, unless
    too few would remain.

    Args:
        records: the photos; those without a camera yet have no lens to fit.

    Returns:
        The usable photos, their kind (encoded, linear, raw or float), and notes.

    Raises:
        InputError: if most photos cannot be used, as the first of them.
    """
    if not records or any(record.derived for record in records):
        return list(records), "encoded", []
    kind, selected, notes = _most_common_kind(records)
    usable, problems = [], []
    for record in selected:
        try:
            usable.append(_check_size(record))
        except InputError as error:
            problems.append(error)
    notes += unusable_notes(problems, len(selected))
    if kind == "encoded":
        notes += note_of({record.image: record.encoding for record in usable})
        if deep := [record.image.name for record in usable if avif_bits(record.image) > 8]:
            notes.append(f"AVIF is read with 8 bits, and {_names_text(deep)} hold more: use HEIC, PNG or TIFF for all")
        light = [record.encoding is not None and record.encoding.light is not None for record in usable]
        if any(light):
            linear = 2 * sum(light) >= len(light)
            odd = [r.image.name for r, states in zip(usable, light, strict=True) if states != linear]
            usable = [record for record, states in zip(usable, light, strict=True) if states == linear]
            kind = "linear" if linear else kind
            if odd:
                state = "do not state their light as the others do" if linear else "state light and the others do not"
                notes.append(f"{_names_text(odd)} {state} and were left out")
    return usable, kind, notes


def fitted_lens(record: ImageRecord) -> tuple[Lens, bool]:
    """Return the lens at the photo's size, and whether the pixels are to be turned as EXIF says.

    COLMAP ignores the EXIF orientation, other tools follow it: the size that agrees with the camera's decides, and the
    stored orientation wins if both agree. Photos may be smaller or larger than the camera's size, as of images_2 or
    enlarged by a network, if their sides have its ratio to a pixel.

    Raises:
        InputError: if the photo has another shape in both orientations.
    """
    lens = record.lens
    size, turned = photo_sizes(record.image)
    choices = [(size, False), (turned, True)] if record.oriented is None else [(turned, True)]
    for (width, height), oriented in choices:
        if (width, height) == (lens.width, lens.height):
            return lens, oriented
    for (width, height), oriented in choices:
        factor = max(width, height) / max(lens.width, lens.height)
        off = max(abs(lens.width * factor - width), abs(lens.height * factor - height))
        if _SMALLEST <= factor <= _LARGEST and off < max(1, factor):
            return lens.resized(width, height), oriented
    problem = f"image is {size[0]} x {size[1]}, its camera {lens.width} x {lens.height}"
    raise InputError(record.image, problem, "use the images that the cameras were solved for")


def unusable_notes(problems: Sequence[InputError], count: int, *, truth: bool = False) -> list[str]:
    """Return a note on the photos, of `count`, that have a problem and are left out; with `truth` on files of truth.

    Raises:
        InputError: the first problem, if more than half of them or all but two photos have one.
    """
    if not problems:
        return []
    if 2 * len(problems) > count or (not truth and count - len(problems) < min(FEWEST_PHOTOS, count)):
        raise problems[0]
    # A mask may have the name of its photo, so its folder is named too.
    paths = [Path(error.path) for error in problems]
    names = [f"{p.parent.name}/" * (p.parent.name.lower() in MASK_FOLDERS) + p.name for p in paths]
    reasons = "; ".join(f"{name}: {error.problem}" for name, error in zip(names[:_MOST_EXPLAINED], problems))
    more = "; and " * (len(names) > _MOST_EXPLAINED) + ", ".join(names[_MOST_EXPLAINED:])
    files = "files of truth" if truth else "photos"
    return [f"{len(problems)} of {count} {files} cannot be used and were left out ({reasons}{more})"]


def decoding_problems(photos: Sequence[Path]) -> list[InputError]:
    """Return the problem of each photo that cannot be decoded."""
    problems = []
    for photo in photos:
        try:
            read_photo(photo)
        except InputError as error:
            problems.append(error)
    return problems


def _most_common_kind(records: Sequence[ImageRecord]) -> tuple[str, list[ImageRecord], list[str]]:
    kinds = Counter(file_kind(record.image) for record in records)
    kind = max(_KINDS, key=lambda each: kinds[each])  # Of equal numbers the first in the table.
    others = [record for record in records if file_kind(record.image) != kind]
    if not others:
        return kind, list(records), []
    kind_names = " and ".join(name for each, name in _KINDS.items() if each != kind and kinds[each])
    most = "most" if list(kinds.values()).count(kinds[kind]) == 1 else "as many"
    reason = f"were left out, because {most} are {_KINDS[kind]}: photos of one set are of one kind"
    if kind == "encoded" and kinds["raw"] == kinds[kind]:  # As cameras write RAW and JPEG of each shot
        reason += "; to train on RAW, whose response is known, give a folder of RAW alone"
    notes = [f"{_names_text([record.image.name for record in others])} ({kind_names}) {reason}"]
    return kind, [record for record in records if file_kind(record.image) == kind], notes


def _check_size(record: ImageRecord) -> ImageRecord:
    """Return the photo with what its file states of its colors. Raises InputError if it cannot be used."""
    width, height = pixel_aspect(record.image), 1.0
    if record.mask is not None:
        require_file(record.mask)
    if file_kind(record.image) == "encoded":
        with open_image(record.image) as image:
            record = replace(record, encoding=encoding_of(image))
            width, height = _pixel_aspect(image.info)
    if record.lens is UNPLACED:
        photo_sizes(record.image)
        if abs(width - height) > _LEAST_SQUARE * height:
            problem = f"states pixels that are not square ({width:g} : {height:g})"
            raise InputError(record.image, problem, "resample it to square pixels, such as with FFmpeg's scale")
    else:
        fitted_lens(record)
    return record


def _pixel_aspect(info: Mapping[Any, Any]) -> tuple[float, float]:
    """Return the shape of a pixel, horizontal : vertical, that JFIF, PNG and TIFF state as a density without a unit."""
    density = info.get("jfif_density") if info.get("jfif_unit") == 0 else info.get("aspect", info.get("resolution"))
    width, height = map(float, density or (1, 1))
    return (width, height) if width > 0 and height > 0 else (1.0, 1.0)


def _names_text(names: Sequence[str]) -> str:
    listing = first_names(names)
    return f"{len(names)} photos: {listing}" if len(names) > 1 else listing


def photo_sizes(path: Path) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return (width, height) of the photo as stored and turned upright; raises as read_photo."""
    kind = file_kind(path)
    if kind == "encoded":
        return image_sizes(path)
    _refuse_renamed(path)
    if kind == "raw":
        header = read_header(path)
        return header.size, header.upright_size
    size = hdr_size(path)
    return size, size


def stored_orientation(path: Path) -> int:
    """Return EXIF's orientation of a photo's stored pixels; 1 without one, and for RAW and float pictures."""
    if file_kind(path) != "encoded":
        return 1
    with open_image(path) as image:
        return orientation_of(image)


def read_photo(path: Path, *, oriented: bool = False) -> EncodedImage:
    """Read the codes of a photo, turned upright if `oriented`.

    RAW files have 16 bits in the sensor's primaries, float images 8 bits at an exposure of their own.

    Raises:
        InputError: if the file is missing, damaged or too large.
    """
    kind = file_kind(path)
    if kind == "encoded":
        return read_ldr(path, oriented=oriented)
    return read_raw(path, oriented=oriented) if kind == "raw" else EncodedImage(tone_mapped(path), None)


def brightened_codes(codes: np.ndarray) -> np.ndarray:
    """Return the 8-bit codes [H, W, 3] of a photo in which features are found.

    A power brightens a photo with a median below the midtone, because detectors have an absolute threshold of contrast.
    A black background beside a subject does not count.
    """
    midtone, least_exponent, black = BRIGHTENING
    levels = np.iinfo(codes.dtype).max
    sample = codes[::8, ::8] / levels
    bright = sample[sample > black]
    median = max(float(np.median(bright if 10 * bright.size > sample.size else sample)), 1e-3)
    exponent = max(np.log(midtone) / np.log(median), least_exponent) if median < midtone else 1.0
    if codes.dtype == np.uint8 and exponent == 1:
        return codes
    return np.rint(255 * (np.arange(levels + 1) / levels) ** exponent).astype(np.uint8)[codes]


def _refuse_renamed(path: Path) -> None:
    """Raise InputError for a photo of codes under the name of a RAW file or a float image."""
    require_file(path)
    with path.open("rb") as file:
        head = file.read(8)
    for signature, (kind, suffix) in _ENCODED.items():
        if head.startswith(signature):
            raise InputError(path, f"is a {kind} photo, not what its name says", f"name it {suffix}")
