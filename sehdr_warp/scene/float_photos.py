"""OpenEXR and Radiance pictures as photos: their values are light, at exposure times that make them middle grey."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..subsets import every_nth
from .dataparser import ImageRecord, reinhard_gamma
from .exposure.times import stated_times
from .images.hdr_files import exr_exposure_time, read_hdr
from .types import codes_of

_MIDDLE_GREY = 0.18
_MOST_JUDGED = 24


def with_float_times(records: Sequence[ImageRecord], folder: Path) -> tuple[list[ImageRecord], bool, list[str]]:
    """Return float images with the time each at which they are middle grey; results as of with_exposure_times().

    Their values are divided by the times of the set or exposures.json, else by expTime of the headers. Times that the
    user states count if the images' brightness follows them: a set of light may list those of photos. A float image is
    its own truth.
    """
    averages = _log_averages([record.image for record in records])
    stated, notes = stated_times(records, folder)
    times = [exr_exposure_time(record.image) if time is None else time for record, time in zip(records, stated)]
    own_times = [time for time in times if time is not None]
    factors, meaning = [1.0] * len(records), "taken as light, at no exposure"
    if len(own_times) == len(times) and max(own_times) >= min(own_times) * 1.001:
        span, values = f"{min(own_times):g} to {max(own_times):g} s", np.array(list(averages.values()))
        # Whether images become more alike if their values are divided by their times
        if None in stated or np.std(values - np.log([own_times[index] for index in averages])) <= np.std(values):
            factors = [time / own_times[0] for time in own_times]
            meaning = f"light times {'expTime' if None in stated else 'the stated times'}, {span}"
        else:
            meaning = f"taken as light, because they do not follow the stated times, {span}"
    grey = _MIDDLE_GREY / float(np.exp(np.mean(list(averages.values()))))
    timed = [
        replace(record, exposure_time=grey * factor, hdr=record.hdr or record.image, light_scale=1 / factor)
        for record, factor in zip(records, factors, strict=True)
    ]
    return timed, True, [*notes, f"float images: their values are {meaning}"]


def float_codes(radiance: np.ndarray, time: float) -> np.ndarray:
    """Return [H, W, 3] uint16 codes of linear values at an exposure time."""
    return codes_of(reinhard_gamma(radiance * time), 16)


def tone_mapped(path: Path) -> np.ndarray:
    """Return [H, W, 3] uint8 of a float image at its own exposure, for structure from motion."""
    radiance = read_hdr(path)
    return codes_of(reinhard_gamma(radiance * _MIDDLE_GREY / _log_average(radiance)), 8)


def _log_averages(photos: Sequence[Path]) -> dict[int, float]:
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


def _log_average(radiance: np.ndarray) -> float:
    mean = radiance.mean(axis=2)
    bright = float(np.percentile(mean, 99))
    if not bright > 0:
        return 1.0
    return float(np.exp(np.log(np.maximum(mean, bright * 1e-6)).mean()))
