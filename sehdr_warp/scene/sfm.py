"""Structure from motion through pycolmap: poses and points of bare photos, and points of views with known poses.

pycolmap only ever sees images that this module wrote under names of its own, and its models come back through the
package's bounded reader. Results go to a cache folder under a key made of all that they depend on.
"""

import contextlib
import hashlib
import json
import math
import os
import struct
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from sehdr_warp.errors import InputError, SehdrError

from .colmap_model import SparseModel, read_model
from .images import open_image, read_ldr
from .types import View

Progress = Callable[[str], None]

# SIFT finds little more above this size, and extraction time grows with the area.
MAX_SIDE = 1200
_SEED = 0
_VERSION = 1
# Up to here every pair is matched; beyond, each photo with its neighbours by name (a walk or a video).
_EXHAUSTIVE_LIMIT = 150
_CHUNK = 8


def reconstruct(photos: Sequence[Path], cache: Path | None, progress: Progress) -> SparseModel:
    """Cameras (SIMPLE_RADIAL, at the photos' oriented size), poses and points of a list of photos.

    The names in the model are the photos' indices (`00003.png` is photos[3]); photos that could not be placed are
    missing from it. cache: a folder for results; the same photos (name, size, time of change) are not solved again.
    Raises InputError where fewer than two photos can be placed.
    """
    stamps = [(photo.name, photo.stat().st_size, photo.stat().st_mtime_ns) for photo in photos]
    key = _key("photos", MAX_SIDE, _SEED, stamps)

    def solve(work: Path, result: Path) -> None:
        sizes, small = _write_photos(photos, work / "images", progress)
        database = work / "database.db"
        for group in _same_camera(photos, sizes):
            focal = _focal_prior(photos[group[0]], small[group[0]])
            width, height = small[group[0]]
            _extract(database, work / "images", [_name(i) for i in group], "SIMPLE_RADIAL",
                     (focal, width / 2, height / 2, 0.0), progress)  # fmt: skip
        _match(database, len(photos), progress)
        model = _map(database, work, len(photos), photos[0].parent, progress)
        model.write_binary(result)
        (result / "sizes.json").write_text(json.dumps(sizes))

    with _cached(cache, f"sfm-{key}", solve, progress) as folder:
        model = read_model(folder)
        sizes = json.loads((folder / "sizes.json").read_text())
    full = {image.camera_id: sizes[int(Path(image.name).stem)] for image in model.images}
    cameras = {camera_id: model.cameras[camera_id].resized(*size) for camera_id, size in full.items()}
    return SparseModel(cameras, model.images, model.points, model.colors)


def triangulate(views: Sequence[View], cache: Path | None, progress: Progress) -> tuple[np.ndarray, np.ndarray]:
    """[P, 3] points and [P, 3] colours seen in views whose cameras are known; P is 0 where no feature matches.

    Features are found on the views' images stretched to full range (a short exposure is nearly black as it is), at
    no more than MAX_SIDE pixels; poses stay as they are.
    """
    digest = hashlib.sha256()
    for view in views:
        digest.update(view.image.tobytes())
        digest.update(json.dumps(view.camera.to_dict()).encode())
    key = _key("points", MAX_SIDE, _SEED, digest.hexdigest())

    def solve(work: Path, result: Path) -> None:
        import pycolmap

        sizes = _write_views(views, work / "images")
        database = work / "database.db"
        for i, view in enumerate(views):
            camera = view.camera.resized(*sizes[i])
            _extract(
                database, work / "images", [_name(i)], "PINHOLE", camera.intrinsics, progress if i == 0 else _silent
            )
        _match(database, len(views), progress)
        progress("triangulating points from the known poses")
        model = _known_poses(database, views)
        options = pycolmap.IncrementalPipelineOptions()
        _seed(options)
        with _quiet():
            model = pycolmap.triangulate_points(model, database, work / "images", work / "model", options=options)
        places, colors = _sampled_colors(model, views, sizes)
        np.savez(result / "points.npz", points=places, colors=colors)

    with _cached(cache, f"points-{key}", solve, progress) as folder, np.load(folder / "points.npz") as stored:
        return stored["points"], stored["colors"]


@contextlib.contextmanager
def _cached(cache: Path | None, name: str, solve: Callable[[Path, Path], None], progress: Progress):
    """The folder of a finished result: the cached one, or a new one that solve(work, result) fills."""
    if cache is not None and (cache / name).is_dir():
        progress(f"using the cached result {cache / name}")
        yield cache / name
        return
    try:
        if cache is not None:
            cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="sehdr-sfm-", dir=cache) as work:
            result = Path(work) / "result"
            (Path(work) / "model").mkdir()
            result.mkdir()
            solve(Path(work), result)
            if cache is None:
                yield result
                return
            try:
                os.replace(result, cache / name)
            except OSError:
                # Another process finished the same work first; its result is as good.
                if not (cache / name).is_dir():
                    raise
    except BaseException as error:
        if cache is not None:
            with contextlib.suppress(OSError):  # Not empty, or never made.
                cache.rmdir()
        if not isinstance(error, OSError):
            raise
        raise SehdrError(f"{cache or tempfile.gettempdir()}: structure from motion cannot write "
                         f"({error.strerror or error}); free some space or choose another cache") from None  # fmt: skip
    yield cache / name


def _key(*parts) -> str:
    return hashlib.sha256(json.dumps([_VERSION, *parts]).encode()).hexdigest()[:16]


def _name(index: int) -> str:
    return f"{index:05d}.png"


def _silent(message: str) -> None:
    pass


def _write_photos(photos, folder: Path, progress: Progress) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Oriented 8-bit copies of at most MAX_SIDE pixels; returns the oriented full sizes and the copies' sizes."""
    folder.mkdir()
    sizes, small, informative = [], [], False
    for i, photo in enumerate(photos):
        if i % _CHUNK == 0:
            progress(f"reading photos {i + 1} to {min(i + _CHUNK, len(photos))} of {len(photos)}")
        encoded = read_ldr(photo, oriented=True)
        pixels = encoded.pixels if encoded.pixels.dtype == np.uint8 else (encoded.pixels >> 8).astype(np.uint8)
        image = Image.fromarray(pixels)
        sizes.append(image.size)
        image.thumbnail((MAX_SIDE, MAX_SIDE), Image.Resampling.BOX)
        small.append(image.size)
        values = np.asarray(image)
        informative |= bool(((values > 2) & (values < 253)).mean() > 1e-3)
        image.save(folder / _name(i), compress_level=1)
    if not informative:
        raise InputError(
            photos[0].parent, "the photos are all black or all white", "expose them so that the scene shows"
        )
    return sizes, small


def _write_views(views, folder: Path) -> list[tuple[int, int]]:
    folder.mkdir()
    sizes = []
    for i, view in enumerate(views):
        image = view.image / max(float(np.percentile(view.image, 99.5)), 1 / 255)
        if view.mask is not None:
            image = image * view.mask[:, :, None]
        picture = Image.fromarray((np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8))
        picture.thumbnail((MAX_SIDE, MAX_SIDE), Image.Resampling.BOX)
        picture.save(folder / _name(i), compress_level=1)
        sizes.append(picture.size)
    return sizes


def _same_camera(photos, sizes) -> list[list[int]]:
    """Indices of photos that one set of intrinsics describes: same size, device and focal length by EXIF."""
    groups: dict[tuple, list[int]] = {}
    for i, photo in enumerate(photos):
        groups.setdefault((tuple(sizes[i]), *map(str, _device(photo))), []).append(i)
    return list(groups.values())


def _focal_prior(photo: Path, size: tuple[int, int]) -> float:
    """Pixels: from EXIF's 35 mm equivalent (whose diagonal is 43.27 mm), or COLMAP's guess of 1.2 longest sides."""
    equivalent = _device(photo)[-1]
    if isinstance(equivalent, int | float) and 4 <= equivalent <= 2000:
        return float(equivalent) / 43.27 * math.hypot(*size)
    return 1.2 * max(size)


def _device(photo: Path) -> tuple:
    """EXIF's maker, model, focal length and its 35 mm equivalent; None where EXIF does not say or is damaged."""
    with open_image(photo) as image:
        try:
            exif = image.getexif()
            lens = exif.get_ifd(0x8769)
        except (OSError, SyntaxError, ValueError, KeyError, TypeError, EOFError, struct.error):
            return None, None, None, None
    return exif.get(0x010F), exif.get(0x0110), lens.get(0x920A), lens.get(0xA405)


def _extract(database: Path, images: Path, names: list[str], model: str, params, progress: Progress) -> None:
    """Features of images that share one camera, a few at a time so that progress can be told."""
    import pycolmap

    reader = pycolmap.ImageReaderOptions(
        camera_model=model, camera_params=",".join(f"{value:.17g}" for value in params)
    )
    for start in range(0, len(names), _CHUNK):
        part = names[start : start + _CHUNK]
        progress(f"finding features in images {start + 1} to {start + len(part)} of {len(names)}")
        with _quiet():
            pycolmap.extract_features(
                database, images, part, pycolmap.CameraMode.SINGLE, reader, device=pycolmap.Device.cpu
            )
        if start == 0:
            with pycolmap.Database.open(database) as opened:
                shared = next(image.camera_id for image in opened.read_all_images() if image.name == part[0])
            reader.existing_camera_id = shared


def _match(database: Path, count: int, progress: Progress) -> None:
    import pycolmap

    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = _SEED
    progress(f"matching features between {count} images")
    with _quiet():
        if count <= _EXHAUSTIVE_LIMIT:
            pycolmap.match_exhaustive(database, verification_options=verification, device=pycolmap.Device.cpu)
        else:
            pairing = pycolmap.SequentialPairingOptions(overlap=20, quadratic_overlap=True)
            pycolmap.match_sequential(database, pairing_options=pairing, verification_options=verification,
                                      device=pycolmap.Device.cpu)  # fmt: skip


def _seed(options) -> None:
    options.random_seed = _SEED
    options.mapper.random_seed = _SEED
    options.triangulation.random_seed = _SEED


def _map(database: Path, work: Path, count: int, source: Path, progress: Progress):
    """The largest reconstruction; where photos are left, after a second try with weaker conditions."""
    import pycolmap

    best = None
    for patient in (False, True):
        options = pycolmap.IncrementalPipelineOptions(min_model_size=2)
        _seed(options)
        if patient:
            options.min_num_matches = 10
            options.mapper.init_min_tri_angle = 4.0
            options.mapper.init_min_num_inliers = 50
            options.mapper.abs_pose_min_num_inliers = 15
            progress("placing the photos again with weaker conditions")
        placed = [2]

        def next_image(placed=placed) -> None:
            placed[0] += 1
            progress(f"placed {placed[0]} of {count} photos")

        output = work / f"model{int(patient)}"
        output.mkdir()
        with _quiet():
            models = pycolmap.incremental_mapping(
                database, work / "images", output, options, next_image_callback=next_image
            )
        for model in models.values():
            if best is None or model.num_reg_images() > best.num_reg_images():
                best = model
        if best is not None and best.num_reg_images() == count:
            return best
    if best is None or best.num_reg_images() < 2:
        raise InputError(source, f"none of the {count} photos could be placed by structure from motion",
                         "take sharp photos that overlap by two thirds, or bring poses")  # fmt: skip
    return best


def _known_poses(database: Path, views):
    """A reconstruction that holds the database's cameras and images at the views' poses, and no points."""
    import pycolmap

    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as opened:
        for camera in opened.read_all_cameras():
            model.add_camera_with_trivial_rig(camera)
        for image in opened.read_all_images():
            pose = views[int(Path(image.name).stem)].camera.world_to_camera
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
    return model


def _sampled_colors(model, views, sizes) -> tuple[np.ndarray, np.ndarray]:
    """Places and the mean colour of the pixels where each point was seen, as encoded in the views."""
    places, colors = [], []
    for point in model.points3D.values():
        seen = []
        for element in point.track.elements:
            image = model.images[element.image_id]
            index = int(Path(image.name).stem)
            pixels, (width, height) = views[index].image, sizes[index]
            x, y = image.points2D[element.point2D_idx].xy
            row = min(max(int(y * pixels.shape[0] / height), 0), pixels.shape[0] - 1)
            column = min(max(int(x * pixels.shape[1] / width), 0), pixels.shape[1] - 1)
            seen.append(pixels[row, column])
        places.append(point.xyz)
        colors.append(np.mean(seen, axis=0))
    return np.array(places, np.float64).reshape(-1, 3), np.array(colors, np.float32).reshape(-1, 3)


@contextlib.contextmanager
def _quiet():
    """pycolmap logs every step to the terminal; only its fatal errors pass."""
    import pycolmap

    level, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, int(pycolmap.logging.FATAL)
    try:
        yield
    except (RuntimeError, ValueError) as error:
        raise SehdrError(f"structure from motion failed ({str(error).splitlines()[0] if str(error) else error!r}); "
                         "check that the photos are sharp and overlap") from None  # fmt: skip
    finally:
        pycolmap.logging.minloglevel = level
