"""Processes that train one scene together, each on its own GPU (or, with gloo, on CPUs), on one node or several.

Every rank has all Gaussians and takes its own photo; all gradients, in one buffer, are averaged, so that all ranks
apply the same step. Rank 0, the main process, also densifies, evaluates, writes and prints. One rank of each node reads
the photos and shares them with the others of its node, which only run steps.
"""

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
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from ..errors import SehdrError, as_user_error
from ..model.adam import Adam
from ..model.gaussians import Gaussians
from ..parallel import WAITING_NOTICE, leave_at_exit, run_interruptibly, thread_count
from ..scene.photo_storage import PhotoFile, can_share, open_shared
from .launch import RankInfo, installed_versions, open_store
from .strategies import Strategy

log = logging.getLogger(__name__)

TIMEOUT = "SEHDR_RANK_TIMEOUT"
DEFAULT_TIMEOUT = 600.0  # Seconds that a step of another rank may take; the environment variable above overrides it
_SHORTEST_TIMEOUT = 0.1
GO, WAIT, END = 2, 1, 0
_EVER = timedelta(days=30)  # Disables torch's own timeouts, which end a process with long stack traces
_POLL = 0.1
ENDING = "all ranks end; the last checkpoint is complete, --resume continues from it"
_WATCH_END = 5.0  # Seconds that the watch may take to end
_GRACE = 1.0  # Seconds that a rank with a more specific error has to report it first


class RanksLost(SehdrError):
    """Another rank has ended or does not answer."""


class Ranks:
    """This process among those that train together; use join_ranks().

    Attributes:
        store: Key-value store of the ranks.
        info: Rank and node of this process.
        rank: Number of this process.
        count: Number of processes.
        device: Device that this process trains on.
        is_main_process: True for rank 0.
    """

    def __init__(self, store: dist.Store, info: RankInfo, device: torch.device):
        """Create a rank; init() connects it."""
        self.store, self.info, self.device = store, info, device
        self.rank, self.count = info.rank, info.count
        self.is_main_process = info.rank == 0
        self._cuda = device.type == "cuda"
        self._deadline: float | None = None
        self._over = threading.Event()
        self._photos: PhotoFile | None = None
        self._timeout = rank_timeout()
        self._log_wait = partial(log.info, "%s waits for the others", info)

    def init(self) -> None:
        """Connect to the other ranks; raise SehdrError if some do not come, or run other versions."""
        self._await_all()
        with self._collective():
            backend = "nccl" if self._cuda else "gloo"
            options: dict[str, Any] = {"device_id": self.device} if self._cuda else {}
            options |= {"store": self.store, "rank": self.rank, "world_size": self.count}
            begin = partial(dist.init_process_group, backend, timeout=_EVER, **options)
            run_interruptibly(begin, self._log_wait)
            # Messages between hosts must not wait for their devices.
            self._hosts: Any = dist.new_group(backend="gloo", timeout=_EVER) if self._cuda else dist.group.WORLD
        self._check_versions()
        self._watcher = threading.Thread(target=self._watch, name="sehdr-warp ranks", daemon=True)
        self._watcher.start()

    def _await_all(self) -> None:
        """Wait until all ranks are there; raise SehdrError that names the nodes of those that do not come."""
        keys = [f"here/{rank}" for rank in range(self.count)]
        self.store.set(keys[self.rank], platform.node())
        began, logged_once = time.monotonic(), False
        while not self.store.check(keys):
            seconds = time.monotonic() - began
            if seconds > WAITING_NOTICE and not logged_once:
                self._log_wait()
                logged_once = True
            if seconds > self._timeout:
                absent = [rank for rank, key in enumerate(keys) if not self.store.check([key])]
                nodes = ", ".join(str(node) for node in sorted({self.info.node_of(rank) for rank in absent}))
                problem = f"{self.info} waited {self._timeout:.0f} s ({TIMEOUT}) for rank {absent[0]}"
                problem += f" and {len(absent) - 1} more" if len(absent) > 1 else ""
                raise SehdrError(
                    f"{problem}: node {nodes} of {self.info.nodes} did not join; start it, or use fewer nodes"
                )
            time.sleep(_POLL)

    def all_reduce_min(self, signal: int) -> int:
        """Return the smallest of GO, WAIT and END that any rank passes.

        Rank 0 may take its time before it calls this; the others wait.
        """
        answer = torch.tensor([signal], dtype=torch.int32)
        # Rank 0 may evaluate or be paused, so only it expects answers in time.
        self._deadline = time.monotonic() + self._timeout if self.is_main_process else None
        with self._collective():
            dist.all_reduce(answer, dist.ReduceOp.MIN, group=self._hosts)
        lowest = int(answer)
        self._deadline = time.monotonic() + self._timeout if lowest == GO else None
        return lowest

    def shutdown(self) -> None:
        """End a training: wait until all ranks have called this, because leaving early breaks off pending transfers."""
        self.all_reduce_min(END)
        came, until = self.store.add("parted", 1), time.monotonic() + self._timeout
        while self.store.add("parted", 0) < -(-came // self.count) * self.count and time.monotonic() < until:
            time.sleep(_POLL / 10)

    def all_reduce_mean(self, buffer: Tensor) -> None:
        """Replace a buffer by its mean over the ranks, with the same bits on all of them."""
        with self._collective():
            dist.all_reduce(buffer, dist.ReduceOp.AVG if self._cuda else dist.ReduceOp.SUM)
        if not self._cuda:  # gloo lacks ReduceOp.AVG.
            buffer.mul_(1 / self.count)

    def reduce_to_main(self, totals: list[Tensor]) -> None:
        """Sum tensors on rank 0 and zero them on the others, so that a second call changes nothing."""
        for total in totals:
            with self._collective():
                dist.reduce(total, 0)
            if not self.is_main_process:
                total.zero_()

    def broadcast(self, tensors: list[Tensor]) -> None:
        """Replace tensors by those of rank 0; the others wait as long as rank 0 needs before it calls this."""
        self._deadline = None
        for tensor in tensors:
            with self._collective():
                dist.broadcast(tensor, 0)
        self._deadline = time.monotonic() + self._timeout

    def broadcast_refined(self, changed: bool, strategy: Strategy, gaussians: Gaussians, optimizer: Adam) -> bool:
        """Replace Gaussians and optimizer state by those that rank 0 refined; return what it passes as `changed`."""
        values = [changed, gaussians.count, bool(strategy.state_dict(gaussians.count))]
        values = torch.tensor(values, dtype=torch.int64, device=self.device)
        self.broadcast([values])
        changed, count, has_statistics = values.tolist()
        gaussians.resize(count, optimizer)
        if not has_statistics:
            strategy.load_state_dict({})
        self.broadcast([*gaussians.tensors().values(), *optimizer.moments(gaussians.parameters())])
        return bool(changed)

    def check_equal(self, tensors: dict[str, Tensor], iteration: int) -> None:
        """Raise SehdrError on all ranks if their tensors differ in any bit."""
        sums = [t.detach().contiguous().view(torch.int32).sum(dtype=torch.int64) for t in tensors.values()]
        own = torch.stack(sums)
        least, most = own.clone(), own.clone()
        with self._collective():
            dist.all_reduce(least, dist.ReduceOp.MIN)
            dist.all_reduce(most, dist.ReduceOp.MAX)
        different = [name for name, same in zip(tensors, (least == most).tolist(), strict=True) if not same]
        if different:
            raise SehdrError(
                f"iteration {iteration}: {different[0]} differs between ranks: memory or a GPU is faulty, or the "
                "GPUs are of different models; --resume continues from the last checkpoint, with --gpus 1 on one GPU"
            )

    def broadcast_object(self, value: Any = None) -> Any:
        """Return rank 0's value on all ranks; the others wait as long as rank 0 needs before it calls this."""
        values = [value]
        with self._collective():
            run_interruptibly(partial(dist.broadcast_object_list, values, 0, group=self._hosts))
        return values[0]

    def broadcast_arrays(self, tensors: list[Tensor]) -> None:
        """Replace tensors on the CPU by those of rank 0."""
        for tensor in tensors:
            with self._collective():
                dist.broadcast(tensor, 0, group=self._hosts)

    def request_photos(self, request: Any) -> None:
        """Tell the ranks that read photos for other nodes which ones to read, before rank 0 reads its own."""
        self.store.set("request", pickle.dumps(request))  # pyright: ignore[reportArgumentType]

    def requested_photos(self) -> Any:
        """Return what rank 0 passed to request_photos(); wait for it."""
        self._await_keys(["request"])
        return pickle.loads(self.store.get("request"))

    def share_photos(self, value: Any, size: int) -> None:
        """Share a value of about `size` bytes with the other ranks of this node, which read its arrays from one file.

        Rank 0 waits until those of other nodes have done the same.
        """
        handle = None
        if self.info.local_count > 1:
            self._photos = PhotoFile(size + (1 << 30))
            handle = self._photos.share(value)
        # The store takes bytes, although its stub says str.
        self.store.set(f"photos/{self.info.node}", pickle.dumps(handle))  # pyright: ignore[reportArgumentType]
        if self.is_main_process:
            self._await_keys([f"photos/{node}" for node in range(self.info.nodes)])

    def receive_photos(self) -> Any:
        """Return what the rank that reads the photos of this node shares; wait for it."""
        key = f"photos/{self.info.node}"
        self._await_keys([key])
        return open_shared(pickle.loads(self.store.get(key)))

    def _await_keys(self, keys: list[str]) -> None:
        """Wait until the store has keys; exit if a rank has ended before."""
        with self._collective():
            while not self.store.check(keys):
                if self.store.check(["ended"]):
                    raise SystemExit(1)
                time.sleep(_POLL)

    def ends_first(self) -> bool:
        """Return whether this is the first rank that ends with an error; only that one reports it."""
        try:
            return self.store.add("ended", 1) == 1
        except RuntimeError:  # The store belonged to a rank that has ended.
            return True

    def notes(self) -> Iterator[str]:
        """Yield notes about this machine's GPUs."""
        others = range(1, self.info.local_count) if self._cuda else ()
        apart = [k for k in others if not torch.cuda.can_device_access_peer(0, k)]
        if apart:
            yield f"GPU {apart[0]} has no access to the memory of GPU 0: gradients go through the host, which is slower"

    def close(self) -> None:
        """Disconnect at the end of a training that all ranks reached."""
        self.stop_watching()
        # A thread that still talks to other ranks while the interpreter ends would abort the process.
        self._watcher.join(_WATCH_END)
        self._hosts = None
        dist.destroy_process_group()

    def stop_watching(self) -> None:
        """Stop watching the others, at the end of this rank while others may wait."""
        self._over.set()

    @contextmanager
    def _collective(self) -> Iterator[None]:
        """Convert errors of a collective operation to RanksLost."""
        try:
            yield
        except RuntimeError as error:
            time.sleep(_GRACE)
            log.debug("%s", error)
            raise RanksLost(f"{self.info} cannot reach another rank, which has ended: {ENDING}") from error

    def _check_versions(self) -> None:
        """Raise SehdrError if a rank runs other versions of packages."""
        own = installed_versions()
        versions: list = [None] * self.count
        with self._collective():
            dist.all_gather_object(versions, own, group=self._hosts)
        other = next((k for k, text in enumerate(versions) if text != versions[0]), None)
        if other is not None:
            who = f"rank {other}"
            who += f" on node {self.info.node_of(other)}" if self.info.several_nodes else ""
            raise SehdrError(f"{who} runs {versions[other]}, rank 0 {versions[0]}: install the same on all")

    def _watch(self) -> None:
        """End this process if another rank does not answer: waits for a device or a socket cannot be interrupted.

        Rank 0 may be long between steps, but its own watch keeps reporting.
        """
        last_message, since, beat = "", time.monotonic(), 0.0
        while not self._over.wait(min(1.0, self._timeout / 4)):
            now, deadline = time.monotonic(), self._deadline
            if now - beat > self._timeout / 4:
                beat = now
                with suppress(RuntimeError):  # The store is gone: its rank will be missed otherwise.
                    if self.is_main_process:
                        self.store.set("alive", str(now))
                    elif self.store.check(["alive"]) and (message := self.store.get("alive").decode()) != last_message:
                        last_message, since = message, now
            if (deadline is not None and now > deadline) or (last_message and now - since > self._timeout):
                if self.ends_first():
                    message = "another rank did not answer %s for %.0f s (%s): %s"
                    log.error(message, self.info, self._timeout, TIMEOUT, ENDING)
                os._exit(1)


def rank_timeout() -> float:
    """Return the seconds that another rank may be silent; raise SehdrError for a value that is not a number of them."""
    if not (timeout := os.environ.get(TIMEOUT, "")):
        return DEFAULT_TIMEOUT
    try:
        seconds = float(timeout)
    except ValueError:
        seconds = 0.0
    if not _SHORTEST_TIMEOUT <= seconds <= _EVER.total_seconds():
        least, most = _SHORTEST_TIMEOUT, _EVER.total_seconds()
        raise SehdrError(f"{TIMEOUT} = {timeout:.40} is not a number of seconds from {least:g} to {most:g}: correct it")
    return seconds


@contextmanager
def join_ranks(info: RankInfo, device: torch.device) -> Iterator[Ranks]:
    """Connect this process to the ranks within this block; an error of any rank ends all, and one reports it."""
    if info.local_count > 1 and not can_share():
        raise SehdrError("several ranks of one machine need Linux, where processes can read one nameless file")
    os.environ.setdefault("SEHDR_THREADS", str(max(1, thread_count() // info.local_count)))
    if not info.several_nodes:  # All are on this machine, whatever its network.
        for name in ("GLOO_SOCKET_IFNAME", "NCCL_SOCKET_IFNAME"):
            os.environ.setdefault(name, "lo")
    if device.type == "cuda":
        torch.cuda.set_device(device)
    if info.rank:
        logging.getLogger("sehdr_warp").setLevel(logging.ERROR)
    waits = partial(log.info, "%s waits for the others", info)
    ranks = Ranks(run_interruptibly(partial(open_store, info, rank_timeout()), waits), info, device)
    try:
        ranks.init()
        yield ranks
        ranks.close()
    except BaseException as error:
        ranks.stop_watching()
        leave_at_exit(error)  # Cleanup would wait for ranks that have ended.
        first, message = ranks.ends_first(), isinstance(error, Exception) and as_user_error(error)
        if message and not first:
            raise SystemExit(1) from None
        if message and info.several_nodes and str(info) not in str(message):
            raise SehdrError(f"{info}: {message}") from None
        if info.rank and isinstance(error, KeyboardInterrupt):
            raise SystemExit(130) from None
        raise
