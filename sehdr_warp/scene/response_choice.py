"""The response of a scene's photos: what files state, what the user names, or what fits the photos best."""

import logging
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError, SehdrError
from ..subsets import counted, every_nth, first_names
from .dataparser import DataparserOutputs
from .images.exif import are_camera_files, exif_lens
from .images.gain_map import MOST_STOPS_IN_CODES, read_gain_map
from .images.ldr_files import has_16_bits
from .preprocess import read_codes
from .raw.decode import color_matrix
from .types import View

if TYPE_CHECKING:
    from ..response import Response
    from ..response.selection import ResponseSelection

_log = logging.getLogger("sehdr_warp.scene")
_CURVES = {"raw": "srgb", "linear": "srgb", "gain-map": "gain-map", "float": "hdr-nerf"}
"""Response of the codes of photos whose light is known, by kind. Float pictures have no white level, nor has Reinhard's
curve."""
_MOST_SAMPLED = 24  # Photos that a response is chosen from: they have more edges than are used
_BELOW_WHITE = 0.97  # Code of the largest light of a gain map, in light: from 0.99 on codes count as clipped


@dataclass(frozen=True)
class ResponseChoice:
    """The response of a dataset."""

    dataset: DataparserOutputs  # The dataset, whose kind may now be linear or gain-map, and with more notes
    response: "Response"  # The camera response
    color_matrix: np.ndarray | None  # As in Scene
    chosen_by: tuple[str, tuple[str, ...]] | None = None  # As in Scene


def check_response_type(response: object) -> None:
    """Raise TypeError for what is neither a name or a file nor a curve."""
    from ..response import Response

    if not isinstance(response, str | Path | Response):
        raise TypeError(f"response is {response!r:.60}, expected a name, a file, or what response_by_name() returns")


def choose_response(
    dataset: DataparserOutputs, response: "str | Path | Response", method: str, candidates: Sequence[str]
) -> ResponseChoice:
    """Return the response with which the photos of a dataset are loaded; arguments as of load_scene().

    Raises:
        InputError: if the response is chosen from the photos, and they show nothing.
    """
    from ..response import response_by_name

    curve, name = response, str(response) if isinstance(response, str | Path) else response.name
    if isinstance(response, str | Path) and name not in ("auto", "learned", "linear"):
        curve = response_by_name(response)
    if dataset.stated_response is not None and name == "auto":
        curve = response_by_name(dataset.stated_response)
    if dataset.kind == "encoded" and name == "linear":
        dataset = as_linear(dataset)
        curve = "auto" if dataset.kind == "linear" else response_by_name("linear")
    # A run states the curve of its codes, by which its photos are loaded again.
    if dataset.kind == "encoded" and (str(curve) == "auto" or name == _CURVES["gain-map"]):
        dataset = as_gain_mapped(dataset)
    matrix = dataset.color_matrix
    if matrix is not None and dataset.stated_response is not None:
        dataset = _with_clip_colors(dataset, str(getattr(curve, "name", curve)))
        matrix = None if dataset.within_rec709 else matrix
    if dataset.kind != "encoded":
        if dataset.kind == "raw":
            matrix = color_matrix([record.image for record in dataset.records])
        return ResponseChoice(dataset, response_by_name(_CURVES[dataset.kind]), matrix)
    dataset = replace(dataset, notes=dataset.notes + _cameras_note(dataset))
    if str(curve) == "auto":
        selection = _select_for_dataset(dataset, method, candidates)
        if selection.note:
            dataset = replace(dataset, notes=(*dataset.notes, selection.note))
        return ResponseChoice(dataset, selection.response, matrix, (method, tuple(map(str, candidates))))
    if str(curve) == "learned":  # The training learns it; until then codes count as sRGB.
        curve = response_by_name("srgb")
    return ResponseChoice(dataset, curve, matrix)  # pyright: ignore[reportArgumentType]


def select_for_views(views: Sequence[View], method: str, candidates: Sequence[str]) -> "ResponseSelection":
    """Select the response that fits training views best, for a scene that was loaded otherwise."""
    codes = [view.codes for view in _sample(views, method)]
    return select_for_codes(codes, [view.source for view in views], method, candidates)


def select_for_codes(
    codes: Iterable[np.ndarray], files: list[Path | None], method: str, candidates: Sequence[str]
) -> "ResponseSelection":
    """Select the candidate that fits the codes of a sample of photos best; further arguments as of load_scene().

    `files` are those of all training photos, None for those computed from truth.
    """
    from ..response import responses_named
    from ..response.selection import select_response

    curves = [response for name in candidates for response in responses_named(name)] or None
    return select_response(codes, curves, method=method, from_camera=are_camera_files(files))


def check_response(dataset: DataparserOutputs, response: "str | Path | Response", path: Path | str) -> None:
    """Raise InputError if a named response is not that of photos whose light is known."""
    if dataset.kind == "encoded" or not isinstance(response, str | Path):
        return
    allowed = {"auto", _CURVES[dataset.kind]} | ({"linear"} if dataset.kind == "linear" else set())
    if str(response) not in allowed:
        problem = f"its photos are {dataset.kind}: their light is known, and response {response} does not apply"
        raise InputError(path, problem, "leave the response out")


def _cameras_note(dataset: DataparserOutputs) -> tuple[str, ...]:
    """Return a note if EXIF names several cameras, each of which has a response of its own."""
    lenses = (exif_lens(record.image) for record in dataset.records if not record.derived)
    models = Counter(name for lens in lenses if (name := lens[1] if lens else "None") != "None")
    if len(models) < 2:
        return ()
    names = first_names([f"{name} ({count})" for name, count in models.most_common()])
    return (f"photos of {len(models)} cameras get one response, which fits some of them better: {names}",)


def _with_clip_colors(dataset: DataparserOutputs, response: str) -> DataparserOutputs:
    """Decide, and note, whether the photos of a clip with a stated response are converted to Rec.709."""
    within = dataset.within_rec709 and response == dataset.stated_response
    note = "colors: the clip's lie within Rec.709 and are converted to it"
    if not within:
        note = "colors: the scene is trained in the clip's primaries, and its light is converted to Rec.709"
    return replace(dataset, within_rec709=within, notes=(*dataset.notes, note))


def as_linear(dataset: DataparserOutputs) -> DataparserOutputs:
    """Take the photos' codes as proportional to light if all photos have 16 bits; codes of 8 bits stay codes."""
    photos = [record.image for record in dataset.records]
    if any(record.derived for record in dataset.records) or not all(map(has_16_bits, photos)):
        return dataset
    return replace(dataset, kind="linear", records=tuple(replace(record, linear=True) for record in dataset.records))


def as_gain_mapped(dataset: DataparserOutputs) -> DataparserOutputs:
    """Take the light of photos from their gain maps if most photos of a dataset have one."""
    images = [record.image for record in dataset.records if not record.derived]
    maps = {image: read_gain_map(image, problems={}) for image in images}  # Preprocessing names damaged ones.
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
        replace(record, gain_map_scale=scale, exposure_time=record.seconds * scale)
        for record, scale in zip(dataset.records, scales, strict=True)
    )
    return replace(dataset, kind="gain-map", records=records, notes=(*dataset.notes, note))


def _select_for_dataset(dataset: DataparserOutputs, method: str, candidates: Sequence[str]) -> "ResponseSelection":
    """Select the response from the codes of a sample of the training photos, which are read one by one."""
    records = dataset.training

    def codes() -> Iterator[np.ndarray]:
        for record in _sample(records, method):
            try:
                image = read_codes(record)
            except InputError:
                continue  # Preprocessing names it.
            if image.alpha is not None:  # Transparent pixels have no color, nearly opaque ones have theirs.
                image.pixels[image.alpha < 0.5] = 0
            yield image.pixels
            del image  # Free the memory before the next photo is read.

    files = [None if record.derived else record.image for record in records]
    try:
        return select_for_codes(codes(), files, method, candidates)
    except InputError:
        raise
    except SehdrError as error:  # By "paper" alone
        problem = "the photo that the response is chosen from is black or white"
        remedy = "name a response, or expose the photos so that the scene shows"
        raise InputError(dataset.folder, problem, remedy) from error


def _sample(photos: Sequence, method: str) -> Sequence:
    """Return up to 24 of the training photos, evenly spread; for method "paper" a random one."""
    sample = every_nth(photos, _MOST_SAMPLED)
    if method == "paper":
        sample = (photos[int(np.random.default_rng(0).integers(len(photos)))],)
    _log.info("choosing the response from %s", counted(len(sample), "photo", "photos"))
    return sample
