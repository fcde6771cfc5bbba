"""Starts the ranks of a training, one for each GPU, as processes of this machine, and ends them together."""

import logging
import os
import signal
import sys
import tempfile
from collections.abc import Callable
from multiprocessing.connection import wait
from pathlib import Path

import torch.distributed as dist
import torch.multiprocessing as processes

from ..errors import SehdrError

GRACE = 5.0  # Seconds for the others to end by themselves once one has, and again after SIGTERM


def launch(count: int, run: Callable[[list[str]], None], words: list[str]) -> None:
    """Runs the command line of these words in `count` processes, each by run(words), and exits as they do. Raises
    SehdrError where one is killed."""
    for name in ("torch.multiprocessing.spawn", "torch.multiprocessing"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # It tells whom it ends, which is no news.
    with tempfile.TemporaryDirectory(prefix="sehdr-warp-") as folder:
        meeting = str(Path(folder) / "ranks")
        store = dist.FileStore(meeting, count + 1)
        context = processes.start_processes(
            _rank, (count, run, words, meeting), count, join=False, start_method="spawn"
        )
        assert context is not None
        _pass_signals_on(context)
        killed = None
        try:
            while True:
                for rank in [context.sentinels[sentinel] for sentinel in wait(context.sentinels)]:
                    process = context.processes[rank]
                    assert process is not None
                    process.join()
                    code = process.exitcode or 0
                    # Before the others are waited for: they would tell less.
                    if code < 0 and store.add("ended", 1) == 1:
                        killed = f"rank {rank} of {count} was killed ({signal.Signals(-code).name})"
                if context.join(grace_period=GRACE):
                    return
        except processes.ProcessExitedException as ended:
            if killed:
                remedy = "all end; the last checkpoint is whole, --resume goes on from it"
                raise SehdrError(f"{killed}: {remedy}") from None
            sys.exit(ended.exit_code if ended.exit_code > 0 else 1)


def _rank(rank: int, count: int, run: Callable[[list[str]], None], words: list[str], meeting: str) -> None:
    os.environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank), "WORLD_SIZE": str(count), "SEHDR_RANKS": meeting}
    run(words)


def _pass_signals_on(context) -> None:
    """What would end this process ends the ranks, which save first; a terminal's Ctrl-C reaches them by itself."""

    def pass_on(number: int, _) -> None:
        for process in context.processes:
            if process.is_alive():
                os.kill(process.pid, number)

    signal.signal(signal.SIGINT, lambda *_: None)
    for name in ("SIGTERM", "SIGHUP"):
        if hasattr(signal, name) and signal.getsignal(getattr(signal, name)) is not signal.SIG_IGN:
            signal.signal(getattr(signal, name), pass_on)
