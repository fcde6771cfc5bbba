"""Load a scene: parse a data folder of any layout, choose the response, preprocess the photos."""

import logging
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..subsets import every_nth
from .dataparser import DataparserOutputs
from .exposure import are_camera_jpegs
from .gain_map import MOST_STOPS_IN_CODES, has_gain_map, read_gain_map
from .images import has_16_bits
from .linear_photos import CURVES, color_matrix
from .names import unique_names
from .parse import embedded_folder, embedded_scenes, is_embedded, parse_dataset
from .preprocess import preprocess, read_codes, require_content
from .types import Scene

if TYPE_CHECKING:
    from ..response import Response
    from ..response.selection import ResponseSelection

__all__ = [
    "choose_response",
    "embedded_folder",
    "embedded_scenes",
    "is_embedded",
    "load_scene",
    "parse_dataset",
    "sample_photos",
    "select_response_for",
]
_log = logging.getLogger("sehdr_warp.scene")
_MOST_SAMPLED = 24  # Photos that a response is chosen from: they have more edges than are looked at
_BELOW_WHITE = 0.97  # Code of the largest light of a gain map, in light: from 0.99 on codes count as clipped


def load_scene(
    path: Path | str,
    *,
    response: "str | Path | Response" = "auto",
    method: str = "posterior",
    candidates: Sequence[str] = (),
    exposure_index: int | None = None,
    max_size: int | None = None,
    holdout: int | None = None,
    cache: Path | str | None = None,
    photos: str = "auto",
    views: Collection[str] | None = None,
) -> Scene:
    """Read a folder of posed or bare photos, whatever its layout.

    Args:
        path: a folder (COLMAP, transforms.json, HDR-NeRF synthetic or real, HDR-GS, LLFF, or bare photos), "embedded"
            for the room that comes with the package, or "embedded:NAME" for another of embedded_scenes(); or a video
            file, of whose frames the sharpest are taken.
        response: the camera's: a name, a file or an object; "auto" chooses it from the training photos' codes;
            "learned" stands for sRGB here. "linear" is for photos whose 16-bit codes are proportional to light. Photos
            whose light is known take none: RAW files, OpenEXR and Radiance images, and those whose files state linear,
            PQ, HLG or log light.
        method: how "auto" chooses, "posterior" or "paper".
        candidates: names and files that "auto" chooses among; none: the built-in ones.
        exposure_index: the exposure to take if each view has several (the k of `<view>_<k>.png`); None takes the middle
            one.
        max_size: longest side of the views in pixels; None keeps the photos' sizes. Averages are exact areas, of light
            for photos and of values for truth and masks; a pixel is clipped if half of its area was.
        holdout: every so many views is held out, 0 for none, whatever the set states; None keeps the set's split, or
            the protocol of its layout, or takes the middle of every eight. Sets of fewer than 5 views have no test
            view.
        cache: a folder for results of structure from motion; None is the user's ($SEHDR_CACHE).
        photos: where they are stored: "memory", "disk" (in a nameless file beside the cache, removed with the process),
            or "auto" for the disk if they would take more than half of the free memory.
        views: names of the views to read; None reads all. Response, splits and colors are those of the whole set.

    Returns:
        A Scene in the set's own world coordinates, with the points that the set has.

    Raises:
        InputError: if a file of the set is missing, damaged or hostile, an exposure is impossible, fewer than two
            training views remain, or the photos show nothing but black or white. Single photos that cannot be used are
            left out, and a note names them.
    """
    from ..response import response_by_name, responses_named

    if max_size is not None and max_size < 1:
        raise InputError(path, f"longest side of {max_size} pixels asked for", "give at least 1 pixel")
    by_name = isinstance(response, str | Path) and str(response) not in ("auto", "learned", "linear")
    curve = response_by_name(response) if by_name else response  # pyright: ignore[reportArgumentType]
    for candidate in candidates:
        responses_named(candidate)
    check = partial(_check_response, response=response, path=path)
    dataset = parse_dataset(path, exposure_index=exposure_index, holdout=holdout, cache=cache, check=check)
    chosen_by = None
    if dataset.stated_response is not None and str(response) == "auto":
        curve = response_by_name(dataset.stated_response)
    if dataset.kind == "encoded" and str(response) == "linear":
        dataset = as_linear(dataset)
        curve = "auto" if dataset.kind == "linear" else response_by_name("linear")
    # A run states the curve of its codes, by which its photos are loaded again.
    if dataset.kind == "encoded" and (str(curve) == "auto" or str(response) == CURVES["gain-map"]):
        dataset = as_gain_mapped(dataset)
    matrix, light_known = dataset.color_matrix, dataset.kind != "encoded"
    if light_known:
        curve = response_by_name(CURVES[dataset.kind])
        if dataset.kind == "raw":
            matrix = color_matrix([record.image for record in dataset.records])
    elif str(curve) == "auto":
        selection = _select_response(dataset, method, candidates)
        curve, chosen_by = selection.response, (method, tuple(map(str, candidates)))
        if selection.note:
            dataset = replace(dataset, notes=(*dataset.notes, selection.note))
    elif str(curve) == "learned":
        curve = response_by_name("srgb")
    names = unique_names(dataset.records)
    if views is not None:
        indices = [index for index, name in enumerate(names) if name in views]
        if missing := sorted(set(views) - set(names)):
            problem = f"{len(missing)} of the views that were named are missing, {missing[0]} first"
            raise InputError(path, problem, "put the photos back as they were")
        names = [names[index] for index in indices]
        dataset = replace(dataset, records=tuple(dataset.records[index] for index in indices))
    scene = preprocess(dataset, curve, max_size, photos, names)  # pyright: ignore[reportArgumentType]
    named_views = zip(names, dataset.records, strict=True)
    if guessed := {name for name, record in named_views if not record.time_known}:
        from .exposure_estimate import with_estimated_times

        scene = with_estimated_times(scene, guessed, curve)  # pyright: ignore[reportArgumentType]
    return replace(scene, chosen_by=chosen_by, color_matrix=matrix, light_known=light_known)


def _check_response(dataset: DataparserOutputs, *, response: "str | Path | Response", path: Path | str) -> None:
    """Raise InputError if a named response is not that of photos whose light is known."""
    if dataset.kind == "encoded" or not isinstance(response, str | Path):
        return
    allowed = {"auto", CURVES[dataset.kind]} | ({"linear"} if dataset.kind == "linear" else set())
    if str(response) not in allowed:
        problem = f"its photos are {dataset.kind}: their light is known, and response {response} is not theirs"
        raise InputError(path, problem, "leave the response out")


def as_linear(dataset: DataparserOutputs) -> DataparserOutputs:
    """Take the photos' codes as proportional to light if all photos have 16 bits; codes of 8 bits stay codes."""
    photos = [record.image for record in dataset.records]
    if any(record.derived for record in dataset.records) or not all(map(has_16_bits, photos)):
        return dataset
    return replace(dataset, kind="linear", records=tuple(replace(record, linear=True) for record in dataset.records))


def as_gain_mapped(dataset: DataparserOutputs) -> DataparserOutputs:
    """Take the light of photos from their gain maps if most photos of a dataset have one."""
    images = [record.image for record in dataset.records if not record.derived]
    maps = {image: read_gain_map(image) for image in images if has_gain_map(image)}
    headrooms = {image: gain_map.headroom for image, gain_map in maps.items() if gain_map is not None}
    if 2 * len(headrooms) <= len(dataset.records):
        return dataset
    most = max(headrooms.values())
    note = f"{len(headrooms)} of {len(dataset.records)} photos have a gain map: light is taken from it, up to "
    note += f"{most:.1f} stops above white; --response NAME takes the codes and a curve instead"
    # Codes hold the light above white, too, as those of a photo that was exposed shorter.
    scale = _BELOW_WHITE * 2.0 ** -min(max(most, 0.0), MOST_STOPS_IN_CODES)
    scales = [scale if record.image in headrooms else 1.0 for record in dataset.records]
    records = tuple(
        replace(record, gain_map=True, light_scale=scale, exposure_time=record.seconds * scale)
        for record, scale in zip(dataset.records, scales, strict=True)
    )
    return replace(dataset, kind="gain-map", records=records, notes=(*dataset.notes, note))


def choose_response(
    dataset: DataparserOutputs, method: str = "posterior", candidates: Sequence[str] = ()
) -> "Response":
    """Choose the response that fits the training photos best, from their codes; arguments as of load_scene().

    Up to 24 photos are read, evenly spread; for method "paper" a random one.

    Raises:
        InputError: if the photos show nothing.
    """
    return _select_response(dataset, method, candidates).response


def _select_response(dataset: DataparserOutputs, method: str, candidates: Sequence[str]) -> "ResponseSelection":
    records = dataset.training

    def codes() -> Iterator[tuple[np.ndarray, None]]:
        for record in sample_photos(records, method):
            try:
                image = read_codes(record)
            except InputError:
                continue  # Preprocessing names it.
            if image.alpha is not None:  # Transparent pixels have no color.
                image.pixels[image.alpha < 1] = 0
            photo = image.pixels, None
            del image  # Free the memory before the next photo is read.
            yield photo
            del photo

    photos = require_content(codes(), dataset.folder)
    files = [None if record.derived else record.image for record in records]
    return select_response_for(photos, files, method, candidates)


def sample_photos(photos: Sequence, method: str) -> Sequence:
    """Return those of the training photos that a response is chosen from."""
    sample = every_nth(photos, _MOST_SAMPLED)
    if method == "paper":
        sample = (photos[int(np.random.default_rng(0).integers(len(photos)))],)
    _log.info("choosing the response from %d photos", len(sample))
    return sample


def select_response_for(
    codes: Iterable[np.ndarray], files: list[Path | None], method: str, candidates: Sequence[str]
) -> "ResponseSelection":
    """Select the candidate that fits the codes of sample_photos() best; further arguments as of load_scene().

    `files` are those of all training photos, None for those computed from truth.
    """
    from ..response import responses_named
    from ..response.selection import select_response

    curves = [response for name in candidates for response in responses_named(name)] or None
    return select_response(codes, curves, method=method, from_camera=are_camera_jpegs(files))
