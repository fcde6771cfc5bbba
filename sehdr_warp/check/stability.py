"""Error against float64 over four axes, as plots: scale ratio, radiance range, depth of overlap, exposure."""

import io
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from ..files import atomic_path, check_absent, write_json
from ..response import response_by_name
from .case import ROUNDINGS, UNIT, Reading, compare
from .splats import Splats, compare_splat


@dataclass(frozen=True)
class Axis:
    """name: of the files. label: of the axis. values: where it is measured. measure: (value, device) -> readings, of
    which those called in `shown` are drawn."""

    name: str
    label: str
    values: tuple[float, ...]
    measure: Callable[[float, torch.device], list[Reading]]
    shown: tuple[str, ...]


def _scale_ratio(ratio: float, device) -> list[Reading]:
    """Needles of the image's length, `ratio` times longer than thick."""
    splats = Splats(24)
    splats.log_scales[:] = torch.tensor([1.0, 1 / ratio, 1.3 / ratio], dtype=torch.float64).log()
    return compare_splat(splats, device)


def _radiance_range(decades: float, device) -> list[Reading]:
    splats = Splats(40, spread=1.0)
    splats.opacities *= 0.5
    order = torch.randperm(40, generator=torch.Generator().manual_seed(1))
    splats.features[:] = 10.0 ** ((order / 39 - 0.5) * decades).double()[:, None]
    return compare_splat(splats, device)


def _overlap(number: float, device) -> list[Reading]:
    """Gaussians that together cover a pixel to 1 - e^-5, in one tile."""
    number = int(number)
    splats = Splats(number, width=4, height=4, spread=0.2)
    splats.log_scales[:] = torch.tensor([0.3, 0.5, 0.7], dtype=torch.float64).log()
    splats.opacities[:] = 5.0 / number
    splats.means[:, 2] = torch.linspace(2.0, 6.0, number, dtype=torch.float64)
    splats.options = {"alpha_threshold": 1e-7}
    return compare_splat(splats, device, ties=True, extra=ROUNDINGS * UNIT * math.sqrt(number))


def _exposure(stops: float, device) -> list[Reading]:
    readings = []
    x = torch.linspace(2.0**stops, 2.0 ** (stops + 1), 33, dtype=torch.float64)
    for name in ("srgb", "gamma-2.2", "reinhard-gamma", "aces"):
        curve = response_by_name(name)

        def encode(x, curve=curve):
            return {"f": curve.encode(x)}

        (reading,) = compare(
            encode, lambda _, x, f=encode: f(x), {"x": x}, device, elementwise=True, extra=64 * UNIT * (name == "aces")
        )
        readings.append(Reading(name, reading.error, reading.bound))
    return readings


AXES = (
    Axis("scale-ratio", "length of a needle / its thickness", tuple(10.0**k for k in range(8)), _scale_ratio,
         ("image", "d/d log_scales", "d/d quaternions")),
    Axis("radiance-range", "decades of radiance within the image", tuple(range(0, 29, 4)), _radiance_range,
         ("image", "d/d opacities", "d/d features")),
    Axis("overlap", "Gaussians behind each other", (10, 30, 100, 300, 1000, 3000, 10_000, 30_000), _overlap,
         ("image", "d/d opacities", "d/d features")),
    Axis("exposure", "stops of exposure", tuple(range(-24, 25, 4)), _exposure,
         ("srgb", "gamma-2.2", "reinhard-gamma", "aces")),
)  # fmt: skip
# Okabe and Ito's colours, which the colour-blind tell apart.
_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")


def plot_stability(folder: Path, device: torch.device, *, overwrite: bool, progress) -> list[Path]:
    """Measures the axes and writes one PNG each and stability.json; returns the paths.

    Raises InputError where a file exists (unless overwrite).
    """
    paths = [folder / f"stability-{axis.name}.png" for axis in AXES] + [folder / "stability.json"]
    for path in paths:
        check_absent(path, overwrite)
    measured = {}
    for axis, path in zip(AXES, paths, strict=False):
        progress(f"measuring {axis.name}")
        rows = [{r.quantity: (r.error, r.bound) for r in axis.measure(value, device)} for value in axis.values]
        measured[axis.name] = {"values": axis.values, "rows": rows}
        with atomic_path(path, overwrite) as temporary:
            _save(_figure(axis, rows, device), temporary)
    write_json(paths[-1], {"device": str(device), "axes": measured}, overwrite)
    return paths


def _save(figure, path: Path) -> None:
    """As a PNG of 16 colours, which is all that lines need: some 6 kB."""
    from PIL import Image

    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=78, format="png")
    Image.open(buffer).convert("RGB").quantize(16).save(path, format="PNG", optimize=True)


def _figure(axis: Axis, rows: list[dict], device: torch.device):
    """A matplotlib Figure: errors as solid lines, their bounds as dotted ones of the same colour."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    axes = figure.add_subplot()
    for name, color in zip(axis.shown, _COLORS, strict=False):
        # An exact result has no place on a logarithmic axis: it is drawn at a tenth of a rounding.
        errors = [max(row[name][0], UNIT / 10) for row in rows]
        axes.plot(axis.values, errors, color=color, marker="o", markersize=3, label=name)
        axes.plot(axis.values, [row[name][1] for row in rows], color=color, linestyle=":", linewidth=1)
    if axis.values[-1] > 1000:
        axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel(axis.label)
    axes.set_ylabel("relative error against float64")
    axes.set_title(f"float32 on {device.type}; dotted: bounds", loc="left", fontsize=9)
    axes.grid(color="#e1e4e8", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8)
    return figure
