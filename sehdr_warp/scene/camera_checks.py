"""Checks of a set's cameras against each other, its points and its photos: what other tools often state wrongly."""

from collections.abc import Callable, Sequence

import numpy as np

from ..subsets import first_names
from .dataparser import ImageRecord, PointCloud
from .lens import Lens

_FAR = 20.0  # Times the usual distance between cameras: to 19 a training loses nothing, at 77 it loses 12 dB
_USUAL = 75  # Percentile of the cameras' distances from their middle
_NEAR_POINTS = 0.1  # Part of the points' distance that counts as usual, where cameras stand at one place
_OFF_CENTER = 0.25  # Part of a photo's size by which its principal point may lie beside the middle
_ONE_PLACE = 1e-9  # Part of their coordinates by which cameras at one place may differ
_MOST_POINTS, _MOST_CAMERAS = 2000, 64  # That are looked at
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # Between the axes of OpenGL (y up, z back) and OpenCV (y down, z ahead)


def check_cameras(records: Sequence[ImageRecord], cloud: PointCloud) -> tuple[list[ImageRecord], list[str]]:
    """Return photos without those whose cameras are far from all others, and notes on cameras that seem to be wrong.

    One camera at a false place, as structure from motion leaves it at times, would make the scene a dot in its own
    unit, and training would fail.
    """
    near, notes = _without_far_cameras(records, cloud)
    return near, [*notes, *_at_one_place(near), *_off_center(near), *_wrong_way(near, cloud)]


def _at_one_place(records: Sequence[ImageRecord]) -> list[str]:
    """Return a note if all cameras have one position: their photos show no depth, or an export lost the positions."""
    positions = np.stack([_position(record) for record in records])
    if len(records) < 2 or np.ptp(positions, axis=0).max() > _ONE_PLACE * max(1.0, float(np.abs(positions).max())):
        return []
    place = ", ".join(f"{value:.4g}" for value in positions[0])
    remedy = "check that the poses have positions, and are not inverted"
    return [f"all {len(records)} cameras are at one place ({place}), and show no depth: {remedy}"]


def _without_far_cameras(records: Sequence[ImageRecord], cloud: PointCloud) -> tuple[list[ImageRecord], list[str]]:
    """Return the photos without those from _FAR times the usual distance, and a note on these."""
    positions = np.stack([_position(record) for record in records])
    middle = np.median(positions, axis=0)
    distances = np.linalg.norm(positions - middle, axis=1)
    usual = float(np.percentile(distances, _USUAL))
    if len(cloud.positions):
        usual = max(usual, _NEAR_POINTS * float(np.median(np.linalg.norm(cloud.positions - middle, axis=1))))
    far = distances > _FAR * usual
    if not usual > 0 or not far.any():
        return list(records), []
    names = first_names([record.image.name for record, is_far in zip(records, far, strict=True) if is_far])
    count, least = int(far.sum()), float(distances[far].min()) / usual
    who, photos = ("1 camera is", "its photo was") if count == 1 else (f"{count} cameras are", "their photos were")
    note = f"{who} {least:.0f} times as far away as the others, so {photos} left out: {names}"
    return [record for record, is_far in zip(records, far, strict=True) if not is_far], [note]


def _off_center(records: Sequence[ImageRecord]) -> list[str]:
    """Return a note on principal points that are far from the middle of their photos."""
    lenses = [record.lens for record in records]
    off = [
        lens
        for lens in lenses
        if max(abs(lens.centre[0] / lens.width - 0.5), abs(lens.centre[1] / lens.height - 0.5)) > _OFF_CENTER
    ]
    if not off:
        return []
    x, y = off[0].centre
    where = f"({x:g}, {y:g}) in {off[0].width} x {off[0].height} pixels"
    count = f"{len(off)} of {len(lenses)} photos"
    return [f"the principal point of {count} is far from the middle, {where}: it may be that of another size"]


def _wrong_way(records: Sequence[ImageRecord], cloud: PointCloud) -> list[str]:
    """Return a note if photos show few of the set's points, and many if poses are read by another convention."""
    judged = [record for record in records if record.lens.projection == "pinhole"]
    judged = judged[:: max(1, len(judged) // _MOST_CAMERAS)]
    if not len(cloud.positions) or not judged:
        return []
    points = cloud.positions[:: max(1, len(cloud.positions) // _MOST_POINTS)]

    def mean_share(read: Callable[[np.ndarray], np.ndarray]) -> float:
        return float(np.mean([_share_in_frame(each.lens, read(each.world_to_camera), points) for each in judged]))

    own_share = mean_share(lambda pose: pose)
    others = {
        "inverted (camera-to-world and world-to-camera exchanged)": mean_share(np.linalg.inv),
        "in other axes (OpenCV's and OpenGL's exchanged)": mean_share(lambda pose: _FLIP @ pose),
    }
    reading, share = max(others.items(), key=lambda item: item[1])
    if share < 3 * own_share + 0.1:
        return []
    problem = f"the photos show {100 * own_share:.0f} % of the set's points, and {100 * share:.0f} % if poses are read"
    return [f"poses: {problem} {reading}: export them again if training fails"]


def _share_in_frame(lens: Lens, pose: np.ndarray, points: np.ndarray) -> float:
    """Return the part of points [P, 3] that lies in the frame of a lens without its distortion."""
    x, y, z = pose[:3, :3] @ points.T + pose[:3, 3:]
    z = np.where(z > 0, z, np.nan)
    columns, rows = lens.focal[0] * x / z + lens.centre[0], lens.focal[1] * y / z + lens.centre[1]
    return float(np.mean((columns >= 0) & (columns < lens.width) & (rows >= 0) & (rows < lens.height)))


def _position(record: ImageRecord) -> np.ndarray:
    pose = record.world_to_camera
    return -pose[:3, :3].T @ pose[:3, 3]
