"""Tables of the page of quality, and the table of the README."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from statistics import fmean, median
from typing import Any

from .quality import EXPOSURES, KNOWN, LEARNED, UPPER_BOUND
from .report_tables import PAGES, pivot
from .results import groups, markdown_table, parted

FIRST_TITLE, ENERGY_TITLE = "method", "light energy: median, 5th to 95th percentile"  # Of the README's table
NOTHING_CLIPS = 0.001  # Largest share of clipped pixels at which nothing counts as clipped


def quality_tables(result: dict) -> Iterable[str]:
    """Return the paragraphs of the page of quality."""
    rows, columns, places = result["rows"], PAGES["quality"]["means"], ("scene", "curve", "exposure", "seed", "device")
    bounds = groups([row for row in rows if row["method"] == UPPER_BOUND], *places)
    for row in rows:
        (bound, *_) = bounds.get(tuple(row[field] for field in places), [row])
        row["to_bound"] = None if bound is row else row["gt_max"] - bound["gt_max"]
    yield "## In short: the middle exposure, one seed, the curve known"
    yield markdown_table(in_short(rows), SHORT)
    if len(by_curve := curves_in_short(rows)) > 1:
        yield f"## `{by_curve[0]['method']}` for several curves: the middle exposure, one seed, the curve known"
        yield markdown_table(by_curve, BY_CURVE)
    for (curve,), mine in groups([row for row in rows if row["response"] in (KNOWN, LEARNED)], "curve").items():
        suffix = "" if curve == rows[0]["curve"] else f", curve {curve}"
        for tables in (_irradiance_tables, _energy_tables):
            yield from (text + suffix if text.startswith("## ") else text for text in tables(mine))
    for curve, response in groups([row for row in rows if row["response"] != LEARNED], "curve", "response"):
        members = [row for row in rows if row["curve"] == curve and row["response"] in (response, LEARNED)]
        table, common = [], _rows_of_all_methods(members)
        for (method,), mine in groups(common, "method").items():
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
        if len(common) < len(members):
            yield "Means are over the scenes and exposures at which every method was trained."
        yield markdown_table(table, columns)
        yield "gt-max by scene and exposure, mean over seeds, dB:"
        yield pivot(
            _means(members, "gt_max", "scene", "exposure", "method"),
            {"scene": "", "exposure": "d"},
            "method",
            "gt_max",
            ".2f",
        )
        yield from _whole_by_seed(members)
    shared = max(row["shared_by"] for row in rows)
    if shared > 1:
        yield f"{shared} trainings shared a device: seconds and renders / s are those of a shared one."


def _rows_of_all_methods(rows: Sequence[Mapping]) -> Sequence[Mapping]:
    """Return the rows of the scenes and exposures that every method has; all, if there are none."""
    shared = set.intersection(*(set(groups(mine, "scene", "exposure")) for mine in groups(rows, "method").values()))
    return [row for row in rows if (row["scene"], row["exposure"]) in shared] or rows


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


SHORT = {"method": "", "HDR dB": ".1f", "photos dB": ".1f", "lost": "", "irradiance error": ".0%", "worst room": ".0%"}
SHORT |= {"light energy": ".2f", "5th to 95th percentile": ""}
BY_CURVE = {"curve": "", "clips": ".1%"} | {title: form for title, form in SHORT.items() if title != "method"}


def in_short(rows: Sequence[Mapping]) -> list[dict]:
    """Return a row for each method: means over scenes of one seed at the middle exposure, with the first curve known.

    "irradiance error" is a mean over scenes, "worst room" the largest; "light energy" is the median over lights that
    clip, and "5th to 95th percentile" the range of the 5th to the 95th percentile. None and a dash without figures.
    """
    fields = ("curve", "exposure", "seed")
    common = (rows[0]["curve"], EXPOSURES // 2, rows[0]["seed"])
    middle = [row for row in rows if tuple(row[field] for field in fields) == common]
    return [
        {
            "method": method,
            "HDR dB": fmean(row["gt_max"] for row in mine),
            "photos dB": fmean(row["ldr"] for row in mine),
            "lost": f"{sum(row['lights_lost'] for row in mine)} of {sum(row['lights_count'] for row in mine)} lights",
            "irradiance error": _over_rows(mine, "irradiance", fmean),
            "worst room": _over_rows(mine, "irradiance", max),
            **_light_energy(mine),
        }
        for (method, response), mine in groups(middle, "method", "response").items()
        if response in (KNOWN, LEARNED)
    ]


def curves_in_short(rows: Sequence[Mapping]) -> list[dict]:
    """Return in_short()'s row of the first method for each curve, and "clips": the mean share of clipped pixels."""
    table = []
    for (curve,), mine in groups([row for row in rows if row["method"] == rows[0]["method"]], "curve").items():
        if line := in_short(mine):
            used = [row for row in mine if row["exposure"] == EXPOSURES // 2 and row["response"] in (KNOWN, LEARNED)]
            table.append(line[0] | {"curve": curve, "clips": _over_rows(used, "clipped_share", fmean)})
    return table


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
            near = sum(0.5 <= energy <= 2 for energy in energies) / len(energies)
            line = {"method": method, "exposure": exposure, "n": len(energies), "near": near} | _light_energy(mine)
            table.append(line | {name: sum(row[f"lights_{name}"] for row in mine) for name in ("lost", "count")})
    if table:
        yield "## Energy of the lights that photos clip, over the truth's"
        columns = {"method": "", "exposure": "d", "lights that clip=n": "d", "median=light energy": ".2f"}
        columns |= {"percentiles=5th to 95th percentile": "", "half to twice=near": ".0%"}
        columns |= {"all lights=count": "d", "lost": "d"}
        yield markdown_table(table, columns)


def _irradiance_tables(rows: Sequence[Mapping]) -> Iterable[str]:
    """Error of the light on surfaces, by what clips."""
    rows = [row for row in rows if row.get("irradiance") is not None]
    if not rows:
        return
    yield "## Irradiance error, and share of clipped pixels"
    medians = []
    for (method,), mine in groups(rows, "method").items():
        whole = [row["irradiance"] for row in mine if row["clipped_share"] < NOTHING_CLIPS]
        medians += [f"{method} {median(whole):.1%} ({len(whole)} trainings)"] if whole else []
    if medians:
        yield f"Where less than {NOTHING_CLIPS:.1%} of the pixels clip, in the median: {', '.join(medians)}."
    clipped = {
        (row["scene"], row["exposure"]): {**row, "method": "clipped pixels", "irradiance": row["clipped_share"]}
        for row in rows
    }
    means = _means(rows, "irradiance", "scene", "exposure", "method")
    yield pivot([*clipped.values(), *means], {"scene": "", "exposure": "d"}, "method", "irradiance", ".1%")


def _means(rows: Sequence[Mapping], value: str, *fields: str) -> list[dict]:
    """Return a row for each combination of fields, with the mean of a value."""
    each = groups(rows, *fields).items()
    return [dict(zip(fields, key, strict=True)) | {value: fmean(row[value] for row in mine)} for key, mine in each]


def readme_table(rows: Sequence[Mapping]) -> str:
    """Return the rows of in_short() that the README shows, as Markdown."""
    labels = PAGES["quality"]["readme"]
    short = {row["method"]: row for row in in_short(rows)}
    titles = FIRST_TITLE, "HDR", "photos", "lights below half", "irradiance error: mean, worst", ENERGY_TITLE
    lines = [f"| {' | '.join(titles)} |", f"| ---{' | -:' * (len(titles) - 1)} |"]
    for row, label in ((short[method], label) for method, label in labels.items() if method in short):
        off, energy = f"{row['irradiance error']:.0%}, {row['worst room']:.0%}", f"{row['light energy']:.2f}"
        lines.append(
            f"| {label} | {row['HDR dB']:.1f} dB | {row['photos dB']:.1f} dB | {row['lost'].removesuffix(' lights')} | "
            f"{off} | {energy}, {row['5th to 95th percentile']} |"
        )
    return "\n".join(lines)
