"""Load a scene: parse a data folder of any layout, choose the response, preprocess the photos."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import InputError
from .exposure import exposures_note
from .names import unique_names
from .parse import parse_dataset
from .preprocess import preprocess
from .response_choice import check_response, choose_response
from .types import Scene

if TYPE_CHECKING:
    from ..response import Response


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
    photo_storage: str = "auto",
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
        photo_storage: where photos are stored: "memory", "disk" (in a nameless file beside the cache, removed with the
            process), or "auto" for the disk if they would take more than half of the free memory.
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
    if isinstance(response, str | Path) and str(response) not in ("auto", "learned", "linear"):
        response_by_name(response)  # An unknown name is refused before the photos are read.
    for candidate in candidates:
        responses_named(candidate)
    check = partial(check_response, response=response, path=path)
    dataset = parse_dataset(path, exposure_index=exposure_index, holdout=holdout, cache=cache, check=check)
    choice = choose_response(dataset, response, method, candidates)
    dataset, curve = choice.dataset, choice.response
    names = unique_names(dataset.records)
    if views is not None:
        indices = [index for index, name in enumerate(names) if name in views]
        if missing := sorted(set(views) - set(names)):
            problem = f"{len(missing)} of the views that were named are missing, {missing[0]} first"
            raise InputError(path, problem, "put the photos back as they were")
        names = [names[index] for index in indices]
        dataset = replace(dataset, records=tuple(dataset.records[index] for index in indices))
    scene = preprocess(dataset, curve, max_size, photo_storage, names)
    named_views = zip(names, dataset.records, strict=True)
    if guessed := {name for name, record in named_views if not record.time_known}:
        from .exposure_estimate import with_estimated_times

        scene = with_estimated_times(scene, guessed, curve)
    light_known = dataset.kind != "encoded" or curve.name == dataset.stated_response
    if dataset.kind != "float":
        used = {view.name for view in scene.views}
        records = [record for name, record in zip(names, dataset.records, strict=True) if name in used]
        scene = replace(scene, notes=(*scene.notes, *exposures_note(records)))
    return replace(scene, chosen_by=choice.chosen_by, color_matrix=choice.color_matrix, light_known=light_known)
