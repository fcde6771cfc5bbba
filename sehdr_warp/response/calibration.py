"""A camera's response from an exposure stack: photos of one still scene at known times (Debevec and Malik 1997)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from .table import TabulatedResponse

# 8-bit codes outside of this range are clipped or nearly so, and are not used.
DARKEST, BRIGHTEST = 3, 252
CHANNELS = ("red", "green", "blue")
_SMOOTHNESS = 0.02  # Weight of the squared second derivative of the curve against the mean weight of a code
# Residuals in stops from which a sample counts less (movement, noise), rounds of reweighting, and the median residual
# from which photos cannot be of one still scene: a curve is right if most samples agree, whatever the others do.
_OUTLIER, _ROUNDS, _MISALIGNED = 0.1, 4, 0.2
# Codes up to which a photo can be at its black, stops between photos in which black does not change, codes that noise
# changes it by, and the share of these codes that must not change for the photos to have a black of their own.
_DARK, _BLACK_STOPS, _BLACK_NOISE, _BLACK_SHARE = 64, 2.0, 2, 0.2
# Shares of usable samples in a photo below which nothing tells whether its time and its scene are right.
_LEAST_SHARE, _LEAST_SHARE_OF_SCENE = 0.002, 0.1
# Least rise of log2 exposure from code to code, where the samples alone would let the curve fall.
_LEAST_RISE = 1e-4
_MOST_PIXELS, _SHOWN = 30_000, 3000
_CODES = np.arange(256)
_REMEDY = "photograph one still scene from a tripod at several times, one to three stops apart"


@dataclass(frozen=True)
class Calibration:
    """A measured response and how well it fits.

    Attributes:
        response: the curve; exposure 1 is white.
        residual: weighted RMS residual in stops.
        channel_spread: RMS difference of each channel's own curve from the shared one, stops; NaN if a channel does not
            determine a curve alone.
        photo_offsets: stops by which each photo is brighter than its time states; NaN if nearly all of it is black or
            white.
        photo_spreads: median difference of a photo's samples from that offset, stops; NaN if most of it is black or
            white.
        samples: [S, 2] exposures and encoded values of some samples, for a plot.
    """

    response: TabulatedResponse
    residual: float
    channel_spread: tuple[float, ...]
    photo_offsets: tuple[float, ...]
    photo_spreads: tuple[float, ...]
    samples: np.ndarray


def calibrate_codes(
    photos: Sequence[np.ndarray], times: Sequence[float], *, channel: str | None = None, name: str = "calibrated"
) -> Calibration:
    """Measure the response of the camera that took a stack.

    Least squares over pixels i and photos j of w (g(z_ij) - log2 E_i - log2 t_j)^2, w a hat over the codes that are not
    clipped, with a penalty on the curvature of g, which only rises. Outliers count less from round to round.

    Args:
        photos: [H, W, 3] uint8 or uint16 codes, all of one size.
        times: seconds, or any numbers in proportion to the light.
        channel: "red", "green" or "blue" alone; None finds one curve for all three.
        name: of the response, and of the stack in errors.

    Raises:
        InputError: if the stack does not determine a curve, with the reason.
    """
    if channel not in (None, *CHANNELS):
        raise InputError(name, f"channel {channel!r} is not one of {', '.join(CHANNELS)}", "name one, or none for all")
    stops = np.log2(np.asarray(times, np.float64))
    if len(photos) < 2 or len(photos) != len(stops):
        raise InputError(name, f"{len(photos)} photo(s) with {len(stops)} time(s) are not an exposure stack", _REMEDY)
    if not np.isfinite(stops).all() or np.ptp(stops) < 0.1:
        raise InputError(name, "every photo has the same exposure time", _REMEDY)
    if len({photo.shape for photo in photos}) > 1:
        raise InputError(name, "its photos differ in size", "give photos of one size from a tripod")
    codes = [photo if photo.dtype == np.uint8 else np.rint(photo / 257.0).astype(np.uint8) for photo in photos]
    codes = np.stack(codes).reshape(len(photos), -1, 3)
    rng = np.random.default_rng(0)
    codes = codes[:, rng.permutation(codes.shape[1])[:_MOST_PIXELS]]
    order = np.argsort(stops, kind="stable")
    darker = np.diff(codes.mean(axis=(1, 2))[order]) < -2
    if darker[np.diff(stops[order]) > 0.1].any():
        raise InputError(name, "a photo of longer exposure is darker than one of shorter", "correct the exposure times")
    selection = slice(None) if channel is None else [CHANNELS.index(channel)]
    blacks = [_black(codes[..., index], stops) for index in range(3)]
    whites = [255 - _black(255 - codes[..., index], -stops) for index in range(3)]  # The black of negatives
    usable = (codes > np.array(blacks)) & (codes < np.array(whites))
    photo_codes = codes[..., selection].reshape(len(photos), -1)
    curve, residuals, weights, light = _solve(
        photo_codes, stops, usable[..., selection].reshape(photo_codes.shape), name
    )
    typical = float(np.median(np.abs(residuals[weights > 0])))
    if typical > _MISALIGNED:
        problem = f"half of its pixels contradict each other by {typical:.2f} stops or more: something moved"
        raise InputError(name, problem, _REMEDY)
    pairs = rng.permutation(np.argwhere(weights > 0))[:_SHOWN].T
    samples = np.stack(
        [2.0 ** (light[pairs[1]] + stops[pairs[0]] - curve[255]), photo_codes[tuple(pairs)] / 255], axis=1
    )
    exposures = 2.0 ** (curve - curve[255])
    exposures[0] = 0.0
    offsets = (weights * residuals).sum(1) / np.maximum(weights.sum(1), 1e-9)
    shares = (weights > 0).mean(1)
    offsets[shares < _LEAST_SHARE] = np.nan
    spreads = [
        float(np.median(np.abs(row[used] - np.median(row[used])))) if share >= _LEAST_SHARE_OF_SCENE else float("nan")
        for row, used, share in zip(residuals, weights > 0, shares, strict=True)
    ]
    return Calibration(
        TabulatedResponse(name, exposures, _CODES / 255),
        float(np.sqrt((weights * residuals**2).sum() / weights.sum())),
        tuple(_spread(codes[..., index], stops, usable[..., index], curve) for index in range(3)),
        tuple(offsets),
        tuple(spreads),
        samples,
    )


def _black(codes: np.ndarray, stops: np.ndarray) -> int:
    """Return the largest dark code of [J, S] that more light does not change, as of scanned film; 0 without one."""
    darkest = int(np.argmin(stops))
    brighter = np.flatnonzero(stops >= stops[darkest] + _BLACK_STOPS)
    if not len(brighter):
        return 0
    before, after = (codes[index].astype(int) for index in (darkest, brighter[np.argmin(stops[brighter])]))
    unchanged = np.abs(after - before) <= _BLACK_NOISE
    dark = before <= _DARK
    if unchanged[dark].sum() < _BLACK_SHARE * dark.sum() or not dark.any():
        return 0
    return int(np.quantile(before[dark & unchanged], 0.99)) + _BLACK_NOISE


def _spread(codes: np.ndarray, stops: np.ndarray, usable: np.ndarray, shared: np.ndarray) -> float:
    """Return the RMS difference in stops of one channel's curve from the shared one, over its codes from 10 to 245."""
    try:
        own, _, weights, _ = _solve(codes, stops, usable, "")
    except InputError:
        return float("nan")
    present = np.bincount(codes.ravel(), weights.ravel(), 256) > 0
    return float(np.std((own - shared)[10:246][present[10:246]]))


def _solve(codes: np.ndarray, stops: np.ndarray, usable: np.ndarray, name: str):
    """Solve for the log2 exposure of each code by the usable samples [J, S]; radiance is eliminated: 256 unknowns.

    Returns:
        log2 exposures [256], residuals in stops and weights [J, S] of the samples, and log2 radiance [S].
    """
    from scipy.linalg import solve

    hat = np.sqrt(np.minimum(_CODES - DARKEST + 1, BRIGHTEST - _CODES + 1).clip(min=0) / (0.5 * (BRIGHTEST - DARKEST)))
    start = hat[codes] * usable
    start *= (start > 0).sum(0) >= 2
    if (start > 0).any(0).sum() < 256:
        problem = "fewer than 256 pixels are well exposed in two photos"
        raise InputError(name, problem, "give photos of closer exposure times")
    # Second derivatives of the curve over nearly the logit of the code, on which cameras' curves are almost straight;
    # each with the root of its step, so that squares sum to an integral.
    axis = np.log((_CODES + 1.0) / (280.0 - _CODES))
    bends = np.diff(np.diff(np.eye(256), axis=0) / np.diff(axis)[:, None], axis=0)
    bends /= np.sqrt(0.5 * (axis[2:] - axis[:-2]))[:, None]
    weights, places = start, codes.astype(np.int64)
    for _ in range(_ROUNDS):
        total = np.maximum(weights.sum(0), 1e-12)
        offset = stops[:, None] - (weights * stops[:, None]).sum(0) / total
        matrix = np.diag(np.bincount(places.ravel(), weights.ravel(), 256))
        right = np.bincount(places.ravel(), (weights * offset).ravel(), 256)
        for place, weight in zip(places, weights, strict=True):
            pairs = np.bincount((place * 256 + places).ravel(), (weight * weights / total).ravel(), 65536)
            matrix -= pairs.reshape(256, 256)
        scale = np.trace(matrix) / 256
        matrix += scale * (_SMOOTHNESS * bends.T @ bends + 1e-9 * np.eye(256))
        matrix[128, 128] += scale  # The curve is known up to a constant: this one is 0 at the middle code.
        curve = solve(matrix, right, assume_a="pos")
        if np.diff(curve).min() < _LEAST_RISE:
            curve = _rising(matrix, right)
        light = (weights * (curve[codes] - stops[:, None])).sum(0) / total
        residuals = curve[codes] - light - stops[:, None]
        weights = start / (1 + (residuals / _OUTLIER) ** 2)
    return curve, residuals, weights, light


def _rising(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the solution of the normal equations whose steps are all at least _LEAST_RISE."""
    from scipy.linalg import cholesky, solve_triangular
    from scipy.optimize import lsq_linear

    root = cholesky(matrix)
    steps = np.tril(np.ones((256, 256)))
    lowest = np.r_[-np.inf, np.full(255, _LEAST_RISE)]
    return steps @ lsq_linear(root @ steps, solve_triangular(root, right, trans=1), (lowest, np.inf), tol=1e-6).x
