"""`python -m sehdr_warp` and the script `sehdr-warp`: the command line, loaded where interrupts are caught."""

import sys


def run() -> None:
    """Runs the command line of this process and exits, see cli.main()."""
    try:
        from .cli import main

        main()
    except KeyboardInterrupt:  # While modules load, or in main's last words.
        print("sehdr-warp: interrupted", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    run()
