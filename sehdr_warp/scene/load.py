"""One call for every layout: find out what a folder holds, read it, and make a scene of it."""

from collections.abc import Callable
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np

from sehdr_warp.errors import InputError

from .capture import Capture, Shot
from .colmap_model import find_model
from .develop import Developer
from .exposure import choose_exposure, with_exposure_times
from .names import unique_names
from .read_colmap import image_folder, is_hdr_gs, read_colmap, read_hdr_gs
from .read_llff import read_hdr_nerf_real, read_llff
from .read_photos import read_photos
from .read_transforms import has_transforms, is_hdr_nerf, read_hdr_nerf, read_transforms
from .resample import Curve, srgb_decode, srgb_encode
from .sfm import triangulate
from .types import Scene, View

# Every eighth view is held out: the habit of LLFF, Mip-NeRF 360 and 3DGS.
_HOLDOUT = 8
_EMBEDDED = Path(str(resources.files("sehdr_warp.embedded")))
# Below this many views none can be spared for testing.
_FEWEST_FOR_TEST = 5


def load_scene(
    path: Path | str,
    *,
    exposure_index: int | None = None,
    max_size: int | None = None,
    holdout: int | None = None,
    cache: Path | str | None = None,
    decode: Curve | None = None,
    encode: Curve | None = None,
    progress: Callable[[str], None] | None = None,
) -> Scene:
    """Read a folder of posed or bare photos, whatever its layout.

    path: a folder (COLMAP, transforms.json, HDR-NeRF synthetic or real, HDR-GS, LLFF, or bare photos), "embedded"
        for the room that comes with the package, or "embedded:NAME" for another of its scenes (embedded_names()).
    exposure_index: the number of the exposure to take where each view has several (the k of `<view>_<k>.png`); None
        takes the middle one and says so in the notes.
    max_size: longest side of the views in pixels; None keeps the photos' sizes. Averages are exact areas, of light
        for photos and of values for truth and masks; a value of 1 stays 1 where half of its area was clipped.
    holdout: every so many views is held out where the set states no split, 0 for none; None is 8, and every second
        view (odd ones) for HDR-GS and HDR-NeRF's real sets. Sets of fewer than 5 views have no test view.
    cache: a folder where structure from motion keeps its results, so that a second call reuses them.
    decode, encode: the response, encoded [0, 1] -> linear exposure and back, as numpy functions; sRGB by default.
        Only scaling, undistortion and transparency need it.
    progress: is told one line about each long step.

    Returns a Scene in the set's own world coordinates. Points come from the set; where it has poses alone they are
    triangulated from the training views, and where that finds nothing there are none, with a note.
    Raises InputError where a file is missing, damaged or hostile, sizes disagree, an exposure is impossible, fewer
    than two training views remain, or the photos show nothing but black or white.
    """
    progress = progress or (lambda message: None)
    if (decode is None) != (encode is None):
        raise ValueError("decode and encode go together")
    if max_size is not None and max_size < 1:
        raise InputError(path, f"longest side of {max_size} pixels asked for", "give at least 1 pixel")
    if holdout is not None and holdout < 0:
        raise InputError(path, f"every {holdout}th view asked for as test view", "give 0 (none) or more")
    folder = _folder(path)
    cache = None if cache is None else Path(cache)
    capture = _read(folder, cache, progress)
    if not capture.shots:
        raise InputError(folder, "has no views", "check the data folder")

    shots, notes = choose_exposure(capture.shots, exposure_index, folder)
    shots, times_known, more = with_exposure_times(shots, folder)
    notes = [*capture.notes, *notes, *more]
    shots, more = _with_splits(shots, capture, holdout)
    notes += more
    training = sum(shot.split == "train" for shot in shots)
    if training < 2:
        found = f"{len(shots)} view{'s' * (len(shots) != 1)}, {training} for training"
        raise InputError(folder, f"has {found}; one view does not show depth", "add views from other places")

    developer = Developer(max_size, decode or srgb_decode, encode or srgb_encode, capture.alpha)
    views = []
    for i, (shot, name) in enumerate(zip(shots, unique_names(shots), strict=True)):
        if i % 10 == 0:
            progress(f"reading views {i + 1} to {min(i + 10, len(shots))} of {len(shots)}")
        views.append(developer.view(shot, name))
    _require_content(views, folder)
    points, colors, more = _with_points(capture, views, cache, progress)
    name = str(path) if is_embedded(path) else folder.resolve().name
    return Scene(name, capture.format, tuple(views), points, colors, times_known, (*notes, *more))


def is_embedded(path: Path | str) -> bool:
    """Whether this names a scene of the package, known or not, rather than a folder."""
    return str(path) == "embedded" or str(path).startswith("embedded:")


def embedded_names() -> tuple[str, ...]:
    """The scenes that come with the package, for load_scene("embedded:NAME")."""
    return tuple(sorted(folder.name for folder in _EMBEDDED.iterdir() if (folder / "transforms_train.json").is_file()))


def _folder(path: Path | str) -> Path:
    if is_embedded(path):
        _, _, name = str(path).partition(":")
        if name and name not in embedded_names():
            known = ", ".join(f"embedded:{known}" for known in embedded_names())
            raise InputError(path, "is no scene of the package", f"take one of {known}")
        return _EMBEDDED / (name or "room")
    folder = Path(path)
    if not folder.exists():
        raise InputError(folder, "not found", "give a folder of photos, or 'embedded'")
    if not folder.is_dir():
        raise InputError(folder, "is not a folder", "give the folder that holds the photos")
    try:
        empty = not any(folder.iterdir())
    except OSError as error:
        raise InputError(folder, f"cannot be read ({error.strerror or error})", "check its rights") from None
    if empty:
        raise InputError(folder, "folder is empty", "put the photos there")
    return folder


def _read(folder: Path, cache: Path | None, progress: Callable[[str], None]) -> Capture:
    """The first layout that fits, the most telling one first."""
    if is_hdr_nerf(folder):
        return read_hdr_nerf(folder)
    if (folder / "poses_bounds_exps.npy").is_file():
        return read_hdr_nerf_real(folder)
    if is_hdr_gs(folder):
        return read_hdr_gs(folder)
    model = find_model(folder)
    if model is not None and model.is_relative_to(folder / "sparse") and image_folder(folder) is not None:
        return read_colmap(folder)
    if has_transforms(folder):
        return read_transforms(folder)
    if model is not None:
        return read_colmap(folder)
    if (folder / "poses_bounds.npy").is_file():
        return read_llff(folder)
    return read_photos(folder, cache, progress)


def _with_splits(shots: list[Shot], capture: Capture, holdout: int | None) -> tuple[list[Shot], list[str]]:
    if any(shot.split for shot in shots):
        return [replace(shot, split=shot.split or "train") for shot in shots], []
    step, offset = (holdout, 0) if holdout is not None else capture.holdout or (_HOLDOUT, 0)
    if step == 0 or len(shots) < _FEWEST_FOR_TEST:
        note = "no views are held out for testing"
        return [replace(shot, split="train") for shot in shots], [note]
    return [replace(s, split="test" if i % step == offset else "train") for i, s in enumerate(shots)], []


def _require_content(views: list[View], folder: Path) -> None:
    """Refuse sets that show nothing: fewer than one training sample in a thousand between black and white."""
    low, high = 1.5 / 255, 1 - 1.5 / 255
    samples = [
        view.image if view.mask is None else view.image[view.mask > 0.5] for view in views if view.split == "train"
    ]
    shown = sum(int(((image > low) & (image < high)).sum()) for image in samples)
    total = sum(image.size for image in samples)
    if shown < total * 1e-3 or total == 0:
        mean = sum(float(image.sum()) for image in samples) / max(total, 1)
        state = "masked out" if total == 0 else f"black or white in {100 - 100 * shown / total:.1f} % (mean {mean:.3f})"
        raise InputError(folder, f"the training photos are {state}", "expose them so that the scene shows, "
                         "or choose another exposure index")  # fmt: skip


def _with_points(
    capture: Capture, views: list[View], cache: Path | None, progress
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    if len(capture.points):
        return capture.points, capture.point_colors, []
    points, colors = triangulate([view for view in views if view.split == "train"], cache, progress)
    note = f"the set has no points; triangulated {len(points)} from the training views" if len(points) else (
        "the set has no points and none could be triangulated"
    )  # fmt: skip
    return points, colors, [note]
