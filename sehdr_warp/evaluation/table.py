"""Figures as text in aligned columns."""

from collections.abc import Sequence
from itertools import zip_longest
from statistics import median


def columns(rows: Sequence[Sequence[str]], left: int = 1) -> list[str]:
    """Return one line for each row, with aligned cells: the first `left` flush left, the others flush right."""
    widths = [max(map(len, cells)) for cells in zip_longest(*rows, fillvalue="")]
    sides = [str.ljust] * left + [str.rjust] * (len(widths) - left)
    return ["  ".join(side(cell, width) for side, cell, width in zip(sides, row, widths)) for row in rows]


def format_table(result: dict) -> str:
    """Return the figures of evaluate() as a table for a terminal; missing ones are dashes, with the reasons below."""
    origin = result.get("folder") or (
        f"{result['gaussians']:,} Gaussians, {result['iterations']:,} iterations in {result['train_seconds']:.1f} s"
    )
    rows = [["", "PSNR", "SSIM", "LPIPS"]]
    if "folder" not in result:
        rows.append(_row("LDR", result["ldr"]))
    # Without truth there are no HDR figures, and the reason below says so once.
    names = list(result["protocol"]) if any(figures["views"] for figures in result["protocol"].values()) else []
    rows += [_row(f"HDR mu-law {name}", result["protocol"][name], "_mu") for name in names]
    rows += [_row(f"HDR PU21 {name}", result["pu21"][name]) for name in names]
    regions = [["region of the photo", "share", "LDR", *names]]
    for region, figures in result["regions"].items():
        values = [figures["psnr_ldr"], *(figures["psnr_mu"][name] for name in names)]
        regions.append([region, f"{figures['fraction']:.1%}", *(format_figure(value, 2) for value in values)])
    count, split = len(result["views"]), {"train": "training"}.get(result["split"], result["split"])
    lines = [f"{result['scene']}: {count} {split} view{'s' * (count != 1)}, {origin}", "", *columns(rows)]
    lines += ["", *columns(regions)]
    ranking = result["confidence"]
    if ranking["spearman_log2"] is not None:
        correlations = f"{ranking['spearman_log2']:.2f} (log2), {ranking['spearman_mu']:.2f} (mu-law)"
        lines += ["", f"confidence ranks errors: {correlations}; mean confidence {ranking['mean']:.2f}"]
    if result["lights"]["count"]:
        lines += [
            "",
            "lights: {count} in the truth, {lost} lost".format(**result["lights"]) + _energies(result["lights"]),
        ]
    return "\n".join([*lines, "", *_notes(result, bool(names))])


def _energies(lights: dict) -> str:
    """Return the energy of clipped lights in words; nothing if none clips."""
    ratios = lights.get("energies")
    if not ratios:
        return ""
    figures = f"{ratios[0]:.2f} to {ratios[-1]:.2f} times their energy, median {median(ratios):.2f}"
    return f"; those that clip ({len(ratios)}) have {figures}"


def _row(label: str, figures: dict, suffix: str = "") -> list[str]:
    digits = {f"psnr{suffix}": 2, f"ssim{suffix}": 4, f"lpips{suffix}": 4}
    return [label, *(format_figure(figures[key], count) for key, count in digits.items() if key in figures)]


def format_figure(value: float | None, digits: int) -> str:
    """Return a figure with so many digits after the point, or a dash for None."""
    return "-" if value is None else f"{value:.{digits}f}"


def _notes(result: dict, has_truth: bool) -> list[str]:
    peak = result["pu21"]["peak_luminance"]
    notes = [f"PU21: the maximum of each view's truth is shown at {peak:g} cd/m^2."] * has_truth
    if (scale := result["protocol"]["aligned"].get("scale")) is not None:
        where = "the scored views" if result.get("scale_from") == "scored" else "the training photos"
        notes.append(f"aligned: radiance times {scale:.4g}, fitted on what {where} do not show clipped.")
    if result["lpips_backbone"]:
        notes.append(f"LPIPS: {result['lpips_backbone']}.")
    if result["split"] == "train":
        notes.append("There are no test views: these figures are of the training views.")
    figures = [*([] if "folder" in result else [result["ldr"]]), *result["protocol"].values()]
    reasons = [entry[key] for entry in figures for key in ("reason", "lpips_reason") if key in entry]
    return notes + [f"-: {reason}." for reason in dict.fromkeys(reasons)]
