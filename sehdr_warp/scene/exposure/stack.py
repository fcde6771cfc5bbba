"""Exposure stacks: photos of one still scene at several times, and the camera's response by them."""

import logging
import math
import shlex
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise, starmap
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...errors import InputError, path_of
from ...progress import track_progress
from ..dataparser import UNPLACED, ImageRecord
from ..file_names import list_images
from ..images.ldr_files import LDR_SUFFIXES, PILLOW_ERRORS, grey_thumbnail, read_ldr
from .times import shutter, with_exposure_times

if TYPE_CHECKING:
    from ...response import Response
    from ...response.calibration import Calibration
    from ...response.table import ChannelResponse

log = logging.getLogger(__name__)


# Stops from which a channel's curve clearly differs from the shared one (RMS), by which a photo may miss its time, and
# by which half of a photo may differ from the others (of stacks by six cameras at most 0.5, 0.4 to 3 if one is turned).
CHANNELS_DIFFER, WRONG_TIME, OTHER_SCENE = 0.15, 0.25, 0.55
CSV_ROWS = 1024  # Of a file with a column for each channel
# What makes photos a stack: the least factor between the brightest and the darkest, and, sorted by brightness, the
# least median and minimum of rank correlations between thumbnails of this side, where neither clips. Two pairs at least
# must show a fifth of their pixels unclipped. This sees 33 of 40 stacks by other people, and none in 76 folders of
# other photos. Medians of those stacks are 0.97 and more; videos from one place have that, but not the brightness.
BRIGHTER, ALIKE, LEAST_ALIKE, THUMBNAIL, LEAST_SHOWN, MOST_OF_STACK = 1.3, 0.96, 0.85, 64, 0.2, 32


def read_stack(folder: Path, times: Sequence[float] | None = None) -> tuple[list[Path], Sequence[float]]:
    """List the photos of a folder and their exposure times.

    Raises:
        InputError: for a folder without photos, or if there is not one time for each.
    """
    files = list_images(folder, LDR_SUFFIXES) if folder.is_dir() else []
    if not files:
        raise InputError(folder, "is not a folder of photos", "give a folder of one scene at several exposure times")
    if times is None:
        records = [ImageRecord(file.stem, file, UNPLACED, np.eye(4)) for file in files]
        records, times_known, notes = with_exposure_times(records, folder)
        if not times_known or not all(record.time_known for record in records):
            raise InputError(folder, "its photos state no exposure times", "give times, or an exposures.json")
        for note in notes:
            log.info(note)
        times = [record.seconds for record in records]
    if isinstance(times, str) or not isinstance(times, Iterable):
        raise TypeError(f"times is {times!r:.60}, expected a list of seconds")
    times = list(times)
    for time in times:
        if not (isinstance(time, Real) and 0 < time < math.inf):
            raise InputError(folder, f"time {time!r:.40} is not seconds above 0", "give numbers, such as 1 / 125")
    if len(times) != len(files):
        raise InputError(folder, f"has {len(files)} photos, and {len(times)} times are given", "give one for each")
    return files, times


def refuse_stack(photos: Sequence[Path], folder: Path) -> None:
    """Raise InputError if photos are an exposure stack: they differ in brightness, and rank that of places alike."""
    if len(photos) > MOST_OF_STACK or any(photo.suffix.lower() not in LDR_SUFFIXES for photo in photos):
        return
    try:
        tracked = track_progress("comparing exposures", photos, log)  # Large PNG and TIFF files take a while.
        pictures = sorted((grey_thumbnail(photo, THUMBNAIL) for _, photo in tracked), key=np.mean)
    except (InputError, *PILLOW_ERRORS):
        return  # The readers of these photos report what is wrong with them.
    alike = [each for each in starmap(_likeness, pairwise(pictures)) if each is not None]
    brighter = pictures[-1].mean() > BRIGHTER * pictures[0].mean()
    if not brighter or len(alike) < 2 or np.median(alike) < ALIKE or min(alike) < LEAST_ALIKE:
        return
    records = [ImageRecord(file.stem, file, UNPLACED, np.eye(4)) for file in photos]
    records, times_known, _ = with_exposure_times(records, folder)
    times = sorted(record.seconds for record in records)
    times_known = times_known and all(record.time_known for record in records)
    span = f" ({shutter(times[0])} to {shutter(times[-1])})" if times_known else ""
    problem = f"its {len(photos)} photos are an exposure stack from one place{span}, which does not show depth"
    command = f"`sehdr-warp calibrate {shlex.quote(str(photos[0].parent))} --out camera.csv`"
    remedy = f"take photos from different places; {command} finds the camera's response in the stack"
    raise InputError(folder, problem, remedy)


def _likeness(one: np.ndarray, other: np.ndarray) -> float | None:
    """Return how alike thumbnails rank the brightness of places, up to 1; None if too few are neither black nor white.

    Thumbnails of different shapes return 0.
    """
    if one.shape != other.shape:
        return 0.0
    exposed = (np.minimum(one, other) > 8) & (np.maximum(one, other) < 247)
    if exposed.mean() < LEAST_SHOWN:
        return None
    from scipy.stats import rankdata

    ranks = rankdata(one[exposed]), rankdata(other[exposed])
    return float(np.corrcoef(*ranks)[0, 1]) if min(map(np.ptp, ranks)) > 0 else 0.0


def calibrate(
    stack: Path | str,
    *,
    times: Sequence[float] | None = None,
    channel: str | None = None,
    out: Path | str | None = None,
    overwrite: bool = False,
) -> "Response":
    """Measure the response of the camera that took an exposure stack (Debevec and Malik 1997); exposure 1 is white.

    The residual, channels that clearly differ, and photos that do not fit their times are logged.

    Args:
        stack: a folder of photos of one still scene.
        times: seconds, in the order of the files' names; by default exposures.json's, or EXIF's (which counts ISO and
            f-number too).
        channel: "red", "green" or "blue" alone, or "each" for a curve of each; by default one curve for all three.
        out: a CSV file for the curve, which `response_by_name` reads; a plot goes beside it, with the suffix .png.
        overwrite: replace these files.

    Raises:
        InputError: if the stack does not determine a curve, for another suffix, or a file that exists.
    """
    from ...files import atomic_path, check_absent
    from ...response.calibration import CHANNELS, calibrate_codes

    folder = path_of(stack, "stack")
    paths = [] if out is None else [path_of(out, "out"), path_of(out, "out").with_suffix(".png")]
    if paths and paths[0].suffix.lower() != ".csv":
        raise InputError(paths[0], "the curve is a CSV file", f"name it {paths[0].with_suffix('.csv').name}")
    for path in paths:
        check_absent(path, overwrite)
    files, times = read_stack(folder, times)
    name = folder.name if out is None else Path(out).stem
    photos = [read_ldr(file).pixels for file in files]
    try:
        channels = CHANNELS if channel == "each" else (channel,)
        curves = [calibrate_codes(photos, times, channel=each, name=name) for each in channels]
    except InputError as error:
        raise InputError(folder, *error.args[0].split(": ", 1)[1].split("; ", 1)) from None
    for calibration in curves:
        _tell(calibration, files, channel)
    response = curves[0].response if len(curves) == 1 else _join(name, curves)
    if paths:
        with atomic_path(paths[1], overwrite) as picture:
            _plot(curves, times, picture)
        with atomic_path(paths[0], overwrite) as table:
            table.write_text("\n".join([*_rows(response), ""]), encoding="utf-8")
    return response


def _join(name: str, calibrations: Sequence["Calibration"]) -> "ChannelResponse":
    """Return the channels' curves as one response, in which equal middle codes are neutral (Debevec and Malik)."""
    from ...response.table import ChannelResponse

    codes = np.arange(256) / 255
    exposures = [calibration.response.decode(codes) for calibration in calibrations]
    exposures = [each * (exposures[1][128] / each[128]) for each in exposures]
    return ChannelResponse(name, exposures, [codes] * 3)


def _rows(response: "Response") -> Iterator[str]:
    """Yield the lines of a CSV file: a row for each code, or of four columns at even steps of log exposure."""
    curves = getattr(response, "curves", None)
    if curves is None:
        yield "exposure,value"
        for code, exposure in enumerate(response.decode(np.arange(256) / 255)):
            yield f"{exposure:.9g},{code / 255:.9g}"
        return
    darkest = min(float(curve.decode(np.array([1 / 255]))[0]) for curve in curves) / 4
    brightest = max(curve.clip_exposure for curve in curves)
    exposures = np.r_[0.0, np.geomspace(darkest, brightest, CSV_ROWS)]
    yield "exposure,red,green,blue"
    for row in zip(exposures, *(curve.encode(exposures) for curve in curves), strict=True):
        yield ",".join(f"{number:.9g}" for number in row)


def _tell(calibration: "Calibration", files: list[Path], channel: str | None) -> None:
    from ...response.calibration import CHANNELS

    log.info("%d photos, residual %.3f stops", len(files), calibration.residual)
    spread = {name: value for name, value in zip(CHANNELS, calibration.channel_spread, strict=True) if value == value}
    if channel is None and max(spread.values(), default=0.0) > CHANNELS_DIFFER:
        spread_text = ", ".join(f"{name} {value:.2f}" for name, value in spread.items())
        log.warning(
            "the channels' curves differ from the shared one, stops: %s; --channel each keeps them", spread_text
        )
    for file, off, spread in zip(files, calibration.photo_offsets, calibration.photo_spreads, strict=True):
        if spread > OTHER_SCENE:
            text = "half of %s differs by %.2f stops or more from what the other photos show: leave it out"
            log.warning(text, file.name, spread)
        elif abs(off) > WRONG_TIME:
            side = "brighter" if off > 0 else "darker"
            log.warning("%s is %.2f stops %s than its time says", file.name, abs(off), side)


def _plot(calibrations: Sequence["Calibration"], times: Sequence[float], path: Path) -> None:
    """Plot the curves over their samples: encoded value against stops from white."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.add_subplot()
    exposures, values = np.concatenate([calibration.samples for calibration in calibrations]).T
    axes.plot(np.log2(exposures), values * 255, ".", color="#9aa4ae", markersize=2, label="samples", rasterized=True)
    codes = np.arange(1, 256)
    colors = ("#c0392b", "#2e8b57", "#0072b2") if len(calibrations) == 3 else ("#0072b2",)
    labels = ("red", "green", "blue") if len(calibrations) == 3 else ("response",)
    for calibration, color, label in zip(calibrations, colors, labels, strict=True):
        stops = np.log2(calibration.response.decode(codes / 255))
        axes.plot(stops, codes, color=color, linewidth=1.8, label=label)
    axes.set(xlabel="exposure, stops from white", ylabel="8-bit code", ylim=(0, 260))
    axes.set_xlim(left=max(axes.get_xlim()[0], -14))
    axes.grid(color="#e1e4e8", linewidth=0.8)
    span = f"{len(times)} photos over {math.log2(max(times) / min(times)):.1f} stops"
    residual = max(calibration.residual for calibration in calibrations)
    title = f"{calibrations[0].response.name}: {span}, residual {residual:.3f} stops"
    axes.set_title(title, loc="left", fontsize=10)
    axes.legend(frameon=False, loc="upper left", markerscale=4)
    figure.savefig(path, dpi=140, facecolor="white", format="png")
