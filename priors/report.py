"""Write the report page of the prior for clipped light from the figures of `priors.judge` and `priors.brackets`.

python -m priors.report FIGURES.json BRACKETS.json docs
"""

import json
from math import erf
from pathlib import Path

import numpy as np

from benchmarks.study import run

PAGE = "light-prior"
_COLUMNS = {
    "rms": "RMS, stops",
    "level": "spread of a photo's level, stops",
    "light": "total light, median error, log2",
    "psnr": "mu-law dB",
    "worst": "worst 5 %, dB",
}
_SETS = {
    "plain": "sRGB, 8 bits, 0.2 to 20 % of the pixels at white",
    "camera": "random camera curves, white balance, noise, JPEG and exposures; the curve is known to a fifth of a stop",
    "bright lamps": "the same, with small lights raised to a random power of up to 2.2",
    "lights put in": "as camera, with inserted lamps, windows and screens",
    "overexposed": "as camera, 10 to 95 % of the pixels at white",
    "pages": "as camera, with inserted white surfaces that are not lamps, blank or printed",
    "lit rooms": "rendered rooms and streets with lamps in view, not those of a training",
}
_AREAS = {"30": "up to 30", "300": "31 to 300", "3000": "301 to 3000", "27648": "more"}
_TEXT = """# The prior for light above white

How well the network that comes with the package estimates the light of clipped pixels ([Light above white](light.md)).
On plain photos its error is {rms:.2f} stops (RMS); taking clipped light as white, it would be {white:.2f}. In photos by
real cameras (below), two values in three lie within the deviation that the network states.

The photos are taken from {panoramas} HDR panoramas that no training used (`checked` and `checked_more` in
`priors/sources.toml`), at most 384 for each table. Each row estimates the excess of clipped values over white, in log2:
*white* is no excess, *constant* the mean of the training, *ridge* a ridge regression on ten figures of the photo's
histogram. Constant and ridge are fitted on the panoramas of the training.

- *RMS* is over all clipped values. *spread of a photo's level*: standard deviation over photos of a photo's mean error.
- *total light*: median over photos of the error of the summed clipped light.
- *mu-law dB*: PSNR of whole photos, in the mean and for the worst 5 %.

The card beside the weights, `sehdr_warp/prior/clipped_light.md`, says how they were trained.

{tables}

![Estimates against the truth, and how often the truth lies within a deviation](images/{page}.png)

The truth lies within one deviation of the network for {within:.0%} of the clipped values (`camera`). One factor for
all deviations was fitted on panoramas of its training. The values of a region err alike, so trainings widen deviations
over one stop ([how well they hold](light.md#the-cheapest-cures)). By quarters of the deviation that the network states:

| mean deviation, stops | RMS, stops | within one deviation |
| -: | -: | -: |
{quarters}

Expected light (the mean of the log-normal estimate) divided by true light, summed over all photos, by the number of
values that clip in a photo of 96 x 96 pixels. Trainings use half of the variance, so they expect less:

| photos | {areas} |
| --- |{rules}
{energies}

## Photos by real cameras

{photos} photos of {stacks} exposure stacks by other people, which no training used (`python -m priors.brackets`). Each
stack calibrates its camera, and its darker photos show what clips in the others. All stacks weigh the same. *RMS* and
*bias* are those of clipped values, in stops; *light* is the median error of their sum, in log2; *of white*: if clipped
light is taken as white.

| pixels that clip | photos (stacks) | RMS of white | RMS | bias | within one deviation | light of white | light |
| --- | -: | -: | -: | -: | -: | -: | -: |
{brackets}

The color of a light is hardly known: the estimate has {slope:.2f} of the true stops between red and blue (correlation
{correlation:.2f}). So lights that clip in all channels come out pale.
"""


def main(figures_file: Path, brackets_file: Path, folder: Path, /) -> None:
    """Write page and plot of the prior.

    Args:
        figures_file: JSON file of priors.judge.
        brackets_file: JSON file of priors.brackets.
        folder: docs.
    """
    figures, brackets = (json.loads(file.read_text()) for file in (figures_file, brackets_file))
    tables = "\n\n".join(
        f"**{name}: {title}**\n\n{_table(figures[name])}" for name, title in _SETS.items() if name in figures
    )
    network = figures["camera"]["network"]
    rows = [f"| {row['deviation']:.2f} | {row['rms']:.2f} | {row['within']:.0%} |" for row in network["by_deviation"]]
    ratios = {name: figures[name]["network"]["energy"] for name in _SETS if name in figures}
    energies = [f"| {name} | {' | '.join(f'{row[area]:.2f}' for area in _AREAS)} |" for name, row in ratios.items()]
    values = {"page": PAGE, "tables": tables, "within": network["within_one_deviation"], "quarters": "\n".join(rows)}
    values |= {"areas": " | ".join(_AREAS.values()), "rules": " -: |" * len(_AREAS), "energies": "\n".join(energies)}
    values |= {"brackets": _bracket_rows(brackets["rows"]), **brackets["colors"]}
    photos = [photo["stack"] for photo in brackets["photos"]]
    values |= {"photos": len(photos), "stacks": len(set(photos))}
    plain = figures["plain"]
    values |= {"panoramas": figures["settings"]["panoramas"], "rms": plain["network"]["rms"]}
    values |= {"white": plain["white"]["rms"]}
    (folder / f"{PAGE}.md").write_text(_TEXT.format(**values))
    _plot(np.array(network["sample"]), folder / "images" / f"{PAGE}.png")


def _table(estimates: dict) -> str:
    lines = [f"| estimate | {' | '.join(_COLUMNS.values())} |", f"| --- |{' -: |' * len(_COLUMNS)}"]
    for name, row in estimates.items():
        lines.append(f"| {name} | {' | '.join(f'{row[column]:.2f}' for column in _COLUMNS)} |")
    return "\n".join(lines)


def _bracket_rows(rows: list[dict]) -> str:
    return "\n".join(
        f"| {row['least']:.1%} to {row['most']:.1%} | {row['photos']} ({row['stacks']}) | {row['white_rms']:.2f} "
        f"| {row['rms']:.2f} | {row['bias']:+.2f} | {row['within']:.0%} | {row['white_light']:.2f} "
        f"| {row['light']:.2f} |"
        for row in rows
    )


def _plot(sample: np.ndarray, path: Path) -> None:
    """Plot estimates against the truth, and the share of values within a number of deviations."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4))
    left.scatter(sample[:, 0], sample[:, 1], s=3, c=sample[:, 2], cmap="viridis", alpha=0.6)
    left.plot([0, 10], [0, 10], "k", lw=0.8)
    left.set(xlabel="true excess over white, stops", ylabel="estimate, stops", xlim=(0, 10), ylim=(0, 10))
    left.set_title(f"{len(sample)} clipped values; brighter: less sure")
    off, places = np.abs(sample[:, 1] - sample[:, 0]) / sample[:, 2], np.linspace(0, 3, 200)
    right.plot(places, [(off <= place).mean() for place in places], label="measured")
    right.plot(places, [erf(place / 2**0.5) for place in places], "k--", lw=0.8, label="normal distribution")
    right.set(xlabel="deviations from the estimate", ylabel="share of clipped values within", ylim=(0, 1))
    right.set_title("Calibration")
    right.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=80)


if __name__ == "__main__":
    run(main)
