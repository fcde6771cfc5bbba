"""`python -m benchmarks COMMAND ...`, in a checkout: measure speed, memory, quality and stability."""

import os
import shutil
import sys

from sehdr_warp.arguments import parse
from sehdr_warp.errors import UsageError, as_user_error
from sehdr_warp.process import calm_threads

PROGRAM = "python -m benchmarks"
LEAST_COLUMNS = 40
"""Columns that help tables need."""


def main(words: list[str] | None = None) -> None:
    """Run a benchmark and exit: status 0 is success, 1 an error or a failed check, 2 wrong usage, 130 an interrupt."""
    words = sys.argv[1:] if words is None else words
    quiet = {"-q", "--quiet"} & {*words}
    try:
        calm_threads()
        if shutil.get_terminal_size().columns < LEAST_COLUMNS:
            os.environ["COLUMNS"] = str(LEAST_COLUMNS)
        from sehdr_warp.console import show_logs

        show_logs("warning" if quiet else "info")
        from .commands import Benchmarks, run_benchmark

        run_benchmark(parse(Benchmarks, [word for word in words if word not in ("-q", "--quiet")], PROGRAM))
    except KeyboardInterrupt:
        sys.exit(130)
    except Exception as error:
        message = as_user_error(error)
        if message is None:
            raise
        print(f"benchmarks: {str(message).removeprefix(PROGRAM + ' ')}", file=sys.stderr)
        sys.exit(2 if isinstance(message, UsageError) else 1)
    sys.exit(0)


if __name__ == "__main__":
    main()
