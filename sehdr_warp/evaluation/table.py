"""An evaluation as text."""


def format_table(result: dict) -> str:
    """The figures of evaluate() as a table for a terminal; missing ones are dashes, with the reasons below."""
    lines = [f"{result['scene']}: {len(result['views'])} {result['split']} views, {_origin(result)}", ""]
    lines.append(f"{'':<22}{'PSNR':>8}{'SSIM':>9}{'LPIPS':>9}")
    if "folder" not in result:
        lines.append(_row("LDR", result["ldr"], ("psnr", "ssim", "lpips")))
    # Sets without truth have no HDR figures: seven lines of dashes would say less than the reason below.
    names = list(result["protocol"]) if any(figures["views"] for figures in result["protocol"].values()) else []
    for name in names:
        lines.append(_row(f"HDR mu-law {name}", result["protocol"][name], ("psnr_mu", "ssim_mu", "lpips_mu")))
    for name in names:
        lines.append(_row(f"HDR PU21 {name}", result["pu21"][name], ("psnr", "ssim")))
    lines += ["", f"{'region of the photo':<22}{'share':>8}{'LDR':>9}" + "".join(f"{name:>10}" for name in names)]
    for region, figures in result["regions"].items():
        values = [figures["psnr_ldr"], *(figures["psnr_mu"][name] for name in names)]
        text = "".join(_number(value, width, 2) for value, width in zip(values, [9] + [10] * len(names)))
        lines.append(f"{region:<22}{figures['fraction']:>8.1%}{text}")
    ranking = result["confidence"]
    if ranking["spearman_log2"] is not None:
        correlations = f"{ranking['spearman_log2']:.2f} (log2), {ranking['spearman_mu']:.2f} (mu-law)"
        lines += ["", f"confidence ranks errors: {correlations}; mean confidence {ranking['mean']:.2f}"]
    lines += ["", *_notes(result)]
    return "\n".join(lines)


def _origin(result: dict) -> str:
    if "folder" in result:
        return result["folder"]
    facts = f"{result['gaussians']:,} Gaussians, {result['iterations']:,} iterations"
    return f"{facts} in {result['train_seconds']:.1f} s"


def _row(label: str, figures: dict, keys: tuple[str, ...]) -> str:
    widths, digits = (8, 9, 9), (2, 4, 4)
    return f"{label:<22}" + "".join(_number(figures[k], w, d) for k, w, d in zip(keys, widths, digits))


def _number(value: float | None, width: int, digits: int) -> str:
    return f"{'-':>{width}}" if value is None else f"{value:>{width}.{digits}f}"


def _notes(result: dict) -> list[str]:
    pu21 = result["pu21"]
    white = "maximum" if pu21["white_percentile"] == 100 else f"{pu21['white_percentile']:g}th percentile"
    has_truth = any(figures["views"] for figures in result["protocol"].values())
    notes = [f"PU21: the {white} of each view's truth is shown at {pu21['peak_luminance']:g} cd/m^2."] * has_truth
    scale = result["protocol"].get("aligned", {}).get("scale")
    if scale is not None:
        where = "the scored views" if result.get("scale_from") == "scored" else "the training photos"
        notes.append(f"aligned: radiance times {scale:.4g}, fitted on what {where} do not show clipped.")
    if result["lpips_backbone"]:
        notes.append(f"LPIPS: {result['lpips_backbone']}.")
    if result["split"] == "train":
        notes.append("There are no test views: these figures are of the training views.")
    figures = [*([] if "folder" in result else [result["ldr"]]), *result["protocol"].values()]
    reasons = [entry[key] for entry in figures for key in ("reason", "lpips_reason", "flip_reason") if key in entry]
    return notes + [f"-: {reason}." for reason in dict.fromkeys(reasons)]
