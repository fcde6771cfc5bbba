"""The command line of `sehdr-warp eval`. torch is imported when it runs."""

import json
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from ..training.commands import ensured_scene, open_run


@dataclass(frozen=True)
class Evaluate:
    """Compare a trained scene with its held-out photos and, where there is some, with HDR truth."""

    run: Positional[Path]
    """Folder of a run."""
    json: Path | None = None
    """Also write the figures to this file; - prints them on standard output in place of the table."""
    data: str | None = None
    """The photos, if they have moved since the training."""
    lpips: Path | None = None
    """Folder with LPIPS weights; without, LPIPS is null."""
    device: str | None = None
    """cpu or cuda:N; by default the first GPU if there is one."""
    overwrite: bool = False
    """Replace the file of --json."""


def run_evaluate(asked: Evaluate) -> None:
    """Prints the figures as a table or as JSON, and writes what was asked for."""
    from ..files import check_absent, write_json
    from .evaluate import evaluate
    from .table import format_table

    to_file = asked.json is not None and str(asked.json) != "-"
    if to_file:
        check_absent(asked.json, asked.overwrite)
    run = open_run(asked.run, asked.device)
    result = evaluate(run, ensured_scene(run, asked.data), lpips_weights=asked.lpips)
    if to_file:
        write_json(asked.json, result, asked.overwrite)
    print(format_table(result) if asked.json is None or to_file else json.dumps(result))
