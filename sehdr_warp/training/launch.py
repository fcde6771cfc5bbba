"""Processes that train together: start them for --gpus, and read rank and node that torchrun or --gpus state."""

import logging
import os
import platform
import signal
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import timedelta
from importlib.metadata import version
from multiprocessing.connection import wait
from pathlib import Path

import torch
import torch.distributed as dist
import torch.multiprocessing as processes

from ..caches import package_hash
from ..errors import InputError, SehdrError

FILE_STORE = "SEHDR_RANKS"  # Environment variable with the file through which the ranks of --gpus find each other
_MOST_RANKS = 1 << 14  # Processes of a training; the server of the ranks takes memory for each that is announced
GRACE = 5.0  # Seconds that other ranks have to end after one has ended, and again after SIGTERM


@dataclass(frozen=True)
class RankInfo:
    """Rank and node of a process."""

    rank: int  # Number among all processes
    count: int  # Number of processes
    local_rank: int  # Number among those of this node
    local_count: int  # Processes of this node
    node: int = 0  # Number of this node
    nodes: int = 1  # Number of nodes

    @property
    def several_nodes(self) -> bool:
        """True if the processes are on several nodes."""
        return self.nodes > 1

    def __str__(self) -> str:
        """Return the rank, with its node if there are several."""
        where = f" on node {self.node} ({platform.node()})" if self.several_nodes else ""
        return f"rank {self.rank} of {self.count}{where}"

    def node_of(self, rank: int) -> int:
        """Return the node of another rank; nodes have equal numbers of processes, and ranks in order."""
        return rank // self.local_count


def rank_from_environment() -> RankInfo | None:
    """Return the info that a launcher sets for this process; None if there is no launcher, or one process.

    Raises SehdrError for numbers that no launcher sets.
    """

    def number(name: str, default: int) -> int:
        with suppress(KeyError, ValueError):
            return int(os.environ[name])
        return default

    if not {"RANK", "WORLD_SIZE"} <= os.environ.keys():
        return None
    rank, count = number("RANK", -1), number("WORLD_SIZE", 0)
    _check_number("WORLD_SIZE", count, 1, _MOST_RANKS)
    _check_number("RANK", rank, 0, count - 1)
    local_count = number("LOCAL_WORLD_SIZE", count)
    _check_number("LOCAL_WORLD_SIZE", local_count, 1, count)
    local_rank, node = number("LOCAL_RANK", rank % local_count), number("GROUP_RANK", rank // local_count)
    nodes = number("GROUP_WORLD_SIZE", -(-count // local_count))
    _check_number("LOCAL_RANK", local_rank, 0, local_count - 1)
    if nodes * local_count != count:
        problem = f"{count} ranks on {nodes} nodes, and {local_count} on this one"
        raise SehdrError(f"{problem}: start the same number on each, with --nproc-per-node")
    _check_number("GROUP_RANK", node, 0, nodes - 1)
    return RankInfo(rank, count, local_rank, local_count, node, nodes) if count > 1 else None


def _check_number(name: str, value: int, least: int, most: int) -> None:
    """Raise SehdrError if an environment variable of a launcher is not a number from `least` to `most`."""
    if not least <= value <= most:
        problem = f"{name} = {os.environ.get(name, value)!s:.40} is not a number from {least} to {most}"
        raise SehdrError(f"{problem}: start with torchrun or --gpus, or unset RANK")


def installed_versions() -> str:
    """Return the versions of this package, with its hash, and of what it computes with."""
    from .. import __version__

    own = f"sehdr-warp {__version__} ({package_hash()}), torch {torch.__version__}"
    return f"{own}, warp {version('warp-lang')}, Python {platform.python_version()}"


def device_of_rank(rank: int, device: str | None) -> torch.device:
    """Return the device of a rank, by its number on its node: a GPU of its own, or the CPU if named or without GPUs."""
    if device not in (None, "cpu", "cuda"):
        raise InputError(f"device {device}", "names one GPU, and each rank uses its own", "use cpu or cuda")
    if device == "cpu" or (device is None and not torch.cuda.is_available()):
        if rank >= (most := max(2, os.cpu_count() or 1)):
            raise SehdrError(f"{rank + 1} ranks on {os.cpu_count()} processors: start {most} at most")
        return torch.device("cpu")
    if (there := torch.cuda.device_count()) <= rank:
        raise SehdrError(f"rank {rank} finds {there} GPUs: start one rank for each GPU, or add --device cpu")
    return torch.device("cuda", rank)


def open_store(info: RankInfo, timeout: float) -> dist.Store:
    """Return the store of the ranks: a file of --gpus, or torchrun's server, for which it waits `timeout` seconds.

    Raises:
        SehdrError: If there is no server, naming its address.
    """
    if path := os.environ.get(FILE_STORE):
        return dist.FileStore(path, info.count + 1)
    if missing := [name for name in ("MASTER_ADDR", "MASTER_PORT") if not os.environ.get(name)]:
        problem = f"RANK and WORLD_SIZE are set, and {' and '.join(missing)} not"
        raise SehdrError(f"{problem}: start with torchrun or --gpus, or unset RANK")
    host, port = os.environ["MASTER_ADDR"], os.environ["MASTER_PORT"]
    if not (port.isascii() and port.isdigit() and 0 < int(port[:9]) < 1 << 16):
        raise SehdrError(f"MASTER_PORT = {port:.40} is not a port from 1 to 65535: start with torchrun, or unset RANK")
    of_agent = os.environ.get("TORCHELASTIC_USE_AGENT_STORE") == "True"
    serves = info.rank == 0 and not of_agent
    try:
        # Not torch's rendezvous(), which does not say who is missing.
        wait = timedelta(seconds=timeout)
        store = dist.TCPStore(host, int(port), info.count, serves, wait, wait_for_workers=False)
        # An agent's server outlives a restart of its processes.
        return dist.PrefixStore(f"attempt_{os.environ['TORCHELASTIC_RESTART_COUNT']}", store) if of_agent else store
    except (RuntimeError, ValueError) as error:
        problem = f"{info} cannot {'serve' if serves else 'reach'} {host}:{port} ({str(error).splitlines()[0]:.120})"
        remedy = "check that node 0 runs and that this port is free and open, and start with torchrun"
        raise SehdrError(f"{problem}; {remedy}") from None


def launch_ranks(count: int, run: Callable[[list[str]], None], words: list[str]) -> None:
    """Run a command line in `count` processes, one per rank, and exit with their status.

    `run` runs a command line in a process; raises SehdrError if a rank is killed.
    """
    for name in ("torch.multiprocessing.spawn", "torch.multiprocessing"):
        logging.getLogger(name).setLevel(logging.CRITICAL)  # Silence its lines about the processes it ends.
    with tempfile.TemporaryDirectory(prefix="sehdr-warp-") as folder:
        store_path = str(Path(folder) / "ranks")
        store = dist.FileStore(store_path, count + 1)
        arguments = count, run, words, store_path
        context = processes.start_processes(_rank, arguments, count, join=False, start_method="spawn")
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
