"""Two nodes, as two agents of torchrun on this host: the same bits as one node, restarts, errors that name a node."""

import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from sehdr_warp.runs.run import load_run
from sehdr_warp.runs.run_folder import RunFolder

from ..refusals import call

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="ranks share photos through Linux's /proc")

TRAIN = ["train", "embedded", "--device", "cpu", "--max-size", "24", "--preset", "fast", "--response", "srgb"]
TRAIN += ["--schedule.checkpoint-every", "3000", "--mcmc.seed-fraction", "0", "--model.initial-density", "0"]
SHORT = [*TRAIN, "--iterations", "100"]


def free_port() -> int:
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        return server.getsockname()[1]


def agent(node: int, port: int, *words) -> subprocess.Popen:
    """An agent of torchrun, with one process, in a session of its own."""
    command = [sys.executable, "-m", "torch.distributed.run", "--nnodes", "2", "--nproc-per-node", "1"]
    command += ["--rdzv-backend", "c10d", "--rdzv-endpoint", f"127.0.0.1:{port}", "--rdzv-id", "town"]
    command += [
        "--rdzv-conf",
        f"is_host={int(node == 0)},join_timeout=120,keep_alive_interval=1",
        "--max-restarts",
        "3",
    ]
    command += ["--local-addr", "127.0.0.1", "-m", "sehdr_warp", *map(str, words)]
    environment = os.environ | {"GLOO_SOCKET_IFNAME": "lo", "SEHDR_RANK_TIMEOUT": "60", "SEHDR_THREADS": "1"}
    # Agents that share a server do not let a new node in (torch 2.13).
    environment["TORCH_DISABLE_SHARE_RDZV_TCP_STORE"] = "1"
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.Popen(command, env=environment, start_new_session=True, **pipes)


def together(agents, seconds: float = 150) -> list[str]:
    """Return what agents print, once both have ended well."""
    try:
        printed = [each.communicate(timeout=seconds)[0] for each in agents]
    finally:
        for each in agents:
            end(each)
    assert [each.returncode for each in agents] == [0, 0], "\n".join(printed)[-4000:]
    return printed


def end(process: subprocess.Popen) -> None:
    """Kills an agent and its process at once, as a node that loses power."""
    with suppress(OSError):
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        for each in (process.pid, *map(int, children)):
            os.kill(each, signal.SIGKILL)
    process.wait()


def result(run) -> str:
    """The hash of all tensors of a run's newest checkpoint."""
    checkpoint = RunFolder(run).newest_checkpoint()
    assert checkpoint is not None and checkpoint.values["iteration"] == 100
    return checkpoint.values["sha256"]


@pytest.fixture(scope="module")
def one_node(tmp_path_factory):
    """The hash of a training by two processes of one node."""
    out = tmp_path_factory.mktemp("one") / "run"
    assert call(*SHORT, "--out", out, "--gpus", "2") == 0
    return result(out)


@pytest.fixture(scope="module")
def two_nodes(tmp_path_factory):
    """A training by two nodes, of which one loses power and is replaced."""
    port, out = free_port(), tmp_path_factory.mktemp("two") / "run"
    words = *SHORT, "--out", out, "--resume"
    first, lost = (agent(node, port, *words) for node in (0, 1))
    try:
        deadline = time.monotonic() + 120
        while not any((out / "checkpoints").glob("iteration_*[1-9]*")):
            assert time.monotonic() < deadline and first.poll() is None, first.communicate()[0]
            time.sleep(0.05)
    finally:
        end(lost)
    replacement = agent(1, port, *words)
    printed = together([first, replacement])
    return out, printed


def test_two_nodes_train_the_same_bits_as_one_although_one_is_lost(one_node, two_nodes):
    out, (printed, _) = two_nodes
    assert result(out) == one_node
    assert "cannot reach another rank, which has ended" in printed and "rank 0 of 2 on node 0" in printed


def test_one_node_goes_on(two_nodes):
    out, _ = two_nodes
    assert call("train", "--resume", "--out", out, "--device", "cpu", "--iterations", "110") == 0
    assert load_run(out).iterations == 110


def test_a_node_that_does_not_come_is_named(tmp_path):
    places = {"RANK": "0", "WORLD_SIZE": "4", "LOCAL_RANK": "0", "LOCAL_WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1"}
    environment = os.environ | places | {"MASTER_PORT": str(free_port()), "SEHDR_RANK_TIMEOUT": "1"}
    command = [sys.executable, "-m", "sehdr_warp", *TRAIN, "--out", str(tmp_path / "run"), "-q"]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert ended.returncode == 1 and len(ended.stderr.splitlines()) == 1, ended.stderr
    assert "rank 0 of 4 on node 0" in ended.stderr and "node 0, 1 of 2 did not join" in ended.stderr
    assert not (tmp_path / "run").exists()
