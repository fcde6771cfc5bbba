"""`python -m sehdr_warp` and the script `sehdr-warp`: the command line, loaded where interrupts are caught."""

import signal
import sys


def run() -> None:
    """Runs the command line of this process and exits, see cli.main()."""
    interrupted = bool
    try:
        from .process import interrupted, prepare

        prepare()
        from .cli import main

        main()
    except BaseException as error:
        # While modules load, in main's last words, or as what a library made of an interrupt.
        if isinstance(error, KeyboardInterrupt) or (interrupted() and not isinstance(error, SystemExit)):
            print("sehdr-warp: interrupted", file=sys.stderr)
            sys.exit(130)
        raise
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Python's own end shows tracebacks.


if __name__ == "__main__":
    run()
