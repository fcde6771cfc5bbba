"""Check of stated cameras against the photos: pixels that two photos share must fit their poses and lenses.

Scripts and exports mix up axes, camera-to-world and world-to-camera, positions and translations, sizes of photos, and
photos with and without distortion. Nothing in their files tells these apart, and a training on wrong cameras fails
without an error.
"""

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from ..errors import InputError
from .cached_folder import cached_folder, file_digest
from .dataparser import ImageRecord
from .lens import Lens
from .shared_pixels import SharedPixels, candidate_pairs, shared_pixels

POSED = ("transforms", "colmap", "llff", "opensfm", "meshroom", "arkit")  # Layouts whose cameras are checked
MISFIT = "fits the photos by no convention"
_VERSION = 2  # Raised with every change of results
_AXES = {  # From a camera's axes to OpenCV's: x right, y down, z ahead
    "OpenCV's": np.eye(3),
    "OpenGL's": np.diag([1.0, -1.0, -1.0]),
    "LLFF's": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
    "upside-down": np.diag([-1.0, -1.0, 1.0]),
}
# In which axes camera-to-world is stated; other layouts state world-to-camera.
_FILE_AXES = {"transforms": "OpenGL's", "arkit": "OpenGL's", "llff": "LLFF's"}
_SURE_PAIRS, _FEWEST_PAIRS, _MOST_PAIRS = 3, 4, 8  # That show cameras to be right, and wrong; that are compared
_FITS, _MISSES = 1.2, 4.0  # Pixels of a photo of shared_pixels.SIDE: sound cameras have 0.1 to 0.6, other axes 3 to 100
_EXACT = 0.6  # Pixels from which on the lens is doubted: a focal length that is 10 % off has 0.4 to 2.5
_LEAST_SHARE = 0.75  # Of the pairs, which another reading must fit
_LEAST_GAIN = 2.0  # By which another lens must fit better
_FOCAL_LENGTHS = np.geomspace(0.3, 3.3, 61)  # In parts of the stated one
_LEAST_CHANGE = 0.05  # Of the focal length
_CLEARLY = 1.25  # By which one reading of the lens must fit better than a simpler one
_ALIKE = 1.2  # Ratio of focal lengths, in parts of the photos' sides, of cameras that one mistake may concern
_OFF_CENTER = 0.1  # Part of a photo's size by which a principal point of another size lies beside the middle


@dataclass(frozen=True)
class _Verdict:
    """Reading of the poses and of the lenses of a set, and a note on it."""

    reading: str | None = None
    focal: float = 1.0  # Times the stated focal length
    whole: bool = False  # The principal point, too
    distorted: bool = True
    note: str | None = None

    @property
    def as_stated(self) -> bool:
        """True if the lens is read as the file states it."""
        return self.focal == 1 and self.distorted


def with_fitting_cameras(
    records: Sequence[ImageRecord], layout: str, cache: Path | str | None = None
) -> tuple[list[ImageRecord], list[str]]:
    """Return photos with poses and lenses by the reading that fits pairs of photos, and a note if it is not the usual.

    Few photos are read: three pairs that fit end the check. The result is cached, as cached_folder() does.
    """
    pairs = candidate_pairs(records)
    used = [records[i] for i in sorted({i for pair in pairs for i in pair})]
    if any(record.derived or not record.image.is_file() for record in used):
        return list(records), []
    facts = [
        (
            [file_digest(file) for file in (record.image, record.mask) if file is not None],
            (record.lens.model, record.lens.width, record.lens.height, record.lens.params, record.lens.source.name),
            record.world_to_camera.tolist(),
        )
        for record in used
    ]
    key = hashlib.sha256(json.dumps([_VERSION, layout, pairs, facts]).encode()).hexdigest()[:16]

    def fill(result: Path) -> None:
        (result / "verdict.json").write_text(json.dumps(asdict(_verdict(records, layout, pairs))))

    try:
        place = cached_folder(cache, f"poses-{key}", "comparison of the poses with the photos", fill)
    except ImportError:
        return list(records), ["poses: not compared with the photos, because pycolmap is not installed"]
    verdict = _Verdict(**json.loads((place / "verdict.json").read_text()))
    return [_read(record, layout, verdict) for record in records], [verdict.note] if verdict.note else []


def _read(record: ImageRecord, layout: str, verdict: _Verdict) -> ImageRecord:
    """Return a photo with the pose and the lens of a verdict."""
    pose, lens = record.world_to_camera, record.lens
    if verdict.reading is not None:
        pose = dict(_readings(layout))[verdict.reading](pose)
    return replace(record, world_to_camera=pose, lens=_lens(lens, verdict))


def _lens(lens: Lens, verdict: _Verdict) -> Lens:
    """Return a lens as a verdict reads it."""
    if verdict.as_stated or lens.projection != "pinhole":
        return lens
    params, count = list(lens.params), lens.focal_count
    changed = count + 2 * verdict.whole
    params[:changed] = [verdict.focal * value for value in params[:changed]]
    if not verdict.distorted:
        params[count + 2 :] = [0.0] * len(params[count + 2 :])
    return replace(lens, params=tuple(params))


def _readings(layout: str) -> Iterator[tuple[str, Callable[[np.ndarray], np.ndarray]]]:
    """Yield readings of what a file states, by name: from the pose that was read to the pose that is meant."""
    file_axes = _FILE_AXES.get(layout)

    def in_file(pose: np.ndarray) -> np.ndarray:
        if file_axes is None:
            return pose
        return np.linalg.inv(pose) @ _pose(_AXES[file_axes], np.zeros(3))

    for name, axes in _AXES.items():
        kinds = {
            f"as camera-to-world in {name} axes": lambda file, axes=axes: _pose(
                axes @ file[:3, :3].T, -axes @ file[:3, :3].T @ file[:3, 3]
            ),
            f"as world-to-camera in {name} axes": lambda file, axes=axes: _pose(
                axes @ file[:3, :3], axes @ file[:3, 3]
            ),
            f"as rotations world-to-camera with the cameras' positions, in {name} axes": lambda file, axes=axes: _pose(
                axes @ file[:3, :3], -axes @ file[:3, :3] @ file[:3, 3]
            ),
            f"as rotations camera-to-world with translations world-to-camera, in {name} axes": (
                lambda file, axes=axes: _pose(axes @ file[:3, :3].T, axes @ file[:3, 3])
            ),
        }
        for kind, read in kinds.items():
            yield kind, lambda pose, read=read: read(in_file(pose))
    if layout == "colmap":
        yield "with quaternions in the order x, y, z, w", _with_quaternion_last


def _pose(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation
    return pose


def _with_quaternion_last(pose: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return _pose(Rotation.from_quat([w, x, y, z]).as_matrix(), pose[:3, 3])


def _verdict(records: Sequence[ImageRecord], layout: str, pairs: Sequence[tuple[int, int]]) -> _Verdict:
    shared: list[SharedPixels] = []
    distances: list[float] = []
    for each in shared_pixels(records, pairs):
        shared.append(each)
        distances += _distances(records, [each])
        fitting = sorted(distances)[:_SURE_PAIRS]
        if len(fitting) == _SURE_PAIRS and fitting[-1] < _FITS and np.median(distances) < _EXACT:
            return _Verdict()
        if len(shared) == _MOST_PAIRS:
            break
    miss = float(np.median(distances)) if distances else 0.0
    if len(distances) < _FEWEST_PAIRS or miss < _EXACT:
        return _Verdict()
    file = records[0].lens.source.name.replace("cameras.", "images.")  # Of COLMAP, which states poses there
    far = f"pixels that two photos share lie {miss:.1f} pixels beside where {file} puts them"
    if miss == np.inf:
        far = f"{file} puts points that two photos share behind the cameras"
    lens, residuals = _best_lens(records, shared)
    if not lens.as_stated and np.median(residuals) * _LEAST_GAIN < miss and _fit(residuals):
        first = records[0].lens
        other = f"a focal length of {lens.focal * first.focal[0]:.0f} in place of {first.focal[0]:.0f} pixels"
        what = " and ".join([other] * (lens.focal != 1) + ["no distortion"] * (not lens.distorted))
        fit = f"which fits the photos ({np.median(residuals):.1f} pixels)"
        return replace(lens, note=f"lens: {far}; it is read with {what}, {fit}")
    if miss < _MISSES:
        return _Verdict()
    readings = {name: _distances(records, shared, read) for name, read in _readings(layout)}
    reading = min(readings, key=lambda name: float(np.median(readings[name])))
    if _fit(readings[reading]):
        fit = f"which fits the photos ({np.median(readings[reading]):.1f} pixels)"
        return _Verdict(reading, note=f"poses: {far}; they are read {reading} instead, {fit}")
    remedy = "to find the cameras anew, give a folder with the photos alone"
    return _Verdict(note=f"poses: {file} {MISFIT}: {far}; {remedy}")


def _fit(distances: Sequence[float]) -> bool:
    return float(np.mean(np.array(distances) < _FITS)) >= _LEAST_SHARE


def _best_lens(records: Sequence[ImageRecord], shared: Sequence[SharedPixels]) -> tuple[_Verdict, list[float]]:
    """Return the reading of the lens that fits best, and its distances.

    A simpler reading wins unless another one fits clearly better. Unlike lenses are read as stated: some may be right.
    """
    lens, best = records[0].lens, (_Verdict(), _distances(records, shared))
    views = [max(record.lens.focal) / max(record.lens.width, record.lens.height) for record in records]
    if max(views) > _ALIKE * min(views):
        return best
    off_center = max(abs(lens.centre[0] / lens.width - 0.5), abs(lens.centre[1] / lens.height - 0.5)) > _OFF_CENTER

    def distances_at(focal: float, kind: _Verdict) -> list[float]:
        try:
            return _distances(records, shared, verdict=replace(kind, focal=float(focal)))
        except InputError:  # No lens is so short or so long.
            return [math.inf] * len(shared)

    for whole in (False, True)[: 1 + off_center]:
        for distorted in (True, False)[: 2 - lens.is_pinhole]:
            kind = _Verdict(whole=whole, distorted=distorted)
            for focal in (1.0, _best_focal(lambda focal, kind=kind: _typical(distances_at(focal, kind)))):
                distances = distances_at(focal, kind)
                unchanged = 0 < abs(focal - 1) < _LEAST_CHANGE
                if not unchanged and _CLEARLY * _typical(distances) < _typical(best[1]):
                    best = replace(kind, focal=focal), distances
    return best


def _best_focal(distance: Callable[[float], float]) -> float:
    """Return the focal length, in parts of the stated one, at which a distance is least."""
    from scipy.optimize import minimize_scalar

    nearest = int(np.argmin([distance(float(focal)) for focal in _FOCAL_LENGTHS]))
    low, high = _FOCAL_LENGTHS[[max(nearest - 1, 0), min(nearest + 1, len(_FOCAL_LENGTHS) - 1)]]
    minimum = minimize_scalar(distance, bounds=(low, high), method="bounded", options={"xatol": 1e-3 * low})
    return float(minimum.x)  # pyright: ignore[reportAttributeAccessIssue]


def _typical(distances: Sequence[float]) -> float:
    """Return the mean of the distances that another reading must explain."""
    return float(np.mean(sorted(distances)[: math.ceil(_LEAST_SHARE * len(distances))]))


def _distances(
    records: Sequence[ImageRecord],
    shared: Sequence[SharedPixels],
    read: Callable[[np.ndarray], np.ndarray] = lambda pose: pose,
    verdict: _Verdict = _Verdict(),
) -> list[float]:
    """Return the distances of shared pixels from the epipolar lines, of a reading of poses and lenses."""
    return [
        each.distance(
            [_lens(lens, verdict) for lens in each.lenses], *(read(records[i].world_to_camera) for i in each.indices)
        )
        for each in shared
    ]
