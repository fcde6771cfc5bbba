"""Mutated files for every reader, each in a child process with a memory and a time limit.

Only SehdrError, with a message of one line, may come out. Anything else is a finding: another exception, a warning
that numbers were lost, more than --seconds of processor time, more than --memory, or the death of the process.
"""

import argparse
import json
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


def _child(pipe, name, folder, seed, first, count, seconds, until, memory):
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # decoders print there
    import torch  # its address space is no reader's doing

    torch.set_num_threads(1)
    with open("/proc/self/statm") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + memory, used + memory))
    fuzz(name, folder, seed, first, count, seconds, until, lambda *message: pipe.send(message))
    pipe.send((None, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss))


def run_reader(name: str, folder: Path, options) -> dict:
    """Fuzzes one reader in child processes: a new one after each death. Returns counts and findings by kind."""
    context = get_context("spawn")
    until, index, tried, findings, peak = time.monotonic() + options.budget, 0, 0, {}, 0

    def found(what, at):
        entry = findings.setdefault(what, {"count": 0, "first": at})
        entry["count"] += 1

    while tried < options.inputs and time.monotonic() < until:
        pipe, other = context.Pipe(False)
        arguments = (other, name, folder, options.seed, index, options.inputs - tried, options.seconds, until)
        child = context.Process(target=_child, args=(*arguments, options.memory << 20))
        child.start()
        other.close()
        begun = None
        while True:
            if not pipe.poll(30 + 10 * options.seconds):
                child.kill()
                found("hang", begun)
                break
            try:
                at, what = pipe.recv()
            except EOFError:
                break
            if at is None:
                peak = max(peak, what)
            elif what == "begun":
                begun = at
            else:
                begun, tried, index = None, tried + 1, at + 1
                if what is not None:
                    found(what, at)
        child.join()
        if begun is not None:
            if child.exitcode != -signal.SIGKILL:
                found(f"process died with {child.exitcode}", begun)
            tried, index = tried + 1, begun + 1
        elif child.exitcode:
            found(f"process died with {child.exitcode} between inputs", index)
            break
        else:
            break
    return {"inputs": tried, "peak_rss_mb": peak // 1024, "findings": findings}


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--readers", default=",".join(READERS), help="names separated by commas")
    parser.add_argument("--inputs", type=int, default=6000, help="of each reader")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--budget", type=float, default=600.0, help="seconds for each reader")
    parser.add_argument("--seconds", type=float, default=2.0, help="of processor time that one input may take")
    parser.add_argument("--memory", type=int, default=4096, help="MiB of address space that a reader may take")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    results = {}
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        for name in options.readers.split(","):
            started = time.monotonic()
            results[name] = run_reader(name, Path(folder) / name, options)
            took = time.monotonic() - started
            result = results[name]
            kinds = len(result["findings"])
            print(
                f"{name:16} {result['inputs']:7} inputs {took:7.1f} s  peak {result['peak_rss_mb']} MB  {kinds} kinds"
            )
            for what, entry in result["findings"].items():
                print(f"    {entry['count']:6} x {what} (first: index {entry['first']})", flush=True)
    total = sum(result["inputs"] for result in results.values())
    print(f"{total} inputs, {sum(len(result['findings']) for result in results.values())} kinds of findings")
    if options.json is not None:
        options.json.write_text(json.dumps({"seed": options.seed, "total": total, "readers": results}, indent=1) + "\n")
    return 1 if any(result["findings"] for result in results.values()) else 0
