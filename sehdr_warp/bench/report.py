"""`bench report`: the pages and plots of docs/reports, made of the results stored there. Nothing is typed by hand."""

import csv
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, median

from ..errors import InputError
from ..files import atomic_path
from . import report_plots as plots
from .jobs import LEARNED, UPPER_BOUND
from .results import machine_line, markdown_table

RESULTS, TRIED = "results", "tried.csv"


@dataclass(frozen=True)
class Page:
    """A report on results/NAME.json: its text, the tables of a result, and a plot with its caption."""

    name: str
    title: str
    text: str
    tables: Callable[[dict], Iterable[str]]
    caption: str = ""
    draw: Callable[[dict, Path], None] | None = None


def write_reports(folder: Path) -> list[Path]:
    """Writes a page, with its plot, for each result in folder/results and for folder/tried.csv, and an index.

    Raises:
        InputError: for a folder without results, and for a result that cannot be read.
    """
    pages = {page: folder / RESULTS / f"{page.name}.json" for page in PAGES}
    pages = {page: path for page, path in pages.items() if path.is_file()}
    if not pages:
        raise InputError(folder, "holds no results", "name the folder with results/*.json, such as docs/reports")
    written, index = [], []
    for page, path in pages.items():
        result = _read(path)
        machine = result["machine"]
        parts = [f"# {page.title}", page.text, f"```sh\n{result['command']}\n```", machine_line(result) + "."]
        if page.draw:
            picture = folder / f"{page.name}.png"
            with atomic_path(picture, overwrite=True) as temporary:
                page.draw(result, temporary)
            written.append(picture)
            parts.append(f"![{page.caption}]({picture.name})")
        written.append(_write(folder / f"{page.name}.md", [*parts, *page.tables(result), *result["notes"]]))
        name = machine["gpu"]["name"] if machine["gpu"] else f"{machine['cpu']}, {machine['cores']} cores"
        index.append({"report": f"[{page.title}]({page.name}.md)", "machine": name})
    if (folder / TRIED).is_file():
        written.append(_write(folder / "tried.md", _tried_page(folder / TRIED)))
        index.append({"report": "[Tried and lost](tried.md)"})
    text = "What was measured. `sehdr-warp bench report` makes these pages of `results/*.json` and `tried.csv`."
    table = markdown_table(index, {"report": "", "machine": ""})
    return [*written, _write(folder / "README.md", ["# Reports", text, table])]


def _read(path: Path) -> dict:
    try:
        result = json.loads(path.read_text(encoding="utf-8"))
        for key in ("command", "machine", "date", "rows", "notes"):
            result[key]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(path, f"is no result ({error!r:.80})", "write it with --json of a benchmark") from None
    return result


def _write(path: Path, parts: Sequence[str]) -> Path:
    with atomic_path(path, overwrite=True) as temporary:
        temporary.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    return path


def _groups(rows: Iterable[dict], *fields: str) -> dict[tuple, list[dict]]:
    """Rows by the values of these fields, in the order of their first."""
    groups: dict[tuple, list[dict]] = {}
    for row in rows:
        groups.setdefault(tuple(row[field] for field in fields), []).append(row)
    return groups


def _pivot(rows: Sequence[dict], places: dict[str, str], over: str, value: str, form: str) -> str:
    """A table with a row for each place, and a column for the value of each `over`. places: as columns of a table."""
    fields = [key.partition("=")[2] or key for key in places]
    found = _groups(rows, *fields).items()
    made = [dict(zip(fields, key, strict=True)) | {row[over]: row[value] for row in here} for key, here in found]
    return markdown_table(made, places | dict.fromkeys((row[over] for row in rows), form))


def _kernel_tables(result: dict) -> Iterable[str]:
    places = {"Gaussians=gaussians": ",d", "width": "d", "height": "d", "C=channels": "d"}
    for (passing,), rows in _groups(result["rows"], "pass").items():
        yield f"## {passing.capitalize()}, median ms"
        yield _pivot(rows, places, "implementation", "median_ms", ".3f")
    yield _checks_line(result)


def _step_tables(result: dict) -> Iterable[str]:
    from .step import COLUMNS

    yield markdown_table(result["rows"], COLUMNS)
    yield _checks_line(result)


def _scale_tables(result: dict) -> Iterable[str]:
    from .scale import COLUMNS

    for (sweep,), rows in _groups(result["rows"], "sweep").items():
        yield f"## Over {sweep}"
        yield markdown_table(rows, {key: form for key, form in COLUMNS.items() if key != "sweep"})
    yield "## Slopes of the logarithms, whole and at the large end"
    columns = dict.fromkeys(("sweep", "rasterizer=implementation", "what", "quantity"), "")
    yield markdown_table(result["slopes"], columns | {"slope": ".2f", "at the large end=slope_large": ".2f"})
    yield _checks_line(result)


def _checks_line(result: dict) -> str:
    passed = sum(check["passed"] for check in result["checks"])
    return f"{passed} of {len(result['checks'])} correctness checks passed."


_QUALITY = {
    "method": "", "n": "d", "gt-max dB=gt_max": ".2f", "worst": ".2f", "to U=to_bound": "+.2f",
    "aligned dB=aligned": ".2f", "SSIM=ssim": ".3f", "LPIPS=lpips": ".3f", "clipped dB=clipped": ".2f",
    "well-exposed dB=well_exposed": ".2f", "LDR dB=ldr": ".2f", "seconds": ".1f", "MiB=peak_memory_bytes": "MiB",
    "Gaussians=gaussians": ",.0f", "renders / s=renders_per_second": ".0f",
}  # fmt: skip


def _quality_tables(result: dict) -> Iterable[str]:
    rows, places = result["rows"], ("scene", "curve", "exposure", "seed", "device")
    bounds = _groups([row for row in rows if row["method"] == UPPER_BOUND], *places)
    for row in rows:
        (bound, *_) = bounds.get(tuple(row[field] for field in places), [row])
        row["to_bound"] = None if bound is row else row["gt_max"] - bound["gt_max"]
    for curve, response in _groups([row for row in rows if row["response"] != LEARNED], "curve", "response"):
        members = [row for row in rows if row["curve"] == curve and row["response"] in (response, LEARNED)]
        table = []
        for (method,), mine in _groups(members, "method").items():
            line = {"method": method, "n": len(mine), "worst": min(row["gt_max"] for row in mine)}
            for field in (key.partition("=")[2] or key for key in _QUALITY):
                values = [row[field] for row in mine if field not in line and row[field] is not None]
                line |= {field: fmean(values)} if values else {}
            table.append(line)
        yield f"## Curve {curve}, response {response}"
        yield markdown_table(table, _QUALITY)
        yield "gt-max by scene and exposure, mean over seeds, dB:"
        fields = ("scene", "exposure", "method")
        groups = _groups(members, *fields).items()
        means = [dict(zip(fields, key)) | {"dB": fmean(row["gt_max"] for row in here)} for key, here in groups]
        yield _pivot(means, {"scene": "", "exposure": "d"}, "method", "dB", ".2f")
    shared = max(row["shared_by"] for row in rows)
    if shared > 1:
        yield f"{shared} trainings shared a device: seconds and renders / s are those of a shared one."


def _response_tables(result: dict) -> Iterable[str]:
    from .response import COLUMNS

    yield markdown_table(result["rows"], COLUMNS)


def _stability_tables(result: dict) -> Iterable[str]:
    groups = []
    for (group,), cases in _groups(result["rows"], "group").items():
        readings = [(case["case"], reading) for case in cases for reading in case["readings"]]
        parts = [((r["error"] or 0) / r["bound"], f"{case}: {r['quantity']}") for case, r in readings if r["bound"] > 0]
        line = {"group": group, "cases": len(cases), "bounds": len(readings)}
        if parts:
            line["worst"], line["which"] = max(parts, key=lambda part: part[0])
            line["median"] = median(part for part, _ in parts)
        groups.append(line)
    columns = {"group": "", "cases": "d", "bounds": "d", "median": ".2f", "worst": ".2f", "which": ""}
    failed = [row["case"] for row in result["rows"] if not row["holds"]]
    yield "Errors over their bounds:"
    yield markdown_table(groups, columns)
    yield markdown_table(result["rows"], {"case": "", "what": "", "note": ""})
    yield f"Failed: {', '.join(failed)}." if failed else "All bounds hold."


def _tried_page(path: Path) -> list[str]:
    with open(path, newline="", encoding="utf-8") as file:
        topics = _groups(csv.DictReader(file), "topic")
    columns = {"option": "", "idea": "", "gave": "", "on": ""}
    text = (
        "Ideas that were built, measured and taken out again, or never turned on. dB are differences in held-out "
        "mu-law PSNR under `gt-max` to the same training without, where nothing else is said; 0.2 dB are within chance."
    )
    tables = [part for (topic,), rows in topics.items() for part in (f"## {topic}", markdown_table(rows, columns))]
    return ["# Tried and lost", text, *tables]


PAGES = (
    Page(
        "quality",
        "Quality",
        "Scenes with HDR truth, exposed through a known curve; methods are presets over the same kernels, photos and "
        "iterations. PSNR of mu-law values (mu = 5000): *gt-max* over the truth's maximum, *aligned* after one "
        "factor a scene; *to U* is the mean difference to 3DGS trained on the HDR truth (`truth`); regions are of "
        "the photo, aligned; *LDR* is the simulated photo. *known*: the method is told the curve; *blind*: it is not; "
        "methods that learn the response stand in both. Exposures are numbered from the shortest, four times apart.",
        _quality_tables,
        "Held-out HDR error over training time",
        plots.plot_quality,
    ),
    Page(
        "kernels",
        "The splat",
        "Projecting, ordering, binning and blending random Gaussians with colors given. *recorded*: replayed as a CUDA "
        "graph, as inside a training step; *RecordedRasterizer*: called from Python, two graphs behind each call; "
        "without a word: `rasterize()` called from Python, whose launches set the pace of small scenes on a GPU.",
        _kernel_tables,
        "Median times over channels",
        plots.plot_kernels,
    ),
    Page(
        "step",
        "A training step",
        "Photograph, losses, gradients, optimizer and densification on synthetic photos, with all degrees of the "
        "harmonics. *with densification* is the mean over whole intervals between changes of the count; *host* is the "
        "time until `step()` returns. Memory on a GPU is all that is held, photos and optimizer included.",
        _step_tables,
    ),
    Page(
        "scale",
        "Growth",
        "One quantity varied, the others held. Splats are forward and backward, called from Python; steps are of the "
        "preset `paper`, nine channels in one pass, without densification; gsplat's are the same with its rasterizer.",
        _scale_tables,
        "Time and peak memory over what is varied",
        plots.plot_scale,
    ),
    Page(
        "response",
        "Choosing the response",
        "Rendered scenes, exposed by each curve at several exposures; a curve is chosen from the photos alone. Error "
        "in stops: RMS over codes 10 to 245 of log2 of decoded over true exposure, after one scale. Decibels are of "
        "the photos decoded by the choice, beside those of the true curve; no 3D is involved.",
        _response_tables,
    ),
    Page(
        "stability",
        "Numerical stability",
        "Stiff and extreme cases in float32 against float64. A bound is what disturbing every number between stages by "
        "8 units of float32's rounding does to the float64 result (Monte Carlo arithmetic, Parker 1997).",
        _stability_tables,
        "Error against float64 over four axes; dotted: bounds",
        plots.plot_stability,
    ),
)
