"""One call for every layout: read what was photographed, choose the response, develop the scene."""

import logging
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError, did_you_mean
from .colmap_model import find_model
from .dataparser import DataparserOutputs, ImageRecord
from .exposure import are_camera_jpegs, choose_exposure, with_exposure_times
from .gain_map import has_gain_map, read_gain_map
from .images import has_16_bits
from .linear_photos import CURVES, color_matrix, float_time, one_kind
from .masks import assign_masks
from .names import unique_names
from .preprocess import fitted_lens, preprocess, read_codes, require_content
from .read_folders import (
    image_folder,
    is_hdr_gs,
    read_colmap,
    read_hdr_gs,
    read_hdr_nerf_real,
    read_llff,
    read_photos,
)
from .read_opensfm import FILE as OPENSFM_FILE
from .read_opensfm import read_opensfm
from .read_transforms import read_hdr_nerf, read_transforms
from .types import Scene
from .video import is_video
from .video_frames import read_video

if TYPE_CHECKING:
    from ..response import Response

_log = logging.getLogger("sehdr_warp.scene")
_MARK = "transforms_train.json"  # What a folder of an embedded scene has.
_HOLDOUT = 8  # Every eighth view is held out: the habit of LLFF, Mip-NeRF 360 and 3DGS.
_FEWEST_FOR_TEST = 5  # Below this many views none can be spared for testing.
_MOST_JUDGED = 24  # Photos that a response is chosen from: they give as many edges as are looked at, and more.


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
) -> Scene:
    """Read a folder of posed or bare photos, whatever its layout, and develop it.

    Args:
        path: a folder (COLMAP, transforms.json, HDR-NeRF synthetic or real, HDR-GS, LLFF, or bare photos), "embedded"
            for the room that comes with the package, or "embedded:NAME" for another of embedded_scenes(); or a video
            file, of whose frames the sharpest are taken.
        response: the camera's: a name, a file or an object; "auto" chooses it from the training photos' codes;
            "learned" stands for sRGB here. "linear" is of photos whose 16-bit codes are proportional to light. The
            light of RAW files, OpenEXR and Radiance pictures is known: they take none.
        method: how "auto" chooses, "posterior" or "paper".
        candidates: names and files that "auto" chooses among; none: the built-in ones.
        exposure_index: the exposure to take where each view has several (the k of `<view>_<k>.png`); None: the middle
            one.
        max_size: longest side of the views in pixels; None keeps the photos' sizes. Averages are exact areas, of light
            for photos and of values for truth and masks; a value of 1 stays 1 where half of its area was clipped.
        holdout: every so many views is held out, 0 for none, whatever the set states; None keeps the set's split, or
            the protocol of its layout, or takes the middle of every eight. Sets of fewer than 5 views have no test
            view.
        cache: a folder where structure from motion keeps its results; None is the user's ($SEHDR_CACHE).
        photos: where they stay: "memory", "disk" (in a nameless file beside the cache, which goes with the process), or
            "auto": the disk if they would take more than half of the memory that is free.

    Returns:
        A Scene in the set's own world coordinates, with the points that the set has.

    Raises:
        InputError: where a file is missing, damaged or hostile, sizes disagree, an exposure is impossible, fewer than
            two training views remain, or the photos show nothing but black or white.
    """
    from ..response import response_by_name

    if max_size is not None and max_size < 1:
        raise InputError(path, f"longest side of {max_size} pixels asked for", "give at least 1 pixel")
    dataset = parse_dataset(path, exposure_index=exposure_index, holdout=holdout, cache=cache)
    chosen_by = None
    if dataset.stated_response is not None and str(response) == "auto":
        response = dataset.stated_response
    if dataset.kind == "encoded" and str(response) == "linear":
        dataset = as_linear(dataset)
        response = "auto" if dataset.kind == "linear" else response
    if dataset.kind == "encoded" and str(response) in ("auto", CURVES["gain-map"]):
        dataset = as_gain_mapped(dataset)
    if dataset.kind != "encoded":
        chosen = response_by_name(CURVES[dataset.kind])
        if isinstance(response, str | Path) and str(response) not in ("auto", chosen.name):
            problem = f"its photos are {dataset.kind}: their light is known, and response {response} is not theirs"
            raise InputError(path, problem, "leave the response out")
        matrix = color_matrix([record.image for record in dataset.records]) if dataset.kind == "raw" else None
        return replace(preprocess(dataset, chosen, max_size, photos), color_matrix=matrix, light_known=True)
    if isinstance(response, str) and response == "auto":
        response, chosen_by = choose_response(dataset, method, candidates), (method, tuple(map(str, candidates)))
    elif isinstance(response, str | Path):
        response = response_by_name("srgb" if response == "learned" else response)
    scene = preprocess(dataset, response, max_size, photos)
    return replace(scene, chosen_by=chosen_by, color_matrix=dataset.color_matrix)


def parse_dataset(
    path: Path | str, *, exposure_index: int | None = None, holdout: int | None = None, cache: Path | str | None = None
) -> DataparserOutputs:
    """Cameras, files, exposure times and splits of a data folder; of photos their sizes alone. Arguments and errors are
    load_scene's."""
    if holdout is not None and holdout < 0:
        raise InputError(path, f"every {holdout}th view asked for as test view", "give 0 (none) or more")
    folder = _folder(path)
    dataset = read_video(folder, cache) if is_video(folder) else _read(folder, cache)
    name = str(path) if is_embedded(path) else folder.resolve().name
    folder = folder if folder.is_dir() else dataset.folder
    if not dataset.records:
        raise InputError(folder, "has no views", "check the data folder")
    records, masks = assign_masks(dataset.records, folder)
    records, notes = choose_exposure(records, exposure_index, folder)
    kind, more = one_kind([record.image for record in records if not record.derived] or [Path("derived")]), []
    if kind == "float" and all(record.exposure_time is None for record in records):
        time = float_time([record.image for record in records])
        records = [replace(record, exposure_time=time, hdr=record.hdr or record.image) for record in records]
        times_known = True
        more = ["float pictures: their values are taken as light, at no exposure"]
    else:
        records, times_known, more = with_exposure_times(records, folder)
    records, split = _with_splits(records, dataset, holdout)
    training = sum(record.split == "train" for record in records)
    if training < 2:
        found = f"{len(records)} view{'s' * (len(records) != 1)}, {training} for training"
        raise InputError(folder, f"has {found}; one view does not show depth", "add views from other places")
    for record in records:
        if not record.derived:
            fitted_lens(record)
    notes = (*dataset.notes, *masks, *notes, *more, *split)
    told = {"notes": notes, "name": name, "folder": folder, "times_known": times_known, "kind": kind}
    return replace(dataset, records=tuple(records), **told)


def as_linear(dataset: DataparserOutputs) -> DataparserOutputs:
    """A dataset whose photos are proportional to light, if all of them have 16 bits; of 8 bits codes stay codes."""
    if any(record.derived for record in dataset.records) or not all(
        has_16_bits(record.image) for record in dataset.records
    ):
        return dataset
    return replace(dataset, kind="linear", records=tuple(replace(record, linear=True) for record in dataset.records))


def as_gain_mapped(dataset: DataparserOutputs) -> DataparserOutputs:
    """Take the light of photos from their gain maps if most photos of a dataset have one."""
    maps = [
        read_gain_map(record.image) for record in dataset.records if not record.derived and has_gain_map(record.image)
    ]
    headrooms = [gain_map.headroom for gain_map in maps if gain_map is not None]
    if 2 * len(headrooms) <= len(dataset.records):
        return dataset
    note = f"{len(headrooms)} of {len(dataset.records)} photos have a gain map: light is taken from it, up to "
    note += f"{max(headrooms):.1f} stops above white; --response NAME takes the codes and a curve instead"
    records = tuple(replace(record, gain_map=True) for record in dataset.records)
    return replace(dataset, kind="gain-map", records=records, notes=(*dataset.notes, note))


def choose_response(
    dataset: DataparserOutputs, method: str = "posterior", candidates: Sequence[str] = ()
) -> "Response":
    """The response that fits the training photos best, from their codes as photographed.

    Photos are up to 24 of the training views, evenly spread; for method "paper" a random one. candidates: names, and
    files of one curve or of many; none: the built-in ones. Raises InputError where photos show nothing.
    """
    records = dataset.training

    def codes() -> Iterator[tuple[np.ndarray, None]]:
        for record in sample_photos(records, method):
            image = read_codes(record)
            if image.alpha is not None:  # What is not there has no color.
                image.pixels[image.alpha < 1] = 0
            photo = image.pixels, None
            del image  # Before the next is read: they may be large.
            yield photo
            del photo

    photos = require_content(codes(), dataset.folder)  # One at a time: they may be large.
    return select_response_for(
        photos, [None if record.derived else record.image for record in records], method, candidates
    )


def sample_photos(photos: Sequence, method: str) -> Sequence:
    """Those of the training photos that a response is chosen from."""
    chosen = photos[:: -(-len(photos) // _MOST_JUDGED)]
    if method == "paper":
        chosen = (photos[int(np.random.default_rng(0).integers(len(photos)))],)
    _log.info("choosing the response from %d photos", len(chosen))
    return chosen


def select_response_for(
    codes: Iterable[np.ndarray], files: list[Path | None], method: str, candidates: Sequence[str]
) -> "Response":
    """The candidate that fits the codes of sample_photos best; files: of all training photos."""
    from ..response import responses_named
    from ..response.selection import select_response

    known = [response for name in candidates for response in responses_named(name)] or None
    return select_response(codes, known, method=method, from_camera=are_camera_jpegs(files)).response


def _folder(path: Path | str) -> Path:
    if is_embedded(path):
        return embedded_folder(str(path))
    folder = Path(path)
    if is_video(folder):
        return folder
    try:
        empty = not any(folder.iterdir())
    except FileNotFoundError:
        raise InputError(folder, "not found", "give a folder of photos, or 'embedded'") from None
    except NotADirectoryError:
        raise InputError(folder, "is not a folder", "give the folder that holds the photos") from None
    except OSError as error:
        raise InputError(folder, f"cannot be read ({error.strerror or error})", "check its rights") from None
    if empty:
        raise InputError(folder, "folder is empty", "put the photos there")
    return folder


def _read(folder: Path, cache: Path | str | None) -> DataparserOutputs:
    """The first layout that fits, the most telling one first."""

    def has(*names: str) -> bool:
        return all((folder / name).is_file() for name in names)

    model = find_model(folder)
    beside = model is not None and model.is_relative_to(folder / "sparse") and image_folder(folder) is not None
    readers = (
        (has("transforms_train.json", "exposure_train.json"), read_hdr_nerf),
        (has("poses_bounds_exps.npy"), read_hdr_nerf_real),
        (is_hdr_gs(folder), read_hdr_gs),
        (beside, read_colmap),
        (has("transforms.json") or has("transforms_train.json"), read_transforms),
        (model is not None, read_colmap),
        (has(OPENSFM_FILE), read_opensfm),
        (has("poses_bounds.npy"), read_llff),
    )
    reader = next((reader for fits, reader in readers if fits), None)
    return reader(folder) if reader else read_photos(folder, cache)


def _with_splits(
    records: list[ImageRecord], dataset: DataparserOutputs, holdout: int | None
) -> tuple[list[ImageRecord], tuple[str, ...]]:
    """The records with a split each, and a note where the set does not state it."""
    if holdout is None and any(record.split for record in records):
        return [replace(record, split=record.split or "train") for record in records], ()
    held = _held_out(len(records), holdout, dataset.holdout)
    records = [replace(record, split="test" if i in held else "train") for i, record in enumerate(records)]
    if not held:
        return records, ("no views are held out for testing",)
    names = [name for name, record in zip(unique_names(records), records, strict=True) if record.split == "test"]
    listed = ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
    are = "is" if len(names) == 1 else "are"
    return records, (f"{len(names)} of {len(records)} views {are} held out for testing: {listed}",)


def _held_out(count: int, step: int | None, published: tuple[int, int] | None) -> set[int]:
    """Which of so many views test: the published protocol's, or the middle of each block, never the last view."""
    if step == 0 or count < _FEWEST_FOR_TEST:
        return set()
    if published is not None:
        every, offset = step or published[0], published[1]
        return set(range(min(offset, every - 1), count, every))
    step = step or _HOLDOUT
    return set(range(step // 2, count - 1, step)) or {count // 2}


def is_embedded(path: Path | str) -> bool:
    """Whether this names an embedded scene, known or not, rather than a folder."""
    return str(path) == "embedded" or str(path).startswith("embedded:")


def embedded_scenes() -> tuple[str, ...]:
    """The names that load_scene("embedded:NAME") finds here: room always, the others in a checkout or $SEHDR_SCENES."""
    return tuple(sorted({path.parent.name for place in _places() for path in place.glob(f"*/{_MARK}")}))


def embedded_folder(path: str) -> Path:
    """The folder of `embedded` or `embedded:NAME`; InputError where it is not here."""
    name = str(path).partition(":")[2] or "room"
    if name in embedded_scenes():
        return next(place / name for place in _places() if (place / name / _MARK).is_file())
    known = embedded_scenes()
    present = ", ".join(f"embedded:{each}" for each in known)
    problem = f"is not here{did_you_mean(name, known)}; present are {present}"
    raise InputError(path, problem, "get the repository's scenes/ and name it in SEHDR_SCENES")


def _places() -> list[Path]:
    """Where scenes lie: in the package, in $SEHDR_SCENES, and in scenes/ beside a checkout's package."""
    package = Path(str(resources.files("sehdr_warp")))
    stated = os.environ.get("SEHDR_SCENES")
    return [package / "embedded", *([Path(stated)] if stated else []), package.parent / "scenes"]
