"""The command lines of `sehdr-warp eval` and `compare`. torch is imported when they run."""

import json
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from tyro.conf import Positional

from ..errors import InputError, UsageError
from ..output.commands import changed_flags
from ..runs.open import enclosing_run_response, load_run_scene_with_confidence, open_run

if TYPE_CHECKING:
    from ..runs.run import Run

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """For a run."""

    data: str | None = None  # The photos, if they have moved since the training.
    device: str | None = None  # cpu or cuda:N; by default the first GPU if there is one.


@dataclass(frozen=True, kw_only=True)
class PictureOptions:
    """For a folder of EXR pictures, scene-linear with Rec.709 primaries and named as the views of the set."""

    truth: str | None = None  # The set to compare with: a folder with HDR truth, or an embedded scene.
    max_size: int | None = None
    """Longest side of the truth in pixels, if the pictures are smaller than the set's; the truth is reduced."""
    response: str | None = None
    """The response that decodes photos: a name, a file or auto; by default that of the run around the folder,
    else auto."""


@dataclass(frozen=True, kw_only=True)
class ResultOptions:
    """Files to write."""

    json: Path | None = None
    """Also write the figures to this file; - prints them on standard output in place of the table."""
    lpips: Path | None = None  # Folder with LPIPS weights; without it, LPIPS is null.
    overwrite: bool = False  # Replace the file of --json.


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Compare a trained scene, or a folder of EXR pictures, with held-out photos and HDR truth."""

    run: Annotated[Positional[Path], tyro.conf.arg(metavar="RUN|PICTURES")]
    """Folder of a run; or of EXR pictures of any origin, with --truth."""
    scene: RunOptions = RunOptions()
    pictures: PictureOptions = PictureOptions()
    result: ResultOptions = ResultOptions()


@dataclass(frozen=True)
class Compare:
    """Compare trained runs in one table, with mean and deviation of runs that differ by their seed alone."""

    runs: Annotated[Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN ...", help_behavior_hint="")]
    """Folders of runs, or a folder that holds runs; of these, those without an evaluation yet are left out."""
    plot: Path | None = None  # Also draw held-out PSNR against training time to this PNG file.
    csv: Path | None = None  # Also write the table to this CSV file.
    latex: Path | None = None  # Also write the table to this LaTeX file (booktabs).
    overwrite: bool = False  # Replace files that exist.


def run_evaluate(options: Evaluate) -> None:
    """Evaluate, print the figures and write them."""
    from ..files import check_absent, write_json
    from .compare import eval_table

    if options.pictures.truth is None:
        if flags := changed_flags(options.pictures):
            raise UsageError(f"{flags[0]} needs --truth, the set to compare pictures with")
        if any(options.run.glob("*.exr")) and not (options.run / "run.json").is_file():
            raise UsageError(f"{options.run}: holds EXR pictures; add --truth, the set to compare them with")
    elif flags := changed_flags(options.scene):
        raise UsageError(f"{flags[0]} belongs to runs; pictures with --truth do not take it")
    result = options.result
    file = None if result.json is None or str(result.json) == "-" else result.json
    if file is not None:
        check_absent(file, result.overwrite)
    if options.pictures.truth is None:
        from .evaluate import evaluate

        run = open_run(options.run, options.scene.device)
        scene = load_run_scene_with_confidence(run, options.scene.data)
        figures = evaluate(run, scene, lpips_weights=result.lpips)
    else:
        figures = _evaluate_pictures(options, options.pictures.truth)
    if file is not None:
        write_json(file, figures, result.overwrite)
    print(eval_table(figures) if file == result.json else json.dumps(figures))
    if file is not None:
        print(file)


def _evaluate_pictures(options: Evaluate, truth_path: str) -> dict[str, Any]:
    from ..scene import load_scene
    from ..scene.load import parse_dataset
    from .folder import evaluate_folder

    max_size = options.pictures.max_size
    response = options.pictures.response or enclosing_run_response(options.run)
    if response is None:
        dataset = parse_dataset(truth_path)
        resampled = dataset.alpha == "background" or not all(record.lens.is_pinhole for record in dataset.records)
        # Photos that are not resampled keep their codes, so every response finds the same regions clipped and dark.
        states_light = dataset.kind != "encoded"  # Light that needs no response
        response = "auto" if states_light or resampled or max_size is not None else "srgb"
    truth = load_scene(truth_path, response=response, max_size=max_size)
    return evaluate_folder(options.run, truth, lpips_weights=options.result.lpips)


def run_compare(options: Compare) -> None:
    """Print the table and write the files that are asked for."""
    from ..files import atomic_path, check_absent
    from ..output.report.charts import save_picture, training_chart
    from .compare import compare_runs, comparison_csv, comparison_latex, comparison_table

    if options.plot is not None and options.plot.suffix.lower() != ".png":
        raise InputError(options.plot, "the chart is a PNG file", f"name it {options.plot.with_suffix('.png').name}")
    for path in filter(None, (options.plot, options.csv, options.latex)):
        check_absent(path, options.overwrite)
    rows = compare_runs([run for folder in options.runs for run in _runs_in(folder)])
    for path, format_rows in ((options.csv, comparison_csv), (options.latex, comparison_latex)):
        if path is not None:
            with atomic_path(path, options.overwrite) as file:
                file.write_text(format_rows(rows), encoding="utf-8")
    if options.plot is not None:
        with atomic_path(options.plot, options.overwrite) as file:
            save_picture(training_chart({row.label: row.curves for row in rows}), file, 140)
    print(comparison_table(rows))
    for path in filter(None, (options.csv, options.latex, options.plot)):
        print(path)


def _runs_in(folder: Path) -> "list[Run]":
    """Load the run in a folder; else the runs in the folders in it, without those that have no evaluation yet."""
    inside = [] if (folder / "config.json").exists() else sorted(file.parent for file in folder.glob("*/config.json"))
    runs = [open_run(path, "cpu") for path in inside or [folder]]
    evaluated = [run for run in runs if run.metrics()]
    if not evaluated:
        return runs
    for run in runs:
        if run not in evaluated:
            log.warning("%s: has no evaluations of held-out views yet, and is left out", run.path)
    return evaluated
