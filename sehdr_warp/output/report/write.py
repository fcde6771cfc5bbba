"""Reports of a training: a page to look through, and pictures for papers."""

import logging
import textwrap
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError, SehdrError, path_of, require_loaded, require_trained, require_whole_number
from ...files import atomic_path, check_absent
from ...own_files import first_unlisted
from ...progress import track_progress
from ...runs.run import Run
from ...runs.scene_description import warn_of_other_cameras
from ...scene import Scene, View
from ...scene.exposure.times import shutter
from ...scene.images.ldr_files import LDR_SUFFIXES, RAW_SUFFIXES
from ...subsets import evenly
from ..images.display import expose
from ..images.tonemap import fit_tone_map
from .charts import PANELS, QUIET, STYLE, save_picture, training_chart, training_points
from .comparison import Comparison, compare, darker_stops
from .page import STOPS, report_page, stops_text

log = logging.getLogger(__name__)
_PHOTOS = 3  # Pictures of others in a folder that tell that it is one of photos


def check_report_folder(out: Path) -> None:
    """Raise InputError for a folder of photos, for which pictures of a report would count from then on."""
    if not out.is_dir():
        return
    files = (file for file in sorted(out.iterdir()) if not file.name.startswith("."))  # As what a stopped report left.
    pictures = (file for file in files if file.suffix.lower() in (*LDR_SUFFIXES, *RAW_SUFFIXES))
    photos = list(islice((file for file in pictures if first_unlisted(file) is not None), _PHOTOS))
    if len(photos) == _PHOTOS:
        raise InputError(out, f"holds photos ({photos[0].name} ...)", "name a folder for the report alone")


def write_report(
    run: Run,
    scene: Scene,
    out: Path | str,
    *,
    view_count: int = 3,
    overwrite: bool = False,
    evaluation: Mapping[str, Any] | None = None,
) -> list[Path]:
    """Render some held-out views of a trained run and write the report; return the paths of its files.

    `report.html`: one page without a network: figures, what was left out and why, photo, scene and truth as Ultra HDR,
    brackets with an exposure dial, lights, confidence, unexplained regions, error against time, cameras. For papers:
    `comparison.png`: photo; photo, HDR scene and truth (if known) some stops darker; a new view. `stops.png`: the view
    with the most light above white from -4 to +4 stops: the photo alone, the HDR scene with its confidence, the truth.
    `training.png`: held-out PSNR against training time; absent for a run without evaluations. A scene without test
    views shows training views, and captions say so.

    Args:
        run: From load_run or train.
        scene: What it was trained on.
        out: Folder for the files.
        view_count: Number of views, evenly chosen.
        overwrite: Replace files that exist.
        evaluation: Result of evaluate(), for the page's figures, and for the scale of the truth.

    Raises:
        InputError: If a file exists, or the folder holds photos.
        SehdrError: For a scene without views.
    """
    require_loaded("load_scene", scene)
    require_trained(run)
    warn_of_other_cameras(run, scene)
    out = path_of(out, "out")
    require_whole_number(view_count, "view_count", 1)
    if not isinstance(evaluation, Mapping | None):
        raise TypeError(f"evaluation is a {type(evaluation).__name__}, expected what evaluate() returns")
    check_report_folder(out)
    metrics = run.metrics()
    charted = any(training_points(metrics, key) for key in PANELS)
    names = ("report.html", "comparison.png", "stops.png", *["training.png"] * charted)
    paths = [Path(out, name) for name in names]
    for path in paths:
        check_absent(path, overwrite)
    scene = run.normalize_photos(scene)
    candidates, held_out = scene.test_views or scene.train_views, bool(scene.test_views)
    if not candidates:
        raise SehdrError("the scene has no views to report on; check its splits")
    views = evenly(candidates, view_count)
    aligned = (evaluation or {}).get("protocol", {}).get("aligned") or {}
    scale = aligned.get("scale") or 1.0  # Photos tell radiance up to a factor if their times or curve are not known.
    comparisons = [compare(run, view, scene.views, scale) for _, view in track_progress("comparing views", views, log)]
    brightest = max(comparisons, key=lambda comparison: comparison.light_above_white)
    compared = comparison_figure(comparisons, _caption(views, metrics, held_out), held_out=held_out)
    figures = [compared, stops_figure(brightest)] + [training_chart({scene.name: [metrics]})] * charted
    lights = run.find_lights() if run.clipped_share() is not None else []
    page = report_page(run, scene, comparisons, brightest, held_out=held_out, evaluation=evaluation, lights=lights)
    with ExitStack() as stack:
        stack.enter_context(atomic_path(paths[0], overwrite)).write_text(page, encoding="utf-8")
        for path, figure in zip(paths[1:], figures, strict=True):
            temporary = stack.enter_context(atomic_path(path, overwrite))
            save_picture(figure, temporary, 160)
    return paths


def comparison_figure(comparisons: Sequence[Comparison], caption: str, *, held_out: bool = True):
    """Draw photos, what photo and scene hold some stops darker, and a new view, one row for each comparison.

    Args:
        comparisons: The rows, each at the exposure of its photo. New views are tone-mapped by one map.
        caption: Text below the figure.
        held_out: Whether the photos were not trained on.

    Returns:
        A matplotlib Figure.
    """
    darker = darker_stops(comparisons)
    columns = {"Held-out photo" if held_out else "Training photo": [c.photo for c in comparisons]}
    for name, key in (("Photo", "from_photo"), ("HDR scene", "hdr"), ("Truth", "truth")):
        lights = [(getattr(c, key), c.scale) for c in comparisons]
        if all(radiance is not None for radiance, _ in lights):
            columns[f"{name} at {stops_text(darker)}"] = [expose(r, darker, scale=scale) for r, scale in lights]
    new = [c.new for c in comparisons if c.new is not None]
    if len(new) == len(comparisons):
        gain = float(np.median([each.scale for each in comparisons]))
        columns["New view, tone-mapped"] = list(map(fit_tone_map(new, [c.new_alpha for c in comparisons], gain), new))
    rows = list(zip(*columns.values(), strict=True))
    return _grid(rows, list(columns), [c.name for c in comparisons], caption, cell=2.6)


def stops_figure(comparison: Comparison):
    """Draw one view for a plain sRGB display: the photo alone, the HDR scene with its confidence, and the truth.

    Each is shown at several exposures around that of the photo, which is 0 EV.
    """
    sources = {"Photo alone": comparison.from_photo, "HDR scene": comparison.hdr, "Truth": comparison.truth}
    sources = {name: radiance for name, radiance in sources.items() if radiance is not None}
    rows = [[None, *(expose(light, stop, scale=comparison.scale) for stop in STOPS)] for light in sources.values()]
    rows[0][0] = comparison.photo
    titles = ["Photo", *map(stops_text, STOPS)]
    caption = (
        f"View {comparison.name}, re-exposed from {shutter(comparison.exposure_time)} (0 EV) and shown on a plain "
        "sRGB display. What the photo clipped stays flat."
    )
    if comparison.confidence is not None:
        rows[1][0] = np.repeat(comparison.confidence[..., None], 3, axis=2)
        caption += " Confidence: white where photos show the light and agree, black where none does."
    figure = _grid(rows, titles, list(sources), caption, cell=1.9, name_column=1)
    if comparison.confidence is not None:
        box = {"facecolor": "black", "alpha": 0.7, "linewidth": 0, "pad": 2}
        axes = figure.axes[len(titles)]  # The first of the second row
        axes.text(0.04, 0.05, "Confidence", transform=axes.transAxes, fontsize=8, color="white", bbox=box)
    return figure


def _grid(rows, titles: Sequence[str], names: Sequence[str], caption: str, *, cell: float, name_column: int = 0):
    """Arrange pictures [H, W, 3] with titles above, names at the left of a column and a caption below.

    None leaves a place empty. `cell` is the width of a picture in inches.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    shapes = [next(picture.shape for picture in row if picture is not None) for row in rows]
    heights, width = [cell * shape[0] / shape[1] for shape in shapes], 0.4 + len(titles) * cell
    with rc_context(STYLE):
        layout = ConstrainedLayoutEngine(w_pad=0.03, h_pad=0.03, wspace=0, hspace=0)
        figure = Figure(figsize=(width, 0.9 + sum(heights)), layout=layout)
        grid = figure.add_gridspec(len(rows), len(titles), height_ratios=heights)
        for row, (pictures, name) in enumerate(zip(rows, names, strict=True)):
            for column, picture in enumerate(pictures):
                if picture is None:
                    continue
                axes = figure.add_subplot(grid[row, column])
                axes.imshow(np.clip(picture, 0, 1), interpolation="lanczos")
                axes.set(xticks=[], yticks=[])  # A frame shows where a white picture ends.
                axes.set_title(titles[column] if row == 0 else "", fontsize=9.5, fontweight="bold")
                axes.set_ylabel(name if column == name_column else "", fontsize=8.5)
        figure.supxlabel(textwrap.fill(caption, round(14 * width)), x=0.02, ha="left", fontsize=8.5, color=QUIET)
        return figure


def _caption(views: Sequence[View], metrics: Sequence[dict], held_out: bool) -> str:
    times = sorted({view.exposure_time for view in views})
    text = f"Photos at {' and '.join(map(shutter, times)) if len(times) < 3 else 'several exposures'}"
    text += ", none of them trained on." if held_out else ", all of them trained on: the scene has no test views."
    last = {key: points[-1] for key in PANELS if (points := training_points(metrics, key))}
    if last and held_out:
        figures = [f"{PANELS[key]} {decibels:.1f} dB" for key, (_, decibels) in last.items()]
        seconds = max(seconds for seconds, _ in last.values())
        text += f" PSNR of all held-out views after {seconds:.0f} s of training: {'; '.join(figures)}."
    return text
