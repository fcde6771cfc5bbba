"""Load a scene: parse a data folder of any layout, choose the response, preprocess the photos."""

import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib import resources
from itertools import chain
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import InputError, SehdrError, did_you_mean, missing, path_of, require_whole_number
from ..files import has_file
from ..subsets import first_names
from .camera_checks import check_cameras
from .dataparser import UNPLACED, DataparserOutputs, ImageRecord, PlacedPhoto
from .exposure.times import choose_exposure, exposures_note, with_exposure_times
from .file_names import image_folder, unique_names
from .float_photos import with_float_times
from .masks import assign_masks
from .photos import usable_photos
from .pose_conventions import POSED, with_fitting_cameras
from .preprocess import preprocess
from .readers.arkit import find_scan, read_scan
from .readers.bare_photos import find_photos, inner_folder, place_photos, with_cameras
from .readers.colmap import model_fits, read_colmap
from .readers.colmap_model import find_model, has_images
from .readers.hdr_sets import is_hdr_gs, read_hdr_gs, read_hdr_nerf, read_hdr_nerf_real
from .readers.llff import read_llff
from .readers.meshroom import find_sfm, read_meshroom
from .readers.opensfm import find_reconstruction, read_opensfm
from .readers.photo_copies import without_copied_tests
from .readers.transforms import is_transforms, read_transforms
from .response_choice import check_response, check_response_type, choose_response
from .truth_files import assign_truth
from .types import Scene
from .unused_files import ARCHIVE_SUFFIXES, unread_geometry, unused_notes
from .video.decode import UNSTITCHED_SUFFIXES, is_video
from .video.frames import read_video

if TYPE_CHECKING:
    from ..response import Response

_MARK = "transforms_train.json"  # A file of every embedded scene
_HOLDOUT = 8  # Every eighth view is held out, as LLFF, Mip-NeRF 360 and 3DGS do
# Layouts that do not say where truth lies.
_WITH_TRUTH = ("colmap", "transforms", "opensfm", "meshroom", "arkit", "llff", "photos")
METHODS, STORAGES = ("posterior", "paper"), ("auto", "memory", "disk")
_FEWEST_FOR_TEST = 5  # In smaller sets no view is held out


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
    cameras: Sequence[PlacedPhoto] = (),
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
        cameras: of bare photos, with their splits and estimated exposure times, as a run keeps them; other photos are
            left out. Structure from motion finds them if there are none.

    Returns:
        A Scene in the set's own world coordinates, with the points that the set has.

    Raises:
        InputError: if a file of the set is missing, damaged or hostile, an exposure is impossible, fewer than two
            training views remain, or the photos show nothing but black or white. Single photos that cannot be used are
            left out, and a note names them.
        TypeError: for an argument of another type.
        SehdrError: for an unknown method or storage.
    """
    from ..response import response_by_name, responses_named

    if max_size is not None and (isinstance(max_size, bool) or not isinstance(max_size, Real) or not max_size >= 1):
        raise InputError(path, f"longest side of {max_size!r:.60} pixels asked for", "give at least 1 pixel")
    for name, value, names in (("method", method, METHODS), ("photo_storage", photo_storage, STORAGES)):
        if value not in names:
            raise SehdrError(f"{name} {value!r:.60} is not one of {', '.join(names)}")
    _check_lists(candidates, views, cameras)
    if isinstance(response, str | Path) and str(response) not in ("auto", "learned", "linear"):
        response_by_name(response)  # An unknown name is refused before the photos are read.
    for candidate in candidates:
        responses_named(candidate)
    dataset = parse_dataset(
        path, response=response, exposure_index=exposure_index, holdout=holdout, cache=cache, cameras=cameras
    )
    choice = choose_response(dataset, response, method, candidates)
    dataset, curve = choice.dataset, choice.response
    records = dict(zip(unique_names(dataset.records), dataset.records, strict=True))
    if views is not None:
        if absent := sorted(set(views) - records.keys()):
            problem = f"{len(absent)} of the views that were named are missing, {absent[0]} first"
            raise InputError(path, problem, "put the photos back as they were")
        records = {name: record for name, record in records.items() if name in views}
        dataset = replace(dataset, records=tuple(records.values()))
    scene = preprocess(dataset, curve, list(records), max_size, photo_storage)
    scene = _with_all_times(scene, records, cameras, curve)
    if dataset.kind != "float":
        usable = {view.name for view in scene.views}
        note = exposures_note([record for name, record in records.items() if name in usable])
        scene = replace(scene, notes=scene.notes + note)
    return replace(
        scene,
        chosen_by=choice.chosen_by,
        color_matrix=choice.color_matrix,
        light_known=dataset.kind != "encoded" or curve.name == dataset.stated_response,
        unplaced=dataset.unplaced,
    )


def _check_lists(candidates: object, views: object, cameras: Sequence[object]) -> None:
    """Raise TypeError for a text or another value in place of a list, and SehdrError for a list of no views."""
    for name, value in {"candidates": candidates, "views": views}.items():
        if isinstance(value, str) or not isinstance(value, Collection | None):
            raise TypeError(f"{name} is {value!r:.60}, expected a list of names")
    if views is not None and not views:
        raise SehdrError("views is empty; name views, or leave views out to read all")
    if isinstance(cameras, str) or not all(isinstance(camera, PlacedPhoto) for camera in cameras):
        kind = cameras if isinstance(cameras, str) else next(type(camera).__name__ for camera in cameras)
        raise TypeError(f"cameras has {kind!r:.60}, expected those of bare photos that a run keeps (PlacedPhoto)")


def _with_all_times(
    scene: Scene, records: Mapping[str, ImageRecord], cameras: Sequence[PlacedPhoto], response: "Response"
) -> Scene:
    """Return a scene with exposure times for photos, by name, that state none: those of a run, or else estimates."""
    without_time = {name: record for name, record in records.items() if not record.time_known}
    if not without_time:
        return scene
    if not cameras:
        from .exposure.estimate import with_estimated_times

        return with_estimated_times(scene, without_time, response)
    # The training estimated them by points of structure from motion, which are not here.
    run_times = {camera.world_to_camera.tobytes(): camera.exposure_time for camera in cameras}
    times = {name: run_times.get(record.world_to_camera.tobytes()) for name, record in without_time.items()}
    views = (replace(view, exposure_time=times.get(view.name) or view.exposure_time) for view in scene.views)
    return replace(scene, views=tuple(views))


def parse_dataset(
    path: Path | str,
    *,
    response: "str | Path | Response" = "auto",
    exposure_index: int | None = None,
    holdout: int | None = None,
    cache: Path | str | None = None,
    cameras: Sequence[PlacedPhoto] = (),
) -> DataparserOutputs:
    """Parse cameras, files, exposure times and splits of a data folder; of most photos only headers are read.

    Everything that can refuse a set is checked before structure from motion, which takes minutes; so is a response that
    does not apply. Arguments and errors are those of load_scene().
    """
    for name, value in {"holdout": holdout, "exposure_index": exposure_index}.items():
        if value is not None:
            require_whole_number(value, name, 0)
    check_response_type(response)
    folder = _folder(path)
    dataset = read_video(folder, cache) if is_video(folder) else _read(folder, cameras)
    name = str(path) if is_embedded(path) else folder.resolve().name
    root, folder = folder, folder if dataset.folder == Path() else dataset.folder
    if not dataset.records:
        raise InputError(folder, "has no views", "check the data folder")
    records, mask_notes = assign_masks(dataset.records, folder)
    records, truth_notes = assign_truth(records, folder) if dataset.format in _WITH_TRUTH else (records, [])
    all_records = records
    records, exposure_notes = choose_exposure(records, exposure_index, folder)
    records, kind, photo_notes = usable_photos(records)
    with_times = with_float_times if kind == "float" else with_exposure_times
    records, times_known, time_notes = with_times(records, folder)
    dataset = replace(dataset, kind=kind, records=tuple(records), folder=folder, times_known=times_known)
    check_response(dataset, response, path)
    unplaced: list[str] = []
    if records and records[0].lens is UNPLACED:
        dataset, unplaced = _place(dataset, cameras, cache, root)
        records = list(dataset.records)
        if unplaced:  # Notes and relative times are to be those of the photos that remain.
            reset = [replace(record, exposure_time=None, time_known=True) for record in records]
            records, times_known, time_notes = with_times(reset, folder)
            dataset = replace(dataset, times_known=times_known)
    pose_notes: list[str] = []
    if dataset.format in POSED:
        records, pose_notes = with_fitting_cameras(records, dataset.format, cache)
    records, camera_notes = check_cameras(records, dataset.cloud)
    records, split_notes = _with_splits(records, dataset, holdout)
    training = sum(record.split == "train" for record in records)
    unused: list[str] = []
    if not is_embedded(path) and dataset.format != "video":
        unused = [*unused_notes(folder, all_records, [*unplaced, *dataset.mentioned]), *unread_geometry(root)]
    if training < 2:
        counts = f"{len(records)} view{'s' * (len(records) != 1)}, {training} for training"
        remedy = "hold out fewer (--holdout 8, or 0 for none)" if len(records) > 1 else "add views from other places"
        raise InputError(folder, f"has {counts}; one view does not show depth", remedy)
    notes = dataset.notes, mask_notes, truth_notes, exposure_notes, photo_notes, time_notes
    notes = tuple(chain(*notes, pose_notes, camera_notes, split_notes, unused))
    return replace(dataset, records=tuple(records), notes=notes, name=name, unplaced=len(unplaced))


def _place(
    dataset: DataparserOutputs, cameras: Sequence[PlacedPhoto], cache: Path | str | None, root: Path
) -> tuple[DataparserOutputs, list[str]]:
    """Return bare photos, or frames of the video `root`, with the cameras of a run or of structure from motion.

    The second result names the photos without a camera, which are left out.
    """
    try:
        return with_cameras(dataset, cameras) if cameras else place_photos(dataset, cache)
    except InputError as error:
        if dataset.format != "video":
            raise
        remedy = "film slowly and in bright light, while you move past things that stand still"
        raise InputError(root, error.problem.replace("photos", "frames"), remedy) from None  # Not frames in a cache


def _folder(path: Path | str) -> Path:
    """Return the folder of a data set, or a video or transforms.json; raise InputError for anything else."""
    if is_embedded(path):
        return embedded_folder(str(path))
    folder = path_of(path, "path")
    if is_video(folder) or is_transforms(folder):
        return folder
    try:
        empty = not any(folder.iterdir())
    except FileNotFoundError:
        raise missing(folder, "not found", "give a folder of photos, or 'embedded'") from None
    except NotADirectoryError:
        problem, remedy = "is not a folder", "give the folder that holds the photos"
        if folder.suffix.lower() in UNSTITCHED_SUFFIXES:
            problem, remedy = "holds the pictures of two lenses", "export it as one equirectangular MP4"
        elif folder.suffix.lower() in ARCHIVE_SUFFIXES:
            problem, remedy = "is an archive", "unpack it, and give the folder with its photos"
        raise InputError(folder, problem, remedy) from None
    except OSError as error:
        raise InputError(folder, f"cannot be read ({error.strerror or error})", "check its permissions") from None
    if empty:
        raise InputError(folder, "folder is empty", "put the photos there")
    return folder


def _read(folder: Path, cameras: Sequence[PlacedPhoto]) -> DataparserOutputs:
    """Parse by the first layout that fits, the most specific one first; a file as transforms.json.

    With the cameras of a run, photos of a scan or of Meshroom are bare: the run may have found them before poses lay
    there.
    """
    if folder.is_file():
        return replace(read_transforms(folder.parent, folder), folder=folder.parent)

    def has(*names: str) -> bool:
        return all(has_file(folder / name) for name in names)

    usual = find_model(folder)
    model = usual or find_model(folder, anywhere=True)
    poses = model if model is not None and has_images(model) else None
    beside = poses is not None and poses.is_relative_to(folder / "sparse") and image_folder(folder) is not None
    readers = (
        (has("transforms_train.json", "exposure_train.json"), read_hdr_nerf),
        (has("poses_bounds_exps.npy"), read_hdr_nerf_real),
        (is_hdr_gs(folder, usual), partial(read_hdr_gs, model=usual)),
        (beside, partial(read_colmap, source=model)),
        (has("transforms.json") or has("transforms_train.json"), read_transforms),
        (poses is not None and model_fits(folder, poses), partial(read_colmap, source=model)),
        (find_reconstruction(folder) is not None, read_opensfm),
        (has("poses_bounds.npy"), read_llff),
        (not cameras and find_sfm(folder) is not None, read_meshroom),
        (not cameras and find_scan(folder) is not None, read_scan),
        (model != poses, partial(read_colmap, source=model)),  # Refused: nothing else has poses.
    )
    reader = next((reader for fits, reader in readers if fits), None)
    if reader is None and model is None and (inner := inner_folder(folder)) is not None:
        note = f"photos are read from {inner.relative_to(folder)}, the only folder with photos"
        dataset = _read(inner, cameras)
        return replace(dataset, folder=inner, notes=(note, *dataset.notes))
    dataset = reader(folder) if reader else find_photos(folder, [camera.file for camera in cameras])
    if model is not None and poses is None:
        note = f"{model.relative_to(folder)} has no images.bin or images.txt: its cameras are not used"
        dataset = replace(dataset, notes=(*dataset.notes, note))
    return dataset


def _with_splits(
    records: list[ImageRecord], dataset: DataparserOutputs, holdout: int | None
) -> tuple[list[ImageRecord], list[str]]:
    """Return the photos with a split each, and notes if the set does not state one that tests new views."""
    records, copies = without_copied_tests(records)
    if holdout is None and any(record.split == "test" for record in records):
        return [replace(record, split=record.split or "train") for record in records], copies
    uncertain = {i for i, record in enumerate(records) if record.uncertain}
    held_out = holdout_indices(len(records), holdout, dataset.holdout, uncertain)
    records = [replace(record, split="test" if i in held_out else "train") for i, record in enumerate(records)]
    if not held_out:
        return records, [*copies, "no views are held out for testing"]
    names = [name for name, record in zip(unique_names(records), records, strict=True) if record.split == "test"]
    names_text = first_names(names, 5)
    are = "is" if len(names) == 1 else "are"
    return records, [*copies, f"{len(names)} of {len(records)} views {are} held out for testing: {names_text}"]


def holdout_indices(
    count: int, step: int | None, protocol: tuple[int, int] | None, uncertain: Collection[int] = ()
) -> set[int]:
    """Return the indices of test views: by `protocol` (every, offset), or the middle of each block, not the last view.

    In place of a middle view whose camera is uncertain, the nearest other one of its block is taken, if there is one:
    a camera that is off would count as an error of the scene.
    """
    if step == 0 or count < _FEWEST_FOR_TEST:
        return set()
    if protocol is not None:
        every, offset = step or protocol[0], protocol[1]
        return set(range(min(offset, every - 1), count, every))
    step = step or _HOLDOUT
    middles = range(step // 2, count - 1, step) or [count // 2]
    blocks = [range(max(i - step // 2, 0), min(i - step // 2 + step, count - 1)) for i in middles]
    certain = [[j for j in block if j not in uncertain] for block in blocks]
    return {min(each, key=lambda j: abs(j - i), default=i) for i, each in zip(middles, certain, strict=True)}


def is_embedded(path: Path | str) -> bool:
    """Return whether this names an embedded scene, known or not, rather than a folder."""
    return str(path) == "embedded" or str(path).startswith("embedded:")


def embedded_scenes() -> tuple[str, ...]:
    """List the names that load_scene("embedded:NAME") finds: room, and others of a checkout or $SEHDR_SCENES."""
    return tuple(sorted(_embedded_folders()))


def embedded_folder(path: str) -> Path:
    """Return the folder of `embedded` or `embedded:NAME`; raise InputError if it is not here."""
    name, folders = str(path).partition(":")[2] or "room", _embedded_folders()
    if name in folders:
        return folders[name]
    present = ", ".join(f"embedded:{each}" for each in sorted(folders))
    problem = f"is not here{did_you_mean(name, folders)}; present are {present}"
    raise InputError(path, problem, "get the repository's scenes/ and name it in SEHDR_SCENES")


def _embedded_folders() -> dict[str, Path]:
    """Return embedded scenes by name: of the package, else of $SEHDR_SCENES, else of a checkout's scenes/."""
    package, other = Path(str(resources.files("sehdr_warp"))), os.environ.get("SEHDR_SCENES")
    places = [package.parent / "scenes", *([Path(other)] if other else []), package / "embedded"]
    return {path.parent.name: path.parent for place in places for path in place.glob(f"*/{_MARK}")}
