"""The whole catalogue, and a run of it: measured case by case, printed as a table; and sweeps over what is stiff."""

import logging
import math
import time
from collections.abc import Sequence

import torch

from ..errors import SehdrError
from ..response import response_by_name
from .case import Case, Reading
from .light_cases import LIGHT_CASES, encode_readings
from .splat_cases import POISON_CASES, SPLAT_CASES, Splats, compare_splats, overlap
from .training_cases import TRAINING_CASES

LOG = logging.getLogger(__name__)
GROUPS = {"splat": SPLAT_CASES, "light": LIGHT_CASES, "poison": POISON_CASES, "training": TRAINING_CASES}
CASES = tuple((group, case) for group, cases in GROUPS.items() for case in cases)


def choose_cases(names: str | None, quick: bool) -> list[tuple[str, Case]]:
    """The cases of these names or groups, separated by commas, each with its group; all by default. quick: those that
    take a moment. Raises SehdrError for a name that is not known."""
    if names is None:
        return [(group, case) for group, case in CASES if case.quick or not quick]
    chosen = {}
    for name in (part.strip() for part in names.split(",")):
        found = {case.name: (group, case) for group, case in CASES if name in (group, case.name)}
        if not found:
            known = ", ".join([*GROUPS, *(case.name for _, case in CASES)])
            raise SehdrError(f"--cases {name:.60}: no such case; take some of {known}")
        chosen |= found
    return list(chosen.values())


def run_cases(cases: Sequence[tuple[str, Case]], device: torch.device) -> list[dict]:
    """Measures the cases, prints a table, and returns a row for each, with its readings.

    torch runs on one thread, so that the figures do not depend on the machine's cores.
    """
    rows, threads, bounds, begun = [], torch.get_num_threads(), 0, time.perf_counter()
    torch.set_num_threads(1)
    print(f"{'case':17} {'quantity':42} {'error':>9} {'bound':>9}  verdict")
    try:
        for group, case in cases:
            started = time.perf_counter()
            readings = list(case.measure(device))
            row = {"case": case.name, "group": group, "what": case.what, "note": case.note or None}
            row |= {"seconds": round(time.perf_counter() - started, 3), "holds": all(r.holds for r in readings)}
            rows.append(row | {"readings": [vars(reading) | {"holds": reading.holds} for reading in readings]})
            bounds += len(readings)
            for place, reading in enumerate(readings):
                numbers = f"{_number(reading.error)} {_number(reading.bound)}  {'ok' if reading.holds else 'FAILED'}"
                print(f"{'' if place else case.name:17} {reading.quantity:42.42} {numbers}")
    finally:
        torch.set_num_threads(threads)
    failed = sum(not row["holds"] for row in rows)
    print(f"{len(rows)} cases, {bounds} bounds, {failed} failed, {time.perf_counter() - begun:.1f} s")
    return rows


def _number(value: float) -> str:
    return f"{value:9.0f}" if math.isfinite(value) and value == int(value) and value < 1e6 else f"{value:9.1e}"


def _radiance_range(decades: float) -> Splats:
    splats = Splats(40, spread=1.0, radiance=(-0.5 * decades, 0.5 * decades))
    splats.opacities *= 0.5
    return splats


def _exposure(stops: float, device) -> list[Reading]:
    x = torch.linspace(2.0**stops, 2.0 ** (stops + 1), 33, dtype=torch.float64)
    curves = map(response_by_name, ("srgb", "gamma-2.2", "hdr-nerf", "aces"))
    return [reading for curve in curves for reading in encode_readings(curve, device, x)]


SWEEPS = (
    ("length of a needle / its thickness", tuple(10.0**k for k in range(8)),
     lambda ratio, device: compare_splats(Splats(24, scales=(1.0, 1 / ratio, 1.3 / ratio)), device),
     ("image", "d/d log_scales", "d/d quaternions")),
    ("decades of radiance within the image", tuple(range(0, 29, 4)),
     lambda decades, device: compare_splats(_radiance_range(decades), device),
     ("image", "d/d opacities", "d/d features")),
    ("Gaussians behind each other", (10, 30, 100, 300, 1000, 3000, 10_000, 30_000),
     # Together they cover a pixel to 1 - e^-5.
     lambda number, device: compare_splats(overlap(number, 5.0 / number, 1e-7), device),
     ("image", "d/d opacities", "d/d features")),
    ("stops of exposure", tuple(range(-24, 25, 4)), _exposure,
     ("srgb f", "gamma-2.2 f", "hdr-nerf f", "aces f")),
)  # fmt: skip
"""What is varied, its values, a measure of one value, and the quantities that are kept."""


def run_sweeps(device: torch.device) -> list[dict]:
    """Error and bound over what is varied: for each sweep its label, values, and (error, bound) of each quantity."""
    found = []
    for label, values, measure, kept in SWEEPS:
        LOG.info("%s", label)
        readings: dict[str, list] = {name: [] for name in kept}
        for reading in (reading for value in values for reading in measure(value, device)):
            if reading.quantity in kept:
                readings[reading.quantity].append((reading.error, reading.bound))
        found.append({"label": label, "values": values, "readings": readings})
    return found
