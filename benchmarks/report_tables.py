"""Tables of the pages in docs/reports, of all results but those of quality."""

import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import fmean, median, stdev
from typing import Any

from .results import COLUMNS, groups, markdown_table, parted

PAGES: dict[str, dict[str, Any]] = tomllib.loads(Path(__file__).with_name("pages.toml").read_text(encoding="utf-8"))
"""Title, text, caption and commands of each page."""


def pivot(rows: Sequence[Mapping], places: dict[str, str], over: str, value: str, form: str) -> str:
    """Return a table with a row for each place, and a column for the value of each `over`.

    places: as columns of a table.
    """
    by_place = groups(rows, *(field for _, field, _ in parted(places))).values()
    pivoted = [{**here[0], **{row[over]: row[value] for row in here}} for here in by_place]
    return markdown_table(pivoted, places | dict.fromkeys((row[over] for row in rows), form))


def median_of_runs(rows: Sequence[Mapping]) -> list[dict[str, Any]]:
    """Join the rows of several runs of `kernels`: each time is the median of the runs."""
    keys = "gaussians", "width", "height", "channels", "pass", "implementation"
    joined = []
    for key, runs in groups(rows, *keys).items():
        times = [name for name in ("median_ms", "host_ms", "device_ms") if name in runs[0]]
        joined.append(dict(zip(keys, key, strict=True)) | {name: median(run[name] for run in runs) for name in times})
    return joined


def _kernel_tables(result: dict) -> Iterable[str]:
    places = {"Gaussians=gaussians": ",d", "width": "d", "height": "d", "C=channels": "d"}
    for (passing,), rows in groups(median_of_runs(result["rows"]), "pass").items():
        yield f"## {passing.capitalize()}, median ms"
        yield pivot(rows, places, "implementation", "median_ms", ".3f")
        for key, what in (("host_ms", "of the host alone"), ("device_ms", "of the GPU's kernels alone")):
            if all(key in row for row in rows):
                yield f"### {passing.capitalize()}, ms {what}"
                yield pivot(rows, places, "implementation", key, ".3f")
    yield _checks_line(result)


def _step_tables(result: dict) -> Iterable[str]:
    yield markdown_table(result["rows"], COLUMNS["step"])
    if "parts" in result:
        yield "## Parts of the recorded step"
        yield PAGES["step"]["parts"]
        yield markdown_table(result["parts"], COLUMNS["parts"])
    yield _checks_line(result)


def _large_tables(result: dict) -> Iterable[str]:
    rows: list[Mapping] = []
    for ours, theirs in groups(result["rows"], "gaussians", "width", "height").values():
        level = next((iteration for iteration, psnr in ours["tests"] if psnr >= theirs["psnr"]), None)
        rows += [{**ours, "level_at": level}, theirs]
    yield markdown_table(rows, COLUMNS["large"] | {"no worse from=level_at": "d"})


def _checks_line(result: dict) -> str:
    passed = sum(check["passed"] for check in result["checks"])
    return f"{passed} of {len(result['checks'])} correctness checks passed."


def _seeds_tables(result: dict) -> Iterable[str]:
    table = []
    for (scene,), rows in groups(result["rows"], "scene").items():
        values = [row["gt_max"] for row in rows]
        line = {"scene": scene, "seeds": len(rows), "lights": rows[0]["lights_count"], "mean": fmean(values)}
        line |= {"lost": sum(row["lights_lost"] for row in rows), "deviation": stdev(values), "worst": min(values)}
        table.append(line | {"below": line["mean"] - line["worst"], "photos": fmean(row["ldr"] for row in rows)})
    trained, lost_lights = len(result["rows"]), sum(line["lost"] for line in table)
    yield f"{trained} trainings lost {lost_lights} of {sum(row['lights_count'] for row in result['rows'])} lights."
    yield markdown_table(table, PAGES["seeds"]["columns"])
    # Sets that are not part of the project have seeds of their own.
    own = [row for row in result["rows"] if not row["scene"].startswith("room_")]
    values = [fmean(row["gt_max"] for row in rows) for rows in groups(own, "seed").values()]
    yield (
        f"The mean over the {len(groups(own, 'scene'))} scenes of the project, of {len(values)} seeds: "
        f"{fmean(values):.2f} dB, deviation {stdev(values):.2f}, the worst {fmean(values) - min(values):.2f} below."
    )


def _readings_tables(result: dict) -> Iterable[str]:
    page, table = PAGES["readings"], []
    for (method, truth), rows in groups(result["rows"], "method", "sees_truth").items():
        line = {"method": method, "truth": "with" if truth else "without", "reads": page["reads"][method]}
        line |= {row["scene"]: row["gt_max"] for row in rows}
        table.append(
            line | {name: fmean(row[name] for row in rows) for name in ("gt_max", "self_max", "aligned", "ldr")}
        )
    table.sort(key=lambda line: (line["truth"] == "with", -line["gt_max"]))
    yield markdown_table(table, page["columns"])
    for truth, published in page["published"].items():
        least = {}
        for protocol in ("gt_max", "self_max", "aligned"):
            mine = [line for line in table if line["truth"] == truth]
            nearest = min(mine, key=lambda line: abs(line[protocol] - published))
            least[protocol] = f"`{nearest['method']}` under {protocol.replace('_', '-')} ({nearest[protocol]:.1f} dB)"
        yield f"Nearest to the published {published} dB, {truth} truth: {', '.join(least.values())}."


def _bits_tables(result: dict) -> Iterable[str]:
    rows, names = result["rows"], {"hdr": "HDR dB", "well_exposed": "well-exposed dB", "dark": "dark dB"}
    table = []
    for (exposure, kind, noise, bits), mine in groups(rows, "exposure", "kind", "noise", "bits").items():
        line = {"exposure": exposure, "photos": f"{bits} bits, {kind}", "noise": noise}
        table.append(line | {title: fmean(row[field] for row in mine) for field, title in names.items()})
    yield markdown_table(table, {"exposure": "d", "photos": "", "noise": ""} | dict.fromkeys(names.values(), ".2f"))
    yield "HDR dB of each scene:"
    places = {"exposure": "d", "rounded as=kind": "", "noise": "", "bits": "d"}
    yield pivot(rows, places, "scene", "hdr", ".2f")


def _phone_tables(result: dict) -> Iterable[str]:
    titles = {
        "three-channels": "gain map, three channels",
        "one-channel": "one channel",
        "libultrahdr": "libultrahdr",
        "darker-jpeg": "two stops darker, JPEG",
        "darker-png": "PNG",
    }
    table = []
    for (size, scene), rows in groups(result["rows"], "size", "scene").items():
        kinds = groups(rows, "photos").items()
        means = {titles[photos]: fmean(row["hdr"] for row in mine) for (photos,), mine in kinds}
        table.append({"pixels": size, "scene": scene} | means)
    yield markdown_table(table, {"pixels": "d", "scene": ""} | dict.fromkeys(titles.values(), ".2f"))


def _rows_table(name: str, result: dict) -> Iterable[str]:
    yield markdown_table(result["rows"], COLUMNS[name])
    if result.get("checks"):
        yield _checks_line(result)


def _captures_tables(result: dict) -> Iterable[str]:
    figures = ("psnr", "best", "psnr_fitted", "ssim", "lpips", "seconds", "reached", "memory", "gaussians")
    for (part,), part_rows in groups([{"part": None} | row for row in result["rows"]], "part").items():
        if part:
            yield f"## {part}"
        table = []
        for rows in groups(part_rows, "capture", "size", "method", "iterations").values():
            columns = [name for name in figures if all(row.get(name) is not None for row in rows)]
            means = {name: fmean(row[name] for row in rows) for name in columns}
            spread = stdev(row["psnr"] for row in rows) if len(rows) > 1 else None
            means["gaussians"] = round(means["gaussians"])
            table.append(dict.fromkeys(figures) | {**rows[0], **means, "seeds": len(rows), "spread": spread})
        yield markdown_table(table, COLUMNS["captures"])


def _stability_tables(result: dict) -> Iterable[str]:
    lines = []
    for (group,), cases in groups(result["rows"], "group").items():
        readings = [(case["case"], reading) for case in cases for reading in case["readings"]]
        parts = [((r["error"] or 0) / r["bound"], f"{case}: {r['quantity']}") for case, r in readings if r["bound"] > 0]
        line = {"group": group, "cases": len(cases), "bounds": len(readings)}
        if parts:
            line["worst"], line["which"] = max(parts, key=lambda part: part[0])
            line["median"] = median(part for part, _ in parts)
        lines.append(line)
    failed = [row["case"] for row in result["rows"] if not row["holds"]]
    yield "Errors divided by their bounds:"
    columns = {"group": "", "cases": "d", "bounds": "d", "median": ".2f", "worst": ".2f", "which": ""}
    yield markdown_table(lines, columns)
    yield markdown_table(result["rows"], {"case": "", "what": "", "note": ""})
    yield f"Failed: {', '.join(failed)}." if failed else "All bounds hold."


def trial_table(rows: Iterable[Mapping]) -> tuple[list[dict], dict[str, str]]:
    """Return the families of the trial and their sum, and the columns that they have."""
    ordered = sorted((dict(row) for row in rows), key=lambda row: row["family"])
    counts = ("cases", "tracebacks", "hangs", "programs", "lost")
    total = {name: sum(row[name] for row in ordered) for name in (*counts, "seconds")}
    total |= {"family": "all", "longest": max(row["longest"] for row in ordered)}
    columns = {"family": "", **dict.fromkeys(counts, "d"), "seconds": ".0f", "longest": ".1f", "MiB=memory": ""}
    return [*ordered, total], columns


def _trust_tables(result: dict) -> Iterable[str]:
    yield f"## The trial, seed {result['seed']}"
    yield markdown_table(*trial_table(result["rows"]))
    if "outsider" in result:
        counts = ("cases", "held", "mended", "failing")
        rows = [dict(row) for row in result["outsider"]]
        total = {"family": "all"} | {name: sum(row[name] for row in rows) for name in counts}
        yield "## Independent cases"
        yield "Written by someone who knew neither the code nor the trial. *failing*: after the corrections."
        columns = {"family": "", "cases": "d", "passed=held": "d", "corrected=mended": "d", "failing": "d", "found": ""}
        yield markdown_table([*rows, total], columns)
    if "fuzz" in result:
        counts, rows = ("inputs", "findings"), []
        for (reader,), each in groups(result["fuzz"], "reader").items():
            seeds = ", ".join(map(str, sorted({row["seed"] for row in each})))
            rows.append({"reader": reader, "seeds": seeds} | {name: sum(row[name] for row in each) for name in counts})
        rows.append({"reader": "all"} | {name: sum(row[name] for row in rows) for name in counts})
        yield "## Damaged files"
        yield "Made by `python -m tests.fuzz`. A finding is anything but a normal read or a refusal in one line."
        yield markdown_table(rows, {"reader": "", "inputs": ",d", "seeds": "", "findings": "d"})


def _relight_tables(result: dict) -> Iterable[str]:
    rows = [row | {"lit by": f"{row['method']}, {row['by']}"} for row in result["rows"]]
    for title, field, form in (
        ("Difference of pixels, over the mean of the truth", "off", ".0%"),
        ("Light of all pixels, over that of the truth", "energy", ".2f"),
    ):
        yield f"## {title}"
        yield pivot(rows, {"room=scene": "", "exposure": "d"}, "lit by", field, form)


TABLES: dict[str, Callable[[dict], Iterable[str]]] = {
    "relight": _relight_tables,
    "seeds": _seeds_tables,
    "readings": _readings_tables,
    "captures": _captures_tables,
    "units": partial(_rows_table, "units"),
    "bits": _bits_tables,
    "phone": _phone_tables,
    "files": partial(_rows_table, "files"),
    "panorama": partial(_rows_table, "panorama"),
    "kernels": _kernel_tables,
    "step": _step_tables,
    "cores": partial(_rows_table, "workers"),
    "gpus": partial(_rows_table, "workers"),
    "large": _large_tables,
    "blocks": partial(_rows_table, "blocks"),
    "response": partial(_rows_table, "response"),
    "stability": _stability_tables,
    "trust": _trust_tables,
}
"""Functions by the name of a page: each returns the paragraphs below the plot, from the result."""
