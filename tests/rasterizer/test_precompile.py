"""Kernels that are compiled ahead of their first launch."""

import threading
import time

import pytest
import torch
import warp as wp

from benchmarks.splats import Size, make_photo_scene
from benchmarks.step import make_trainer
from sehdr_warp.kernels.plane_sweep_cpu import sweep_rows
from sehdr_warp.kernels.shared_ranges import share_ranges
from sehdr_warp.rasterizer import precompile
from sehdr_warp.rasterizer.warp_launch import launching
from sehdr_warp.rasterizer.warp_launch.packing import PackedLaunch
from sehdr_warp.runs.config_files import load_config


def make_kernel(factor):
    @wp.kernel(module="unique", module_options={"enable_backward": False})
    def scale(values: wp.array(dtype=float)):
        values[wp.tid()] = values[wp.tid()] * wp.static(factor)

    return scale


def is_loaded(kernel):
    return bool(kernel.module.execs)


def test_kernels_are_loaded_beside_the_block_and_launch_as_ever(monkeypatch):
    monkeypatch.setattr(precompile, "PATIENCE", 0.0)
    kernels, values = [make_kernel(3.0), make_kernel(5.0)], torch.ones(4)
    with precompile.precompiled(kernels):
        launching.launch(kernels[1], 4, values)
        until = time.monotonic() + 60
        while not is_loaded(kernels[0]) and time.monotonic() < until:
            time.sleep(0.01)
    launching.launch(kernels[0], 4, values)
    assert values.tolist() == [15.0] * 4


def test_a_block_that_refuses_at_once_has_nothing_compiled():
    kernel = make_kernel(7.0)
    with pytest.raises(ValueError, match="refused"), precompile.precompiled([kernel]):
        raise ValueError("refused")
    assert not is_loaded(kernel)
    assert not [each for each in threading.enumerate() if each.name == "sehdr-warp ahead"]


def test_what_cannot_be_compiled_is_no_end_of_the_block(monkeypatch):
    monkeypatch.setattr(precompile, "PATIENCE", 0.0)
    broken = make_kernel(2.0)
    tried = threading.Event()
    monkeypatch.setattr(precompile.wp, "load_module", lambda *_, **__: tried.set() or 1 / 0)
    with precompile.precompiled([broken]):
        assert tried.wait(10)
    assert not is_loaded(broken)


def test_a_training_launches_what_was_compiled_ahead(monkeypatch):
    launched = {sweep_rows, share_ranges}
    for name in ("launch", "launch_ranges"):

        def watched(packed, *arguments, method=getattr(PackedLaunch, name)):
            launched.add(packed.command.kernel)
            method(packed, *arguments)

        monkeypatch.setattr(PackedLaunch, name, watched)
    scene = make_photo_scene(Size(200, 48, 48), 2)
    trainer = make_trainer(scene, load_config("default", {"response.name": "srgb"}), torch.device("cpu"))
    changing = trainer.iteration - 1
    for iteration in (0, changing):  # The first step, and one that changes the Gaussians
        trainer.iteration = iteration
        trainer.step()
    assert launched.issuperset(precompile.training_kernels(3, antialiased=False))
    assert launched.issuperset(precompile.training_kernels(None, antialiased=False))
