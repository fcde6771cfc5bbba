"""Every choice of a training: one tree of frozen dataclasses, each field with its meaning, its range and its default.

The defaults are the `default` preset. A TOML file states only what differs from the preset named by its key `base`
(default: "default"). Iteration numbers other than `schedule.iterations` are stated for a training of
`schedule.stated_for` iterations and scale with it, so a shorter training is the same training, compressed.
"""

import math
from dataclasses import dataclass, field, fields, is_dataclass

from .config_checks import ConfigError, check_together


def option(default, doc: str, *, low=None, high=None, above=None, choices=None, nonempty=False):
    """A documented field: low <= value <= high, above < value, or one of choices; for tuples, of each item."""
    limits = {"low": low, "high": high, "above": above, "choices": choices, "nonempty": nonempty}
    return field(default=default, metadata={"doc": doc, "limits": limits})


@dataclass(frozen=True)
class ModelConfig:
    """What a Gaussian's colour means and how an image comes of it."""

    radiance: str = option(
        "log",
        "log: log exposure is a harmonic series, so radiance is always positive; linear: exposure itself is (SeHDR); "
        "log-chroma: exposure is exp of a constant times a harmonic series about 1 (after LCD-GS); "
        "display: encoded values are, with 3DGS's offset of 0.5",
        choices=("log", "linear", "log-chroma", "display"),
    )
    tone_map: str = option(
        "pixel",
        "pixel: composite radiance, then apply the response to each pixel; gaussian: apply it to each Gaussian (SeHDR)",
        choices=("pixel", "gaussian"),
    )
    harmonics_degree: int = option(3, "highest degree of the spherical harmonics", low=0, high=3)
    initial_count: int = option(
        50_000, "Gaussians to start from where the scene has no points", low=100, high=10_000_000
    )
    initial_opacity: float = option(0.1, "opacity of every Gaussian at the start", above=0.0, high=0.99)
    initial_scale: float = option(
        1.0, "start size, in mean distances to the three nearest neighbours", above=0.0, high=10.0
    )
    far_points: int = option(
        0, "Gaussians on a far shell behind the scene, for skies and distant light", low=0, high=1_000_000
    )
    dropout: float = option(
        0.0,
        "part of the Gaussians that a step leaves out at the end of the training, from 0 at the start (DropGaussian)",
        low=0.0,
        high=0.9,
    )
    antialiased: bool = option(False, "lower opacity where the low-pass filter widens a small Gaussian (Mip-Splatting)")
    low_pass: float = option(0.3, "variance in square pixels added to every projected Gaussian", low=0.0, high=10.0)


@dataclass(frozen=True)
class ResponseConfig:
    """The camera response f: exposure (radiance x seconds) to encoded values."""

    name: str = option("auto", "a response's name, a file, or auto: the one that fits the photos best", nonempty=True)
    method: str = option(
        "posterior",
        "how auto chooses; posterior: colours across edges mix linearly (Lin et al. 2004), light is spread smoothly "
        "over as many stops as scenes usually have, and cameras' own JPEGs are known to have a camera's curve; edges: "
        "the first of these alone; paper: dynamic range and smoothness on one random training photo",
        choices=("posterior", "edges", "paper"),
    )
    candidates: tuple[str, ...] = option(
        (),
        "what auto chooses from: names, and files of one curve or many; empty: the built-in ones and those between",
        nonempty=True,
    )
    form: str = option(
        "curve",
        "curve: the named response; mlp: none, but a perceptron for each channel that is learned with the scene "
        "(HDR-GS)",
        choices=("curve", "mlp"),
    )
    width: int = option(128, "mlp: hidden units of each channel's perceptron", low=1, high=4096)
    refine: bool = option(False, "curve: correct it together with the scene, within an increasing, anchored family")
    refine_after: int = option(5000, "refine: iterations before the correction begins: geometry comes first", low=0)
    refine_weight: float = option(
        1e-3, "refine: weight of the correction's size, which pulls it to the start curve", low=0.0, high=10.0
    )


@dataclass(frozen=True)
class FusionConfig:
    """Exposure brackets and their neural fusion (SeHDR, equations 6 to 9)."""

    enabled: bool = option(False, "fuse exposure brackets into the HDR colour; off, the base colour is the HDR colour")
    exposures: tuple[str, ...] = option(
        ("1/8x", "1/4x", "1x", "8x", "16x"),
        "exposures of the brackets: multiples of the photos' own (1/8x), stops from it (-3ev) or seconds (1/125)",
        nonempty=True,
    )
    radiance_scale: str = option(
        "unit",
        "the radiance of a fused value of 1; unit: 1, as printed in the paper; base: 1 / dt_1, an exposure of 1; "
        "white: the radiance that the photos show as white",
        choices=("unit", "base", "white"),
    )
    sigma: float = option(0.2, "start value of the well-exposedness widths", above=0.0, high=10.0)
    width: int = option(128, "hidden units of each channel's perceptron", low=1, high=4096)
    hidden_layers: int = option(1, "hidden layers of each channel's perceptron", low=1, high=8)
    evaluation: str = option(
        "tabulated",
        "exact: the perceptrons run for every Gaussian; tabulated: for a table over radiance, which is interpolated",
        choices=("exact", "tabulated"),
    )


@dataclass(frozen=True)
class LossConfig:
    """What the renders are compared with, and how."""

    form: str = option(
        "sum", "sum: L1 + w (1 - SSIM), SeHDR; blend: (1 - w) L1 + w (1 - SSIM), 3DGS", choices=("sum", "blend")
    )
    ssim_weight: float = option(0.2, "w above", low=0.0, high=1.0)
    ldr_weight: float = option(1.0, "weight of the photos; 0 leaves them out", low=0.0, high=100.0)
    hdr_weight: float = option(
        0.0, "weight of the HDR colour against HDR truth, where a view has it (HDR-GS: 0.6)", low=0.0, high=100.0
    )
    hdr_domain: str = option(
        "mu-law",
        "what that comparison is made of, all over the largest truth; mu-law: mu = 5000; log: the same with 2^20, "
        "almost a logarithm over 20 stops; linear: radiance itself",
        choices=("mu-law", "log", "linear"),
    )
    predictor: str = option(
        "",
        "what stands in for HDR truth in training: a single-image predictor's name, a folder of predictions or a file "
        "of a network; empty: nothing, truth is the data's own",
    )
    clipping: bool = option(
        True, "a clipped pixel only says `at least`, a black one only `at most`; off: both are plain values"
    )
    interval: str = option(
        "off",
        "a code z says `between z - 1/2 and z + 1/2`, and inside nothing pulls; difference: in L1; all: in SSIM as "
        "well",
        choices=("off", "difference", "all"),
    )
    domain: str = option(
        "auto",
        "what is compared; encoded: photos; mu-law: exposures, decoded from the photo, by log(1 + mu x / white); auto: "
        "mu-law where pixels have an exposure and the curve is known",
        choices=("auto", "encoded", "mu-law"),
    )
    knee: float = option(
        8.0,
        "mu-law: code of 255 whose exposure is white / mu; light below counts as light, above as its logarithm",
        above=0.0,
        high=250.0,
    )
    linear_weight: float = option(0.0, "weight of the linear loss (SeHDR: 0.5)", low=0.0, high=100.0)
    linear_detach: str = option(
        "fused",
        "the side of the self-supervised linear loss that gets no gradient: the fused or the base colour, or none",
        choices=("fused", "base", "none"),
    )
    hdr_truth: bool = option(False, "compare the base colour with HDR truth in the linear loss, where a view has it")
    highlight_weight: float = option(
        0.0,
        "weight of the mean number of stops that clipped pixels lack to what is expected, or a tenth of what is beyond",
        low=0.0,
        high=10.0,
    )
    highlight_stops: float = option(
        1.8, "stops over white that light at clipped pixels is expected at, at most", low=0.0, high=20.0
    )
    highlight_expected: str = option(
        "photos",
        "fixed: highlight_stops at every clipped pixel; photos: less where few channels of it clip, and where much "
        "light lies just below white",
        choices=("fixed", "photos"),
    )
    harmonics_weight: float = option(
        0.0, "weight of the mean square of the harmonics above degree 0", low=0.0, high=100.0
    )
    anchor_weight: float = option(
        0.0, "mlp: weight of (f(1) - anchor_value)^2, which holds the scale (HDR-NeRF: 0.5)", low=0.0, high=100.0
    )
    anchor_value: float = option(0.5, "mlp: what the unit exposure is encoded as", above=0.0, high=0.999)
    opacity_weight: float = option(
        0.01, "weight of the mean opacity: relocation needs some that fade (3DGS-MCMC: 0.01)", low=0.0, high=10.0
    )
    scale_weight: float = option(0.0, "weight of the mean size (3DGS-MCMC: 0.01)", low=0.0, high=10.0)

    @property
    def uses_hdr(self) -> bool:
        """Whether HDR truth of the training views takes part in the loss."""
        return self.hdr_weight > 0 or (self.linear_weight > 0 and self.hdr_truth)


@dataclass(frozen=True)
class DensificationConfig:
    """How Gaussians are added and taken away."""

    strategy: str = option(
        "relocation",
        "gradient: clone and split where image gradients are large (3DGS); relocation: move the dead to where the "
        "living are (3DGS-MCMC); none",
        choices=("gradient", "relocation", "none"),
    )
    start: int = option(500, "first iteration after which the count may change", low=0)
    stop: int = option(15_000, "the iteration from which it may no longer", low=0)
    every: int = option(100, "iterations between changes", low=1)
    max_gaussians: int = option(3_000_000, "the count never exceeds this", low=1)
    budget: float = option(
        120.0,
        "relocation: nor this many times the square root of the training photos' pixels, if they start with fewer; 0: "
        "no such bound",
        low=0.0,
    )
    grow_gradient: float = option(
        0.0002, "gradient: mean gradient in normalised screen units that makes one grow", above=0.0
    )
    grow_scale: float = option(
        0.01, "gradient: larger than this part of the scene is split, smaller is cloned", above=0.0
    )
    prune_opacity: float = option(0.005, "fainter ones are taken away (relocation: are moved)", above=0.0, high=0.5)
    prune_scale: float = option(
        0.1, "gradient: larger than this part of the scene is taken away after the first reset", above=0.0
    )
    reset_every: int = option(3000, "gradient: iterations between resets of the opacities", low=1)
    slope_corrected: bool = option(
        False, "gradient: weigh the gradients by what the response's slope takes from dark and bright Gaussians"
    )
    revised_opacity: bool = option(False, "gradient: a split keeps the opacity of the whole (Revising Densification)")
    contribution: float = option(
        0.0,
        "those that add less than this many pixels' worth to every training photo are taken away at contribution_at",
        low=0.0,
        high=100.0,
    )
    contribution_at: tuple[int, ...] = option(
        (5900, 8900, 11_900, 15_000, 20_000),
        "iterations of that, before resets of the opacities rather than after",
        low=1,
    )
    growth: float = option(0.05, "relocation: the count grows by this part at each change", low=0.0, high=1.0)
    noise: float = option(5e5, "relocation: strength of the noise on the positions, in learning rates", low=0.0)


@dataclass(frozen=True)
class OptimizerConfig:
    """Adam's learning rates. Positions are in units of the scene's extent."""

    means: float = option(1.6e-4, "positions, at the start", above=0.0, high=1.0)
    means_final: float = option(1.6e-6, "positions, at the end; exponential in between", above=0.0, high=1.0)
    log_scales: float = option(5e-3, "logarithms of the sizes", above=0.0, high=1.0)
    quaternions: float = option(1e-3, "rotations", above=0.0, high=1.0)
    opacity_logits: float = option(5e-2, "opacities before the sigmoid", above=0.0, high=1.0)
    harmonics_dc: float = option(2e-2, "colours, degree 0", above=0.0, high=1.0)
    harmonics_rest: float = option(1e-3, "colours, higher degrees", above=0.0, high=1.0)
    fusion: float = option(1e-3, "perceptrons and widths of the fusion", above=0.0, high=1.0)
    response: float = option(5e-4, "what a learned response is made of (HDR-GS: 0.0005)", above=0.0, high=1.0)
    refinement: float = option(2e-3, "logarithms of the slopes by which a curve is refined", above=0.0, high=1.0)
    final_factor: float = option(
        1.0, "all rates but the positions' fall to this part of theirs over decay_from to the end", above=0.0, high=1.0
    )
    decay_from: float = option(0.5, "part of the training after which they fall, exponentially", low=0.0, high=0.99)
    visible_only: bool = option(
        False, "a step changes only what is in its photo, with its moments; off: momentum also moves the unseen (Adam)"
    )


@dataclass(frozen=True)
class ScheduleConfig:
    """When things happen."""

    iterations: int = option(30_000, "training steps; one photo each", low=1, high=10_000_000)
    stated_for: int = option(30_000, "the number of iterations for which all other iteration numbers are stated", low=1)
    harmonics_every: int = option(1000, "iterations between degrees of the harmonics; degree 0 first", low=1)
    harmonics_on_demand: bool = option(
        False, "a degree is stored and optimised from the iteration that adds it; off: all are from the start"
    )
    harmonics_gain: float = option(
        0.0,
        "decibels by which a degree must lower the loss over training photos after its first harmonics_every "
        "iterations; with less it is taken out again, and no higher one is added; 0: none is",
        low=0.0,
        high=10.0,
    )
    coarse_levels: int = option(0, "start with photos halved this often", low=0, high=4)
    coarse_every: int = option(1000, "iterations at each coarse level", low=1)
    evaluate_at: tuple[int, ...] = option(
        (500, 1000, 2000, 4000, 7000, 10_000, 14_000, 20_000, 30_000),
        "iterations that test the held-out views, not just after a reset of opacities; the last always does",
        low=1,
    )
    checkpoint_every: int = option(5000, "iterations between checkpoints; one is always written at the end", low=1)
    checkpoints_kept: int = option(1, "older checkpoints are deleted", low=1, high=1000)
    early_stop: int = option(
        0, "the training ends after this many looks in a row without early_stop_gain; 0: never", low=0, high=1000
    )
    early_stop_every: int = option(1000, "iterations between looks", low=1)
    early_stop_gain: float = option(0.02, "decibels over the best look so far that count as a gain", low=0.0, high=10.0)
    early_stop_on: str = option(
        "held-in",
        "held-in: the mean loss of the steps since the last look, as an amplitude; held-out: PSNR of the held-out "
        "photos, which then are no fair test any more",
        choices=("held-in", "held-out"),
    )
    recorded: bool = option(True, "on a GPU, replay training steps as CUDA graphs; off, launch each: much slower")
    nonfinite_limit: int = option(
        20, "steps with a loss or gradient that is not finite are skipped; more than this stop the training", low=0
    )


DECISIONS = (
    "response",
    "brackets",
    "linear-loss",
    "densification",
    "iterations",
    "confidence",
)
"""What a plan decides, in this order."""


@dataclass(frozen=True)
class PlanConfig:
    """What is left out because the scene does not need it (docs/plan.md)."""

    enabled: bool = option(False, "read the scene before the training and decide what it does not need")
    decisions: tuple[str, ...] = option((), "which decisions are made; empty: all", choices=DECISIONS)
    keep: tuple[str, ...] = option(
        (), "fields that the plan leaves as they are, such as those given on the command line", nonempty=True
    )


@dataclass(frozen=True)
class Config:
    """Every choice of a training; see the parts. Immutable: dataclasses.replace or load_config make another."""

    model: ModelConfig = ModelConfig()
    response: ResponseConfig = ResponseConfig()
    fusion: FusionConfig = FusionConfig()
    loss: LossConfig = LossConfig()
    densification: DensificationConfig = DensificationConfig()
    optimizer: OptimizerConfig = OptimizerConfig()
    schedule: ScheduleConfig = ScheduleConfig()
    plan: PlanConfig = PlanConfig()
    seed: int = option(0, "of every random number in the training", low=0, high=2**62)
    deterministic: bool = option(
        False, "on a GPU, the same bits every time, for some speed and memory; a CPU always does"
    )

    def __post_init__(self):
        validate(self)

    def scaled(self, iteration: int) -> int:
        """An iteration number of the config as a number of this training's iterations, at least 1."""
        return max(1, round(iteration * self.schedule.iterations / self.schedule.stated_for))


def validate(config: Config) -> None:
    """Raises ConfigError for the first field that is out of range, or for fields that contradict each other."""
    for path, value, limits in _leaves(config, ""):
        _check(path, value, limits)
    check_together(config)


def _leaves(node, prefix: str):
    for item in fields(node):
        value = getattr(node, item.name)
        if is_dataclass(value):
            yield from _leaves(value, f"{prefix}{item.name}.")
        else:
            yield prefix + item.name, value, item.metadata["limits"]


def _check(path: str, value, limits: dict) -> None:
    for item in value if isinstance(value, tuple) else (value,):
        shown = f"{path} = {item!r}"
        if isinstance(item, float) and not math.isfinite(item):
            raise ConfigError(f"{shown} is not finite")
        if limits["choices"] is not None and item not in limits["choices"]:
            raise ConfigError(f"{shown} is not one of {', '.join(limits['choices'])}")
        if limits["low"] is not None and item < limits["low"]:
            raise ConfigError(f"{shown} is less than {limits['low']}")
        if limits["above"] is not None and item <= limits["above"]:
            raise ConfigError(f"{shown} is not greater than {limits['above']}")
        if limits["high"] is not None and item > limits["high"]:
            raise ConfigError(f"{shown} is greater than {limits['high']}")
        if limits["nonempty"] and not item:
            raise ConfigError(f"{shown} is empty")
