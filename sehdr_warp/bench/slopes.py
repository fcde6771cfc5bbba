"""How steeply times and memory grow: slopes in log-log, over a whole sweep and at its large end."""

import math

STEEPEST = 1.2
"""A slope above it, at the large end of a sweep, is called steeper than linear; 2 is quadratic."""
LARGE_END = 3
"""The large end is a sweep's last so many points."""


def fit_slopes(rows: list[dict]) -> list[dict]:
    """One row for each sweep, implementation, stage and quantity (time, memory) that has two points or more.

    Times are the least of their repetitions, which other work on the machine disturbs least.
    slope: least squares of log(quantity) on log(varied) over `from` to `to`; slope_large: over the last LARGE_END
    points, `large_from` to `large_to`; too_steep: slope_large > STEEPEST.
    """
    series: dict[tuple, list[tuple[int, float]]] = {}
    for row in rows:
        for quantity, field in (("time", "min_ms"), ("memory", "peak_memory_bytes")):
            if row.get(field):
                key = row["sweep"], row["implementation"], row["what"], quantity
                series.setdefault(key, []).append((row["varied"], row[field]))
    slopes = []
    for (sweep, implementation, what, quantity), points in series.items():
        if len(points) < 2:
            continue
        large = points[-LARGE_END:]
        slope_large = slope(large)
        slopes.append(
            {
                "stage": "slope",
                "sweep": sweep,
                "implementation": implementation,
                "what": what,
                "quantity": quantity,
                "slope": slope(points),
                "from": points[0][0],
                "to": points[-1][0],
                "slope_large": slope_large,
                "large_from": large[0][0],
                "large_to": large[-1][0],
                "too_steep": slope_large > STEEPEST,
            }
        )
    return slopes


def slope(points: list[tuple[float, float]]) -> float:
    """Least squares of log y on log x; at least two points, all positive, not all of one x."""
    xs, ys = zip(*((math.log(x), math.log(y)) for x, y in points))
    mean_x, mean_y = sum(xs) / len(xs), sum(ys) / len(ys)
    return sum((x - mean_x) * (y - mean_y) for x, y in zip(xs, ys)) / sum((x - mean_x) ** 2 for x in xs)
