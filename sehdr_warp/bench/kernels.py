"""`bench kernels`: the whole differentiable splat (project, order, bin, blend; colors given), timed and checked."""

import logging
import math
from collections.abc import Callable, Sequence

import torch

from ..kernels.constants import TILE_SIZE
from ..splatting.rasterization import rasterize
from ..splatting.recorded_rasterizer import RecordedRasterizer
from ..splatting.recording import GraphRecorder
from ..splatting.reference import rasterize_reference
from .gsplat_peer import BOUND, GSPLAT, gsplat_renderer, missing
from .results import check, new_result
from .splats import NAMES, Size, SplatScene, make_splat_scene
from .timing import Variant, peak_memory, time_variants

LOG = logging.getLogger(__name__)
OURS, PLAIN_TORCH = "sehdr-warp", "plain torch"
REPLAYED = "sehdr-warp, RecordedRasterizer"
"""Called from Python like the peers, gradients by torch's autograd; two CUDA graphs behind each call."""
RECORDED = "sehdr-warp, recorded"
"""rasterize() with room for a quarter more entries than there are, replayed as a CUDA graph: what it costs inside a
recorded training step."""
PLAIN_TORCH_BYTES = 4 << 30
"""The plain torch rasterizer keeps about 16 numbers for each pixel-Gaussian pair; beyond this it is left out."""
IMAGE_BOUND, GRADIENT_BOUND = 1e-4, 1e-3
"""Largest relative difference, in norm, of float32 from float64 truth. Alphas that fall on the other side of the
threshold make most of it; a wrong formula or a lost Gaussian is far beyond."""
REFERENCE_GAUSSIANS = 4000
"""Scenes of at most so many Gaussians are checked themselves, larger ones on a smaller one of the same density."""
COLUMNS = {
    "Gaussians=gaussians": ",d", "width": "d", "height": "d", "C=channels": "d", "pass": "",
    "rasterizer=implementation": "", "median ms=median_ms": ".3f", "p90 ms=p90_ms": ".3f", "n=repetitions": "d",
    "peak MiB=peak_memory_bytes": "MiB", "ours / this=ours_over_this": ".3f",
}  # fmt: skip


def bench_kernels(
    sizes: Sequence[Size],
    channels: Sequence[int],
    device: torch.device,
    *,
    peers: bool,
    repetitions: int,
    budget: float,
) -> dict:
    """Every combination of size and channels, forward, and forward and backward; a result.

    Args:
        peers: also gsplat, where it is installed. repetitions, budget: see time_variants.
    """
    result = new_result("kernels", device, {"device": str(device), "repetitions": repetitions, "budget": budget})
    reason = missing(device) if peers else "gsplat not compared: not asked for (--peers)"
    result["notes"] += [reason] if reason else []
    for size in sizes:
        for count in channels:
            scene = make_splat_scene(size, count, device)
            result["checks"] += _checks(scene, peer=reason is None)
            rows = _rows(scene, reason is None, repetitions, budget)
            result["rows"] += rows
            ours = [row["median_ms"] for row in rows if row["implementation"] == OURS]
            LOG.info("%s, %d channels: %.3f ms forward, %.3f ms with backward", size, count, *ours)
    return result


def render(scene: SplatScene) -> torch.Tensor:
    return rasterize(*scene.arguments).image


def render_reference(scene: SplatScene) -> torch.Tensor:
    """The plain torch rasterizer, in the scene's own precision and on its device."""
    return rasterize_reference(*scene.arguments).image


def image_and_gradients(rendered: Callable[[SplatScene], torch.Tensor], scene: SplatScene) -> list[torch.Tensor]:
    """The image, and the gradients of scene.leaves for scene.cotangent()."""
    scene.clear()
    image = rendered(scene)
    image.backward(scene.cotangent())
    gradients = [leaf.grad for leaf in scene.leaves]
    scene.clear()
    return [image.detach(), *gradients]


def differs(value: torch.Tensor, other: torch.Tensor) -> float:
    """|value - other| / |other| over the whole tensor, in float64; infinite where a number is not finite."""
    value, other = value.detach().double().cpu(), other.detach().double().cpu()
    difference = float((value - other).norm() / other.norm().clamp_min(1e-300))
    return difference if math.isfinite(difference) else math.inf


def compared(name: str, against: str, ours: list[torch.Tensor], truth: list[torch.Tensor]) -> list[dict]:
    """Checks of an image and the gradients of NAMES, as image_and_gradients() gives them."""
    labels = ["image", *(f"gradient of {leaf}" for leaf in NAMES)]
    return [
        check(f"{name}: {label}", against, differs(a, b), IMAGE_BOUND if label == "image" else GRADIENT_BOUND)
        for label, a, b in zip(labels, ours, truth, strict=True)
    ]


def _checks(scene: SplatScene, *, peer: bool) -> list[dict]:
    """What is timed, against float64; on a GPU also against the CPU's kernels at full size."""
    channels = scene.leaves[-1].shape[1]
    small = make_splat_scene(scene.size.reduced(REFERENCE_GAUSSIANS), channels, scene.device)
    truth = image_and_gradients(render_reference, small.to("cpu", torch.float64))
    made = compared(OURS, "float64", image_and_gradients(render, small), truth)
    if scene.device.type == "cuda":
        cpu = image_and_gradients(render, scene.to("cpu"))
        splat = RecordedRasterizer(scene.device)
        replayed = image_and_gradients(lambda s: splat(*s.arguments).image, scene)
        recorded = _recorded(scene, scene.cotangent())()
        for name, ours in ((OURS, image_and_gradients(render, scene)), (REPLAYED, replayed), (RECORDED, recorded)):
            made += compared(name, "the CPU's kernels", ours, cpu)
    if peer:
        with torch.no_grad():
            made.append(check("gsplat: image", OURS, differs(gsplat_renderer(scene)(), render(scene)), BOUND))
    return made


def _recorded(scene: SplatScene, cotangent: torch.Tensor | None) -> Callable[[], list[torch.Tensor]]:
    """A replay: of [image], or with a cotangent of [image, gradients of the leaves]."""
    with torch.no_grad():
        capacity = rasterize(*scene.arguments).entry_count * 5 // 4

    def forward():
        with torch.set_grad_enabled(cotangent is not None):
            image = rasterize(*scene.arguments, capacity=capacity).image
        if cotangent is None:
            return [image]
        return [image.detach(), *torch.autograd.grad(image, scene.leaves, cotangent)]

    forward()  # loads the kernels, which a recording cannot
    recorder = GraphRecorder(scene.device)
    return lambda: recorder.run("render", forward)


def _rows(scene: SplatScene, peer: bool, repetitions: int, budget: float) -> list[dict]:
    with torch.no_grad():
        entries = rasterize(*scene.arguments).entry_count
    renderers = {OURS: lambda: render(scene)}
    if peer:
        renderers[GSPLAT] = gsplat_renderer(scene)
    if scene.device.type == "cuda":
        splat = RecordedRasterizer(scene.device)
        renderers[REPLAYED] = lambda: splat(*scene.arguments).image
    elif entries * TILE_SIZE**2 * 16 * 4 <= PLAIN_TORCH_BYTES:
        renderers[PLAIN_TORCH] = lambda: render_reference(scene)
    cotangent, rows = scene.cotangent(), []
    for name, backward in (("forward", False), ("forward + backward", True)):
        variants = {key: _variant(call, scene, cotangent if backward else None) for key, call in renderers.items()}
        if scene.device.type == "cuda":
            replay = _recorded(scene, cotangent if backward else None)
            variants[RECORDED] = Variant(lambda _, replay=replay: replay())
        timings = time_variants(variants, scene.device, repetitions=repetitions, budget=budget)
        for key, timing in timings.items():
            size = scene.size
            row = {"gaussians": size.gaussians, "width": size.width, "height": size.height}
            row |= {"channels": scene.leaves[-1].shape[1], "pass": name, "implementation": key, "entries": entries}
            row |= timing | {"peak_memory_bytes": peak_memory(variants[key], scene.device)}
            ratio = None if key == OURS else timings[OURS]["median_ms"] / timing["median_ms"]
            rows.append(row | {"ours_over_this": ratio})
    return rows


def _variant(call: Callable[[], torch.Tensor], scene: SplatScene, cotangent: torch.Tensor | None) -> Variant:
    if cotangent is not None:
        return Variant(lambda _: call().backward(cotangent), prepare=scene.clear)
    return Variant(torch.no_grad()(lambda _: call()))
