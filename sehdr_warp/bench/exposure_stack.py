"""A camera's response from an exposure stack: photos of one still scene at known times (Debevec and Malik 1997)."""

import json
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..scene.images import read_ldr

DARKEST, BRIGHTEST = 3, 252
"""Codes outside are clipped, or nearly, and tell nothing."""
SMOOTHNESS = 30.0
"""Of the second difference of the curve, against the mean weight of a code."""
MOST_PIXELS = 60_000


def read_stack(folder: Path) -> tuple[list[Path], list[np.ndarray], np.ndarray]:
    """Files, images [H, W, 3] in [0, 1] and exposure times [J] in seconds of a folder with `exposures.json`.

    exposures.json: a list of {"file": name, "exposure_time": seconds}. Raises InputError for a file that is not one,
    for photos of different sizes, and for fewer than two different times.
    """
    listed = folder / "exposures.json"
    try:
        entries = json.loads(listed.read_text(encoding="utf-8"))
        files = [folder / Path(entry["file"]).name for entry in entries]
        times = np.array([float(entry["exposure_time"]) for entry in entries])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            listed, f"is no list of exposures ({error!r:.80})", 'write [{"file": ..., "exposure_time": seconds}, ...]'
        ) from None
    if not (np.isfinite(times).all() and (times > 0).all()) or len(set(times)) < 2:
        raise InputError(listed, "has fewer than two different positive times", "give each photo's time in seconds")
    photos = [read_ldr(file) for file in files]
    images = [photo.pixels / np.float64(photo.levels) for photo in photos]
    if len({image.shape for image in images}) > 1:
        raise InputError(folder, "has photos of different sizes", "give photos of one size from a tripod")
    return files, images, times


def stack_curve(images: list[np.ndarray], times: np.ndarray) -> np.ndarray:
    """[256] log2 of the exposure that each 8-bit code stands for, 0 at code 128, all channels alike.

    Least squares over pixels i and photos j of w (g(z_ij) - log2 E_i - log2 t_j)^2, w a hat over the codes, with a
    penalty on g's second difference. Each E_i is eliminated, so that 256 unknowns are left whatever the pixel count.
    Raises InputError where no pixel is usable in two photos.
    """
    values = np.stack([np.round(image.reshape(-1) * 255).astype(np.int64) for image in images])
    codes = values[:, :: max(1, values.shape[1] // MOST_PIXELS)]
    weights = np.minimum(codes - DARKEST + 1, BRIGHTEST - codes + 1).clip(min=0) / (0.5 * (BRIGHTEST - DARKEST))
    usable = (weights > 0).sum(0) >= 2
    if usable.sum() < 256:
        raise InputError(
            "exposure stack", "no pixel is well exposed in two photos", "give photos of closer exposure times"
        )
    codes, weights = codes[:, usable], weights[:, usable]
    total, stops = weights.sum(0), np.log2(times)
    mean_stops = (weights * stops[:, None]).sum(0) / total
    matrix, right = np.zeros((256, 256)), np.zeros(256)
    for j, (code, weight) in enumerate(zip(codes, weights, strict=True)):
        matrix[np.diag_indices(256)] += np.bincount(code, weight, 256)
        right += np.bincount(code, weight * (stops[j] - mean_stops), 256)
        for other, other_weight in zip(codes, weights, strict=True):
            matrix -= np.bincount(code * 256 + other, weight * other_weight / total, 65536).reshape(256, 256)
    scale = np.trace(matrix) / 256
    bends = np.diff(np.eye(256), 2, axis=0)
    matrix += SMOOTHNESS * scale * bends.T @ bends
    matrix[128, 128] += scale
    curve = np.linalg.solve(matrix, right)
    return curve - curve[128]
