"""`python -m sehdr_warp` and the script `sehdr-warp`: the command line, loaded where interrupts are caught."""

import os
import signal
import sys

_OUT_OF_MEMORY = b"sehdr-warp: out of memory; raise the limit (ulimit -v), or use smaller photos (--max-size)\n"


def run() -> None:
    """Run the command line of this process and exit, see cli.main()."""
    interrupted = bool
    try:
        from .process import interrupted, prepare, use_utf8

        use_utf8()
        prepare()
        from .cli import main

        main()
    except BaseException as error:
        if isinstance(error, MemoryError) or (isinstance(error, ImportError) and "map segment" in str(error)):
            # While modules load, or because even the line of main() found no memory: nothing is allocated here.
            os.write(2, _OUT_OF_MEMORY)
            os._exit(1)
        # An interrupt while modules load or main() ends, or an exception into which a library turned it.
        if isinstance(error, KeyboardInterrupt) or (interrupted() and not isinstance(error, SystemExit)):
            print("sehdr-warp: interrupted", file=sys.stderr)
            sys.exit(130)
        raise
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # An interrupt while Python ends would show a traceback.


if __name__ == "__main__":
    run()
