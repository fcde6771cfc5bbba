"""Synthetic splats, turns, memory, and what peers are given."""

import math
import sys
import time
from itertools import pairwise
from types import SimpleNamespace

import pytest
import torch

from sehdr_warp.bench import peers
from sehdr_warp.bench.splats import Size, make_splat_scene, parse_sizes
from sehdr_warp.bench.timing import Variant, peak_memory, time_variants
from sehdr_warp.errors import SehdrError
from sehdr_warp.splatting import rasterize

CPU = torch.device("cpu")


def test_sizes_are_read_by_name_and_by_number():
    assert parse_sizes("20k@200x100, 1M@1600x1200", "cpu") == [Size(20_000, 200, 100), Size(1_000_000, 1600, 1200)]
    assert parse_sizes(None, "cuda")[-1] == Size(1_000_000, 1600, 1200)
    assert parse_sizes("small", "cpu") == [Size(5_000, 200, 200)]
    for bad in ("tiny", "0@4x4", "5@4", "5@0x4", ""):
        with pytest.raises(SehdrError, match="not a size"):
            parse_sizes(bad or ",", "cpu")


def test_variants_take_turns_and_slow_ones_run_less_often():
    ran = []
    clock = {"fast": 0.0, "slow": 0.02}

    def variant(name):
        def run(prepared):
            assert prepared == f"for {name}"
            ran.append(name)
            torch.zeros(1)
            if clock[name]:
                time.sleep(clock[name])

        return Variant(run, prepare=lambda: f"for {name}")

    timings = time_variants({name: variant(name) for name in clock}, CPU, repetitions=12, warm_up=1, budget=0.11)
    assert len(timings["fast"].samples) == 12
    assert 3 <= len(timings["slow"].samples) <= 5
    assert timings["slow"].median >= 20
    assert sum(a != b for a, b in pairwise(ran)) >= 6
    figures = timings["slow"].to_dict()
    assert figures["min_ms"] <= figures["median_ms"] <= figures["p90_ms"]


def test_peak_memory_counts_what_is_held_at_once():
    def run(_):
        for _ in range(3):
            a = torch.empty(1_000_000, dtype=torch.float32)
            b = torch.empty(500_000, dtype=torch.float32)
            del a, b

    assert peak_memory(Variant(run), CPU) == pytest.approx(6_000_000, rel=0.01)


def test_peers_need_a_gpu_and_say_so():
    found, notes = peers.find_peers(CPU)
    assert found == []
    assert [note.split()[0] for note in notes] == ["gsplat", "gswarp"]


def test_gsplat_is_given_the_same_scene(monkeypatch):
    scene = make_splat_scene(Size(300, 60, 44), 5)

    def rasterization(means, quats, scales, opacities, colors, viewmats, intrinsics, width, height, *, packed):
        assert not packed
        matrix = intrinsics[0]
        camera = torch.stack([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]])
        drawn = rasterize(means, scales.log(), quats, opacities, colors, viewmats[0], camera, width, height)
        return drawn.image[None], drawn.alpha[None, ..., None], {}

    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=rasterization))
    image = peers._gsplat_renderer(scene)()
    assert peers.differs(image, rasterize(*scene.arguments).image) < 1e-5
    image.sum().backward()
    assert all(leaf.grad is not None for leaf in scene.leaves)


def test_gswarp_is_given_the_same_scene(monkeypatch):
    """A camera as 3DGS's matrices describe it puts every centre where ours does."""
    scene = make_splat_scene(Size(300, 60, 44), 3)

    class Rasterizer:
        def __init__(self, settings):
            self.settings = settings

        def __call__(self, *, means3D, means2D, opacities, colors_precomp, scales, rotations):
            s = self.settings
            clip = torch.cat([means3D, torch.ones(len(means3D), 1)], 1) @ s.projmatrix
            centres = (clip[:, :2] / clip[:, 3:] + 1) * torch.tensor([s.image_width, s.image_height]) / 2
            ours = rasterize(*scene.arguments)
            assert ours.visible.sum() > 250
            torch.testing.assert_close(centres[ours.visible], ours.means2d[ours.visible], rtol=1e-4, atol=1e-3)
            assert ((clip[:, 2] > 0) & (clip[:, 2] < clip[:, 3])).all()
            focal = [s.image_width / (2 * s.tanfovx), s.image_height / (2 * s.tanfovy)]
            camera = torch.tensor([*focal, s.image_width / 2, s.image_height / 2])
            drawn = rasterize(
                means3D, scales.log(), rotations, opacities[:, 0], colors_precomp, s.viewmatrix.T, camera,
                s.image_width, s.image_height,
            )  # fmt: skip
            return drawn.image.permute(2, 0, 1), drawn.radii, None

    fake = SimpleNamespace(GaussianRasterizationSettings=SimpleNamespace, GaussianRasterizer=Rasterizer)
    monkeypatch.setitem(sys.modules, "gswarp", fake)
    image = peers._gswarp_renderer(scene)()
    assert peers.differs(image, rasterize(*scene.arguments).image) < 1e-5


def test_an_image_that_is_not_finite_differs_without_end():
    image = torch.ones(2, 2, 3)
    assert peers.differs(image, image) == 0
    assert peers.differs(torch.full_like(image, math.nan), image) == math.inf
