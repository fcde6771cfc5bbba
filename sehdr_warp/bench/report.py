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
    """A report on results/NAME.json: its text, the tables of a result, and the plots, each (ending, title, draw)."""

    name: str
    title: str
    text: str
    tables: Callable[[dict], Iterable[str]]
    plots: tuple[tuple[str, str, Callable[[dict, Path], None]], ...] = ()


def write_reports(folder: Path) -> list[Path]:
    """Writes a page, with its plots, for each result in folder/results and for folder/tried.csv, and an index.

    Raises:
        InputError: for a folder without results, and for a result that cannot be read.
    """
    found = {page.name: folder / RESULTS / f"{page.name}.json" for page in PAGES}
    if not any(path.is_file() for path in found.values()):
        raise InputError(folder, "holds no results", "name the folder with results/*.json, such as docs/reports")
    written, index = [], []
    for page in PAGES:
        if not found[page.name].is_file():
            continue
        result = _read(found[page.name])
        parts = [f"# {page.title}", page.text, f"```sh\n{result['command']}\n```", machine_line(result) + "."]
        for ending, title, draw in page.plots:
            picture = folder / f"{page.name}{ending}.png"
            with atomic_path(picture, overwrite=True) as path:
                draw(result, path)
            written.append(picture)
            parts.append(f"![{title}]({picture.name})")
        parts += [*page.tables(result), *result["notes"]]
        written.append(_write(folder / f"{page.name}.md", parts))
        index.append({"report": f"[{page.title}]({page.name}.md)", "machine": _short_machine(result)})
    if (folder / TRIED).is_file():
        written.append(_write(folder / "tried.md", _tried_page(folder / TRIED)))
        index.append({"report": "[Tried and lost](tried.md)"})
    text = "What was measured. `sehdr-warp bench report` makes these pages of `results/*.json` and `tried.csv`."
    columns = {"report": "", "machine": ""}
    written.append(_write(folder / "README.md", ["# Reports", text, markdown_table(index, columns)]))
    return written


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


def _short_machine(result: dict) -> str:
    return (result["machine"]["gpu"] or {}).get(
        "name"
    ) or f"{result['machine']['cpu']}, {result['machine']['cores']} cores"


def _unique(rows: Iterable[dict], *fields: str) -> list[tuple]:
    return list(dict.fromkeys(tuple(row[field] for field in fields) for row in rows))


def _chosen(rows: Iterable[dict], **values) -> list[dict]:
    return [row for row in rows if all(row[field] == value for field, value in values.items())]


def _pivot(rows: Sequence[dict], place: Sequence[str], over: str, value: str) -> tuple[list[dict], list[str]]:
    """Rows of one place each, with the value of each `over` as a field of its name; and these names."""
    names = [name for (name,) in _unique(rows, over)]
    made = []
    for key in _unique(rows, *place):
        here = dict(zip(place, key, strict=True))
        made.append(here | {row[over]: row[value] for row in _chosen(rows, **here)})
    return made, names


_SIZE = {"Gaussians=gaussians": ",d", "width": "d", "height": "d"}


def _kernel_tables(result: dict) -> Iterable[str]:
    for (passing,) in _unique(result["rows"], "pass"):
        rows, names = _pivot(
            _chosen(result["rows"], **{"pass": passing}),
            ("gaussians", "width", "height", "channels"),
            "implementation",
            "median_ms",
        )
        yield f"## {passing.capitalize()}, median ms"
        yield markdown_table(rows, _SIZE | {"C=channels": "d"} | dict.fromkeys(names, ".3f"))
    yield _checks_line(result)


def _step_tables(result: dict) -> Iterable[str]:
    from .step import COLUMNS

    yield markdown_table(result["rows"], COLUMNS)
    yield _checks_line(result)


def _scale_tables(result: dict) -> Iterable[str]:
    from .scale import COLUMNS

    for (sweep,) in _unique(result["rows"], "sweep"):
        yield f"## Over {sweep}"
        yield markdown_table(_chosen(result["rows"], sweep=sweep), {k: v for k, v in COLUMNS.items() if k != "sweep"})
    yield "## Slopes of the logarithms, whole and at the large end"
    fields = ("sweep", "rasterizer=implementation", "what", "quantity")
    yield markdown_table(
        result["slopes"], dict.fromkeys(fields, "") | {"slope": ".2f", "at the large end=slope_large": ".2f"}
    )
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
    rows = result["rows"]
    places = ("scene", "curve", "exposure", "seed", "device")
    bounds = {tuple(row[p] for p in places): row["gt_max"] for row in rows if row["method"] == UPPER_BOUND}
    for curve, response in _unique([row for row in rows if row["response"] != LEARNED], "curve", "response"):
        members = [row for row in rows if row["curve"] == curve and row["response"] in (response, LEARNED)]
        yield f"## Curve {curve}, response {response}"
        table = []
        for (method,) in _unique(members, "method"):
            mine = _chosen(members, method=method)
            pairs = [(row["gt_max"], bounds.get(tuple(row[p] for p in places))) for row in mine]
            gains = [value - bound for value, bound in pairs if None not in (value, bound)]
            line = {"method": method, "n": len(mine), "worst": min(row["gt_max"] for row in mine)}
            line["to_bound"] = fmean(gains) if gains and method != UPPER_BOUND else None
            for field in (key.partition("=")[2] or key for key in _QUALITY):
                if field in mine[0] and field not in line:
                    values = [row[field] for row in mine if row[field] is not None]
                    line[field] = fmean(values) if values else None
            table.append(line)
        yield markdown_table(table, _QUALITY)
        yield "gt-max by scene and exposure, mean over seeds, dB:"
        means = []
        for key in _unique(members, "scene", "exposure", "method"):
            here = dict(zip(("scene", "exposure", "method"), key, strict=True))
            means.append(here | {"dB": fmean(row["gt_max"] for row in _chosen(members, **here))})
        by_scene, names = _pivot(means, ("scene", "exposure"), "method", "dB")
        yield markdown_table(by_scene, {"scene": "", "exposure": "d"} | dict.fromkeys(names, ".2f"))
    shared = max(row["shared_by"] for row in rows)
    if shared > 1:
        yield f"{shared} trainings shared a device: seconds and renders / s are those of a shared one."


def _response_tables(result: dict) -> Iterable[str]:
    from .response import COLUMNS

    yield markdown_table(result["rows"], COLUMNS)


def _stability_tables(result: dict) -> Iterable[str]:
    readings = [
        {"group": row["group"], "case": row["case"]} | reading | {"part": (reading["error"] or 0) / reading["bound"]}
        for row in result["rows"]
        for reading in row["readings"]
        if reading["bound"] > 0
    ]
    groups = []
    for (group,) in _unique(result["rows"], "group"):
        mine = _chosen(readings, group=group)
        cases = _chosen(result["rows"], group=group)
        line = {"group": group, "cases": len(cases), "bounds": sum(len(row["readings"]) for row in cases)}
        if mine:
            worst = max(mine, key=lambda reading: reading["part"])
            line |= {"median": median(reading["part"] for reading in mine), "worst": worst["part"]}
            line["which"] = f"{worst['case']}: {worst['quantity']}"
        groups.append(line)
    yield "Errors over their bounds:"
    yield markdown_table(
        groups, {"group": "", "cases": "d", "bounds": "d", "median": ".2f", "worst": ".2f", "which": ""}
    )
    yield markdown_table(result["rows"], {"case": "", "what": "", "note": ""})
    failed = [row["case"] for row in result["rows"] if not row["holds"]]
    yield f"Failed: {', '.join(failed)}." if failed else "All bounds hold."


def _tried_page(path: Path) -> list[str]:
    with open(path, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    columns = {"option": "", "idea": "", "gave": "", "on": ""}
    text = (
        "Ideas that were built, measured and taken out again, or never turned on. dB are differences in held-out "
        "mu-law PSNR under `gt-max` to the same training without, where nothing else is said; 0.2 dB are within chance."
    )
    parts = ["# Tried and lost", text]
    for (topic,) in _unique(rows, "topic"):
        parts += [f"## {topic}", markdown_table(_chosen(rows, topic=topic), columns)]
    return parts


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
        (("", "Held-out HDR error over training time", plots.plot_quality),),
    ),
    Page(
        "kernels",
        "The splat",
        "Projecting, ordering, binning and blending random Gaussians with colors given. *recorded*: replayed as a CUDA "
        "graph, as inside a training step; *RecordedRasterizer*: called from Python, two graphs behind each call; "
        "without a word: `rasterize()` called from Python, whose launches set the pace of small scenes on a GPU.",
        _kernel_tables,
        (("", "Median times over channels", plots.plot_kernels),),
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
        (("", "Time and peak memory over what is varied", plots.plot_scale),),
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
        (("", "Error against float64 over four axes; dotted: bounds", plots.plot_stability),),
    ),
)
