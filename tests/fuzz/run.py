"""Mutated files for every reader, each in a child process with a memory and a time limit.

Only SehdrError, with a message of one line, may come out. Anything else is a finding: another exception, a warning
that numbers were lost, more than --seconds of processor time, more than --memory, or the death of the process.
"""

import argparse
import os
import random
import resource
import signal
import tempfile
import time
import traceback
import warnings
import zlib
from multiprocessing import get_context
from pathlib import Path

from .mutate import mutate
from .readers import READERS, Workspace

LONGEST_MESSAGE = 1000


class TooSlow(BaseException):
    """Raised by the timer within a reader; no reader's `except Exception` may swallow it."""


def seed_of(name: str, seed: int, index: int) -> int:
    """The random seed of one input: (reader, seed, index) makes it again."""
    return zlib.crc32(f"{name}/{seed}/{index}".encode())


def make_input(space: Workspace, name: str, seed: int, index: int) -> Path:
    """Changes one of the workspace's files; returns which."""
    rng = random.Random(seed_of(name, seed, index))
    path = rng.choice(list(space.targets))
    others = [data for other, data in space.targets.items() if other.suffix == path.suffix]
    path.write_bytes(mutate(space.targets[path], others, space.reader.text, rng))
    if space.reader.repair is not None:
        space.reader.repair(space.folder)
    return path


def try_input(space: Workspace, seconds: float) -> str | None:
    """None if the reader behaved, else what it did."""
    from sehdr_warp.errors import SehdrError

    def late(*_):
        raise TooSlow

    previous = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            space.reader.read(space.folder)
    except SehdrError as error:
        text = str(error)
        if "\n" in text or not text or len(text) > LONGEST_MESSAGE:
            return f"message of {len(text)} characters: {text[:60]!r}"
    except TooSlow:
        return f"more than {seconds} s of processor time"
    except BaseException as error:  # noqa: BLE001 - whatever else comes out is the finding
        place = [entry for entry in traceback.extract_tb(error.__traceback__) if "sehdr_warp" in entry.filename]
        where = f"{Path(place[-1].filename).name}:{place[-1].lineno}" if place else "?"
        return f"{type(error).__name__} at {where}: {str(error)[:80]!r}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, previous)
    return None


def fuzz(name: str, folder: Path, seed: int, first: int, count: int, seconds: float, until: float, report) -> int:
    """Tries up to `count` inputs of one reader; report(index, finding) of each; returns how many were tried."""
    space = Workspace(READERS[name], folder)
    done = 0
    for index in range(first, first + count):
        if time.monotonic() > until:
            break
        report(index, "begun")
        make_input(space, name, seed, index)
        finding = try_input(space, seconds)
        space.restore()
        done += 1
        report(index, finding)
    return done


def _child(pipe, name: str, folder: Path, options, first: int) -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # decoders print there
    import torch  # its address space is no reader's doing

    torch.set_num_threads(1)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (options.memory << 20),) * 2)
    count, until = options.inputs - first, time.monotonic() + options.budget
    fuzz(name, folder, options.seed, first, count, options.seconds, until, lambda *message: pipe.send(message))


def run_reader(name: str, folder: Path, options) -> tuple[int, dict[str, list[int]]]:
    """How many inputs one reader was given, and the indices behind each finding; a new process after a death."""
    tried, findings, started = 0, {}, time.monotonic()
    while tried < options.inputs and time.monotonic() < started + options.budget:
        pipe, other = get_context("spawn").Pipe(False)
        child = get_context("spawn").Process(target=_child, args=(other, name, folder, options, tried))
        child.start()
        other.close()
        begun, what = None, "the process died"
        while pipe.poll(60 + 10 * options.seconds):
            try:
                index, finding = pipe.recv()
            except EOFError:
                break
            begun = index if finding == "begun" else None
            if begun is None:
                tried = index + 1
                if finding is not None:
                    findings.setdefault(finding, []).append(index)
        else:
            child.kill()
            what = "hang"
        child.join()
        if begun is None:
            break
        findings.setdefault(what, []).append(begun)
        tried = begun + 1
    return tried, findings


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--readers", default=",".join(READERS), help="names separated by commas")
    parser.add_argument("--inputs", type=int, default=6000, help="of each reader")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--budget", type=float, default=600.0, help="seconds for each reader")
    parser.add_argument("--seconds", type=float, default=2.0, help="of processor time that one input may take")
    parser.add_argument("--memory", type=int, default=4096, help="MiB of address space that a reader may take")
    options, bad = parser.parse_args(), 0
    with tempfile.TemporaryDirectory() as folder:
        for name in options.readers.split(","):
            tried, findings = run_reader(name, Path(folder) / name, options)
            print(f"{name:16} {tried:7} inputs, {len(findings)} kinds of findings", flush=True)
            for what, indices in findings.items():
                print(f"    {len(indices):6} x {what} (first: index {indices[0]})", flush=True)
            bad += len(findings)
    return min(bad, 1)
