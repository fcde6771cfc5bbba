"""The plot of the rasterizer's times: a matplotlib figure that needs no display, saved small."""

import io
from itertools import cycle
from pathlib import Path

from sehdr_warp.output.report.charts import COLORS, RULE

from .report_tables import median_of_runs
from .results import groups


def plot_kernels(result: dict, path: Path) -> None:
    """Write median times over channels, forward and backward, as a PNG of 32 colors, which is all that lines need.

    Each size is a panel, each implementation a line; they share a legend below.
    """
    from matplotlib.figure import Figure
    from PIL import Image

    rows = [row for row in median_of_runs(result["rows"]) if row["pass"] != "forward"]
    panels = groups(rows, "gaussians", "width", "height")
    figure = Figure(figsize=(max(4.2 * len(panels), 6.4), 3.7), layout="constrained")
    lines = {}
    for place, ((count, width, height), here) in enumerate(panels.items(), 1):
        axes = figure.add_subplot(1, len(panels), place)
        for ((name,), mine), color in zip(groups(here, "implementation").items(), cycle(COLORS)):
            points = zip(*sorted((row["channels"], row["median_ms"]) for row in mine), strict=True)
            (lines[name],) = axes.plot(*points, "o-", color=color, markersize=3, label=name)
        axes.set(title=f"{count:,} Gaussians, {width} x {height}", xlabel="channels", ylabel="forward + backward, ms")
        axes.set(ylim=(0, 1.1 * max(row["median_ms"] for row in here)))
        axes.grid(color=RULE, linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=90, format="png")
    Image.open(buffer).convert("RGB").quantize(32).save(path, format="PNG", optimize=True)
