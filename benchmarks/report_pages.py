"""Write the pages and plots of docs/reports from the results stored there. Nothing in them is typed by hand.

python -m benchmarks.report_pages
"""

import csv
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import fmean, median, stdev
from typing import Any

from sehdr_warp.errors import InputError
from sehdr_warp.files import atomic_path, read_json

from . import report_plots as plots
from .quality import EXPOSURES, KNOWN, LEARNED, UPPER_BOUND
from .results import COLUMNS, groups, machine_line, markdown_table, parted

ROOT = Path(__file__).resolve().parents[1]
REPORTS = ROOT / "docs" / "reports"
PAGES: dict[str, dict[str, Any]] = tomllib.loads(Path(__file__).with_name("pages.toml").read_text(encoding="utf-8"))
"""Title, text, caption and commands of each page."""
FIRST_TITLE = "trained by"  # Of the README's table
NOTHING_CLIPS = 0.001  # Of the pixels


def write_reports(folder: Path) -> list[Path]:
    """Write a page, with its plot, for each result in folder/results and for folder/tried.csv, and an index.

    Raises InputError for a folder without results, and for a result that cannot be read.
    """
    result_files = {name: path for name in PAGES if (path := folder / "results" / f"{name}.json").is_file()}
    if not result_files:
        raise InputError(folder, "holds no results", "store them as results/*.json")
    pages, index = [], []
    for name, path in result_files.items():
        page, result = PAGES[name], _read(path)
        parts = [f"# {page['title']}", page["text"], f"```sh\n{result['command']}\n```"]
        parts += [f"Measure again: `python -m benchmarks.measure {name}`."] if "command" in page else []
        parts += [machine_line(result) + "."]
        if name in PLOTS:
            pages.append(folder / f"{name}.png")
            with atomic_path(pages[-1], ours=True) as temporary:
                PLOTS[name](result, temporary)
        if "caption" in page and (folder / f"{name}.png").is_file():
            parts.append(f"![{page['caption']}]({name}.png)")
        pages.append(_write(folder / f"{name}.md", [*parts, *TABLES[name](result), *result["notes"]]))
        machine = result["machine"]
        place = machine["gpu"]["name"] if machine["gpu"] else f"{machine['cpu']}, {machine['cores']} cores"
        build = machine.get("build")
        index.append({"report": f"[{page['title']}]({name}.md)", "machine": place, "build": build})
    if (folder / "tried.csv").is_file():
        pages.append(_write(folder / "tried.md", _tried_page(folder / "tried.csv")))
        index.append({"report": "[Negative results](tried.md)"})
    text = (
        "What was measured. `python -m benchmarks.measure PAGE` measures a page again. "
        "`python -m benchmarks.report_pages` writes pages and the README's table from the results."
    )
    table = markdown_table(index, {"report": "", "machine": "", "build": ""})
    return [*pages, _write(folder / "README.md", ["# Reports", text, table])]


def _read(path: Path) -> dict:
    result = read_json(path)
    if missing := {"command", "machine", "date", "rows", "notes"} - result.keys():
        raise InputError(path, f"is no result (lacks {min(missing)})", "write it with --json of a benchmark")
    return result


def _write(path: Path, parts: Sequence[str]) -> Path:
    with atomic_path(path, ours=True) as temporary:
        temporary.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    return path


def _pivot(rows: Sequence[Mapping], places: dict[str, str], over: str, value: str, form: str) -> str:
    """Return a table with a row for each place, and a column for the value of each `over`.

    places: as columns of a table.
    """
    fields = [field for _, field, _ in parted(places)]
    row_groups = groups(rows, *fields).items()
    pivoted = [
        dict(zip(fields, key, strict=True)) | {row[over]: row[value] for row in here} for key, here in row_groups
    ]
    return markdown_table(pivoted, places | dict.fromkeys((row[over] for row in rows), form))


def _kernel_tables(result: dict) -> Iterable[str]:
    places = {"Gaussians=gaussians": ",d", "width": "d", "height": "d", "C=channels": "d"}
    for (passing,), rows in groups(result["rows"], "pass").items():
        yield f"## {passing.capitalize()}, median ms"
        yield _pivot(rows, places, "implementation", "median_ms", ".3f")
        for key, what in (("host_ms", "of the host alone"), ("device_ms", "of the GPU's kernels alone")):
            if all(key in row for row in rows):
                yield f"### {passing.capitalize()}, ms {what}"
                yield _pivot(rows, places, "implementation", key, ".3f")
    yield _checks_line(result)


def _step_tables(result: dict) -> Iterable[str]:
    yield markdown_table(result["rows"], COLUMNS["step"])
    if "parts" in result:
        yield "## Parts of the recorded step"
        yield PAGES["step"]["parts"]
        yield markdown_table(result["parts"], COLUMNS["parts"])
    yield _checks_line(result)


def _scale_tables(result: dict) -> Iterable[str]:
    columns = {key: form for key, form in COLUMNS["scale"].items() if key != "sweep"}
    for (sweep,), rows in groups(result["rows"], "sweep").items():
        yield f"## Over {sweep}"
        yield markdown_table(rows, columns)
    yield "## Slopes of the logarithms, whole and at the large end"
    columns = dict.fromkeys(("sweep", "rasterizer=implementation", "what", "quantity"), "")
    yield markdown_table(result["slopes"], columns | {"slope": ".2f", "at the large end=slope_large": ".2f"})
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


def _quality_tables(result: dict) -> Iterable[str]:
    rows, columns, places = result["rows"], PAGES["quality"]["means"], ("scene", "curve", "exposure", "seed", "device")
    bounds = groups([row for row in rows if row["method"] == UPPER_BOUND], *places)
    for row in rows:
        (bound, *_) = bounds.get(tuple(row[field] for field in places), [row])
        row["to_bound"] = None if bound is row else row["gt_max"] - bound["gt_max"]
    yield "## In short: the middle exposure, one seed, the curve known"
    yield markdown_table(in_short(rows), SHORT)
    known_rows = [row for row in rows if row["response"] in (KNOWN, LEARNED)]
    yield from _irradiance_tables(known_rows)
    yield from _energy_tables(known_rows)
    for curve, response in groups([row for row in rows if row["response"] != LEARNED], "curve", "response"):
        members = [row for row in rows if row["curve"] == curve and row["response"] in (response, LEARNED)]
        table = []
        for (method,), mine in groups(members, "method").items():
            line = {"method": method, "n": len(mine), "worst": min(row["gt_max"] for row in mine)}
            line |= {name: sum(row[name] for row in mine) for name in ("lights_count", "lights_lost")}
            seeds = [[row["gt_max"] for row in here] for here in groups(mine, "scene", "exposure").values()]
            if max(map(len, seeds)) > 1:
                line["below_mean"] = max(fmean(values) - min(values) for values in seeds)
            for _, field, _ in parted(columns):
                values = [row[field] for row in mine if field not in line and row.get(field) is not None]
                line |= {field: fmean(values)} if values else {}
            table.append(line)
        yield f"## Curve {curve}, response {response}"
        yield markdown_table(table, columns)
        yield "gt-max by scene and exposure, mean over seeds, dB:"
        fields = ("scene", "exposure", "method")
        means = [
            dict(zip(fields, key)) | {"dB": fmean(row["gt_max"] for row in here)}
            for key, here in groups(members, *fields).items()
        ]
        yield _pivot(means, {"scene": "", "exposure": "d"}, "method", "dB", ".2f")
        yield from _whole_by_seed(members)
    shared = max(row["shared_by"] for row in rows)
    if shared > 1:
        yield f"{shared} trainings shared a device: seconds and renders / s are those of a shared one."


def _whole_by_seed(rows: Sequence[Mapping]) -> Iterable[str]:
    """Return the mean over scenes and exposures of each seed that has them all, if several have."""
    places, table = groups(rows, "scene", "exposure").keys(), []
    for (method, seed), mine in sorted(groups(rows, "method", "seed").items()):
        if groups(mine, "scene", "exposure").keys() == places:
            away = [row["to_bound"] for row in mine if row["to_bound"] is not None]
            line = {"method": method, "seed": seed, "gt-max dB": fmean(row["gt_max"] for row in mine)}
            table.append(line | {"to U": fmean(away) if away else None})
    if len({line["seed"] for line in table}) > 1:
        yield "Means over all scenes and exposures, by seed:"
        yield markdown_table(table, {"method": "", "seed": "d", "gt-max dB": ".2f", "to U": "+.2f"})


SHORT = {"method": "", "HDR dB": ".1f", "photos dB": ".1f", "lost": "", "irradiance off": ".0%", "worst room": ".0%"}
SHORT |= {"light energy": ".2f", "5th to 95th percentile": ""}


def in_short(rows: Sequence[Mapping]) -> list[dict]:
    """Return a row for each method: means over scenes of one seed at the middle exposure, with the curve known.

    "irradiance off" is a mean over scenes, and "worst room" the largest; "light energy" is the median over lights that
    clip, and "5th to 95th percentile" the range of the 5th to the 95th percentile. None and a dash without figures.
    """
    middle = [row for row in rows if (row["exposure"], row["seed"]) == (EXPOSURES // 2, rows[0]["seed"])]
    return [
        {
            "method": method,
            "HDR dB": fmean(row["gt_max"] for row in mine),
            "photos dB": fmean(row["ldr"] for row in mine),
            "lost": f"{sum(row['lights_lost'] for row in mine)} of {sum(row['lights_count'] for row in mine)} lights",
            "irradiance off": _over_rows(mine, "irradiance", fmean),
            "worst room": _over_rows(mine, "irradiance", max),
            **_light_energy(mine),
        }
        for (method, response), mine in groups(middle, "method", "response").items()
        if response in (KNOWN, LEARNED)
    ]


def _over_rows(rows: Sequence[Mapping], field: str, summary: Callable[[list[float]], float]) -> float | None:
    """Return the summary of a field over the rows that have it; None if none has."""
    values = [row[field] for row in rows if row.get(field) is not None]
    return summary(values) if values else None


def _light_energy(rows: Sequence[Mapping]) -> dict[str, Any]:
    """Return the median and the range of the energy of lights that clip, as in_short() has them."""
    energies = sorted(energy for row in rows for energy in row.get("light_energies") or ())
    if not energies:
        return {"light energy": None, "5th to 95th percentile": "-"}
    low, high = (energies[round(part * (len(energies) - 1))] for part in (0.05, 0.95))
    return {"light energy": median(energies), "5th to 95th percentile": f"{low:.2f} to {high:.2f}"}


def _energy_tables(rows: Sequence[Mapping]) -> Iterable[str]:
    """Energy of the lights that clip, by method and exposure."""
    table = []
    for (method, exposure), mine in sorted(groups(rows, "method", "exposure").items()):
        energies = [energy for row in mine for energy in row.get("light_energies") or ()]
        if energies:
            near = (sum(0.5 <= energy <= 2 for energy in energies)) / len(energies)
            counts = {
                "lost": sum(row["lights_lost"] for row in mine),
                "lights": sum(row["lights_count"] for row in mine),
            }
            table.append({"method": method, "exposure": exposure, "n": len(energies), "near": near} | counts)
            table[-1] |= _light_energy(mine)
    if table:
        yield "## Energy of the lights that photos clip, over the truth's"
        columns = {"method": "", "exposure": "d", "lights that clip=n": "d", "median=light energy": ".2f"}
        columns |= {"percentiles=5th to 95th percentile": "", "half to twice=near": ".0%"}
        columns |= {"all lights=lights": "d", "lost": "d"}
        yield markdown_table(table, columns)


def _irradiance_tables(rows: Sequence[Mapping]) -> Iterable[str]:
    """Error of the light on surfaces, by what clips."""
    rows = [row for row in rows if row.get("irradiance") is not None]
    if not rows:
        return
    yield "## Irradiance: off by, and what the photos clip"
    medians = []
    for (method,), mine in groups(rows, "method").items():
        whole = [row["irradiance"] for row in mine if row["clipped_share"] < NOTHING_CLIPS]
        medians += [f"{method} {median(whole):.1%} ({len(whole)} trainings)"] if whole else []
    if medians:
        yield f"Where less than {NOTHING_CLIPS:.1%} of the pixels clip, in the median: {', '.join(medians)}."
    means = [
        {"scene": scene, "exposure": exposure, "method": method, "off": fmean(row["irradiance"] for row in here)}
        for (scene, exposure, method), here in groups(rows, "scene", "exposure", "method").items()
    ]
    clipped = [
        {"scene": row["scene"], "exposure": row["exposure"], "method": "clipped pixels", "off": row["clipped_share"]}
        for row in {(row["scene"], row["exposure"]): row for row in rows}.values()
    ]
    yield _pivot([*clipped, *means], {"scene": "", "exposure": "d"}, "method", "off", ".1%")


def write_readme(path: Path, result: dict) -> None:
    """Write the figures of the page of quality into the table of the README."""
    text, table = path.read_text(encoding="utf-8"), readme_table(result["rows"])
    start = text.index(f"| {FIRST_TITLE} |")
    with atomic_path(path, ours=True) as temporary:
        temporary.write_text(text[:start] + table + text[text.index("\n\n", start) :], encoding="utf-8")


def readme_table(rows: Sequence[Mapping]) -> str:
    """Return the rows of in_short() that the README shows, as Markdown; figures that no row has are left out."""
    labels = PAGES["quality"]["readme"]
    short = {row["method"]: row for row in in_short(rows) if row["method"] in labels}
    irradiance = any(row["irradiance off"] is not None for row in short.values())
    titles = [FIRST_TITLE, "HDR", "photos", "lights below half", *["irradiance off: mean, worst"] * irradiance]
    titles += ["light energy: median, 5th to 95th percentile"]
    lines = []
    for method, label in labels.items():
        if (row := short.get(method)) is None:
            continue
        off = "-" if row["irradiance off"] is None else f"{row['irradiance off']:.0%}, {row['worst room']:.0%}"
        energy = "-" if row["light energy"] is None else f"{row['light energy']:.2f}, {row['5th to 95th percentile']}"
        lights_lost = row["lost"].removesuffix(" lights")
        cells = [
            label,
            f"{row['HDR dB']:.1f} dB",
            f"{row['photos dB']:.1f} dB",
            lights_lost,
            *[off] * irradiance,
            energy,
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([f"| {' | '.join(titles)} |", f"| ---{' | -:' * (len(titles) - 1)} |", *lines])


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
    yield _pivot(rows, places, "scene", "hdr", ".2f")


def _rows_table(name: str, result: dict) -> Iterable[str]:
    yield markdown_table(result["rows"], COLUMNS[name])
    if result.get("checks"):
        yield _checks_line(result)


def _captures_tables(result: dict) -> Iterable[str]:
    table, figures = [], ("psnr", "best", "psnr_fitted", "ssim", "lpips", "seconds", "memory", "gaussians")
    for rows in groups(result["rows"], "capture", "size", "method", "iterations").values():
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
    yield "Errors over their bounds:"
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
    if "fuzz" in result:
        rows = []
        for (reader,), each in groups(result["fuzz"], "reader").items():
            seeds = ", ".join(str(seed) for seed in sorted({row["seed"] for row in each}))
            rows.append(
                {"reader": reader, "seeds": seeds} | {n: sum(r[n] for r in each) for n in ("inputs", "findings")}
            )
        sums = {name: sum(row[name] for row in rows) for name in ("inputs", "findings")}
        yield "## Damaged files"
        yield "Made by `python -m tests.fuzz`. A finding is anything but a refusal in one line."
        yield markdown_table(
            [*rows, {"reader": "all"} | sums], {"reader": "", "inputs": ",d", "seeds": "", "findings": "d"}
        )


def _relight_tables(result: dict) -> Iterable[str]:
    rows = [row | {"lit by": f"{row['method']}, {row['by']}"} for row in result["rows"]]
    for title, field, form in (("Pixels, mean difference over the mean", "off", ".0%"), ("Light", "energy", ".2f")):
        yield f"## {title} of the truth"
        yield _pivot(rows, {"room=scene": "", "exposure": "d"}, "lit by", field, form)


TABLES: dict[str, Callable[[dict], Iterable[str]]] = {
    "relight": _relight_tables,
    "quality": _quality_tables,
    "seeds": _seeds_tables,
    "seeds-cpu": _seeds_tables,
    "readings": _readings_tables,
    "captures": _captures_tables,
    "units": partial(_rows_table, "units"),
    "bits": _bits_tables,
    "panorama": partial(_rows_table, "panorama"),
    "kernels": _kernel_tables,
    "step": _step_tables,
    "scale": _scale_tables,
    "cores": partial(_rows_table, "workers"),
    "gpus": partial(_rows_table, "workers"),
    "large": _large_tables,
    "response": partial(_rows_table, "response"),
    "stability": _stability_tables,
    "trust": _trust_tables,
}
PLOTS: dict[str, Callable[[dict, Path], None]] = {
    "quality": plots.plot_quality,
    "kernels": plots.plot_kernels,
    "scale": plots.plot_scale,
}


def _tried_page(path: Path) -> list[str]:
    with open(path, newline="", encoding="utf-8") as file:
        topics = groups(csv.DictReader(file), "topic")
    columns: dict[str, str] = dict.fromkeys(("option", "idea", "gave", "on"), "")
    text = (
        "Ideas that were built, measured and taken out again, or never turned on. dB are differences in "
        "held-out mu-law PSNR under `gt-max` to the same training without, where nothing else is said; 0.2 dB are "
        "within seed variance."
    )
    tables = [part for (topic,), rows in topics.items() for part in (f"## {topic}", markdown_table(rows, columns))]
    return ["# Negative results", text, *tables]


if __name__ == "__main__":
    print(*write_reports(REPORTS), sep="\n")
    write_readme(ROOT / "README.md", _read(REPORTS / "results" / "quality.json"))
