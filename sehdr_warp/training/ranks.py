"""Processes that train one scene together, each on a GPU of its own (or, with gloo, on the CPU of one machine).

Every rank has all the Gaussians and takes a photo of its own; one sum of all gradients, in one buffer, makes the step
that each of them then makes alike. Rank 0 leads: it reads the photos and hands them on, decides how the count changes,
evaluates, writes and prints. The others do steps and say nothing.
"""

import hashlib
import logging
import os
import pickle
import platform
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from ..errors import InputError, SehdrError, as_user_error
from ..parallel import run_interruptibly, thread_count
from ..scene.photo_file import PhotoFile, can_share, open_shared

log = logging.getLogger(__name__)

TIMEOUT = "SEHDR_RANK_TIMEOUT"
LONGEST_SILENCE = 600.0  # Seconds that a step of another rank may take; the variable above states others
GO, WAIT, END = 2, 1, 0
_EVER = timedelta(days=30)  # Of torch's own limits: they end a process with pages of its innards
_POLL = 0.1
ALL_END = "all end; the last checkpoint is whole, --resume goes on from it"
_LONGEST_WORD = 5.0  # Seconds that the watch may take to say or ask something
_GRACE = 1.0  # Seconds for whoever knows more about the end of a rank to tell it first


class RanksLost(SehdrError):
    """Another rank is gone or does not answer."""


class Ranks:
    """The place of this process among those that train together; use joined().

    rank: its number; count: of all. leads: whether it is rank 0. device: what it trains on.
    """

    def __init__(self, store: dist.Store, rank: int, count: int, device: torch.device):
        self.store, self.rank, self.count, self.device = store, rank, count, device
        self.leads = rank == 0
        self._cuda = device.type == "cuda"
        self._deadline: float | None = None
        self._over = threading.Event()
        self._photos: PhotoFile | None = None
        stated = os.environ.get(TIMEOUT, "")
        self._patience = float(stated) if stated.replace(".", "", 1).isdigit() else LONGEST_SILENCE

    def meet(self) -> None:
        """Finds the others; raises SehdrError where they run other versions."""
        with self._together():
            backend = "nccl" if self._cuda else "gloo"
            given: dict[str, Any] = {"device_id": self.device} if self._cuda else {}
            given |= {"store": self.store, "rank": self.rank, "world_size": self.count}
            begin = partial(dist.init_process_group, backend, timeout=_EVER, **given)
            run_interruptibly(begin, self._tell_wait)
            # What hosts say to each other must not wait for their devices.
            self._hosts = dist.new_group(backend="gloo", timeout=_EVER) if self._cuda else dist.group.WORLD
        self._check_versions()
        self._watcher = threading.Thread(target=self._watch, name="sehdr-warp ranks", daemon=True)
        self._watcher.start()

    def _tell_wait(self) -> None:
        log.info("rank %d of %d waits for the others", self.rank, self.count)

    def agree(self, wanted: int) -> int:
        """The least that any rank wants of GO, WAIT and END. Rank 0 may take its time before it asks; the others
        wait."""
        answer = torch.tensor([wanted], dtype=torch.int32)
        # Of another than rank 0 an answer is due; of rank 0, which may evaluate or be paused, none.
        self._deadline = time.monotonic() + self._patience if self.leads else None
        with self._together():
            dist.all_reduce(answer, dist.ReduceOp.MIN, group=self._hosts)
        agreed = int(answer)
        self._deadline = time.monotonic() + self._patience if agreed == GO else None
        return agreed

    def part(self) -> None:
        """The end of a training: waits until all have come to it. Leaving breaks off what was sent last."""
        self.agree(END)
        came, until = self.store.add("parted", 1), time.monotonic() + self._patience
        while self.store.add("parted", 0) < -(-came // self.count) * self.count and time.monotonic() < until:
            time.sleep(_POLL / 10)

    def mean(self, buffer: Tensor) -> None:
        """Replaces a buffer by its mean over the ranks, alike in every bit."""
        with self._together():
            dist.all_reduce(buffer, dist.ReduceOp.AVG if self._cuda else dist.ReduceOp.SUM)
        if not self._cuda:  # gloo has no means.
            buffer.mul_(1 / self.count)

    def collect(self, totals: list[Tensor]) -> None:
        """Adds up tensors on rank 0 and leaves zeros on the others: done twice, it changes nothing."""
        for total in totals:
            with self._together():
                dist.reduce(total, 0)
            if not self.leads:
                total.zero_()

    def spread(self, tensors: list[Tensor]) -> None:
        """Replaces tensors by rank 0's; however long that has to do before, the others wait."""
        self._deadline = None
        for tensor in tensors:
            with self._together():
                dist.broadcast(tensor, 0)
        self._deadline = time.monotonic() + self._patience

    def compare(self, tensors: dict[str, Tensor], iteration: int) -> None:
        """Raises SehdrError, on all ranks, where their tensors differ in a bit."""
        sums = [t.detach().contiguous().view(torch.int32).sum(dtype=torch.int64) for t in tensors.values()]
        own = torch.stack(sums)
        least, most = own.clone(), own.clone()
        with self._together():
            dist.all_reduce(least, dist.ReduceOp.MIN)
            dist.all_reduce(most, dist.ReduceOp.MAX)
        different = [name for name, same in zip(tensors, (least == most).tolist(), strict=True) if not same]
        if different:
            raise SehdrError(
                f"iteration {iteration}: {different[0]} is no longer the same on all ranks: memory or a GPU is broken, "
                "or they are of different kinds; --resume goes on from the last checkpoint, --gpus 1 on one"
            )

    def share(self, value: Any, size: int) -> None:
        """From rank 0: hands a value of about so many bytes on, whose large arrays all ranks then read in one file."""
        self._photos = PhotoFile(size + (1 << 30))
        # It takes bytes, whatever its stub says.
        self.store.set("shared", pickle.dumps(self._photos.share(value)))  # pyright: ignore[reportArgumentType]

    def shared(self) -> Any:
        """On the others: what rank 0 shares, however long it takes to read its photos; None where there is nothing."""
        while not self.store.check(["shared"]):
            if self.store.check(["ended"]):
                return None
            time.sleep(_POLL)
        return open_shared(pickle.loads(self.store.get("shared")))

    def ends_first(self) -> bool:
        """Whether this is the first rank that ends with an error; it alone tells why."""
        try:
            return self.store.add("ended", 1) == 1
        except RuntimeError:  # The store was that of a rank that is gone.
            return True

    def notes(self) -> Iterator[str]:
        """What to know of this machine's GPUs."""
        others = range(1, self.count) if self._cuda else ()
        apart = [k for k in others if not torch.cuda.can_device_access_peer(0, k)]
        if apart:
            yield f"GPU {apart[0]} has no access to the memory of GPU 0: gradients go through the host, which is slower"

    def close(self) -> None:
        """The end of a training that all ranks came to."""
        self._over.set()
        # What still talks to other ranks while the interpreter ends would abort the process.
        self._watcher.join(_LONGEST_WORD)
        self._hosts = None
        dist.destroy_process_group()

    def abandon(self) -> None:
        """The end of this rank where others may wait for ever."""
        self._over.set()

    @contextmanager
    def _together(self) -> Iterator[None]:
        try:
            yield
        except RuntimeError as error:
            time.sleep(_GRACE)
            log.debug("%s", error)
            raise RanksLost(f"rank {self.rank} of {self.count} lost another, which is gone: {ALL_END}") from error

    def _check_versions(self) -> None:
        from .. import __version__

        own = f"sehdr-warp {__version__} ({_source()}), torch {torch.__version__}, warp {version('warp-lang')}"
        own += f", Python {platform.python_version()}"
        found: list = [None] * self.count
        with self._together():
            dist.all_gather_object(found, own, group=self._hosts)
        other = next((k for k, told in enumerate(found) if told != found[0]), None)
        if other is not None:
            raise SehdrError(f"rank {other} runs {found[other]}, rank 0 {found[0]}: install the same on all")

    def _watch(self) -> None:
        """Ends this process where another does not answer: what waits for a device or a socket cannot be told
        otherwise. Rank 0 may be long between steps, but its own watch goes on."""
        heard, since, beat = "", time.monotonic(), 0.0
        while not self._over.wait(min(1.0, self._patience / 4)):
            now, deadline = time.monotonic(), self._deadline
            if now - beat > self._patience / 4:
                beat = now
                with suppress(RuntimeError):  # The store is gone: its rank will be missed otherwise.
                    if self.leads:
                        self.store.set("alive", str(now))
                    elif self.store.check(["alive"]) and (told := self.store.get("alive").decode()) != heard:
                        heard, since = told, now
            if (deadline is not None and now > deadline) or (heard and now - since > self._patience):
                if self.ends_first():
                    told = "another rank did not answer rank %d of %d for %.0f s (%s): %s"
                    log.error(told, self.rank, self.count, self._patience, TIMEOUT, ALL_END)
                os._exit(1)


def _source() -> str:
    """A short hash of the package's own files: a version that is worked on has one name for many states."""
    total = hashlib.sha256()
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        total.update(path.read_bytes())
    return total.hexdigest()[:8]


def stated() -> tuple[int, int] | None:
    """Rank and count that a launcher (torchrun, or --gpus) states for this process; None where there is none. Raises
    SehdrError for ranks on several machines."""
    try:
        rank, count = int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
        here = int(os.environ.get("LOCAL_WORLD_SIZE", count))
    except (KeyError, ValueError):
        return None
    if here != count:
        raise SehdrError(f"{count} ranks on several machines: one machine trains a scene, with --gpus or torchrun")
    return (rank, count) if count > 1 else None


def device_of_rank(rank: int, device: str | None) -> torch.device:
    """The device of a rank on a machine: a GPU of its own, or the CPU where that is named or there is no GPU."""
    if device not in (None, "cpu", "cuda"):
        raise InputError(f"device {device}", "is one, and each rank takes its own", "use cpu or cuda, or leave it out")
    if device == "cpu" or (device is None and not torch.cuda.is_available()):
        if rank >= (most := max(2, os.cpu_count() or 1)):
            raise SehdrError(f"{rank + 1} ranks on {os.cpu_count()} processors: start {most} at most")
        return torch.device("cpu")
    if (there := torch.cuda.device_count()) <= rank:
        raise SehdrError(f"rank {rank} finds {there} GPUs: start as many ranks as there are, or give --device cpu")
    return torch.device("cuda", rank)


@contextmanager
def joined(rank: int, count: int, device: torch.device) -> Iterator[Ranks]:
    """Among the ranks for as long as this lasts. An error of any rank ends all of them, and one tells it."""
    if not can_share():
        raise SehdrError("several ranks need Linux, where processes can read one nameless file")
    os.environ.setdefault("SEHDR_THREADS", str(max(1, thread_count() // count)))
    # All are on this machine, whatever its network.
    for name in ("GLOO_SOCKET_IFNAME", "NCCL_SOCKET_IFNAME"):
        os.environ.setdefault(name, "lo")
    if device.type == "cuda":
        torch.cuda.set_device(device)
    if rank:
        logging.getLogger("sehdr_warp").setLevel(logging.ERROR)
    store = run_interruptibly(_store, lambda: log.info("rank %d of %d waits for the others", rank, count))
    ranks = Ranks(store, rank, count, device)
    try:
        ranks.meet()
        yield ranks
        ranks.close()
    except BaseException as error:
        ranks.abandon()
        _end_soon(error)
        first, told = ranks.ends_first(), isinstance(error, Exception) and as_user_error(error)
        if told and not first:
            raise SystemExit(1) from None
        if rank and isinstance(error, KeyboardInterrupt):
            raise SystemExit(130) from None
        raise


def _store() -> dist.Store:
    """Where the ranks meet: a file of --gpus, or torchrun's server."""
    if path := os.environ.get("SEHDR_RANKS"):
        return dist.FileStore(path, int(os.environ["WORLD_SIZE"]) + 1)
    from torch.distributed.rendezvous import rendezvous

    if missing := [name for name in ("MASTER_ADDR", "MASTER_PORT") if not os.environ.get(name)]:
        problem = f"RANK and WORLD_SIZE are set, and {' and '.join(missing)} not"
        raise SehdrError(f"{problem}: start with torchrun or --gpus, or unset RANK")
    try:
        return next(rendezvous("env://", timeout=timedelta(minutes=5)))[0]
    except (RuntimeError, ValueError) as error:
        place = f"{os.environ['MASTER_ADDR']}:{os.environ['MASTER_PORT']}"
        raise SehdrError(
            f"no other ranks at {place} ({str(error).splitlines()[0]:.120}); start with torchrun"
        ) from None


def _end_soon(error: BaseException) -> None:
    """Lets nothing that the interpreter tidies up at its end wait for ranks that are gone."""
    import atexit

    code = 130 if isinstance(error, KeyboardInterrupt) else error.code if isinstance(error, SystemExit) else 1

    def leave() -> None:
        with suppress(Exception):
            logging.shutdown()
        os._exit(code if isinstance(code, int) else 1)

    atexit.register(leave)
