"""`python -m sehdr_warp` and the script `sehdr-warp`: the command line, loaded where interrupts are caught."""

import errno
import os
import signal
import sys

_OUT_OF_MEMORY = (
    b"sehdr-warp: out of memory; raise the limit (ulimit -v), or use smaller photos (--max-size) or pictures (--size)\n"
)
_LITTLE = 4 << 20  # Bytes of address space; a smaller rest is not enough for a module or a picture


def run() -> None:
    """Run the command line of this process and exit, see cli.main()."""
    is_interrupted = bool  # Until the import below: bool() is False.
    try:
        from .process import is_interrupted, prepare, use_utf8

        use_utf8()
        prepare()
        from .cli import main

        main()
    except BaseException as error:
        if _is_out_of_memory(error):
            # While modules load, or because even the line of main() found no memory: nothing is allocated here.
            os.write(2, _OUT_OF_MEMORY)
            os._exit(1)
        # An interrupt while modules load or main() ends, or an exception into which a library turned it.
        if isinstance(error, KeyboardInterrupt) or (is_interrupted() and not isinstance(error, SystemExit)):
            print("sehdr-warp: interrupted", file=sys.stderr)
            sys.exit(130)
        raise
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # An interrupt while Python ends would show a traceback.


def _is_out_of_memory(error: BaseException) -> bool:
    """Return whether memory is exhausted, which libraries turn into exceptions of any kind."""
    return isinstance(error, MemoryError) or (isinstance(error, Exception) and _address_space_left() < _LITTLE)


def _address_space_left() -> float:
    """Return the bytes that `ulimit -v` leaves this process; infinity without such a limit, or where it is unknown."""
    try:
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        with open("/proc/self/statm", "rb") as file:
            in_use = int(file.read().split()[0]) * resource.getpagesize()
    except ImportError:
        return float("inf")
    except OSError as error:
        return 0 if error.errno == errno.ENOMEM else float("inf")
    return float("inf") if limit == resource.RLIM_INFINITY else limit - in_use


if __name__ == "__main__":
    run()
