"""The command line of `sehdr-warp view`. torch is imported when it runs."""

import logging
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from ..runs.open import load_run_scene, open_scene

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class View:
    """Look at trained scenes in a browser: fly through, expose, probe, compare, save. Runs until Ctrl-C."""

    runs: Annotated[Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN ...", help_behavior_hint="")]
    """Folders of runs, or files of Gaussians; with several, the page compares them."""
    port: int = 8080  # Port; the next free one if it is in use.
    host: str = "127.0.0.1"  # Address to serve: this machine alone, or 0.0.0.0 for all that can reach it.
    origin: tuple[str, ...] = ()
    """Address of a proxy in front of the viewer, such as https://splats.example.org."""
    device: str | None = None  # cpu or cuda:N; by default the first GPU if there is one.
    data: str | None = None  # The photos, if they have moved since the training.


def run_view(args: View) -> None:
    """Run `sehdr-warp view`."""
    from functools import cache

    from ..errors import InputError, UsageError
    from ..process import return_memory
    from ..runs.run import Run
    from .server import Server, Viewer
    from .watching import Watch

    if not args.runs:
        raise UsageError("view needs RUN, the folder of a run; see sehdr-warp view --help")
    if not 0 <= args.port < 65536:
        raise UsageError(f"--port {args.port}: is not a port; give 1 to 65535, or 0 for any")
    for origin in args.origin:
        if not re.fullmatch(r"https?://[A-Za-z0-9.-]+(:[0-9]+)?", origin):
            raise UsageError(f"--origin {origin}: write it as https://NAME or https://NAME:PORT")
    watch = Watch(args.runs, lambda path: open_scene(path, args.device))

    @cache
    def photos(index: int) -> dict:
        run = watch.scenes[index].run
        run = run.reference or run  # Of a merged scene the first one.
        if not isinstance(run, Run):
            raise InputError(args.runs[index], "is a file of Gaussians, without photos", "view the run it came from")
        return {view.name: view for view in load_run_scene(run, args.data).views}

    return_memory()
    watch.start()
    with Server(Viewer(watch.scenes, photos), args.host, args.port, args.origin) as server:
        print(f"{server.url}  (Ctrl-C ends it)", flush=True)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            log.info("the viewer has ended")
        watch.stop()
        for run in watch.scenes:  # What is being rendered is waited for: kernels must not outlive Python.
            run.lock.block(timeout=30)
