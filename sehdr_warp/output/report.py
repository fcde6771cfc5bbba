"""Pictures of what a training achieved: what the photo lost and HDR held, exposure stops, error against time."""

import textwrap
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sehdr_warp.errors import SehdrError
from sehdr_warp.scene import Camera, Scene, View

from ..files import atomic_path, check_absent
from .camera_paths import interpolate
from .tonemap import expose, fit_tone_map

STOPS = (-4, -2, 0, 2, 4)
"""Stops from the photos' exposure in the strip."""
DARKER = -4
"""Stops at which photo, scene and truth stand side by side: what was clipped tells them apart."""

_DPI = 160
_INK, _QUIET, _RULE = "#1f2328", "#6a737d", "#e1e4e8"
# Two hues that the colour-blind tell apart (Okabe and Ito's blue and vermilion).
_SERIES = (("psnr_ldr", "LDR", "#0072b2"), ("psnr_mu", "HDR (mu-law)", "#d55e00"))
_STYLE = {
    "font.family": "sans-serif",
    "font.sans-serif": ["Inter", "Helvetica Neue", "Arial", "DejaVu Sans"],
    "font.size": 9,
    "text.color": _INK,
    "axes.labelcolor": _QUIET,
    "xtick.color": _QUIET,
    "ytick.color": _QUIET,
    "axes.edgecolor": _RULE,
}


@dataclass(frozen=True)
class Comparison:
    """One view of the report.

    Attributes:
        name: of the view.
        photo: [H, W, 3] encoded, in [0, 1].
        from_photo: [H, W, 3] the radiance that the photo alone gives, its response undone.
        hdr: [H, W, 3] rendered radiance.
        truth: [H, W, 3] true radiance; None without.
        confidence: [H, W] in [0, 1] of the render; None where the run's was not measured.
        new: [H, W, 3] radiance from a place without a photo, on the way to the nearest other view; None for one view.
    """

    name: str
    photo: np.ndarray
    from_photo: np.ndarray
    hdr: np.ndarray
    truth: np.ndarray | None = None
    confidence: np.ndarray | None = None
    new: np.ndarray | None = None


def write_report(run, scene: Scene, out: Path | str, *, view_count: int = 3, overwrite: bool = False) -> list[Path]:
    """Renders some held-out views and writes the report's pictures.

    `comparison.png`: photo; photo, HDR scene and truth (where there is some) at -4 EV; a new view; one row a view.
    `stops.png`: the view of most clipped light from -4 to +4 stops: the photo alone, the HDR scene with its confidence,
    the truth.
    `training.png`: held-out error against training time; left out for a run without evaluations.

    Args:
        run: a trained Run.
        scene: of its photos. Without test views the training views are shown, and captions say so.
        view_count: rows of the comparison, evenly chosen.

    Returns:
        The pictures' paths.

    Raises:
        InputError: where a picture exists (unless overwrite).
        SehdrError: for a scene without views.
    """
    out = Path(out)
    metrics = [line for line in run.metrics() if "seconds" in line and any(line.get(key) for key, _, _ in _SERIES)]
    names = ["comparison.png", "stops.png"] + ["training.png"] * bool(metrics)
    for name in names:
        check_absent(out / name, overwrite)
    held_out = bool(scene.test_views)
    views = _chosen(scene.test_views or scene.train_views, view_count)
    comparisons = [compare(run, view, scene.views) for view in views]
    time = views[0].exposure_time
    brightest = max(comparisons, key=lambda comparison: float((comparison.photo > 0.99).mean()))
    figures = [
        comparison_figure(comparisons, time, _caption(views, metrics, held_out), held_out=held_out),
        stops_figure(brightest, time),
    ] + ([training_figure(metrics)] if metrics else [])
    with ExitStack() as stack:
        for name, figure in zip(names, figures, strict=True):
            temporary = stack.enter_context(atomic_path(out / name, overwrite))
            figure.savefig(temporary, dpi=_DPI, facecolor="white", format="png")
    return [out / name for name in names]


def comparison_figure(comparisons: Sequence[Comparison], exposure_time: float, caption: str, *, held_out: bool = True):
    """A matplotlib Figure: one row a view, with what the photo and the scene hold four stops darker, and a new view.

    exposure_time: seconds at 0 EV. The new view is tone-mapped, by one map for all.
    """
    darker = f"{DARKER:+g} EV".replace("-", "\N{MINUS SIGN}")
    kind = "Held-out photo" if held_out else "Training photo"
    columns = {
        kind: [c.photo for c in comparisons],
        f"Photo at {darker}": [expose(c.from_photo, DARKER, scale=exposure_time) for c in comparisons],
        f"HDR scene at {darker}": [expose(c.hdr, DARKER, scale=exposure_time) for c in comparisons],
    }
    if all(c.truth is not None for c in comparisons):
        columns[f"Truth at {darker}"] = [expose(c.truth, DARKER, scale=exposure_time) for c in comparisons]
    if all(c.new is not None for c in comparisons):
        tone_map = fit_tone_map([c.new for c in comparisons])
        columns["New view, tone-mapped"] = [tone_map(c.new) for c in comparisons]
    rows = list(zip(*columns.values(), strict=True))
    return _grid(rows, list(columns), [c.name for c in comparisons], caption, cell=2.6)


def stops_figure(comparison: Comparison, exposure_time: float):
    """A matplotlib Figure: one view at several exposures, as radiance on a plain sRGB display: no tone map.

    The first row holds the photo as it is and re-exposed alone: what it clipped stays white or black. Beside the HDR
    scene stands its confidence, where there is one, as grey. exposure_time: seconds at 0 EV.
    """
    sources = {"Photo alone": comparison.from_photo, "HDR scene": comparison.hdr, "Truth": comparison.truth}
    sources = {name: radiance for name, radiance in sources.items() if radiance is not None}
    rows = [[None, *(expose(radiance, stop, scale=exposure_time) for stop in STOPS)] for radiance in sources.values()]
    rows[0][0] = comparison.photo
    titles = ["Photo"] + [f"{stop:+g} EV".replace("-", "\N{MINUS SIGN}") if stop else "0 EV" for stop in STOPS]
    caption = (
        f"View {comparison.name}, re-exposed from {_seconds(exposure_time)} (0 EV) and shown on a plain sRGB display. "
        "What the photo clipped stays flat."
    )
    if comparison.confidence is not None:
        rows[1].append(np.repeat(comparison.confidence[..., None], 3, axis=2))
        titles.append("Confidence")
        caption += " Confidence: white where the photos vouch for the light, black where they say nothing of it."
    return _grid(rows, titles, list(sources), caption, cell=1.9)


def training_figure(metrics: Sequence[dict]):
    """A matplotlib Figure: held-out PSNR against training seconds."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(7.2, 4.2), layout="constrained")
        figure.get_layout_engine().set(w_pad=0.12, h_pad=0.12)
        axes = figure.add_subplot()
        for key, label, color in _SERIES:
            points = [(line["seconds"], line[key]) for line in metrics if line.get(key) is not None]
            if points:
                style = {"color": color, "linewidth": 1.8, "marker": "o", "markersize": 4, "clip_on": False}
                axes.plot(*zip(*points, strict=True), label=f"{label}  {points[-1][1]:.1f} dB", **style)
        # Curves rise: the corner below them on the right is free.
        axes.legend(loc="lower right", frameon=False, labelcolor="linecolor", prop={"weight": "bold"}, reverse=True)
        axes.set_title("Held-out error against training time", loc="left", fontsize=11, fontweight="bold", pad=12)
        axes.set_xlabel("training time, seconds")
        axes.set_ylabel("PSNR, dB (higher is better)")
        axes.set_xlim(left=0)
        axes.margins(y=0.15)
        axes.grid(axis="y", color=_RULE, linewidth=0.8)
        axes.set_axisbelow(True)
        axes.tick_params(length=0)
        axes.spines[["top", "right", "left"]].set_visible(False)
        return figure


def _grid(rows, titles: Sequence[str], names: Sequence[str], caption: str, *, cell: float):
    """Pictures [H, W, 3] in rows and columns with column titles, row names at the left, and a caption below.

    rows: of the titles' length or shorter; None leaves a place empty, and so does the end of a shorter row.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    gap, left, top, bottom, edge = 0.06, 0.3, 0.36, 0.46, 0.12
    shapes = [next(picture.shape for picture in row if picture is not None) for row in rows]
    heights = [cell * shape[0] / shape[1] for shape in shapes]
    width = left + len(titles) * (cell + gap) - gap + edge
    height = top + sum(heights) + gap * (len(rows) - 1) + bottom
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(width, height))
        for column, title in enumerate(titles):
            where = ((left + column * (cell + gap) + cell / 2) / width, (height - top + 0.1) / height)
            figure.text(*where, title, ha="center", va="bottom", fontsize=9.5, fontweight="bold")
        y = height - top
        for pictures, name, row_height in zip(rows, names, heights, strict=True):
            y -= row_height
            for column, picture in enumerate(pictures):
                if picture is None:
                    continue
                x = left + column * (cell + gap)
                axes = figure.add_axes((x / width, y / height, cell / width, row_height / height))
                axes.imshow(np.clip(picture, 0, 1), aspect="auto", interpolation="lanczos")
                axes.set_axis_off()
            where = ((left - 0.1) / width, (y + row_height / 2) / height)
            figure.text(*where, name, rotation=90, ha="right", va="center", color=_QUIET, fontsize=8.5)
            y -= gap
        caption = "\n".join(textwrap.wrap(caption, max(30, int((width - left) * 17))))
        figure.text(left / width, 0.16 / height, caption, color=_QUIET, fontsize=8, va="bottom")
        return figure


def _chosen(views: Sequence[View], count: int) -> list[View]:
    if not views:
        raise SehdrError("the scene has no views to report on; check its splits")
    return [views[i] for i in sorted({round(i) for i in np.linspace(0, len(views) - 1, max(count, 1))})]


def compare(run, view: View, views: Sequence[View]) -> Comparison:
    """What comparison_figure shows of a view of the scene whose views are `views`."""
    hdr, confidence = _array(run.render(view.camera).hdr), run.render_confidence(view.camera)
    from_photo = np.asarray(run.response.decode(view.image)) / view.exposure_time
    between = _between(view, views)
    return Comparison(
        view.name,
        view.image,
        from_photo,
        hdr,
        view.hdr,
        None if confidence is None else _array(confidence),
        None if between is None else _array(run.render(between).hdr),
    )


def _between(view: View, views: Sequence[View]) -> Camera | None:
    """A camera halfway to the nearest other view."""
    others = [other.camera for other in views if other.name != view.name]
    if not others:
        return None
    nearest = min(others, key=lambda camera: float(np.linalg.norm(camera.position - view.camera.position)))
    return interpolate([view.camera, nearest], 3)[1]


def _array(value) -> np.ndarray:
    """A torch tensor on any device, or an array, as an array."""
    return np.asarray(value.detach().cpu() if hasattr(value, "detach") else value)


def _caption(views: Sequence[View], metrics: Sequence[dict], held_out: bool) -> str:
    times = sorted({view.exposure_time for view in views})
    text = f"Photos at {' and '.join(map(_seconds, times)) if len(times) < 3 else 'several exposures'}"
    text += ", none of them trained on." if held_out else ", all of them trained on: the scene has no test views."
    if metrics and held_out:
        last = metrics[-1]
        figures = [f"{label} {last[key]:.1f} dB" for key, label, _ in _SERIES if last.get(key) is not None]
        text += f" All held-out views after {last['seconds']:.0f} s of training: PSNR {', '.join(figures)}."
    return text


def _seconds(time: float) -> str:
    return f"1/{1 / time:.0f} s" if time < 0.3 else f"{time:.3g} s"
