"""Structure from motion of panoramas: through pinhole views cut from each, which COLMAP moves as one rigid rig."""

import json
import logging
import math
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from ...errors import InputError
from ...parallel import run_interruptibly
from ...progress import stage, track_progress
from ..cached_folder import file_digest
from ..dataparser import PointCloud
from ..images.ldr_files import file_kind, open_image
from ..images.xmp import xmp_of, xmp_values
from ..lens import Lens
from ..photos import brightened_codes, photo_sizes, read_photo
from ..readers.colmap_model import ModelImage, SparseModel, read_points
from ..types import View, encoded_values
from ..wide_camera import FACE_ANGLE, face_rotations, faces_of
from .progress import counted_rows
from .reconstruction import (
    EXHAUSTIVE_LIMIT,
    Reconstruction,
    cache_key,
    image_name,
    matching_options,
    quiet_colmap,
    run_mapper,
    solved_folder,
)

_log = logging.getLogger("sehdr_warp.scene")

_FACE_SIDE = 600  # Pixels of a cut view at most
_SEAM = 3.0  # Times their usual difference, by which the outer columns of a panorama may differ
_CHANCE = 0.8  # Of their difference by chance; 140 views of 20 panoramas have 0.46 at most, no seam 0.85 and more
_JUDGED = 5
_LEAST_SHARE = 0.99  # Of the columns of a whole panorama
_WHOLE = "export whole panoramas (360 x 180 degrees)"
_SKEW = 2  # Pixels by which a panorama may differ from 2:1


def are_panoramas(photos: Sequence[Path]) -> bool:
    """Return whether bare photos are equirectangular panoramas.

    They are if all are twice as wide as high, and some say so in their metadata (GPano), or their left and right ends
    fit together.

    Raises:
        InputError: if the metadata of one say that it is a panorama of a part of the sphere.
    """
    judged = photos[:: max(1, len(photos) // _JUDGED)][:_JUDGED]
    projections = {kind for photo in judged if (kind := _projection_of(photo))}
    for photo in photos:
        width, height = photo_sizes(photo)[1]
        if abs(width - 2 * height) > _SKEW:
            if projections == {"equirectangular"}:
                problem = f"says that it is a panorama (GPano), and is {width} x {height}, not twice as wide as high"
                raise InputError(photo, problem, _WHOLE)
            return False
    if projections:
        return projections == {"equirectangular"}
    return all(np.median([_seam(photo) for photo in judged], axis=0) < (_SEAM, _CHANCE))


def _projection_of(photo: Path) -> str | None:
    """Return the projection that a photo's XMP states, in lower case.

    Raises:
        InputError: if it states that the photo shows a part of a sphere.
    """
    if file_kind(photo) != "encoded":
        return None
    with open_image(photo) as image:
        xmp = xmp_of(image)

    def values(name: str) -> list[str]:
        return xmp_values(xmp, f"GPano:{name}")

    projection = next(iter(values("ProjectionType")), "").lower()
    # A reduced copy keeps the numbers of the original, so their quotient counts.
    cropped, full = ((*values(f"{name}WidthPixels"), "0")[0] for name in ("CroppedAreaImage", "FullPano"))
    with suppress(ValueError):
        if projection == "equirectangular" and 0 < int(cropped) < _LEAST_SHARE * int(full):
            problem = f"shows a part of a panorama: {cropped} of {full} columns (GPano)"
            raise InputError(photo, problem, _WHOLE)
    return projection or None


def _seam(photo: Path) -> tuple[float, float]:
    """Return how much the outer columns of a photo differ, relative to neighboring columns and to chance.

    The second number is relative to the difference from the other column upside down: ends that are even from top to
    bottom, such as a white background or the black around the circles of two fisheye lenses, fit by chance.
    """
    image = encoded_values(read_photo(photo, oriented=True).pixels)
    next_to = np.abs(np.diff(image, axis=1)).mean()
    ends = np.abs(image[:, 0] - image[:, -1]).mean()
    by_chance = np.abs(image[:, 0] - image[::-1, -1]).mean()
    return float(ends / max(next_to, 1e-3)), float((ends + 1e-3) / (by_chance + 1e-3))


def reconstruct_panoramas(photos: Sequence[Path], cache: Path | str | None = None) -> Reconstruction:
    """Find poses and points of equirectangular panoramas; arguments, result and errors as of reconstruct()."""
    digests = [(photo.name, file_digest(photo)) for photo in photos]
    key = cache_key("panoramas", _FACE_SIDE, FACE_ANGLE, digests)

    def solve(work: Path, result: Path) -> None:
        database = work / "database.db"
        _write_faces(photos, work / "images")
        _match_rigs(database, work / "images", len(photos))
        rig = {"name": "panorama", "views": len(face_rotations())}
        model = run_mapper(database, work, len(photos), photos[0].parent, **rig)
        poses = {}
        for number in model.reg_image_ids():
            image = model.images[number]
            face, _, name = image.name.partition("/")
            if face == "face0":
                poses[int(Path(name).stem)] = image.cam_from_world().matrix().tolist()
        model.write_binary(result)
        facts = {"poses": poses, "error": float(model.compute_mean_reprojection_error())}
        (result / "panoramas.json").write_text(json.dumps(facts))

    folder = solved_folder(cache, key, solve)
    facts = json.loads((folder / "panoramas.json").read_text())
    cloud: PointCloud = read_points(folder)
    images = []
    for index, matrix in sorted(facts["poses"].items(), key=lambda item: int(item[0])):
        width, height = photo_sizes(photos[int(index)])[1]
        lens = Lens("EQUIRECTANGULAR", width, height, (float(width), float(height)), photos[int(index)])
        images.append(ModelImage(image_name(int(index)), lens, np.vstack([matrix, [0, 0, 0, 1]])))
    return Reconstruction(SparseModel(tuple(images), cloud), facts["error"], ())


def _write_faces(photos: Sequence[Path], folder: Path) -> None:
    """Write the cut views of each photo: face0/00000.png, face1/00000.png, ..."""
    for number in range(len(face_rotations())):
        (folder / f"face{number}").mkdir(parents=True)
    for index, photo in track_progress("cutting panoramas", photos, _log):
        pixels = brightened_codes(read_photo(photo, oriented=True).pixels)
        height, width = pixels.shape[:2]
        lens = Lens("EQUIRECTANGULAR", width, height, (float(width), float(height)), photo)
        view = View("p", pixels, lens.camera(np.eye(4)), 1.0, "train")
        for number, face in enumerate(faces_of(view, min(_FACE_SIDE, height))):
            Image.fromarray(face.codes).save(folder / f"face{number}" / image_name(index), compress_level=1)


def _match_rigs(database: Path, images: Path, count: int) -> None:
    """Find and match features; views of one panorama are one frame of a rig and are not matched with each other."""
    import pycolmap

    side = Image.open(images / "face0" / image_name(0)).size[0]
    focal = side / 2 / np.tan(np.radians(FACE_ANGLE / 2))
    reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_PINHOLE", camera_params=f"{focal},{side / 2},{side / 2}")
    turns = face_rotations()
    cameras = []
    for number, turn in enumerate(turns):
        options = {"ref_sensor": number == 0, "image_prefix": f"face{number}/"}
        if number > 0:
            options["cam_from_rig"] = pycolmap.Rigid3d(pycolmap.Rotation3d(turn), np.zeros(3))
        cameras.append(pycolmap.RigConfigCamera(**options))
    matching = pycolmap.FeatureMatchingOptions(rig_verification=True, skip_image_pairs_in_same_frame=True)
    options = matching_options()
    with quiet_colmap():
        with pycolmap.Database.open(database):  # As in reconstruction._extract(): numbers by name
            pycolmap.import_images(database, images, pycolmap.CameraMode.PER_FOLDER, [], reader)
        arguments = (database, images, [], pycolmap.CameraMode.PER_FOLDER, reader)
        extract = partial(pycolmap.extract_features, *arguments, device=pycolmap.Device.cpu)
        with (
            stage("finding features in views of panoramas", count * len(turns), _log) as progress,
            counted_rows(database, "keypoints", progress.update),
        ):
            run_interruptibly(extract)
        with pycolmap.Database.open(database) as opened:
            pycolmap.apply_rig_config([pycolmap.RigConfig(cameras=cameras)], opened)
        match = partial(pycolmap.match_exhaustive, database, matching_options=matching, **options)
        pairs = len(turns) ** 2 * math.comb(count, 2)
        if count * len(turns) > EXHAUSTIVE_LIMIT:
            pairing = pycolmap.SequentialPairingOptions(overlap=10, quadratic_overlap=True)
            options |= {"matching_options": matching, "pairing_options": pairing}
            match, pairs = partial(pycolmap.match_sequential, database, **options), 0
        with (
            stage("matching pairs of views", pairs, _log) as progress,
            counted_rows(database, "two_view_geometries", progress.update),
        ):
            run_interruptibly(match)
