"""Memory that runs out: one line with the sizes, before the system ends the process where it would."""

import re
import resource
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import torch

from sehdr_warp.errors import SehdrError
from sehdr_warp.rasterizer import memory, rasterize
from sehdr_warp.rasterizer.memory import OutOfMemory, failed_allocation
from sehdr_warp.training.process_settings import torch_settings

from .scenes import random_scene


@pytest.mark.parametrize(
    ("error", "is_allocation"),
    [
        (MemoryError("Unable to allocate 1.50 GiB for an array"), "1.50 GiB"),
        (MemoryError(), "some memory"),
        (
            RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 4294967296 bytes."),
            "4.00 GiB",
        ),
        (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 MiB. GPU 0 has"), "20.00 MiB"),
        (RuntimeError("Failed to allocate 4096 bytes on device 'cuda:0'"), "4096 bytes"),
        (RuntimeError("CUDA error: an illegal memory access was encountered"), None),
        (ValueError("size"), None),
    ],
)
def test_failed_allocations_are_distinguished_from_other_errors(error, is_allocation):
    assert failed_allocation(error) == is_allocation


def test_a_failed_allocation_says_the_sizes(device, monkeypatch):
    scene = random_scene(count=5).to(torch.float32, device)

    errors = [torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 3.00 GiB. GPU 0"), RuntimeError("a defect")]

    def fails(*arguments, **options):
        raise errors.pop(0)

    monkeypatch.setattr("sehdr_warp.rasterizer.rasterization.project_to_camera", fails)
    with pytest.raises(OutOfMemory) as caught:
        rasterize(*scene.arguments)
    with pytest.raises(RuntimeError, match="a defect"):  # other errors pass
        rasterize(*scene.arguments)
    assert str(caught.value) == (
        f"out of memory on {device}: 3.00 GiB could not be allocated with 5 Gaussians, an image of 70 x 50, "
        "3 channels; " + memory.REMEDY
    )
    assert isinstance(caught.value, SehdrError)


@pytest.mark.skipif(not hasattr(resource, "RLIMIT_AS"), reason="no limit on address space here")
def test_running_out_on_the_cpu_is_one_line():
    """A process of its own with 4 GB more than it has after start, of which each thread takes 72 MB: an 8K image of 48
    channels needs 6.4 GB."""
    code = """
        import resource, torch
        from sehdr_warp.rasterizer import rasterize
        rows = lambda n, *row: torch.tensor([row]).repeat(n, 1)
        arguments = (rows(1, 0.0, 0.0, 2.0), rows(1, 0.0, 0.0, 0.0), rows(1, 1.0, 0.0, 0.0, 0.0), torch.tensor([0.5]))
        used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + (4 << 30), -1))
        camera = torch.eye(4), torch.tensor([100.0, 100.0, 8.0, 8.0])
        try:
            rasterize(*arguments, torch.ones(1, 48), *camera, 7680, 4320)
        except Exception as error:
            print(type(error).__name__, error)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, check=True)
    # With less memory than it takes in all, 12.24 GiB, the machine's own limit comes first.
    begins = r"OutOfMemory out of memory on cpu: (5\.93|12\.24) GiB could not be allocated with 1 Gaussians, an"
    assert re.match(begins, done.stdout)
    assert "7680 x 4320, 48 channels; use fewer" in done.stdout
    assert len(done.stdout.splitlines()) == 1


def test_an_image_larger_than_the_memory_is_refused_before_it_is_written(monkeypatch):
    """Linux hands out more memory than there is, and ends a process that uses it."""
    monkeypatch.setattr(memory, "available_memory", lambda: 2 << 30)
    scene = random_scene(count=1, channels=3, width=16384, height=16384).to(torch.float32, "cpu")
    with pytest.raises(OutOfMemory, match=r"cpu: 9.00 GiB could not be allocated with 1 Gaussians, an image of 16384"):
        rasterize(*scene.arguments)


@pytest.mark.skipif(sys.platform != "linux", reason="needs glibc")
def test_memory_that_a_training_freed_is_there_for_its_next_step(monkeypatch):
    def resident():
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()

    limit = resident() + (96 << 20)
    monkeypatch.setattr(memory, "available_memory", lambda: limit - resident())
    monkeypatch.setattr(memory, "LARGE", 1)
    with torch_settings(deterministic=False):
        steps = [torch.ones(4 << 20) for _ in range(5)]  # 16 MiB each
        last = torch.ones(1 << 20)  # Above them, so that they stay in the process
        del steps
        memory.check_room(64 << 20)
        with pytest.raises(MemoryError):
            memory.check_room(128 << 20)
    assert len(last) == 1 << 20


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_running_out_on_the_gpu_is_one_line_and_the_next_render_works():
    scene = random_scene(count=50, channels=48, width=7680, height=4320).to(torch.float32, "cuda:0")
    small = random_scene(count=50).to(torch.float32, "cuda:0")
    torch.cuda.empty_cache()
    total = torch.cuda.get_device_properties(0).total_memory
    torch.cuda.set_per_process_memory_fraction((torch.cuda.memory_reserved(0) + (1 << 30)) / total, 0)
    try:
        with pytest.raises(
            OutOfMemory, match=r"out of memory on cuda:0: .* 50 Gaussians, an image of 7680 x 4320, 48 ch"
        ):
            rasterize(*scene.arguments)
        assert torch.isfinite(rasterize(*small.arguments).image).all()
    finally:
        torch.cuda.set_per_process_memory_fraction(1.0, 0)


def test_no_kernel_is_compiled_where_its_compiler_would_end_the_process(monkeypatch):
    limits = resource.getrlimit(resource.RLIMIT_AS)
    monkeypatch.setattr(resource, "getrlimit", lambda _: (1 << 20, limits[1]))
    with pytest.raises(MemoryError, match="compiler of kernels"):
        memory.check_room_to_compile()
    monkeypatch.setattr(resource, "getrlimit", lambda _: (1 << 50, limits[1]))
    memory.check_room_to_compile()
