"""Start the ranks of a multi-GPU training as processes of this machine, and end them together."""

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
from .rank_info import FILE_STORE

GRACE = 5.0  # Seconds that other ranks have to end after one has ended, and again after SIGTERM


def launch(count: int, run: Callable[[list[str]], None], words: list[str]) -> None:
    """Run a command line in `count` processes, one per rank, and exit with their status.

    Args:
        count: Number of ranks.
        run: Function that runs a command line in a process.
        words: The command line.

    Raises:
        SehdrError: If a rank is killed.
    """
    for name in ("torch.multiprocessing.spawn", "torch.multiprocessing"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # Silence its lines about the processes it ends.
    with tempfile.TemporaryDirectory(prefix="sehdr-warp-") as folder:
        store_path = str(Path(folder) / "ranks")
        store = dist.FileStore(store_path, count + 1)
        context = processes.start_processes(
            _rank, (count, run, words, store_path), count, join=False, start_method="spawn"
        )
        assert context is not None
        _forward_signals(context)
        killed = None
        try:
            while True:
                for rank in [context.sentinels[sentinel] for sentinel in wait(context.sentinels)]:
                    process = context.processes[rank]
                    assert process is not None
                    process.join()
                    code = process.exitcode or 0
                    # Set before the other ranks report a lost connection, which says less.
                    if code < 0 and store.add("ended", 1) == 1:
                        killed = f"rank {rank} of {count} was killed ({signal.Signals(-code).name})"
                if context.join(grace_period=GRACE):
                    return
        except processes.ProcessExitedException as ended:
            if killed:
                remedy = "all ranks end; the last checkpoint is complete, --resume continues from it"
                raise SehdrError(f"{killed}: {remedy}") from None
            sys.exit(ended.exit_code if ended.exit_code > 0 else 1)


def _rank(rank: int, count: int, run: Callable[[list[str]], None], words: list[str], store_path: str) -> None:
    """Run one rank with the environment variables that torchrun sets."""
    os.environ |= {"RANK": str(rank), "WORLD_SIZE": str(count), FILE_STORE: store_path}
    run(words)


def _forward_signals(context) -> None:
    """Forward signals that end this process to the ranks, which save first; a terminal sends Ctrl-C to them itself."""

    def forward(number: int, _) -> None:
        for process in context.processes:
            if process.is_alive():
                os.kill(process.pid, number)

    signal.signal(signal.SIGINT, lambda *_: None)
    for name in ("SIGTERM", "SIGHUP"):
        if hasattr(signal, name) and signal.getsignal(getattr(signal, name)) is not signal.SIG_IGN:
            signal.signal(getattr(signal, name), forward)
