"""A sandbox for readers of libraries: a process of its own with bounds on memory and time.

Such readers believe the lengths that a file states, so a damaged file would end the process, take minutes or fill the
memory. A sandboxed reader returns plain arrays.
"""

import io
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .errors import InputError

_MEMORY, _MEMORY_PER_BYTE = 1 << 30, 16
MOST_SECONDS, _BYTES_PER_SECOND = 25, 10 << 20
# Each thread reserves address space, of which there is a bound.
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "PXR_WORK_THREAD_LIMIT"), "1")


def read_sandboxed(read: Callable[[Path], dict[str, np.ndarray]], path: Path, kind: str, remedy: str) -> dict:
    """Return the arrays that a reader makes of a file.

    Args:
        read: The reader, a function of a module that loads quickly.
        path: The file.
        kind: What it is to be, for messages.
        remedy: What to do if it cannot be read.

    Raises:
        InputError: If the file is missing, or whatever ends the reader.
    """
    if not path.is_file():
        raise InputError(path, "file not found", "check the name")
    size = path.stat().st_size
    words = (read.__module__, read.__name__, str(path), str(_MEMORY + _MEMORY_PER_BYTE * size))
    seconds = MOST_SECONDS + size / _BYTES_PER_SECOND
    try:
        result = start(words, seconds)
    except OSError as error:
        result = Result(1, b"", str(error).encode())
    except subprocess.TimeoutExpired:
        result = Result(1, b"", f"not read after {seconds:.0f} s".encode())
    if result.code:
        lines = result.err.decode(errors="replace").strip().splitlines() or ["its reader ended early"]
        raise InputError(path, f"cannot be read as {kind} ({lines[-1]:.160})", remedy)
    with np.load(io.BytesIO(result.out)) as arrays:
        return dict(arrays)


class Result(NamedTuple):
    """Exit code, standard output and standard error of a process."""

    code: int
    out: bytes
    err: bytes


def start(words: Sequence[str], seconds: float) -> Result:
    """Run main(*words) in a process; raise subprocess.TimeoutExpired if it takes longer than `seconds`."""
    # The modules of this process, and none that lie where it was started.
    environment = {**os.environ, **_ONE_THREAD, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-P", "-m", __name__, *words]
    process = subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, timeout=seconds, env=environment, check=False
    )
    return Result(process.returncode, process.stdout, process.stderr)


def main(module: str, name: str, path: str, memory: str) -> int:
    """Write the arrays of a reader to standard output; return the exit code."""
    try:
        read = getattr(import_module(module), name)
        with suppress(ImportError, OSError, ValueError):
            import resource

            in_use = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            most = in_use + int(memory)
            resource.setrlimit(resource.RLIMIT_AS, (most, most))
        packed = io.BytesIO()
        np.savez(packed, **read(Path(path)))
        with open(1, "wb", closefd=False) as out:
            out.write(packed.getbuffer())
    except Exception as error:  # noqa: BLE001 - whatever a reader raises says that it cannot read
        message = " ".join(str(error).split())[-140:]
        kind = "" if message and type(error) is ValueError else f"{type(error).__name__}: "  # Readers' own words
        os.write(2, f"\n{kind}{message}\n".encode(errors="replace"))
        return 1
    return 0


def mat_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return B and I of a MATLAB file."""
    from scipy.io import loadmat

    arrays = loadmat(path, variable_names=["B", "I"])
    for name in "BI":
        if arrays[name].dtype.kind not in "fui":
            raise ValueError(f"{name} holds no real numbers")
    return {name: arrays[name].astype(float) for name in "BI"}


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
