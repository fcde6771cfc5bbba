"""Command lines in children of a process that has loaded everything, so that hundreds take minutes: each is watched for
what it says, how long it takes, how much memory, and which programs it starts."""

import builtins
import importlib
import io
import json
import os
import resource
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import chdir, suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from urllib.request import Request, urlopen

from sehdr_warp import cli
from sehdr_warp.output.export import gaussians
from sehdr_warp.synth.expose import RadianceView
from tests.make_scenes import write_blender, write_reinhard
from tests.training.toy import toy_scene

SEED = 19
COMMANDS = {
    # Checkpoints of the default interval are 10 s apart.
    "train": "train photos --out run --preset demo --response hdr-nerf --iterations 24 --device cpu --seed 3 "
    "--schedule.checkpoint-every 4800",
    "render": "render run --out made --cameras all --evs=-2,0 --device cpu --overwrite",
    "export": "export run --out made/scene.ply --kind hdr --overwrite",
    "export usd": "export run --out made/scene.usda --overwrite",
    "report": "report run --out made --device cpu --overwrite",
    "envmap": "envmap run --out made/light.exr --size 32 --device cpu --overwrite",
    "eval": "eval run --json made/figures.json --device cpu --overwrite",
    "synth": "synth truth --out set --overwrite",
    "film": "render run --video made/film.mp4 --cameras all --device cpu --overwrite",
    "lights": "lights run --out made/lights.json --device cpu --overwrite",
}
VIEW = ["view", "run", "--port", "0", "--device", "cpu"]
COMMANDS = {name: line.split() for name, line in COMMANDS.items()}
TRAIN = COMMANDS.pop("train")
LOCAL = ("127.0.0.1", "::1", "localhost")
STARTED = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.spawn")
LATEST = 300.0  # Seconds after which a command hangs, on however busy a machine; of its processor's time it may take 30
CHANGES = ("rename", "replace", "unlink", "rmdir", "mkdir", "fsync", "open", "write")
"""Functions of os at which a child may be killed."""


@dataclass(frozen=True)
class Ended:
    """End of a command line. code: as of subprocess; memory: MiB, at most; changes: calls of CHANGES."""

    code: int
    out: str
    err: str
    seconds: float
    memory: int
    changes: int


def load(folder: Path) -> None:
    """Loads what commands need, and their kernels by using them once, all on one thread: others do not survive a fork.
    Leaves photos, a run `run` and what commands make of it in `folder`."""
    os.environ |= {"SEHDR_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE", "MPLBACKEND": "agg"}
    write_blender(folder / "photos", 6, size=(24, 16))
    views = [RadianceView(view.name, view.camera, view.hdr, view.split) for view in toy_scene(6, 16).views]
    write_reinhard(folder / "truth", views, [0.5, 2.0])
    importlib.import_module("torch").set_num_threads(1)
    _spare_time()
    for words in (TRAIN, *COMMANDS.values()):
        with chdir(folder), suppress(SystemExit):
            cli.main([*words, "-q"])


def _spare_time() -> None:
    """Drop work that no case is about: pixels of figures, steps of a fit, and the source of options, which is read anew
    for each command line (and once more for a tenth of them while pytest is loaded)."""
    figures, docstrings = importlib.import_module("matplotlib.figure"), importlib.import_module("tyro._docstrings")
    save, make = figures.Figure.savefig, docstrings._ClassTokenization.make
    figures.Figure.savefig = lambda figure, *given, **options: save(figure, *given, **options | {"dpi": 40})
    gaussians.fit_to_pictures = partial(gaussians.fit_to_pictures, steps=9)
    docstrings._ClassTokenization.make = staticmethod(cache(make))


def call(
    *words: object,
    folder: Path,
    kill_after: float | None = None,
    kill_at: int | None = None,
    seconds: float = LATEST,
    prepare: Callable[[], None] = lambda: None,
) -> Ended:
    """Runs a command line in a child, in `folder`. kill_after: seconds until SIGKILL; kill_at: the change of the disk
    at which it comes. Raises AssertionError for what no command line may do: a traceback, a hang, a program started."""
    said, started = [folder / f".{name}" for name in ("out", "err")], time.monotonic()
    count = folder / ".count"
    for path in said:
        path.write_bytes(b"")
    child = os.fork()
    if child == 0:
        _run([str(word) for word in words], folder, said, count, kill_at, prepare)
    status, usage = 0, None
    while usage is None:
        done, status, used = os.wait4(child, os.WNOHANG)
        usage = used if done else None
        late = time.monotonic() - started
        if usage is None and late > (kill_after if kill_after is not None else seconds):
            os.kill(child, signal.SIGKILL)
            _, status, usage = os.wait4(child, 0)
            assert kill_after is not None, f"hangs for {seconds} s: {words}"
        time.sleep(0.005)
    out, err = (path.read_text(errors="replace") for path in said)
    changes = int(count.read_text() or 0) if count.exists() else 0
    for path in (*said, count):
        path.unlink(missing_ok=True)
    code = os.waitstatus_to_exitcode(status)
    assert usage.ru_utime + usage.ru_stime < 30, f"hangs for 30 s of processor time: {words}"
    assert "Traceback" not in err and "STARTED" not in err, f"{words}: {err[-2000:]}"
    assert code in (0, 1, 2, 129, 130, 141, 143, -signal.SIGKILL), f"{words}: ended with {code}: {err[-500:]}"
    lines = err.splitlines()
    assert code not in (1, 2) or (lines and lines[-1].startswith("sehdr-warp: ")), f"{words}: {err[-500:]}"
    return Ended(code, out, err, time.monotonic() - started, usage.ru_maxrss // 1024, changes)


def _run(words, folder, said, count, kill_at, prepare) -> None:
    code = 70
    try:
        os.chdir(folder)
        for number, path in enumerate((Path(os.devnull), *said)):
            handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o600)
            os.dup2(handle, number)
            os.close(handle)
        sys.stdin, sys.stdout, sys.stderr = (os.fdopen(n, m, closefd=False) for n, m in enumerate("rww"))
        for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(each, signal.default_int_handler if each == signal.SIGINT else signal.SIG_DFL)
        from sehdr_warp.__main__ import run  # Before prepare(), which may leave no memory for it.

        sys.argv = ["sehdr-warp", *words]
        sys.addaudithook(_watch)
        sys.modules.pop("pytest", None)  # With it tyro makes a tenth of what it has kept once more.
        prepare()
        made = _count(kill_at)
        try:
            run()
        finally:
            sys.stdout.flush()
            with suppress(MemoryError):
                count.write_text(str(made[0]))
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:  # noqa: BLE001
        traceback.print_exc()
        sys.stderr.flush()  # os._exit() would lose it.
    finally:
        os._exit(code)


def _watch(event: str, arguments) -> None:
    """Tells of programs that are started and hosts that are connected to."""
    if event.startswith(STARTED) and str(arguments[0]) != sys.executable:
        os.write(2, f"STARTED {event} {arguments[:2]}\n".encode())
    if event == "socket.connect" and isinstance(arguments[1], tuple) and arguments[1][0] not in LOCAL:
        os.write(2, f"STARTED a connection to {arguments[1]}\n".encode())
    if event == "socket.bind" and "view" not in "".join(sys.argv[1:2]) and isinstance(arguments[1], tuple):
        os.write(2, f"STARTED to listen at {arguments[1]}\n".encode())
    if event == "socket.getaddrinfo" and arguments[0] not in (*LOCAL, None, ""):
        os.write(2, f"STARTED to look for {arguments[0]}\n".encode())


def _count(kill_at: int | None) -> list[int]:
    """Counts the changes of the disk, and kills the process before the one of that number. A file that is written
    counts twice: before, and with half of what was written in it."""
    made, writing = [0], []

    def at_change() -> None:
        made[0] += 1
        if made[0] == kill_at:
            for path, before in writing:
                os.truncate(path, (before + os.path.getsize(path)) // 2)
            os.kill(os.getpid(), signal.SIGKILL)

    def counted(function, opens: bool):
        def call(*arguments, **options):
            if writing and os.path.exists(writing[0][0]):
                at_change()
            writing.clear()
            at_change()
            mode = str((*arguments, *options.values())[1:2])
            appends, path = "a" in mode, arguments[0]
            size = os.path.getsize(path) if opens and appends and os.path.exists(path) else 0
            result = function(*arguments, **options)
            if opens and set(mode) & set("wax+") and os.path.isfile(path):
                writing.append((path, size))
            return result

        return call

    for name in CHANGES:
        setattr(os, name, counted(getattr(os, name), opens=False))
    builtins.open = io.open = counted(open, opens=True)
    return made


def browse(folder: Path, ever: bool) -> Callable[[], None]:
    """Starts, in a child that will be a viewer, a client that asks for all that it serves: for ever, or once."""

    def ask(url: str, path: str, asked: dict | None = None) -> bytes:
        data = None if asked is None else json.dumps(asked).encode()
        with urlopen(Request(url + path, data, {"Content-Type": "application/json"}), timeout=60) as answer:
            return answer.read()

    def client() -> None:
        while "http" not in (said := (folder / ".out").read_text()):
            time.sleep(0.01)
        url = said.split()[0]
        while True:
            camera = {"camera": json.loads((folder / "run" / "scene.json").read_text())["views"][0]["camera"]}
            made = [ask(url, "scene"), ask(url, "photo/0/0"), ask(url, "frame", camera)]
            made += [ask(url, "save", {"cameras": list(camera.values()), "kind": kind}) for kind in ("exr", "brackets")]
            if not ever:
                (folder / "tmp" / "asked").write_text(str(sum(map(len, made))))
                os.kill(os.getpid(), signal.SIGINT)
                return

    def prepare() -> None:
        (folder / "tmp").mkdir(exist_ok=True)
        tempfile.tempdir = str(folder / "tmp")
        threading.Thread(target=client, daemon=True).start()

    return prepare


def limit_memory(mebibytes: int) -> Callable[[], None]:
    """Leaves a child so much address space beyond what it has."""

    def prepare() -> None:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        most = pages * resource.getpagesize() + (mebibytes << 20)
        resource.setrlimit(resource.RLIMIT_AS, (most, most))

    return prepare


def files_in(folder: Path) -> dict[str, bytes | str]:
    """Content of every file, and where links lead; leftovers have hidden names."""
    return {
        str(path.relative_to(folder)): os.readlink(path) if path.is_symlink() else path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_symlink() or path.is_file()
    }
