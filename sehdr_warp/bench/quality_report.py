"""The figures of `bench quality`: all results in one file, means over jobs as tables, differences to the upper bound
and of each variant to its base."""

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import fmean

from ..errors import InputError
from ..files import atomic_path
from .methods import METHODS, UPPER_BOUND
from .quality_jobs import LEARNED
from .quality_plot import plot_error_over_time
from .quality_rows import axes, by_table, collect, exposure, grouped, iterations, knowledge, line_name, method, newest
from .report import markdown_table

RESULTS, TABLES, PLOT = "results.jsonl", "quality.md", "error-over-time-{}.png"
_PROTOCOLS = ("gt-max", "self-max", "aligned")
_REGIONS = ("clipped", "well-exposed", "dark")
_MIB = 2.0**20


def write_quality_report(out: Path) -> str:
    """Writes results.jsonl, quality.md and a plot for each kind of device from the job folders; returns the tables.

    All are replaced: the folders hold the truth. A result that was cut short counts as one that is not there.
    """
    rows, failures = collect(out)
    notes = []
    rows, outdated = newest(rows)
    if outdated:
        notes.append(f"{outdated} results of configs that have changed since are left out.")
    with atomic_path(out / RESULTS, overwrite=True) as path:
        path.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    text = format_tables(rows, failures, notes)
    with atomic_path(out / TABLES, overwrite=True) as path:
        path.write_text(text + "\n", encoding="utf-8")
    for device in sorted({row["config"]["device"] for row in rows}):
        with atomic_path(out / PLOT.format({"cuda": "gpu"}.get(device, device)), overwrite=True) as path:
            plot_error_over_time([row for row in rows if row["config"]["device"] == device], path)
    return text


def write_scenes_report(out: Path, scenes: Sequence[str]) -> str:
    """Writes the tables of these scenes alone as quality-SCENES.md, and returns them: a method that was tuned on some
    scenes is judged on others. Names are those in the tables; `embedded:` may be left out.

    Raises InputError for a scene of which there is no result.
    """
    rows, outdated = newest(collect(out)[0])
    there = {_scene(row) for row in rows}
    names = [name if name in there else f"embedded:{name}" for name in scenes]
    for asked, name in zip(scenes, names, strict=True):
        if name not in there:
            raise InputError(out, f"has no result of scene {asked}", f"choose from {', '.join(sorted(there))}")
    notes = [f"{outdated} results of configs that have changed since are left out."] if outdated else []
    text = format_tables([row for row in rows if _scene(row) in names], [], notes)
    short = "-".join(re.sub(r"[^A-Za-z0-9.]+", "-", name.removeprefix("embedded:")) for name in names)
    with atomic_path(out / f"quality-{short[:100]}.md", overwrite=True) as path:
        path.write_text(text + "\n", encoding="utf-8")
    return text


def _scene(row: dict) -> str:
    return row["config"]["scene"]["name"]


def format_tables(rows: Sequence[dict], failures: Sequence[tuple[str, str]], notes: Sequence[str] = ()) -> str:
    """Markdown: for each device, curve and knowledge of the response one table each of HDR figures, of these by
    exposure where there are several, of regions and of costs; the variants against their bases; failures."""
    parts = [_heading(rows)]
    bound = _upper_bound(rows)
    for (device, curve, response), members in by_table(rows).items():
        parts.append(f"## {device}, {curve}, response {response}")
        methods = _by_method(members)
        for titles, line in (
            (_HDR_TITLES, _hdr_line),
            (_REGION_TITLES, _region_line),
            (_COST_TITLES, _cost_line),
        ):
            parts.append(markdown_table(titles, [[name, *line(items, bound)] for name, items in methods.items()]))
            if line is _hdr_line:
                parts += _by_exposure(methods, bound)
        variants = [_ablation_line(name, items, members) for name, items in methods.items() if _base(items[0])]
        if variants:
            parts += ["Variants, difference to their base:", markdown_table(_ABLATION_TITLES, variants)]
    if failures:
        parts.append(f"{len(failures)} failed:\n\n" + "\n".join(f"- {label}: {error}" for label, error in failures))
    return "\n\n".join([*parts, *_notes(rows), *notes])


def _by_method(rows: Sequence[dict]) -> dict[str, list[dict]]:
    """Rows by method and length, in the order of METHODS, variants after their base."""
    order = list(METHODS)

    def place(row):
        base = _base(row) or method(row)
        return (
            order.index(base) if base in order else len(order),
            base,
            method(row) != base,
            method(row),
            iterations(row),
        )

    found = grouped(rows, place)
    return {line_name(items[0], rows): items for items in found.values()}


def _upper_bound(rows: Sequence[dict]) -> dict[tuple, dict]:
    """U for each set of photos: of several lengths the best under gt-max."""
    gain = _hdr("gt-max", "psnr_mu")
    found = [row for row in rows if method(row) == UPPER_BOUND and gain(row) is not None]
    return {axes(row): row for row in sorted(found, key=gain)}


def _base(row: dict) -> str | None:
    return row["config"]["method"]["base"]


def _hdr(name: str, key: str) -> Callable[[dict], float | None]:
    return lambda row: row["figures"]["protocol"][name].get(key)


def _region(region: str) -> Callable[[dict], float | None]:
    return lambda row: row["figures"]["regions"][region]["psnr_mu"].get("aligned")


def _figure(*keys: str) -> Callable[[dict], float | None]:
    def take(row):
        value = row["figures"]
        for key in keys:
            value = value[key]
        return value

    return take


_HDR_TITLES = ["method", "jobs", "gt-max", "worst", "SSIM", "LPIPS", "to U", "self-max", "SSIM", "LPIPS", "aligned",
               "worst", "SSIM", "LPIPS", "to U", "PU21", "FLIP"]  # fmt: skip


def _hdr_line(rows: list[dict], bound: dict) -> list[str]:
    cells = [str(len(rows))]
    for name in _PROTOCOLS:
        psnr = _hdr(name, "psnr_mu")
        cells += [_mean(rows, psnr), _worst(rows, psnr)] if name != "self-max" else [_mean(rows, psnr)]
        cells += [_mean(rows, _hdr(name, "ssim_mu"), 4), _mean(rows, _hdr(name, "lpips_mu"), 3)]
        if name != "self-max":
            cells.append(_difference(rows, bound, psnr))
    return [*cells, _mean(rows, _figure("pu21", "aligned", "psnr")), _mean(rows, _hdr("aligned", "hdr_flip"), 3)]


def _by_exposure(methods: dict[str, list[dict]], bound: dict) -> list[str]:
    """A table for each protocol with an absolute or fitted scale, a column for each exposure; none for one exposure."""
    places = sorted({exposure(row) for rows in methods.values() for row in rows})
    if len(places) < 2:
        return []
    tables = []
    for name in ("gt-max", "aligned"):
        lines = [[line, *_exposure_cells(rows, bound, places, _hdr(name, "psnr_mu"))] for line, rows in methods.items()]
        titles = [f"{name} (to U)", *(f"exposure {place}" for place in places)]
        tables.append(markdown_table(titles, lines))
    return tables


def _exposure_cells(rows: list[dict], bound: dict, places: Sequence[int], psnr) -> list[str]:
    cells = []
    for place in places:
        there = [row for row in rows if exposure(row) == place]
        gain = _difference(there, bound, psnr)
        cells.append(_mean(there, psnr) + ("" if gain == "-" else f" ({gain})"))
    return cells


_REGION_TITLES = ["method", *(f"{name}{what}" for name in _REGIONS for what in ("", ", to U", ", share")),
                  "LDR", "LDR SSIM", "confidence"]  # fmt: skip


def _region_line(rows: list[dict], bound: dict) -> list[str]:
    cells = []
    for region in _REGIONS:
        share = _mean(rows, lambda row, region=region: 100 * row["figures"]["regions"][region]["fraction"], 1)
        there = [row for row in rows if row["figures"]["regions"][region]["fraction"] > 0]
        cells += [_mean(there, _region(region)), _difference(rows, bound, _region(region)), f"{share} %"]
    cells += [_mean(rows, _figure("ldr", "psnr")), _mean(rows, _figure("ldr", "ssim"), 4)]
    return [*cells, _mean(rows, lambda row: row["figures"].get("confidence", {}).get("spearman_log2"))]


_COST_TITLES = ["method", "seconds", "most", "to 0.1 dB", "peak MiB", "Gaussians", "renders / s"]


def _cost_line(rows: list[dict], bound: dict) -> list[str]:
    def memory(row):
        peak = row["figures"]["peak_memory_bytes"]
        return None if peak is None else peak / _MIB

    seconds = _figure("train_seconds")
    return [
        _mean(rows, seconds, 1),
        _number(max(seconds(row) for row in rows), 1),
        _mean(rows, _figure("seconds_to_final"), 1),
        _mean(rows, memory, 0),
        _mean(rows, _figure("gaussians"), 0),
        _mean(rows, _figure("render_fps"), 0),
    ]


_ABLATION_TITLES = [
    "variant",
    "base",
    "pairs",
    "gt-max",
    "worst",
    "aligned",
    "worst",
    *_REGIONS,
    "LDR",
    "seconds",
    "what",
]


def _ablation_line(name: str, rows: list[dict], members: Sequence[dict]) -> list[str]:
    base = _base(rows[0])
    others = {(axes(row), iterations(row)): row for row in members if method(row) == base}
    if all(iterations(row) != length for row in rows for _, length in others):
        # The variant is another length of its base.
        others = {(key, iterations(rows[0])): row for (key, _), row in others.items()}
    keys = [(row, (axes(row), iterations(row))) for row in rows]
    pairs = [(row, others[key]) for row, key in keys if key in others]
    cells = [name, base, str(len(pairs))]
    for psnr in (_hdr("gt-max", "psnr_mu"), _hdr("aligned", "psnr_mu")):
        cells += [_gain(pairs, psnr), _gain(pairs, psnr, min)]
    cells += [_gain(pairs, _region(region)) for region in _REGIONS]
    cells += [_gain(pairs, _figure("ldr", "psnr")), _gain(pairs, _figure("train_seconds"))]
    changed = ", ".join(
        f"{key} = {json.dumps(value)}" for key, value in rows[0]["config"]["method"]["overrides"].items()
    )
    return [*cells, changed]


def _gain(pairs, figure, summary=fmean) -> str:
    values = [figure(row) - figure(other) for row, other in pairs if None not in (figure(row), figure(other))]
    return f"{summary(values):+.2f}" if values else "-"


def _difference(rows: list[dict], bound: dict, figure) -> str:
    """The mean difference to the upper bound on the same photos and views, dB."""
    return _gain([(row, bound[axes(row)]) for row in rows if axes(row) in bound], figure)


def _values(rows, figure) -> list[float]:
    return [value for value in map(figure, rows) if value is not None]


def _mean(rows, figure, digits: int = 2) -> str:
    values = _values(rows, figure)
    # A mean over some of the jobs would stand beside means over all of them.
    return _number(fmean(values), digits) if values and len(values) == len(rows) else "-"


def _worst(rows, figure) -> str:
    values = _values(rows, figure)
    return _number(min(values), 2) if values and len(values) == len(rows) else "-"


def _number(value: float, digits: int) -> str:
    return f"{value:,.{digits}f}"


def _heading(rows: Sequence[dict]) -> str:
    if not rows:
        return "# Quality\n\nThere are no results."
    scenes = sorted({row["config"]["scene"]["name"] for row in rows})
    dates = sorted(row["date"][:10] for row in rows)
    machines = sorted({(row["machine"]["gpu"] or {}).get("name") or row["machine"]["cpu"] or "CPU" for row in rows})
    return (
        f"# Quality\n\n{len(rows)} trainings on {len(scenes)} scenes ({', '.join(scenes)}), {dates[0]} to {dates[-1]}; "
        f"{', '.join(machines)}; sehdr-warp {', '.join(sorted({str(row['version']) for row in rows}))}.\n\n"
        "PSNR in dB of mu-law values (gt-max, self-max, aligned), of PU21 values (aligned scale) and of the simulated "
        "photo (LDR), means over jobs; *worst* is that of the worst job; *to U* the mean difference to 3DGS trained on "
        "the HDR truth of the same scenes and views; regions are of the photo, aligned; *confidence* is the rank "
        "correlation of 1 - confidence with the error in stops."
    )


def _notes(rows: Sequence[dict]) -> list[str]:
    notes = []
    learned = sorted({method(row) for row in rows if knowledge(row) == LEARNED})
    if learned:
        names = ", ".join(learned)
        notes.append(f"Learn the response with the scene, so one training stands under known and under blind: {names}.")
    shared = max((row["shared_by"] for row in rows), default=1)
    if shared > 1:
        notes.append(f"Up to {shared} trainings shared a device: seconds and renders / s are those of a shared one.")
    reasons = [
        values[key]
        for row in rows
        for values in row["figures"]["protocol"].values()
        for key in ("lpips_reason", "flip_reason")
        if key in values
    ]
    return notes + [f"-: {reason}." for reason in dict.fromkeys(reasons)]
