"""Responses without a formula: a monotone curve through measured samples."""

import math

import numpy as np
import torch

from ..errors import InputError
from .curve import HALF_CODE, Response

# Samples this dense and evenly spaced are joined by straight lines, exactly as stored (DoRF and EMoR have 1024).
DENSE_SAMPLES = 256
# Other curves are read off a grid even in log exposure, whose lowest piece ends so many octaves below the first sample.
CELLS_PER_OCTAVE, TOE_OCTAVES, MAX_OCTAVES = 512, 6, 40
# A flat part is tilted by this much over its length (1/64 of an 8-bit code), so that the curve has an inverse there.
FLAT_TILT = 2.0**-14
LEAST_STEP = 1e-9  # A rise from sample to sample below this does not count: a 16-bit code is 1.5e-5


class TabulatedResponse(Response, kind="table"):
    """A response through 3 or more samples (exposure, value), increasing, exact inverse included.

    exposures: [K] >= 0, in the file's own unit, to which radiance is relative; values: [K] in [0, 1].
    Repaired, with one of `notes` each: samples out of order are sorted, equal exposures averaged, a decrease replaced
    by the nearest monotone curve (least squares). Always done: a curve that starts above exposure 0 is continued to
    (0, 0) by a line; a flat part within it is tilted about its center, so that its value decodes to the middle of
    the part (at black: rises from it); a flat part at the top is the clipped range.

    Raises InputError(source, ...) for fewer than 3 samples, NaN or infinity, a negative exposure, a value outside
    [0, 1], or a curve that does not rise.
    """

    def __init__(self, name: str, exposures, values, *, notes: tuple[str, ...] = (), source: str | None = None):
        """Repair the samples, and prepare the table."""
        self.name = name
        samples = np.asarray(exposures, np.float64), np.asarray(values, np.float64)
        knots, levels, repairs = _monotone(*samples, source or name)
        self.notes = (*notes, *repairs)
        self._knots, self._levels = knots, levels
        self.black, self.peak, self.clip_exposure = float(levels[0]), float(levels[-1]), float(knots[-1])
        steps = np.diff(knots)
        self._even = len(knots) >= DENSE_SAMPLES and np.allclose(steps, steps[0], rtol=1e-4)
        self._nodes, self._node_values = (knots, levels) if self._even else self._log_grid()
        self._tensors: dict = {}

    def _log_grid(self):
        """Return nodes, 0 and then even in log exposure, and their values by monotone cubic interpolation."""
        from scipy.interpolate import PchipInterpolator

        top = self._knots[-1]
        octaves = min(MAX_OCTAVES, math.ceil(math.log2(top / self._knots[1])) + TOE_OCTAVES)
        nodes = np.concatenate([[0.0], top * np.exp2(np.arange(-octaves * CELLS_PER_OCTAVE, 1) / CELLS_PER_OCTAVE)])
        with np.errstate(over="ignore"):  # Harmonic means of slopes next to a nearly flat piece; the limit is right.
            values = PchipInterpolator(self._knots, self._levels)(nodes).clip(self.black, self.peak)
        return nodes, np.maximum.accumulate(values)

    def _table(self, like: torch.Tensor):
        """Return each cell's intercept and slope in the type of `like`, on its device, and float64 nodes to invert."""
        key = (like.device, like.dtype)
        if key not in self._tensors:
            slope = np.diff(self._node_values) / np.diff(self._nodes)
            intercept = self._node_values[:-1] - slope * self._nodes[:-1]
            cells = [torch.as_tensor(part).to(like) for part in (intercept, slope)]
            nodes = [torch.as_tensor(part).to(like.device) for part in (self._nodes, self._node_values)]
            self._tensors[key] = (*cells, *nodes)
        return self._tensors[key]

    def _encode(self, exposure, extension_slope):
        intercept, slope, _, _ = self._table(exposure)
        last, clip = len(slope) - 1, self.clip_exposure
        inside = exposure.clamp(0.0, clip)
        if self._even:
            position = inside * (len(slope) / clip)
        else:
            # Cell 0 is the toe; a position rounded across a node evaluates the neighbor's line, equal there.
            position = (inside / clip).log2() * CELLS_PER_OCTAVE + (last + 1)
        cell = position.nan_to_num(0.0).clamp(0, last).long()
        slope = slope[cell]
        # Rounding may leave [black, peak] by a last digit.
        value = torch.addcmul(intercept[cell], slope, inside).clamp_(self.black, self.peak)
        if extension_slope:
            value = value + extension_slope * (exposure.clamp_min(clip) / clip).log()
        slope = torch.where(exposure > clip, extension_slope / exposure, slope)
        return value, torch.where(exposure < 0, 0.0, slope)

    def _invert(self, value):
        _, _, nodes, levels = self._table(value)
        encoded = value.double()
        cell = (torch.searchsorted(levels, encoded.contiguous()) - 1).clamp(0, len(levels) - 2)
        rise = levels[cell + 1] - levels[cell]
        part = ((encoded - levels[cell]) / rise.clamp_min(1e-300)).clamp(0.0, 1.0)
        return torch.lerp(nodes[cell], nodes[cell + 1], part).to(value.dtype)

    def to_dict(self):
        """Return plain values for JSON."""
        columns = {"exposures": self._knots.tolist(), "values": self._levels.tolist()}
        return {"kind": "table", "name": self.name, **columns, "notes": list(self.notes)}

    @classmethod
    def _from_dict(cls, values):
        return cls(values["name"], values["exposures"], values["values"], notes=tuple(values["notes"]))


class ChannelResponse(TabulatedResponse, kind="channels"):
    """A response whose channels differ, through the samples of one curve for each.

    Photos are brought to the curve of green when they are read (to_shared), so that one curve describes them from there
    on; as a curve this is green's.

    Attributes:
        curves: the responses of red, green and blue.
    """

    def __init__(self, name: str, exposures, values, *, notes: tuple[str, ...] = (), source: str | None = None):
        """Prepare the curves of red, green and blue: arguments and errors as of TabulatedResponse, [3, K] samples."""
        pairs = zip(exposures, values, ("red", "green", "blue"), strict=True)
        self.curves = tuple(TabulatedResponse(f"{name}:{c}", x, y, source=source) for x, y, c in pairs)
        repairs = tuple(note for curve in self.curves for note in curve.notes)
        super().__init__(name, exposures[1], values[1], source=source)
        self.notes = (*notes, *repairs)

    def to_shared(self, codes: np.ndarray) -> np.ndarray:
        """Return [H, W, 3] uint16 codes by green's curve of the light that codes stand for; white stays white."""
        white, shared = int(np.iinfo(codes.dtype).max), np.empty(codes.shape, np.uint16)
        for channel, curve in enumerate(self.curves):
            light = curve.decode(np.arange(white + 1, dtype=np.float64) / white)
            table = np.rint(65535 * np.clip(self.encode(light), 0, 1)).astype(np.uint16)
            table[white] = 65535
            shared[..., channel] = table[codes[..., channel]]
        return shared

    def to_dict(self):
        """Return plain values for JSON."""
        columns = [curve.to_dict() for curve in self.curves]
        curves = {key: [column[key] for column in columns] for key in ("exposures", "values")}
        return {"kind": "channels", "name": self.name, **curves, "notes": list(self.notes)}


def _monotone(exposures: np.ndarray, values: np.ndarray, source: str):
    """Return increasing samples from exposure 0 to the clip point, and notes on repairs."""
    _check(exposures, values, source)
    notes = []
    if (np.diff(exposures) <= 0).any():
        notes.append(f"{source}: exposures were not increasing; sorted, and values of equal exposures averaged")
        exposures, group = np.unique(exposures, return_inverse=True)
        values = np.bincount(group, values) / np.bincount(group)
    drop = np.diff(values).min(initial=0.0)
    if drop < 0:
        from scipy.optimize import isotonic_regression

        count = int((np.diff(values) < 0).sum())
        notes.append(f"{source}: {count} of {len(values)} values fall, by up to {-drop:.3g}; made monotone")
        values = np.maximum.accumulate(isotonic_regression(values).x)
    if exposures[0] > 0:
        exposures, values = np.concatenate([[0.0], exposures]), np.concatenate([[0.0], values])
    if values[-1] - values[0] < 2 * HALF_CODE:
        rise = f"the curve rises by only {values[-1] - values[0]:.3g}"
        raise InputError(source, rise, "give a curve from dark to bright")
    return *_tilt_flat_parts(exposures, values), notes


def _check(exposures: np.ndarray, values: np.ndarray, source: str):
    remedy = "give two columns of numbers, exposure and value in [0, 1]"
    if exposures.ndim != 1 or exposures.shape != values.shape or len(exposures) < 3:
        shapes = f"{exposures.shape} exposures and {values.shape} values"
        raise InputError(source, f"{shapes} are not 3 samples or more", remedy)
    for what, column in (("exposure", exposures), ("value", values)):
        for bad in np.flatnonzero(~np.isfinite(column)):
            raise InputError(source, f"{what} {bad + 1} is {column[bad]}", remedy)
    if exposures.min() < 0:
        raise InputError(source, f"exposure {exposures.min():.6g} is negative", remedy)
    for step in (exposures.max(), np.diff(np.unique(np.r_[0.0, exposures])).min(initial=1.0)):
        if not 1e-30 <= step <= 1e30:
            problem = f"exposures of {step:.3g} apart cannot be computed with"
            raise InputError(source, problem, "divide them by the largest")
    for worst in (values.max(), values.min()):
        if not 0 <= worst <= 1:
            problem = f"value {worst:.6g} is outside [0, 1]"
            raise InputError(source, problem, "divide codes by the largest, 255 or 65535")


def _tilt_flat_parts(exposures: np.ndarray, values: np.ndarray):
    """Return samples up to the clip point with strictly increasing values.

    A flat part (steps under LEAST_STEP) becomes a line of FLAT_TILT, less if neighbors are near.
    """
    edges = np.flatnonzero(np.diff(values) >= LEAST_STEP) + 1
    starts, ends = np.r_[0, edges], np.r_[edges, len(values)] - 1
    # The end of each part, so that the peak stays what it is.
    values = np.repeat(values[ends], ends - starts + 1)
    tilted = values.copy()
    for start, end in zip(starts[:-1], ends[:-1], strict=True):
        if start == end:
            continue
        part = (exposures[start : end + 1] - exposures[start]) / (exposures[end] - exposures[start])
        height = min(FLAT_TILT, 0.5 * (values[end + 1] - values[end]))
        if start > 0:
            height = min(height, 0.5 * (values[start] - values[start - 1]))
            part = part - 0.5
        tilted[start : end + 1] += height * part
    return exposures[: starts[-1] + 1], tilted[: starts[-1] + 1]
