"""The command lines of `sehdr-warp eval`, `compare` and `score`. torch is imported when they run."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from ..errors import InputError
from ..runs.open import enclosing_run_response, load_run_photos_with_confidence, open_run


@dataclass(frozen=True, kw_only=True)
class _Figures:
    json: Path | None = None
    """Also write the figures to this file; - prints them on standard output in place of the table."""
    lpips: Path | None = None
    """Folder with LPIPS weights; without, LPIPS is null."""
    overwrite: bool = False
    """Replace the file of --json."""

    def tell(self, figures: Callable[[], dict]) -> None:
        """Computes once it is known that the result can be written; prints and writes it."""
        from ..files import check_absent, write_json
        from .table import format_table

        file = self.json if str(self.json) != "-" else None
        if file is not None:
            check_absent(file, self.overwrite)
        result = figures()
        if file is not None:
            write_json(file, result, self.overwrite)
        print(format_table(result) if file == self.json else json.dumps(result))


@dataclass(frozen=True, kw_only=True)
class Evaluate(_Figures):
    """Compare a trained scene with its held-out photos and, where there is some, with HDR truth."""

    run: Positional[Path]
    """Folder of a run."""
    data: str | None = None
    """The photos, if they have moved since the training."""
    device: str | None = None
    """cpu or cuda:N; by default the first GPU if there is one."""


@dataclass(frozen=True)
class Compare:
    """Compare trained runs in one table; runs that differ by their seed alone become a mean with its spread."""

    runs: Annotated[Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN ...", help_behavior_hint="")]
    """Folders of runs."""
    plot: Path | None = None
    """Also draw held-out error against training time to this PNG file."""
    csv: Path | None = None
    """Also write the table to this CSV file."""
    latex: Path | None = None
    """Also write the table to this LaTeX file (booktabs)."""
    overwrite: bool = False
    """Replace files that exist."""


@dataclass(frozen=True, kw_only=True)
class Score(_Figures):
    """Score a folder of EXR pictures of any origin against the HDR truth of a set."""

    folder: Positional[Path]
    """EXR files of scene-linear radiance, Rec.709 primaries, named as the set's views."""
    truth: str
    """The set: a folder with HDR truth, or an embedded scene."""
    max_size: int | None = None
    """Longest side of the truth in pixels, as the pictures have it; larger truth is reduced."""
    response: str | None = None
    """The response by which photos are reduced: a name, a file or auto; by default that of the run that FOLDER lies in,
    else auto."""


def run_evaluate(asked: Evaluate) -> None:
    from .evaluate import evaluate

    def figures():
        run = open_run(asked.run, asked.device)
        return evaluate(run, load_run_photos_with_confidence(run, asked.data), lpips_weights=asked.lpips)

    asked.tell(figures)


def run_score(asked: Score) -> None:
    from ..scene import load_scene
    from ..scene.load import parse_dataset
    from .score import score_folder

    def figures():
        response = asked.response or enclosing_run_response(asked.folder)
        if response is None:
            dataset = parse_dataset(asked.truth)
            bent = dataset.alpha == "background" or not all(record.lens.is_pinhole for record in dataset.records)
            # Photos that keep their codes are clipped and dark where they are by any response.
            response = "auto" if bent or asked.max_size is not None else "srgb"
        truth = load_scene(asked.truth, response=response, max_size=asked.max_size)
        return score_folder(asked.folder, truth, lpips_weights=asked.lpips)

    asked.tell(figures)


def run_compare(asked: Compare) -> None:
    from ..files import atomic_path, check_absent
    from ..output.charts import save_picture, training_chart
    from .compare import compare_runs, comparison_csv, comparison_latex, comparison_table

    if asked.plot is not None and asked.plot.suffix.lower() != ".png":
        raise InputError(asked.plot, "the chart is a PNG file", f"name it {asked.plot.with_suffix('.png').name}")
    for path in filter(None, (asked.plot, asked.csv, asked.latex)):
        check_absent(path, asked.overwrite)
    rows = compare_runs([open_run(path, "cpu") for path in asked.runs])
    for path, text in ((asked.csv, comparison_csv), (asked.latex, comparison_latex)):
        if path is not None:
            with atomic_path(path, asked.overwrite) as file:
                file.write_text(text(rows), encoding="utf-8")
    if asked.plot is not None:
        with atomic_path(asked.plot, asked.overwrite) as file:
            save_picture(training_chart({row.label: row.curves for row in rows}), file, 140)
    print(comparison_table(rows))
