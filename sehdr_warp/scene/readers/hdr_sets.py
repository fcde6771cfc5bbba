"""Readers of published sets of several exposures: HDR-NeRF's synthetic and real sets, and HDR-GS's synthetic ones."""

import re
from pathlib import Path

from ...errors import InputError
from ...files import read_json, resolve_inside
from ..dataparser import DERIVED_PHOTOS, NO_POINTS, DataparserOutputs, ImageRecord, PointCloud
from ..exposure.times import parse_seconds
from ..file_names import natural_key, plain_path, sibling, view_and_exposure
from ..images.ldr_files import HDR_SUFFIXES, LDR_SUFFIXES
from .colmap import IMAGES_REMEDY, registered_model
from .colmap_model import find_model
from .llff import camera_of_row, images_of_rows, pose_rows
from .transforms import INCOMPLETE, absent_note, frame_pose, frames_of, sparse_points
from .transforms_lens import frame_lens

# HDR-NeRF's synthetic exposures, which HDR-GS's folders do not state (its train_synthetic.py holds them as constants).
_HDR_GS_SECONDS = (0.125, 0.5, 2.0, 8.0, 32.0)


def read_hdr_nerf(folder: Path) -> DataparserOutputs:
    """Parse HDR-NeRF's synthetic layout (xhuangcv/hdr-nerf, load_syn_llff.py).

    `transforms_<split>.json` with frames whose file_path lacks the `_<k>.png` of the exposure; `exposure_<split>.json`
    maps `<file_path>_<k>.png` to seconds; truth is in `<split>_hdr/hdr_%03d.exr` by the frame's index. With
    `"photo_response": "reinhard-gamma"` (this package's field) photos are computed from the truth by that curve.
    """
    records, absent = [], []
    for split in ("train", "test"):
        path, times_path = folder / f"transforms_{split}.json", folder / f"exposure_{split}.json"
        if split == "test" and not path.is_file():
            continue
        values, times = read_json(path), _exposures_of(read_json(times_path), times_path)
        photo_response = values.get("photo_response")
        if photo_response not in (None, DERIVED_PHOTOS):
            raise InputError(
                path, f"photo_response is {photo_response!r:.40}", f"only {DERIVED_PHOTOS!r} can be derived"
            )
        for place, (name, frame) in enumerate(frames_of(values, path)):
            exposures = times.get(plain_path(name))
            if not exposures:
                problem = f"has no exposure time for {name!r:.90}"
                raise InputError(times_path, problem, "list <file_path>_<k>.png: seconds")
            truth = folder / f"{split}_hdr" / f"hdr_{place:03d}.exr"
            hdr, pose = sibling(truth, HDR_SUFFIXES), frame_pose(frame, path, name)
            if photo_response and hdr is None:
                raise InputError(truth, "HDR truth not found", INCOMPLETE)
            present = []
            for key, (file, time) in sorted(exposures.items()):
                image = hdr if photo_response and hdr else resolve_inside(folder, file, times_path)
                if image.is_file():
                    lens, view = frame_lens(values, frame, image, path), Path(plain_path(name)).name
                    present.append(
                        ImageRecord(view, image, lens, pose, key, time, split, hdr=hdr, derived=bool(photo_response))
                    )
            if not present:
                absent.append(f"{plain_path(name)}_{min(exposures)}.png")
            records += present
    if not records:
        raise InputError(folder / absent[0], "image file not found", INCOMPLETE)
    notes = absent_note(absent, len({(record.split, record.view) for record in records}))
    return DataparserOutputs("hdr-nerf", tuple(records), "background", cloud=sparse_points(folder), notes=notes)


def _exposures_of(values: dict, path: Path) -> dict[str, dict[int, tuple[str, float]]]:
    """Return frame -> exposure number -> (file name, seconds)."""
    by_view: dict[str, dict[int, tuple[str, float]]] = {}
    for key, value in values.items():
        match = re.fullmatch(r"(.+)_(\d{1,3})(\.[A-Za-z]+)?", plain_path(key))
        if match:
            name = plain_path(key) if match[3] else f"{plain_path(key)}.png"
            by_view.setdefault(match[1], {})[int(match[2])] = (name, parse_seconds(value, path, key))
    return by_view


def read_hdr_nerf_real(folder: Path) -> DataparserOutputs:
    """Parse HDR-NeRF's real layout.

    `input_images/<view>_<k>.jpg`, and `poses_bounds_exps.npy` [n, 18] by sorted file names with seconds last. Poses of
    a `sparse/0` beside it (HDR-GS's edition) win, because there all exposures of a view have one pose.
    """
    path = folder / "poses_bounds_exps.npy"
    rows = pose_rows(path, 18)
    images = images_of_rows(folder / "input_images", path, len(rows))
    model = find_model(folder)
    cloud, poses = (NO_POINTS, None) if model is None else _poses_by_view(folder, model)
    records, absent = [], set()
    for row, image in zip(rows, images, strict=True):
        view, key = view_and_exposure(image.stem)
        if poses is not None and view not in poses:
            absent.add(view)
            continue
        lens, pose = camera_of_row(row, path, image.name) if poses is None else poses[view]
        records.append(ImageRecord(view, image, lens, pose, exposure_key=key, exposure_time=float(row[17])))
    notes = (f"{len(absent)} views are not in the sparse model and were left out",) if absent else ()
    return DataparserOutputs("hdr-nerf-real", tuple(records), holdout=(2, 1), cloud=cloud, notes=notes)


def is_hdr_gs(folder: Path, model: Path | None) -> bool:
    """Return whether a folder with a sparse model has HDR-GS's synthetic layout.

    It has exposures of the same views, and truth in exr/ under the views' names: an exr/ of other files beside numbered
    photos of a COLMAP set does not count.
    """
    if model is None or not ((folder / "exr").is_dir() and (folder / "images").is_dir()):
        return False
    exposures = _exposures_by_view(folder / "images")
    with_truth = sum(sibling(folder / "exr" / f"{view}.exr", HDR_SUFFIXES) is not None for view in exposures)
    return bool(exposures) and 2 * with_truth >= len(exposures)


def read_hdr_gs(folder: Path, model: Path | None = None) -> DataparserOutputs:
    """Parse HDR-GS's synthetic layout: `images/<v>_<e>.png`, `exr/<v>.exr`, a model with one image of each view."""
    cloud, poses = _poses_by_view(folder, model or folder / "sparse")
    exposures, records = _exposures_by_view(folder / "images"), []
    seconds, notes = _hdr_gs_seconds(folder, 1 + max(key for files in exposures.values() for key in files))
    for view, (lens, pose) in poses.items():
        hdr = sibling(folder / "exr" / f"{view}.exr", HDR_SUFFIXES)
        hdr = hdr and resolve_inside(folder, hdr.relative_to(folder).as_posix(), folder)
        for key, image in sorted(exposures.get(view, {}).items()):
            records.append(ImageRecord(view, image, lens, pose, key, seconds[key] if seconds else None, hdr=hdr))
    if not records:
        raise InputError(folder / "images", "none of the model's images is in images/", IMAGES_REMEDY)
    return DataparserOutputs("hdr-gs", tuple(records), "background", (2, 1), cloud, notes)


def _poses_by_view(folder: Path, source: Path) -> tuple[PointCloud, dict[str, tuple]]:
    """Return the points, and lens and pose of each view (names without `_<exposure>`) in natural order."""
    model = registered_model(source)
    poses = {}
    for entry in sorted(model.images, key=lambda image: natural_key(image.name)):
        view = re.sub(r"_\d+$", "", resolve_inside(folder, entry.name, source).stem)
        poses.setdefault(view, (entry.lens, entry.world_to_camera))
    return model.cloud, poses


def _exposures_by_view(images: Path) -> dict[str, dict[int, Path]]:
    by_view: dict[str, dict[int, Path]] = {}
    for image in images.iterdir():
        view, key = view_and_exposure(image.stem)
        if key is not None and image.suffix.lower() in LDR_SUFFIXES:
            by_view.setdefault(view, {})[key] = image
    return by_view


def _hdr_gs_seconds(folder: Path, count: int) -> tuple[list[float] | None, tuple[str, ...]]:
    """Return seconds by exposure number from `exposure_times.json`, or HDR-GS's constants, and notes."""
    path = folder / "exposure_times.json"
    if path.is_file():
        values = read_json(path).get("exposure_times")
        if not isinstance(values, list) or len(values) < count:
            raise InputError(path, f"exposure_times does not list {count} values", "list the seconds of every exposure")
        return [parse_seconds(value, path, f"exposure {i}") for i, value in enumerate(values)], ()
    if count == len(_HDR_GS_SECONDS):
        return list(_HDR_GS_SECONDS), (f"the set states no exposure times; took HDR-NeRF's {list(_HDR_GS_SECONDS)} s",)
    return None, ()
