"""Jobs whose machine has other versions or photos, or whose file system loses what they write."""

import shutil
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
import torch

from sehdr_warp.blocks import jobs
from sehdr_warp.blocks.job import folder_of, train_block
from sehdr_warp.errors import SehdrError
from sehdr_warp.runs.run_folder import RunFolder
from sehdr_warp.training.launch import installed_versions


@pytest.fixture(scope="module")
def divided(survey, divide, tmp_path_factory):
    """A folder with photos in `town` and a plan of two blocks in `run`, and the plan."""
    folder = tmp_path_factory.mktemp("divided")
    shutil.copytree(survey, folder / "town")
    return folder, divide(folder / "town", folder / "run", iterations=20)


def test_a_machine_with_other_versions_trains_nothing(divided):
    folder, plan = divided
    result = train_block(folder / "run", 0, "cpu", "sehdr-warp 0.1")
    assert f"it has {installed_versions()}, and the command was started with sehdr-warp 0.1" in result.error
    assert not folder_of(folder / "run", plan, 0).exists()


def test_a_machine_with_other_photos_trains_nothing(divided):
    folder, plan = divided
    photo = folder / "town" / "images" / f"{plan.blocks[0].views[1]}.png"
    before = photo.read_bytes()
    photo.write_bytes(before + b"more")
    try:
        result = train_block(folder / "run", 0, "cpu", installed_versions())
    finally:
        photo.write_bytes(before)
    sizes = f"has {len(before) + 4} bytes, and had {len(before)} when the set was divided"
    assert f"{photo.stem} {sizes}; copy the same set to all nodes" in result.error
    assert not folder_of(folder / "run", plan, 0).exists()


def test_a_file_system_that_loses_a_trained_block_is_named(divided, monkeypatch):
    """The other block stays."""
    folder, plan = divided
    out = folder / "run"

    def submit(job, *arguments):
        result = job(*arguments)._replace(node="far")
        if arguments[1] == 1:
            (folder_of(out, plan, 1) / "confidence.safetensors").unlink()
        return SimpleNamespace(done=lambda: True, exception=lambda: None, result=lambda: result)

    monkeypatch.setattr(jobs, "local_executors", lambda *_: [SimpleNamespace(submit=submit)])
    monkeypatch.setattr(jobs, "ARRIVES", 0.0)
    lost = r"block_02: node far: trained it, and .*block_02 does not hold the trained run: the file system has lost it"
    with pytest.raises(SehdrError, match=rf"{lost}; .*; 1 of 2 blocks are finished; resume=True trains"):
        jobs.run_blocks(out, plan, device=torch.device("cpu"))
    assert jobs.is_finished(folder_of(out, plan, 0))
    shutil.rmtree(out / "blocks")


@pytest.mark.parametrize(("at_once", "threads"), [(1, 8), (2, 4)])
def test_blocks_at_once_share_the_processors(divided, jobs_here, monkeypatch, at_once, threads):
    folder, plan = divided
    out = folder / "run"
    monkeypatch.setenv("SEHDR_THREADS", "8")

    jobs.run_blocks(out, plan, device=torch.device("cpu"), gpus=at_once)
    devices = {RunFolder(folder_of(out, plan, index)).read_summary()["device"] for index in range(2)}
    assert devices == {f"cpu ({threads} threads)"}
    shutil.rmtree(out / "blocks")


@pytest.mark.parametrize(
    ("first", "count", "refusal"),
    [
        ("cuda", 4, None),
        ("cuda:1", 3, None),
        ("cuda", 5, "--gpus 5: there are 4 GPUs, and each block takes one; use --gpus 4"),
        ("cuda:1", 4, "--gpus 4: there are 3 GPUs from cuda:1 on, and each block takes one; use --gpus 3"),
        ("cpu", 10**6, "too many blocks at once for"),
    ],
)
def test_blocks_at_once_need_as_many_gpus_from_the_first_on(monkeypatch, first, count, refusal):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 4)
    with nullcontext() if refusal is None else pytest.raises(SehdrError, match=refusal):
        jobs.check_devices(torch.device(first), count)
