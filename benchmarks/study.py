"""Run a study as a program: its main() takes the command line, its docstring is the help."""

import inspect
import logging
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from functools import wraps
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any, get_origin

import tyro

from sehdr_warp.arguments import MARKERS
from sehdr_warp.cli import run_program
from sehdr_warp.files import check_absent, write_json

from .results import finish


def run(main: Callable[..., Any]) -> None:
    """Call main() with the words of the command line and exit; a user's error is one line.

    The arguments before `/` stand without a flag, the others are flags. If `json` may not be written, nothing is
    measured.
    """
    for name, parameter in inspect.signature(main).parameters.items():
        starred = parameter.kind is parameter.POSITIONAL_ONLY and get_origin(parameter.annotation) is tuple
        absent = parameter.default in (None, ()) or parameter.default is False
        if starred or absent:  # Else the help would say `(default: None)`.
            main.__annotations__[name] = Annotated[parameter.annotation, tyro.conf.arg(help_behavior_hint="")]

    @wraps(main)
    def check_and_call(*values: Any, **options: Any) -> None:
        if (result := options.get("json")) is not None:
            check_absent(result, overwrite=True)
        main(*values, **options)

    logging.basicConfig(level=logging.INFO, format="%(message)s")
    program = f"python -m {sys.modules['__main__'].__spec__.name}"  # pyright: ignore[reportOptionalMemberAccess]
    run_program(lambda words: tyro.cli(check_and_call, prog=program, args=words, config=MARKERS), sys.argv[1:], program)


def add_rows(result: dict, json: Path, measure: Callable[[Any], dict], jobs: Iterable[Any], at_once: int) -> None:
    """Add the row that measure() returns for each job, in processes of their own, then write and print the result.

    Args:
        result: gets the rows.
        json: file of the result, which is written after each row, so that rows outlive an interruption.
        measure: can be pickled.
        jobs: arguments of measure().
        at_once: processes.
    """
    with ProcessPoolExecutor(at_once, get_context("spawn")) as workers:
        for row in workers.map(measure, jobs):
            result["rows"].append(row)
            write_json(json, result, overwrite=True)
    finish(result, json, overwrite=True)
