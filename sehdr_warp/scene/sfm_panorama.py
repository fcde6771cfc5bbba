"""Structure from motion of panoramas: through pinhole views cut from each, which COLMAP moves as one rigid rig."""

import json
import logging
import math
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from ..parallel import run_interruptibly
from ..progress import stage, track_progress
from .colmap_model import ModelImage, SparseModel, counted_rows, read_points
from .dataparser import PointCloud
from .images import open_image
from .lens import Lens
from .linear_photos import kind_of
from .photos import photo_sizes, read_photo
from .sfm import (
    EXHAUSTIVE_LIMIT,
    SEED,
    Reconstruction,
    cache_key,
    file_digest,
    image_name,
    matching_options,
    quiet_colmap,
    run_mapper,
    solved_folder,
)
from .types import View, encoded_values
from .wide_camera import FACE_ANGLE, face_rotations, faces_of

_log = logging.getLogger("sehdr_warp.scene")

_FACE_SIDE = 600  # Pixels of a cut view at most
_SEAM = 3.0  # Times their usual difference, by which the outer columns of a panorama may differ
_JUDGED = 5
_SKEW = 2  # Pixels by which a panorama may differ from 2:1
_PROJECTION = re.compile(rb"GPano:ProjectionType\s*(?:=\s*[\"']|>)\s*(\w+)")


def are_panoramas(photos: Sequence[Path]) -> bool:
    """Return whether bare photos are equirectangular panoramas.

    They are if all are twice as wide as high, and some say so in their metadata (GPano), or their left and right ends
    fit together.
    """
    for photo in photos:
        width, height = photo_sizes(photo)[1]
        if abs(width - 2 * height) > _SKEW:
            return False
    judged = photos[:: max(1, len(photos) // _JUDGED)][:_JUDGED]
    projections = {kind for photo in judged if (kind := _projection_of(photo))}
    if projections:
        return projections == {"equirectangular"}
    return float(np.median([_seam(photo) for photo in judged])) < _SEAM


def _projection_of(photo: Path) -> str | None:
    """Return the projection that a photo's XMP states, in lower case."""
    if kind_of(photo) != "encoded":
        return None
    with open_image(photo) as image:
        xmp = image.info.get("xmp", b"")
    match = _PROJECTION.search(xmp if isinstance(xmp, bytes) else str(xmp).encode())
    return match[1].decode().lower() if match else None


def _seam(photo: Path) -> float:
    """Return how much the outer columns of a photo differ, relative to neighboring columns within it."""
    image = encoded_values(read_photo(photo, oriented=True).pixels)
    inside = np.abs(np.diff(image[:, :: max(1, image.shape[1] // 64)], axis=1)).mean()
    next_to = np.abs(np.diff(image, axis=1)).mean()
    ends = np.abs(image[:, 0] - image[:, -1]).mean()
    # In a picture that is flat everywhere the ends fit, too.
    return float(ends / max(next_to, 1e-3)) if inside > 1e-3 else 0.0


def reconstruct_panoramas(photos: Sequence[Path], cache: Path | str | None = None) -> Reconstruction:
    """Find poses and points of equirectangular panoramas; arguments, result and errors as of reconstruct()."""
    digests = [(photo.name, file_digest(photo)) for photo in photos]
    key = cache_key("panoramas", _FACE_SIDE, FACE_ANGLE, SEED, digests)

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
        pixels = read_photo(photo, oriented=True).pixels
        pixels = pixels if pixels.dtype == np.uint8 else (pixels >> 8).astype(np.uint8)
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
