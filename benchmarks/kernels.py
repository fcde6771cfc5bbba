"""`python -m benchmarks kernels`: time and check rasterize(), forward and backward, on random Gaussians."""

import logging
from collections.abc import Callable, Sequence
from itertools import product

import torch

from sehdr_warp.kernels.constants import TILE_SIZE
from sehdr_warp.rasterizer.cuda_graphs.cache import WARMUP_CALLS, clear_graphs
from sehdr_warp.rasterizer.cuda_graphs.runner import CudaGraphRunner
from sehdr_warp.rasterizer.rasterization import rasterize
from sehdr_warp.rasterizer.reference import rasterize_reference

from .gsplat_peer import BOUND, GSPLAT, gsplat_renderer, note_missing
from .results import check, new_result
from .splats import NAMES, Size, SplatScene, make_splat_scene
from .timing import Variant, kernel_milliseconds, peak_memory, time_variants

LOG = logging.getLogger(__name__)
OURS, PLAIN_TORCH = "sehdr-warp", "plain torch"
RECORDED = "sehdr-warp, recorded"
"""rasterize() with room for a quarter more intersections, replayed as a CUDA graph, as in a training step."""
PLAIN_TORCH_BYTES = 4 << 30
"""The plain torch rasterizer keeps about 16 numbers for each pixel-Gaussian pair; beyond this it is left out."""
IMAGE_BOUND, GRADIENT_BOUND = 1e-4, 1e-3
"""Largest relative difference, in norm, of float32 from float64. Alphas that fall on the other side of the threshold
make most of it; a wrong formula or a lost Gaussian is far beyond."""
PASSES = {"forward": False, "forward + backward": True}  # List whether a timed pass includes the backward pass
REFERENCE_GAUSSIANS = 4000
"""Scenes of at most so many Gaussians are checked themselves, larger ones on a smaller one of the same density."""


def bench_kernels(sizes: Sequence[Size], channels: Sequence[int], device: torch.device, *, repetitions: int) -> dict:
    """Time every combination of size and channels, forward, and forward and backward; return the result."""
    result = new_result("kernels", device, {"device": str(device), "repetitions": repetitions})
    peer = note_missing(result, device)
    places = [(size, count) for size, count in product(sizes, channels)]
    by_place = []
    for size, count in places:
        scene = make_splat_scene(size, count, device)
        result["checks"] += _checks(scene, peer)
        by_place.append(rows := _rows(scene, peer, repetitions))
        times = [row["median_ms"] for row in rows if row["implementation"] == OURS]
        LOG.info("%s, %d channels: %.3f ms forward, %.3f ms with backward", size, count, *times)
    if device.type == "cuda":
        # After all other times: a process that has been profiled launches kernels at half the pace.
        for (size, count), rows in zip(places, by_place, strict=True):
            _add_device_times(rows, make_splat_scene(size, count, device), peer)
            for row in rows:
                if row["implementation"] == OURS:
                    parts = row["pass"], row["host_ms"], row["device_ms"]
                    LOG.info("%s, %d channels, %s: host %.3f ms, GPU %.3f ms", size, count, *parts)
    result["rows"] = [row for rows in by_place for row in rows]
    return result


def render(scene: SplatScene, rasterizer: Callable | None = None) -> torch.Tensor:
    """Render [H, W, C] by a rasterizer, ours by default."""
    return (rasterizer or rasterize)(*scene.arguments).image


def splat_variant(call: Callable[[], torch.Tensor], scene: SplatScene, backward: bool = True) -> Variant:
    """call() renders the scene; backward: and sends cotangent() back."""
    if not backward:
        return Variant(torch.no_grad()(call))
    cotangent = scene.cotangent()
    return Variant(lambda: call().backward(cotangent), prepare=scene.clear)


def against_float64(scene: SplatScene, most: int) -> list[dict]:
    """Check our kernels in float32 against float64, on a scene like this of at most `most` Gaussians."""
    small = make_splat_scene(scene.size.reduced(most), scene.channels, scene.device)
    truth = _image_and_gradients(small.to("cpu", torch.float64), rasterize_reference)
    return _compare(OURS, "float64", _image_and_gradients(small), truth)


@torch.no_grad()
def against_gsplat(scene: SplatScene) -> dict:
    """Compare our image with gsplat's."""
    return check("gsplat: image", OURS, _difference(gsplat_renderer(scene)(), render(scene)), BOUND)


def _checks(scene: SplatScene, peer: bool) -> list[dict]:
    """Check our kernels on a scene like this of at most REFERENCE_GAUSSIANS Gaussians."""
    checks = against_float64(scene, REFERENCE_GAUSSIANS)
    if scene.device.type == "cuda":
        cpu, recorded = _image_and_gradients(scene.to("cpu")), _record(scene, scene.cotangent())()
        # The last of as many calls as are launched before a picture of this size is replayed.
        repeated = [_image_and_gradients(scene) for _ in range(WARMUP_CALLS + 2)][-1]
        for name, ours in ((OURS, repeated), (RECORDED, recorded)):
            checks += _compare(name, "the CPU's kernels", ours, cpu)
    return [*checks, against_gsplat(scene)] if peer else checks


def _image_and_gradients(scene: SplatScene, rasterizer: Callable | None = None) -> list[torch.Tensor]:
    image = render(scene, rasterizer)
    return [image.detach(), *torch.autograd.grad(image, scene.leaves, scene.cotangent())]


def _compare(name: str, against: str, ours: list[torch.Tensor], truth: list[torch.Tensor]) -> list[dict]:
    """Compare an image and the gradients of NAMES."""
    labels, bounds = ["image", *(f"gradient of {leaf}" for leaf in NAMES)], [IMAGE_BOUND] + [GRADIENT_BOUND] * 5
    pairs = zip(labels, ours, truth, bounds, strict=True)
    return [check(f"{name}: {label}", against, _difference(a, b), bound) for label, a, b, bound in pairs]


def _difference(value: torch.Tensor, other: torch.Tensor) -> float:
    """|value - other| / |other| over the whole tensor, in float64."""
    value, other = value.detach().double().cpu(), other.detach().double().cpu()
    return float((value - other).norm() / other.norm().clamp_min(1e-300))


def _record(scene: SplatScene, cotangent: torch.Tensor | None) -> Callable[[], list[torch.Tensor]]:
    """Return a replay of [image], or with a cotangent of [image, gradients of the leaves]."""
    max_intersections = _intersection_count(scene) * 5 // 4

    def forward():
        with torch.set_grad_enabled(cotangent is not None):
            image = rasterize(*scene.arguments, max_intersections=max_intersections).image
        if cotangent is None:
            return [image]
        return [image.detach(), *torch.autograd.grad(image, scene.leaves, cotangent)]

    forward()  # loads the kernels, which a recording cannot
    recorder = CudaGraphRunner(scene.device)
    return lambda: recorder.run("render", forward)


def _from_the_start(variant: Variant) -> Variant:
    """Return a variant of as many calls as end in a replay, without earlier captures, because their memory counts."""

    def calls() -> None:
        for _ in range(WARMUP_CALLS + 2):
            variant.once()

    return Variant(calls, prepare=clear_graphs)


@torch.no_grad()
def _intersection_count(scene: SplatScene) -> int:
    return rasterize(*scene.arguments).intersection_count


def _variants(scene: SplatScene, peer: bool, backward: bool) -> dict[str, Variant]:
    renderers = {OURS: lambda: render(scene)}
    if peer:
        renderers[GSPLAT] = gsplat_renderer(scene)
    if scene.device.type == "cpu" and _intersection_count(scene) * TILE_SIZE**2 * 16 * 4 <= PLAIN_TORCH_BYTES:
        renderers[PLAIN_TORCH] = lambda: render(scene, rasterize_reference)
    variants = {key: splat_variant(call, scene, backward) for key, call in renderers.items()}
    if scene.device.type == "cuda":
        variants[RECORDED] = Variant(_record(scene, scene.cotangent() if backward else None))
    return variants


def _add_device_times(rows: list[dict], scene: SplatScene, peer: bool) -> None:
    """Add the times of a scene's kernels alone to its rows."""
    for name, backward in PASSES.items():
        for key, variant in _variants(scene, peer, backward).items():
            for _ in range(WARMUP_CALLS + 2):
                variant.once()
            time = kernel_milliseconds(variant)
            next(row for row in rows if (row["pass"], row["implementation"]) == (name, key))["device_ms"] = time


def _rows(scene: SplatScene, peer: bool, repetitions: int) -> list[dict]:
    place = {"gaussians": scene.size.gaussians, "width": scene.size.width, "height": scene.size.height}
    rows = []
    for name, backward in PASSES.items():
        variants = _variants(scene, peer, backward)
        timings = time_variants(variants, scene.device, repetitions=repetitions, apart=True)
        for key, timing in timings.items():
            row = place | {"channels": scene.channels, "pass": name, "implementation": key}
            variant = variants[key] if scene.device.type == "cpu" else _from_the_start(variants[key])
            row |= timing | {"peak_memory_bytes": peak_memory(variant, scene.device)}
            ratio = None if key == OURS else timings[OURS]["median_ms"] / timing["median_ms"]
            rows.append(row | {"ours_over_this": ratio})
    return rows
