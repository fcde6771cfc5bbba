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
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from sehdr_warp import sandbox

from .mutate import mutate
from .reader import Workspace
from .readers import READERS

LONGEST_MESSAGE = 1000


class TooSlow(BaseException):
    """Raised by the timer within a reader; no reader's `except Exception` may swallow it."""


def forked(words, seconds: float) -> sandbox.Result:
    """Run words as sandbox.start does, which takes half a second to load what this process has loaded."""
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        child = os.fork()
        if child == 0:
            code = 1
            try:
                os.dup2(out.fileno(), 1), os.dup2(err.fileno(), 2)
                signal.alarm(int(seconds) + 1)
                code = sandbox.main(*words)
            finally:
                os._exit(code)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        out.seek(0), err.seek(0)
        return sandbox.Result(code, out.read(), err.read())


def fork_server():
    """Replace sandbox.start: a copy of this process as it is now forks for each sandbox.

    Decoders that a process has used leave threads and locks behind, which do not survive its fork.
    """
    ours, theirs = get_context("fork").Pipe()
    if os.fork() == 0:
        ours.close()
        try:
            while True:
                theirs.send(tuple(forked(*theirs.recv())))
        finally:
            os._exit(0)
    theirs.close()

    def start(words, seconds: float) -> sandbox.Result:
        ours.send((words, seconds))
        return sandbox.Result(*ours.recv())

    return start


def seed_of(name: str, seed: int, index: int) -> int:
    """The random seed of one input: (reader, seed, index) makes it again."""
    return zlib.crc32(f"{name}/{seed}/{index}".encode())


def make_input(space: Workspace, name: str, seed: int, index: int) -> Path:
    """Changes one of the workspace's files; returns which."""
    rng = random.Random(seed_of(name, seed, index))
    path = space.changed = rng.choice(list(space.targets))
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
            space.read()
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


def fuzz(name: str, folder: Path, seed: int, first: int, count: int, seconds: float):
    """Tries `count` inputs of one reader; yields the index of each and "begun", then the index and what was found."""
    space = Workspace(READERS[name], folder)
    for index in range(first, first + count):
        yield index, "begun"
        make_input(space, name, seed, index)
        finding = try_input(space, seconds)
        space.restore()
        yield index, finding


def _child(pipe, name: str, folder: Path, options, first: int, inputs: int) -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # decoders print there
    import torch  # its address space is no reader's doing

    torch.set_num_threads(1)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (options.memory << 20),) * 2)
    sandbox.start = fork_server()
    for message in fuzz(name, folder, options.seed, first, inputs - first, options.seconds):
        pipe.send(message)


def run_reader(name: str, folder: Path, inputs: int, options) -> tuple[int, dict[str, list]]:
    """Return the number of inputs that one reader got, and of each kind of finding the first index, words, and number.

    A new process starts after a death."""
    tried, findings = 0, {}

    def note(index: int, finding: str) -> None:
        findings.setdefault(finding.partition(": ")[0], [index, finding, 0])[2] += 1

    while tried < inputs:
        pipe, other = get_context("spawn").Pipe(False)
        child = get_context("spawn").Process(target=_child, args=(other, name, folder, options, tried, inputs))
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
                    note(index, finding)
        else:
            child.kill()
            what = "hang"
        child.join()
        if begun is None:
            break
        note(begun, what)
        tried = begun + 1
    return tried, findings


def provenance_of(command: str) -> dict:
    """Return machine, versions and command of a result, as a report's page needs them."""
    import torch

    from benchmarks.results import new_result

    result = new_result("trust", torch.device("cpu"), {})
    return {"command": command} | {name: result[name] for name in ("date", "machine", "notes")}


def store_values(path: Path, **values) -> None:
    """Write values into a JSON file beside those that it holds."""
    path.write_text(json.dumps(read_values(path) | values, indent=1) + "\n")


def read_values(path: Path) -> dict:
    return json.loads(path.read_text()) if path.exists() else {}


def share(name: str, inputs: int) -> int:
    """Return the number of inputs that a reader gets of so many: all readers take about as long."""
    return max(1, round(inputs / READERS[name].cost / sum(1 / reader.cost for reader in READERS.values())))


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--readers", default=",".join(READERS), help="names separated by commas")
    parser.add_argument("--inputs", type=int, default=100_000, help="of all readers, more of those that are quick")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1, help="readers at once")
    parser.add_argument("--seconds", type=float, default=2.0, help="of processor time that one input may take")
    parser.add_argument("--memory", type=int, default=4096, help="MiB of address space that a reader may take")
    parser.add_argument("--json", type=Path, help="file to which the figures are added")
    options, rows = parser.parse_args(), []
    memory = "/dev/shm" if os.path.isdir("/dev/shm") else None
    with tempfile.TemporaryDirectory(dir=memory) as folder, ThreadPoolExecutor(options.jobs) as pool:

        def one(name: str) -> tuple[str, int, float, dict]:
            started = time.monotonic()
            found = run_reader(name, Path(folder) / name, share(name, options.inputs), options)
            return name, found[0], time.monotonic() - started, found[1]

        for name, tried, seconds, findings in pool.map(one, options.readers.split(",")):
            print(f"{name:18}{tried:8} inputs{seconds:7.0f} s, {len(findings)} kinds of findings", flush=True)
            for index, finding, count in findings.values():
                print(f"    {count:6} x {finding} (first: index {index})", flush=True)
            rows.append({"reader": name, "inputs": tried, "seed": options.seed, "findings": len(findings)})
            if options.json:
                store_values(options.json, fuzz=read_values(options.json).get("fuzz", []) + rows[-1:])
    print(f"{sum(row['inputs'] for row in rows)} inputs, {sum(row['findings'] for row in rows)} kinds of findings")
    return int(any(row["findings"] for row in rows))
