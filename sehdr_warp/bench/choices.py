"""`bench choices`: error against run time for each choice that trades one for the other."""

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch

from ..errors import SehdrError
from ..kernels.constants import ALPHA_THRESHOLD, EXPONENTIAL_DEGREE, TILE_SIZE, TRANSMITTANCE_MIN
from ..splatting.blend_style import DEFAULT_STYLE, BlendStyle
from ..splatting.rasterization import rasterize
from ..splatting.recording import GraphRecorder
from ..splatting.reference import rasterize_reference
from . import checks
from .harmonics_choice import harmonics_rows
from .peers import differs
from .report import new_report
from .splats import NAMES, Size, SplatScene, make_splat_scene
from .timing import Variant, time_variants

TRUE_THRESHOLD = 1e-9
"""Contributions down to this are in the truth, which no pixel ends early."""
ERROR_GAUSSIANS = 1500
"""Errors are measured on a scene of the same density with at most so many Gaussians, whose truth the plain reference
makes in float64; times on the scene that was asked for."""
CHANNELS = 9
TILE_SIZES = (8, 16, 32)
DECADES = 5.0


@dataclass(frozen=True)
class Option:
    """One value of one choice; what it leaves out is the default. rounded: what storage does to the features."""

    choice: str
    value: str
    alpha_threshold: float = ALPHA_THRESHOLD
    style: BlendStyle = DEFAULT_STYLE
    rounded: Callable[[torch.Tensor], torch.Tensor] | None = None

    @property
    def is_default(self) -> bool:
        return (self.alpha_threshold, self.style, self.rounded) == (ALPHA_THRESHOLD, DEFAULT_STYLE, None)


def options(device_type: str) -> list[Option]:
    """Every option that a device has, the default once for each choice."""
    made = [
        Option("alpha threshold", f"1/{n}", alpha_threshold=1.0 / n)
        for n in (64, 128, 255, 512, 1024, 4096, 16384, 65536, 262144)
    ]
    made += [
        Option("early termination", f"{least:g}", style=BlendStyle(transmittance_min=least))
        for least in (1e-2, 1e-3, TRANSMITTANCE_MIN, 1e-5, 1e-6, 0.0)
    ]
    made.append(Option("feature storage", "float32"))
    made += [
        Option("feature storage", name, rounded=partial(_through, dtype=dtype))
        for name, dtype in (("float16", torch.float16), ("bfloat16", torch.bfloat16))
    ]
    if device_type == "cuda":
        made += [
            Option("fast maths", name, style=BlendStyle(fast_math=on)) for name, on in (("on", True), ("off", False))
        ]
    else:
        made += [
            Option("exponential", f"degree {degree}", style=BlendStyle(exponential_degree=degree))
            for degree in (3, 4, EXPONENTIAL_DEGREE)
        ]
    return made


def _through(values: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    return values.to(dtype).to(values.dtype)


def bench_choices(
    size: Size,
    device: torch.device,
    *,
    iterations: int = 500,
    tile_sizes: bool = True,
    repetitions: int = 30,
    budget: float = 3.0,
    progress: Callable[[str], None] = lambda line: None,
) -> dict:
    """Time and weigh; returns the report, docs/benchmarks.md says what is in it.

    iterations: training steps of the small model on which degrees of the harmonics are compared, 0 leaves them out.
    tile_sizes: also other tiles, each in a process of its own. repetitions, budget: see time_variants.
    """
    settings = {"device": str(device), "size": str(size), "channels": CHANNELS, "repetitions": repetitions}
    report = new_report("choices", device, settings | {"cpu_seconds_per_variant": budget, "iterations": iterations})
    small = size.reduced(ERROR_GAUSSIANS)
    report["settings"]["errors_at"] = str(small)
    report["checks"] = [
        check.to_dict()
        for check in checks.check_against_reference(
            "the default", lambda scene: _image(scene), make_splat_scene(small, CHANNELS).to(device)
        )
    ]
    times = _times(make_splat_scene(size, CHANNELS).to(device), options(device.type), repetitions, budget)
    for kind in ("HDR", "LDR"):
        scene = with_features(make_splat_scene(small, CHANNELS), kind)
        truths = make_truths(scene)
        scene = scene.to(device)
        for option, timing in zip(options(device.type), times, strict=True):
            report["rows"].append(_row(option, kind) | timing | errors(option, scene, truths))
        progress(f"{kind} features: errors of {len(times)} options")
    if tile_sizes:
        report["rows"] += _tile_rows(size, device, repetitions, budget)
        progress(f"tiles of {', '.join(map(str, TILE_SIZES))}")
    if iterations:
        report["rows"] += harmonics_rows(device, iterations, repetitions, budget)
    report["notes"] += conclusions(report["rows"])
    return report


def with_features(scene: SplatScene, kind: str) -> SplatScene:
    """LDR: the scene's own features, 0 to 1. HDR: log-uniform over five decades, 0.003 to 300, channels alike."""
    if kind == "LDR":
        return scene.to()
    features = scene.leaves[-1].detach()
    generator = torch.Generator().manual_seed(5)
    exponent = DECADES * (torch.rand(len(features), 1, generator=generator) - 0.5)
    bright = 10.0**exponent * (0.5 + features)
    return SplatScene((*scene.leaves[:-1], bright), scene.world_to_camera, scene.intrinsics, scene.size).to()


def make_truths(scene: SplatScene) -> dict[float, list[torch.Tensor]]:
    """The image and the gradients of NAMES in float64, no pixel ended early, by threshold: with every contribution in,
    and with what the default leaves out left out as well."""

    def render(scene, threshold):
        return rasterize_reference(*scene.arguments, alpha_threshold=threshold, transmittance_min=0.0).image

    exact = scene.to("cpu", torch.float64)
    return {
        threshold: checks.image_and_gradients(partial(render, threshold=threshold), exact)
        for threshold in (TRUE_THRESHOLD, ALPHA_THRESHOLD)
    }


def errors(option: Option, scene: SplatScene, truths: dict[float, list[torch.Tensor]]) -> dict:
    """image_error: relative, in norm over the image. pixel_error_p99: what 99 % of the pixels stay below, each relative
    to its own true value. gradient_error: the largest of the relative errors, in norm, by leaf; worst_gradient: whose.

    own_image_error, own_gradient_error: without the threshold's share, which would hide the others: against the truth
    with the same threshold. Of a choice of threshold they are the whole errors.
    """
    image, *gradients = checks.image_and_gradients(partial(_image, option=option), scene)
    truth = truths[TRUE_THRESHOLD]
    by_leaf = dict(zip(NAMES, map(differs, gradients, truth[1:]), strict=True))
    own = truth if option.choice == "alpha threshold" else truths[ALPHA_THRESHOLD]
    worst = max(by_leaf, key=by_leaf.get)
    true = truth[0]
    relative = (image.double().cpu() - true).norm(dim=2) / true.norm(dim=2).clamp_min(1e-6 * float(true.abs().max()))
    return {
        "image_error": differs(image, true),
        "pixel_error_p99": float(relative.flatten().quantile(0.99)),
        "gradient_error": by_leaf[worst],
        "worst_gradient": worst,
        "gradient_errors": by_leaf,
        "own_image_error": differs(image, own[0]),
        "own_gradient_error": max(map(differs, gradients, own[1:])),
    }


def _image(scene: SplatScene, option: Option = Option("", ""), capacity: int | None = None) -> torch.Tensor:
    *geometry, features = scene.leaves
    if option.rounded is not None:
        # Storage is no part of the graph: the gradient passes as if nothing were rounded.
        features = features + (option.rounded(features) - features).detach()
    return rasterize(
        *geometry,
        features,
        *scene.arguments[len(NAMES) :],
        alpha_threshold=option.alpha_threshold,
        style=option.style,
        capacity=capacity,
    ).image


def _row(option: Option, kind: str) -> dict:
    return {
        "stage": "choice",
        "choice": option.choice,
        "value": option.value,
        "default": option.is_default,
        "features": kind,
    }


def _times(scene: SplatScene, asked: list[Option], repetitions: int, budget: float) -> list[dict]:
    """Times of forward and backward of each option, all in turns; times_default is of the shortest runs. On a GPU as a
    recorded graph, whose time is the GPU's own. Rounding of features is not timed: no kernel reads rounded ones."""
    cotangent = scene.cotangent()
    distinct = list(dict.fromkeys((o.alpha_threshold, o.style) for o in asked if o.rounded is None))
    variants = {key: _timed(scene, Option("", "", alpha_threshold=key[0], style=key[1]), cotangent) for key in distinct}
    timings = time_variants(variants, scene.device, repetitions=repetitions, budget=budget)
    default = timings[ALPHA_THRESHOLD, DEFAULT_STYLE].to_dict()["min_ms"]
    rows = []
    for option in asked:
        if option.rounded is not None:
            rows.append({"median_ms": None, "times_default": None})
            continue
        timing = timings[option.alpha_threshold, option.style].to_dict()
        rows.append(timing | {"times_default": timing["min_ms"] / default})
    return rows


def _timed(scene: SplatScene, option: Option, cotangent: torch.Tensor) -> Variant:
    if scene.device.type == "cpu":
        return Variant(lambda _: _image(scene, option).backward(cotangent), prepare=scene.clear)
    with torch.no_grad():
        entries = rasterize(*scene.arguments, alpha_threshold=option.alpha_threshold).entry_count

    def forward_backward():
        image = _image(scene, option, entries * 5 // 4)
        return [image.detach(), *torch.autograd.grad(image, scene.leaves, cotangent)]

    forward_backward()  # loads the kernels, which a recording cannot
    recorder = GraphRecorder(scene.device)
    return Variant(lambda _: recorder.run("splat", forward_backward))


def _tile_rows(size: Size, device: torch.device, repetitions: int, budget: float) -> list[dict]:
    """The default with other tiles. The size of a tile is a constant of the kernels, so each has its own process."""
    rows = []
    for edge in TILE_SIZES:
        command = [sys.executable, "-m", "sehdr_warp.bench.tile_choice", str(edge), str(device), str(size)]
        done = subprocess.run([*command, str(repetitions), str(budget)], capture_output=True, text=True, check=False)
        if done.returncode:
            reason = done.stderr.strip().splitlines()[-1:] or ["no message"]
            raise SehdrError(f"tiles of {edge} pixels could not be measured: {reason[0]}")
        rows += [row | {"default": edge == TILE_SIZE} for row in json.loads(done.stdout.splitlines()[-1])]
    default = next(row["min_ms"] for row in rows if row["default"])
    return [row | {"times_default": row["min_ms"] / default} for row in rows]


def measure_tiles(edge: int, device: torch.device, size: Size, repetitions: int, budget: float) -> list[dict]:
    """Rows of the default option in this process, whose kernels have tiles of `edge` pixels."""
    option = Option("tile size", str(edge))
    (timing,) = _times(make_splat_scene(size, CHANNELS).to(device), [option], repetitions, budget)
    rows = []
    for kind in ("HDR", "LDR"):
        scene = with_features(make_splat_scene(size.reduced(ERROR_GAUSSIANS), CHANNELS), kind)
        rows.append(_row(option, kind) | timing | errors(option, scene.to(device), make_truths(scene)))
    return rows


def conclusions(rows: list[dict]) -> list[str]:
    """For each choice a line from its figures: what the default costs in error, and what the next better and the
    fastest value would change."""
    lines = []
    chosen = [row for row in rows if row["stage"] == "choice" and row["features"] == "HDR"]
    for choice in dict.fromkeys(row["choice"] for row in chosen):
        values = [row for row in chosen if row["choice"] == choice]
        default = next(row for row in values if row["default"])
        parts = [f"{choice}: the default {default['value']} has {_errors(default)}"]
        others = [row for row in values if not row["default"] and row["median_ms"] is not None]
        better = [row for row in others if row["own_image_error"] < 0.9 * default["own_image_error"]]
        faster = [row for row in others if row["times_default"] < 0.97]
        if better:
            best = min(better, key=lambda row: row["times_default"])
            parts.append(f"{best['value']} has {_errors(best)} at {best['times_default']:.2f} times the time")
        else:
            parts.append("no value is more exact")
        if faster:
            fastest = min(faster, key=lambda row: row["times_default"])
            parts.append(f"{fastest['value']} takes {fastest['times_default']:.2f} times the time, {_errors(fastest)}")
        elif others:
            parts.append("none is more than 3 % faster")
        lines.append("; ".join(parts))
    return lines


def _errors(row: dict) -> str:
    return f"image error {row['own_image_error']:.1e}, gradient error {row['own_gradient_error']:.1e}"
