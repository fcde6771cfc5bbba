"""`bench kernels`: the whole differentiable splat (project, order, bin, blend; colours given)."""

from collections.abc import Callable

import torch

from ..kernels.constants import TILE_SIZE
from ..splatting.rasterization import rasterize
from ..splatting.recorded_rasterizer import RecordedRasterizer
from ..splatting.recording import GraphRecorder
from . import checks
from .machine import package_version
from .peers import Peer, differs, find_peers
from .report import new_report
from .splats import Size, SplatScene, make_splat_scene
from .timing import Variant, peak_memory, time_variants

OURS = "sehdr-warp"
OURS_REPLAYED = "sehdr-warp, RecordedRasterizer"
"""Called from Python like the peers, gradients by torch's autograd; two CUDA graphs behind each call."""
OURS_RECORDED = "sehdr-warp, recorded"
"""rasterize() with room for a quarter more entries than there are, replayed as a CUDA graph: what it costs inside a
recorded training step."""
PLAIN_TORCH = "plain torch"
PLAIN_TORCH_BYTES = 4 << 30
"""The plain torch rasterizer keeps about 16 numbers for each pixel-Gaussian pair; beyond this it is left out."""


def bench_kernels(
    sizes: list[Size],
    channels: list[int],
    device: torch.device,
    *,
    peers: bool = True,
    repetitions: int = 30,
    budget: float = 20.0,
    progress: Callable[[str], None] = lambda line: None,
) -> dict:
    """Time and check; returns the report.

    sizes, channels: every combination is measured. peers: compare with the peers that import.
    repetitions, budget: see time_variants.
    """
    settings = {"device": str(device), "repetitions": repetitions, "cpu_seconds_per_variant": budget}
    report = new_report("kernels", device, settings)
    found, notes = find_peers(device) if peers else ([], ["peers not compared: not asked for (--peers)"])
    report["notes"] += notes
    for size in sizes:
        for count in channels:
            scene = make_splat_scene(size, count).to(device)
            usable = [peer for peer in found if peer.supports(count)]
            report["checks"] += [check.to_dict() for check in _checks(scene, usable)]
            report["rows"] += _splat_rows(scene, usable, repetitions, budget, report["notes"])
            best = next(
                row for row in report["rows"][::-1] if row["implementation"] == OURS and row["stage"] == "splat"
            )
            progress(f"{size}, {count} channels: {best['pass']} {best['median_ms']:.3f} ms")
    report["notes"] = list(dict.fromkeys(report["notes"]))
    return report


def _render(scene: SplatScene) -> torch.Tensor:
    return rasterize(*scene.arguments).image


def _replayed(scene: SplatScene) -> Callable[[], torch.Tensor]:
    splat = RecordedRasterizer(scene.device)
    return lambda: splat(*scene.arguments).image


def _recorded(scene: SplatScene, cotangent: torch.Tensor | None) -> Callable[[], list[torch.Tensor]]:
    """A replay of the render with a capacity: of [image], or with a cotangent of [image, gradients of the leaves]."""
    with torch.no_grad():
        capacity = rasterize(*scene.arguments).entry_count * 5 // 4

    def forward():
        with torch.no_grad():
            return [rasterize(*scene.arguments, capacity=capacity).image]

    def forward_backward():
        image = rasterize(*scene.arguments, capacity=capacity).image
        return [image.detach(), *torch.autograd.grad(image, scene.leaves, cotangent)]

    function = forward if cotangent is None else forward_backward
    function()  # loads the kernels, which a recording cannot
    recorder = GraphRecorder(scene.device)
    return lambda: recorder.run("render", function)


def _checks(scene: SplatScene, peers: list[Peer]) -> list[checks.Check]:
    """Every variant that is timed: on a scene small enough for the reference, on CUDA also on the timed one."""
    small = make_splat_scene(scene.size.reduced(checks.REFERENCE_GAUSSIANS), scene.channels).to(scene.device)
    made = []
    if scene.device.type == "cuda":
        cpu = checks.image_and_gradients(_render, scene.to("cpu"))
        for name, render in ((OURS, _render), (OURS_REPLAYED, lambda scene: _replayed(scene)())):
            made += checks.check_against_reference(name, render, small)
            ours = checks.image_and_gradients(render, scene)
            made += checks.compare(name, "CPU kernels", scene, ours, cpu)
        made += checks.compare(OURS_RECORDED, "CPU kernels", scene, _recorded(scene, scene.cotangent())(), cpu)
    else:
        made += checks.check_against_reference(PLAIN_TORCH, checks.render_reference, small)
        made += checks.check_against_reference(OURS, _render, small)
    if peers:
        with torch.no_grad():
            image = _render(scene)
            for peer in peers:
                difference = differs(peer.renderer(scene)(), image)
                what = f"{peer.name}: image"
                made.append(checks.Check(what, OURS, str(scene.size), scene.channels, difference, peer.bound))
    return made


def _splat_rows(scene: SplatScene, peers: list[Peer], repetitions: int, budget: float, notes: list[str]) -> list[dict]:
    """Rows of the whole splat, forward, and forward and backward, of us and of everyone we compare with."""
    with torch.no_grad():
        entries = rasterize(*scene.arguments).entry_count
    renderers = {OURS: lambda: _render(scene)} | {peer.name: peer.renderer(scene) for peer in peers}
    versions = {OURS: package_version(OURS)} | {peer.name: peer.version for peer in peers}
    if scene.device.type == "cuda":
        renderers[OURS_REPLAYED] = _replayed(scene)
        versions[OURS_REPLAYED] = versions[OURS]
    else:
        if entries * TILE_SIZE**2 * 16 * 4 <= PLAIN_TORCH_BYTES:
            renderers[PLAIN_TORCH] = lambda: checks.render_reference(scene)
            versions[PLAIN_TORCH] = package_version("torch")
        else:
            notes.append(f"{PLAIN_TORCH} not compared at {scene.size}: it would need more than 4 GiB")
    cotangent = scene.cotangent()
    rows = []
    for name, make in (("forward", _forward), ("forward + backward", _forward_backward)):
        variants = {key: make(render, scene, cotangent) for key, render in renderers.items()}
        if scene.device.type == "cuda":
            replay = _recorded(scene, None if make is _forward else cotangent)
            variants[OURS_RECORDED] = Variant(lambda _, replay=replay: replay())
            versions[OURS_RECORDED] = versions[OURS]
        timings = time_variants(variants, scene.device, repetitions=repetitions, budget=budget)
        for key, timing in timings.items():
            row = _row(scene, "splat", key, name) | {"version": versions[key], "entries": entries} | timing.to_dict()
            row["peak_memory_bytes"] = peak_memory(variants[key], scene.device)
            row["ours_over_this"] = None if key == OURS else timings[OURS].median / timing.median
            rows.append(row)
    return rows


def _forward(render, scene, cotangent) -> Variant:
    def run(_):
        with torch.no_grad():
            render()

    return Variant(run)


def _forward_backward(render, scene, cotangent) -> Variant:
    return Variant(lambda _: render().backward(cotangent), prepare=scene.clear)


def _row(scene: SplatScene, stage: str, implementation: str, passes: str) -> dict:
    size = scene.size
    return {
        "stage": stage,
        "gaussians": size.gaussians,
        "width": size.width,
        "height": size.height,
        "channels": scene.channels,
        "implementation": implementation,
        "pass": passes,
    }
