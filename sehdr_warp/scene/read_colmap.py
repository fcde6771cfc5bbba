"""COLMAP sets: `images/` with `sparse/0` (or `sparse`), and HDR-GS sets, which add `exr/` and several exposures."""

import re
from pathlib import Path

from ..errors import InputError
from ..files import contained, read_json
from .capture import Capture, Shot
from .colmap_model import SparseModel, find_model, read_model
from .exposure import parse_seconds
from .images import HDR_SUFFIXES, LDR_SUFFIXES
from .names import mask_of, natural_key, photo_beside, sibling, view_and_exposure

# The images of reduced copies of a set lie in images_2 ... images_8; the full ones are taken where they are there.
_IMAGE_FOLDERS = ("images", "images_2", "images_4", "images_8")
# HDR-NeRF's synthetic exposures, which HDR-GS's folders do not state (its train_synthetic.py holds them as constants).
_HDR_GS_SECONDS = (0.125, 0.5, 2.0, 8.0, 32.0)
_REMEDY = "copy the images that COLMAP used"


def image_folder(folder: Path) -> Path | None:
    return next((folder / name for name in _IMAGE_FOLDERS if (folder / name).is_dir()), None)


def read_colmap(folder: Path) -> Capture:
    """One shot for each image of the model, in the natural order of the names."""
    model, source = _model(folder)
    images = image_folder(folder)
    if images is None:
        raise InputError(folder / "images", "folder not found", "put the photos that COLMAP used there")
    shots, absent = [], []
    for entry in sorted(model.images, key=lambda image: natural_key(image.name)):
        image = contained(images, entry.name, source)
        if image.suffix.lower() in HDR_SUFFIXES:
            hdr, image = image, photo_beside(image)
        elif not image.is_file():
            absent.append(entry.name)
            continue
        else:
            beside = (sibling(folder / name / image.name, HDR_SUFFIXES) for name in ("hdr", "exr"))
            hdr = next((file for file in beside if file), None)
        mask, lens = mask_of(folder, entry.name, source), model.cameras[entry.camera_id]
        shots.append(Shot(image.stem, image, lens, entry.world_to_camera, mask=mask, hdr=hdr))
    if not shots:
        problem = f"none of the model's {len(absent)} images is here (the first is {absent[0]!r:.90})"
        raise InputError(images, problem, _REMEDY)
    left_out = (
        f"{len(absent)} images of the model are missing and were left out: {absent[0]!r:.90} ..." if absent else ""
    )
    return Capture("colmap", tuple(shots), holdout=(8, 0), points=model.points, point_colors=model.colors,
                   notes=(left_out,) if absent else ())  # fmt: skip


def is_hdr_gs(folder: Path) -> bool:
    there = (folder / "exr").is_dir() and (folder / "images").is_dir() and find_model(folder) is not None
    return there and bool(_exposures_by_view(folder / "images"))


def read_hdr_gs(folder: Path) -> Capture:
    """HDR-GS's synthetic layout: `images/<v>_<e>.png`, `exr/<v>.exr`, and a model with one image of each view."""
    model, poses = poses_by_view(folder)
    exposures = _exposures_by_view(folder / "images")
    seconds, notes = _hdr_gs_seconds(folder, 1 + max(key for files in exposures.values() for key in files))
    shots = [
        Shot(view, image, *camera, exposure_key=key, exposure_time=seconds[key] if seconds else None,
             hdr=sibling(folder / "exr" / f"{view}.exr", HDR_SUFFIXES))
        for view, camera in poses.items()
        for key, image in sorted(exposures.get(view, {}).items())
    ]  # fmt: skip
    if not shots:
        raise InputError(find_model(folder), "none of the model's images is in images/", _REMEDY)
    return Capture("hdr-gs", tuple(shots), alpha="background", holdout=(2, 1), points=model.points,
                   point_colors=model.colors, notes=notes)  # fmt: skip


def poses_by_view(folder: Path) -> tuple[SparseModel, dict[str, tuple]]:
    """The model and, for each view (names without `_<exposure>`) in natural order, its lens and pose."""
    model, source = _model(folder)
    poses = {}
    for entry in sorted(model.images, key=lambda image: natural_key(image.name)):
        view = re.sub(r"_\d+$", "", contained(folder, entry.name, source).stem)
        poses.setdefault(view, (model.cameras[entry.camera_id], entry.world_to_camera))
    return model, poses


def _model(folder: Path) -> tuple[SparseModel, Path]:
    source = find_model(folder)
    model = read_model(source)
    if not model.images:
        raise InputError(source, "the model has no registered views", "run structure from motion again")
    return model, source


def _exposures_by_view(images: Path) -> dict[str, dict[int, Path]]:
    found: dict[str, dict[int, Path]] = {}
    for image in images.iterdir():
        view, key = view_and_exposure(image.stem)
        if key is not None and image.suffix.lower() in LDR_SUFFIXES:
            found.setdefault(view, {})[key] = image
    return found


def _hdr_gs_seconds(folder: Path, count: int) -> tuple[list[float] | None, tuple[str, ...]]:
    """Seconds by exposure number: "exposure_times" in `exposure_times.json`, or HDR-GS's constants."""
    path = folder / "exposure_times.json"
    if path.is_file():
        values = read_json(path).get("exposure_times")
        if not isinstance(values, list) or len(values) < count:
            raise InputError(path, f"exposure_times does not list {count} values", "list the seconds of every exposure")
        return [parse_seconds(value, path, f"exposure {i}") for i, value in enumerate(values)], ()
    if count == len(_HDR_GS_SECONDS):
        return list(_HDR_GS_SECONDS), (f"the set states no exposure times; took HDR-NeRF's {list(_HDR_GS_SECONDS)} s",)
    return None, ()
