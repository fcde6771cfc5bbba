"""Two nodes, as two agents of torchrun on this host: the same bits as one node, restarts, errors that name a node."""

import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.runs.run import load_run
from sehdr_warp.runs.run_folder import CameraEntry, RunFolder
from sehdr_warp.runs.scene_description import describe_scene
from sehdr_warp.training import workers
from sehdr_warp.training.launch import RankInfo, open_store, rank_from_environment
from sehdr_warp.training.ranks import rank_timeout
from sehdr_warp.training.workers import PhotoRequest, _check_same_photos

from ..refusals import call
from .toy import toy_scene

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
    """What agents print, once both have ended well."""
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
    assert "rank 0 of 4 on node 0" in ended.stderr and "node 0, 1 of 2 did not come" in ended.stderr
    assert not (tmp_path / "run").exists()


def test_nodes_must_have_the_same_photos():
    ranks, scene = SimpleNamespace(info=RankInfo(1, 2, 0, 1, 1, 2)), toy_scene()
    shared = SimpleNamespace(scene=describe_scene(scene) | {"name": "town"})
    _check_same_photos(ranks, shared, scene)
    first = replace(scene.views[0], codes=scene.views[0].codes // 2)
    with pytest.raises(InputError, match=r"rank 1 of 2 on node 1 \(.*\) reads other photos than rank 0: v_0 differ"):
        _check_same_photos(ranks, shared, replace(scene, views=(first, *scene.views[1:])))
    with pytest.raises(InputError, match="views differ"):
        _check_same_photos(ranks, shared, replace(scene, views=scene.views[:-1]))


def test_other_nodes_hold_out_what_a_resumed_run_does(monkeypatch):
    scene = toy_scene(6)
    saved = tuple(CameraEntry(view.name, "train", view.camera, 1.0) for view in scene.views)
    loaded, request = [], PhotoRequest({"path": "town"}, {"response": "srgb"}, saved)

    def check(ranks, shared, scene):
        loaded.append(scene)
        raise InterruptedError

    monkeypatch.setattr("sehdr_warp.runs.open.load_scene_and_log_notes", lambda data, **options: scene)
    monkeypatch.setattr(workers, "_check_same_photos", check)
    monkeypatch.setattr(workers, "field_from_checkpoint", lambda *_: None)
    shared = SimpleNamespace(config=None, layout={}, values={}, info={})
    ranks = SimpleNamespace(info=RankInfo(1, 2, 0, 1, 1, 2), requested_photos=lambda: request)
    ranks.broadcast_object, ranks.broadcast_arrays = lambda: shared, lambda arrays: None
    with pytest.raises(InterruptedError):
        workers.train_as_worker(ranks)
    assert len(scene.train_views) == 5 and len(loaded[0].views) == 6


def test_nodes_train_bare_photos_in_the_world_of_rank_0():
    """Structure from motion on another node may move and scale the world; its views get rank 0's poses."""
    scene = replace(toy_scene(), format="photos")
    views = []
    for view in scene.views:
        pose = view.camera.world_to_camera.copy()
        pose[:3, 3] = 2 * pose[:3, 3] - pose[:3, :3] @ [1, 2, 3]
        views.append(replace(view, camera=replace(view.camera, world_to_camera=pose)))
    found = replace(scene, views=tuple(views), points=2 * scene.points + [1, 2, 3])
    message = SimpleNamespace(scene=describe_scene(scene), info={"normalization": {"center": [0, 0, 0], "unit": 4.0}})
    aligned = workers._in_world_of_rank_0(found, message)
    _check_same_photos(SimpleNamespace(info=RankInfo(1, 2, 0, 1, 1, 2)), message, aligned)
    np.testing.assert_allclose(aligned.points, scene.points, atol=1e-12)


def test_nodes_start_as_many_processes_each(monkeypatch):
    for name, value in {"RANK": 2, "WORLD_SIZE": 3, "LOCAL_WORLD_SIZE": 1, "GROUP_WORLD_SIZE": 2}.items():
        monkeypatch.setenv(name, str(value))
    with pytest.raises(SehdrError, match="3 ranks on 2 nodes, and 1 on this one"):
        rank_from_environment()
    monkeypatch.setenv("GROUP_WORLD_SIZE", "3")
    assert rank_from_environment() == RankInfo(2, 3, 0, 1, 2, 3)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("RANK", value) for value in ("x", "3", "-1")),
        *(("WORLD_SIZE", value) for value in ("0", "1000000000")),
        *(("LOCAL_WORLD_SIZE", "0"), ("LOCAL_RANK", "7"), ("GROUP_RANK", "-1")),
    ],
)
def test_numbers_that_no_launcher_sets_are_refused(monkeypatch, name, value):
    for each, number in {"RANK": "1", "WORLD_SIZE": "3", name: value}.items():
        monkeypatch.setenv(each, number)
    with pytest.raises(SehdrError, match=f"{name} = {value} is not a number from"):
        rank_from_environment()


@pytest.mark.parametrize("port", ["x", "0", "99999", "9" * 5000])
def test_ports_that_cannot_be_are_refused(monkeypatch, port):
    monkeypatch.setenv("MASTER_ADDR", "127.0.0.1")
    monkeypatch.setenv("MASTER_PORT", port)
    with pytest.raises(SehdrError, match="is not a port from 1 to 65535"):
        open_store(RankInfo(0, 2, 0, 2), 1.0)


@pytest.mark.parametrize("seconds", ["nan", "-1", "x", "inf"])
def test_times_that_cannot_be_are_refused(monkeypatch, seconds):
    monkeypatch.setenv("SEHDR_RANK_TIMEOUT", seconds)
    with pytest.raises(SehdrError, match=f"SEHDR_RANK_TIMEOUT = {seconds} is not a number of seconds"):
        rank_timeout()
