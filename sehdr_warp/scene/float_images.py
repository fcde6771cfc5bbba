"""OpenEXR and Radiance pictures as photos: their values are light, at exposure times that make them middle grey."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..subsets import every_nth
from .dataparser import reinhard_gamma
from .hdr_files import read_hdr
from .types import codes_of

_MIDDLE_GREY = 0.18
_MOST_JUDGED = 24


def float_codes(radiance: np.ndarray, time: float) -> np.ndarray:
    """Return [H, W, 3] uint16 codes of linear values at an exposure time."""
    return codes_of(reinhard_gamma(radiance * time), 16)


def log_averages(photos: Sequence[Path]) -> dict[int, float]:
    """Return the logarithm of the log-average of each float image of an even sample, by its index.

    Raises:
        InputError: if none of those that are sampled can be read; others are left out.
    """
    averages, problems = {}, []
    for index in every_nth(range(len(photos)), _MOST_JUDGED):
        try:
            averages[index] = float(np.log(_log_average(read_hdr(photos[index]))))
        except InputError as error:
            problems.append(error)
    if not averages:
        raise problems[0]
    return averages


def middle_grey_time(averages: Collection[float]) -> float:
    """Return the exposure time at which images of these log_averages() are middle grey."""
    return _MIDDLE_GREY / float(np.exp(np.mean(list(averages))))


def follow_times(averages: Mapping[int, float], times: Sequence[float]) -> bool:
    """Return whether images become more alike if their values are divided by their exposure times.

    `averages` are log_averages(), `times` those of all images.
    """
    values = np.array(list(averages.values()))
    return bool(np.std(values - np.log([times[index] for index in averages])) <= np.std(values))


def tone_mapped(path: Path) -> np.ndarray:
    """Return [H, W, 3] uint8 of a float image at its own exposure, for structure from motion."""
    radiance = read_hdr(path)
    return codes_of(reinhard_gamma(radiance * _MIDDLE_GREY / _log_average(radiance)), 8)


def _log_average(radiance: np.ndarray) -> float:
    mean = radiance.mean(axis=2)
    bright = float(np.percentile(mean, 99))
    if not bright > 0:
        return 1.0
    return float(np.exp(np.log(np.maximum(mean, bright * 1e-6)).mean()))
