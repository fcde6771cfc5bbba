"""`python -m benchmarks COMMAND ...`, in a checkout: measure speed, memory, quality and stability."""

import sys

from sehdr_warp.arguments import parse
from sehdr_warp.cli import run_program
from sehdr_warp.console import show_logs
from sehdr_warp.process import calm_threads

PROGRAM = "python -m benchmarks"


def main(words: list[str] | None = None) -> None:
    """Run a benchmark and exit; the status is that of cli.run_program(), and 1 for a failed check."""
    run_program(_run, sys.argv[1:] if words is None else words, PROGRAM)


def _run(words: list[str]) -> None:
    calm_threads()
    show_logs("warning" if {"-q", "--quiet"} & {*words} else "info")
    from .commands import Benchmarks, run_benchmark

    run_benchmark(parse(Benchmarks, [word for word in words if word not in ("-q", "--quiet")], PROGRAM))


if __name__ == "__main__":
    main()
