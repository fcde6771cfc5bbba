"""The options of a training: tables of frozen, validated fields, each with meaning, range and default.

The defaults are the `default` preset. Iteration numbers other than `schedule.iterations` are for a training of
`REFERENCE_ITERATIONS` and scale with it, so a shorter training is the same training, compressed.
"""

from collections.abc import Iterator
from operator import attrgetter
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from ..errors import SehdrError

REFERENCE_ITERATIONS = 30_000  # Length of a training, as in 3DGS, that iteration numbers of a config refer to
RESTART = 10.0
"""Rate of the positions, as a multiple of the final one, at which a finished training goes on: 3DGS's half-way."""
LONGEST_EXTENSION = 3.0
"""Multiple of a finished training's iterations beyond which densification begins again. With 3, 4 and 20 times 150
steps on the embedded scene, held-out photos gain 0.35, 0.5 and 1.4 dB from it by the end."""
EVALUATE_AT = (500, 1000, 2000, 4000, 7000, 10_000, 14_000, 20_000, 30_000)  # Denser where held-out photos gain most

Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Weight = Annotated[float, Field(ge=0.0, le=100.0)]
Rate = Annotated[float, Field(gt=0.0, le=1.0)]
Iteration = Annotated[int, Field(ge=1, le=10**12)]
Positive = Annotated[float, Field(gt=0.0, le=1e6)]
Name = Annotated[str, Field(min_length=1)]
AsTuple = Field(strict=False)  # Lists of TOML and JSON become tuples


class ConfigError(SehdrError):
    """An error that names two fields of a config that contradict each other, and what is allowed."""


class _Table(BaseModel):
    """A table of the config: immutable, without unknown fields or conversions other than int to float."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )

    def __setattr__(self, name: str, value: Any) -> None:
        """Raise SehdrError for a field, because a config is checked as a whole when it is made."""
        if name in type(self).model_fields:
            remedy = "make another config, as in load_config(preset, {'loss.ssim_weight': 0.3})"
            raise SehdrError(f"{type(self).__name__}.{name} = {value!r:.60}: a config cannot be changed; {remedy}")
        super().__setattr__(name, value)


class ModelConfig(_Table):
    """Colors of Gaussians, images made of them, and the start of a training."""

    radiance: Literal["log", "linear", "display"] = "log"
    """what the spherical harmonics represent; log: log exposure, so that radiance is positive; linear: exposure
    (SeHDR); display: encoded values, with 3DGS's offset of 0.5"""
    tone_map: Literal["pixel", "gaussian"] = "pixel"
    """pixel: composite radiance, then apply the response to each pixel; gaussian: apply it to each Gaussian (SeHDR)"""
    sh_degree: Annotated[int, Field(ge=0, le=3)] = 3
    """highest degree of the spherical harmonics"""
    initial_density: Annotated[float, Field(ge=0.0, le=1000.0)] = 20.0
    """initial number of Gaussians, as a multiple of the square root of the training photos' pixels: the scene's points,
    filled up with points matched between photos; 0 uses the scene's points alone"""
    exposure_compensation: Literal["auto", "unstated", "always", "never"] = "auto"
    """correct changes of exposure, white balance and vignetting between photos, measured at points that they share;
    auto: exposure only if photos state no times, or times that the points contradict; unstated: only photos without
    times; always: as if no times were stated; needs the plan and matched points"""
    init_file: str = ""
    """file of Gaussians (PLY, OpenUSD, glTF) in the scene's coordinates to start from instead of points; empty: none"""
    antialiased: bool = False
    """lower the opacity of Gaussians that the low-pass filter widens (Mip-Splatting)"""
    order_angle: Annotated[float, Field(ge=0.0, le=60.0)] = 25.0
    """most degrees, sideways and up or down, by which half of the steps turn at random the axis that Gaussians are
    ordered along, so that views turned away from the photos look right; 0: 3DGS; fisheyes and panoramas have none"""
    dropout: Annotated[float, Field(ge=0.0, le=0.9)] = 0.0
    """share of the Gaussians that the last step leaves out at random, against overfitting to few photos (DropGaussian);
    it grows from 0"""


class ResponseConfig(_Table):
    """The camera response f, from exposure (radiance x seconds) to encoded values."""

    name: Name = "auto"
    """name of a response, or a file; auto: the response that fits the photos best; learned: one perceptron per channel,
    trained with the scene (HDR-GS)"""
    method: Literal["posterior", "paper"] = "posterior"
    """how auto chooses; posterior: by edges, the distribution of light and typical curves of cameras; paper: by dynamic
    range and smoothness on one random training photo (SeHDR)"""
    candidates: Annotated[tuple[Name, ...], AsTuple] = ()
    """responses that auto chooses from: names, and files of one curve or several; empty: built-in curves and their
    interpolations"""


class FusionConfig(_Table):
    """Exposure brackets and their neural fusion (SeHDR, equations 6 to 12)."""

    enabled: bool = False
    """fuse exposure brackets into the HDR color; else the base color is the HDR color"""
    exposures: Annotated[tuple[Name, ...], AsTuple] = ("1/8x", "1/4x", "1x", "8x", "16x")
    """exposures of the brackets: multiples of the photos' own (1/8x), stops from it (-3ev) or seconds (1/125)"""
    radiance_scale: Literal["unit", "base"] = "unit"
    """radiance of a fused value of 1; unit: 1, as printed in the paper; base: 1 / dt_1, an exposure of 1"""


class LossConfig(_Table):
    """The terms of the loss and their weights."""

    form: Literal["sum", "blend"] = "sum"
    """sum: L1 + w (1 - SSIM), SeHDR; blend: (1 - w) L1 + w (1 - SSIM), 3DGS"""
    ssim_weight: Fraction = 0.2
    """w in the formulas of form"""
    ldr_weight: Weight = 1.0
    """weight of the photos; 0 disables"""
    hdr_weight: Weight = 0.0
    """weight of the HDR color against HDR truth in the mu-law, for views that have it (HDR-GS: 0.6)"""
    clipping: bool = True
    """treat saturated pixels as a lower bound and black pixels as an upper bound of radiance; if exposures are
    compared, bright codes are intervals too in the last part of a training; false: plain values"""
    clipped_smoothness: Weight = 0.001
    """weight of the squared difference between the log light of a clipped pixel and the mean of its neighbors; applies
    if exposures are compared"""
    clipped_estimate: Weight = 0.01
    """weight of the squared distance between the log light of clipped pixels and its estimate; applies if exposures are
    compared. The unit is the estimate's deviation for gain maps, 1.5 stops for the learned prior"""
    light_prior: bool = True
    """estimate the light of clipped pixels from the rest of each photo by a learned prior; false: gain maps alone"""
    linear_weight: Weight = 0.0
    """weight of the linear loss (SeHDR: 0.5)"""
    hdr_truth: bool = False
    """compare the base color with HDR truth in the linear loss, for views that have it"""
    anchor_weight: Weight = 0.0
    """learned response: weight of (f(1) - 1/2)^2, which fixes the scale of exposure (HDR-NeRF: 0.5)"""
    opacity_weight: Annotated[float, Field(ge=0.0, le=10.0)] = 0.01
    """weight of the mean opacity, which lets unneeded Gaussians fade for mcmc to relocate (3DGS-MCMC); it is 0 from the
    last relocation on and, where a photo shows less than a tenth of the scene, for new Gaussians until a photo shows
    them; more leaves surfaces transparent"""
    transmittance_weight: Annotated[float, Field(ge=0.0, le=10.0)] = 1.0
    """weight of the mean transmittance of the pixels in a twentieth of the steps, after the last relocation and in the
    second half; these make surfaces opaque, and give positions, sizes and rotations no gradient; it is less in
    trainings below 4,000 steps, and 0 for rendered sets whose transparent parts count as black"""
    size_weight: Annotated[float, Field(ge=0.0, le=10.0)] = 0.01
    """weight of the mean size of the Gaussians in units of the cameras' radius (3DGS-MCMC), which shrinks those that no
    photo supports, and which can veil new views; it is 0 from the last relocation on, and where a photo
    shows less than a tenth of the scene"""

    @property
    def uses_hdr(self) -> bool:
        """True if the loss compares with HDR truth of the training views."""
        return self.hdr_weight > 0 or (self.linear_weight > 0 and self.hdr_truth)


class DensificationConfig(_Table):
    """Changes of the number of Gaussians; options of one strategy are in the tables mcmc and adc."""

    strategy: Literal["mcmc", "adc"] = "mcmc"
    """mcmc: relocate transparent Gaussians to opaque ones (3DGS-MCMC); adc: duplicate and split where image gradients
    are large (3DGS's adaptive density control)"""
    refine_start_iter: Annotated[int, Field(ge=0, le=10**12)] = 500
    """iteration after which the number of Gaussians may change"""
    refine_stop_iter: Annotated[int, Field(ge=0, le=10**12)] = 15_000
    """iteration from which that number no longer changes"""
    refine_every: Iteration = 100
    """iterations between changes"""
    cap_max: Annotated[int, Field(ge=1, le=2**31 - 1)] = 3_000_000
    """largest number of Gaussians"""
    prune_opacity: Annotated[float, Field(gt=0.0, le=0.5)] = 0.005
    """mcmc relocates, and adc removes, Gaussians below this opacity"""


class McmcConfig(_Table):
    """Options of densification.strategy = "mcmc" (3DGS-MCMC, NeurIPS 2024)."""

    cap_density: Annotated[float, Field(ge=0.0, le=1e6)] = 120.0
    """largest number of Gaussians, as a multiple of the square root of the training photos' pixels; ignored if the
    training starts with more; 0 disables this cap"""
    growth_rate: Fraction = 0.05
    """fraction of new Gaussians per change; more in a training too short to reach the cap at this rate"""
    seed_fraction: Fraction = 0.2
    """fraction of the relocated and new Gaussians that is placed where a photo is reproduced worst, at depths on which
    photos agree; 0 disables"""
    sharpness_photos: Annotated[int, Field(ge=0, le=1000)] = 0
    """photos that are compared with their renders at each refinement; Gaussians that they show sharper are copied more
    often; 0 copies by opacity alone"""
    noise_lr: Annotated[float, Field(ge=0.0, le=1e12)] = 5e5
    """strength of the noise on positions, in units of their learning rate; 0 disables"""


class AdcConfig(_Table):
    """Options of densification.strategy = "adc" (3DGS, section 5.2)."""

    grow_grad2d: Positive = 0.0002
    """mean gradient of the projected position, in normalized screen units, above which a Gaussian is duplicated or
    split"""
    grow_scale3d: Positive = 0.01
    """split Gaussians larger than this fraction of the scene, duplicate smaller ones"""
    prune_scale3d: Positive = 0.1
    """remove Gaussians larger than this fraction of the scene, after the first reset"""
    reset_every: Iteration = 3000
    """iterations between resets of the opacities"""


class OptimizerConfig(_Table):
    """Learning rates of Adam. Those of positions are in normalized units: 1.1 radii of the training cameras."""

    means: Rate = 1.6e-4
    """positions, at the start"""
    means_final: Rate = 1.6e-6
    """positions, at the end; exponential in between"""
    log_scales: Rate = 5e-3
    """logarithms of the standard deviations"""
    quaternions: Rate = 1e-3
    """rotations"""
    opacity_logits: Rate = 5e-2
    """opacities before the sigmoid"""
    harmonics_dc: Rate = 2e-2
    """colors, degree 0"""
    harmonics_rest: Rate = 1e-3
    """colors, higher degrees"""
    fusion: Rate = 1e-3
    """perceptrons and widths of the fusion"""
    response: Rate = 5e-4
    """parameters of a learned response (HDR-GS: 0.0005)"""


class ScheduleConfig(_Table):
    """Length of a training, and what happens when."""

    iterations: Annotated[int, Field(ge=1, le=10_000_000)] = 30_000
    """number of photos that are trained on; a step takes one, or one for each GPU"""
    sh_degree_interval: Iteration = 1000
    """iterations after which the SH degree increases by one, from 0"""
    ema_window: Annotated[int, Field(ge=0, le=10**12)] = 750
    """the trained scene is the exponential moving average over about this many of the last iterations; 0 disables"""
    evaluate_at: Annotated[tuple[Iteration, ...], AsTuple] = EVALUATE_AT
    """iterations at which held-out views are evaluated; the last one always is"""
    checkpoint_every: Iteration = 5000
    """iterations between checkpoints, which are also 10 s apart if this is not set; one is always written at the end"""
    keep_checkpoints: Annotated[int, Field(ge=1, le=1000)] = 1
    """number of checkpoints in the run folder; older ones are deleted"""
    photo_cache: Literal["auto", "device", "memory", "disk"] = "auto"
    """where photos are stored: on the device; in memory, copied to the device a step ahead; on the disk; auto: the
    first of these that they fit in; on a CPU, device and memory are the same"""
    use_cuda_graph: bool = True
    """on a GPU, capture training steps as CUDA graphs; false is much slower"""


class PlanConfig(_Table):
    """Automatic choice of options from the photos."""

    enabled: bool = True
    """measure the photos before the training, and leave out what they do not need"""
    keep: Annotated[tuple[Name, ...], AsTuple] = ()
    """fields that the plan does not change, such as those of the command line"""


class Config(_Table):
    """The options of a training; see the tables."""

    model: ModelConfig = ModelConfig()
    response: ResponseConfig = ResponseConfig()
    fusion: FusionConfig = FusionConfig()
    loss: LossConfig = LossConfig()
    densification: DensificationConfig = DensificationConfig()
    mcmc: McmcConfig = McmcConfig()
    adc: AdcConfig = AdcConfig()
    optimizer: OptimizerConfig = OptimizerConfig()
    schedule: ScheduleConfig = ScheduleConfig()
    plan: PlanConfig = PlanConfig()
    seed: Annotated[int, Field(ge=0, le=2**62)] = 0
    """seed of all random numbers of the training"""
    deterministic: bool = False
    """on a GPU, repeat bit for bit, at some cost of speed and memory; on a CPU a training always does"""

    @model_validator(mode="after")
    def _check_contradictions(self) -> "Config":
        """Raise ConfigError if fields contradict each other."""
        if problem := next(_contradictions(self), None):
            raise ConfigError(problem)
        return self

    def scaled(self, iteration: int) -> int:
        """Scale an iteration number of the config to the length of this training, at least 1."""
        return max(1, round(iteration * self.schedule.iterations / REFERENCE_ITERATIONS))

    @property
    def load_options(self) -> dict[str, Any]:
        """Arguments of load_scene() that a config states, beside LoadArguments."""
        response, cache = self.response, self.schedule.photo_cache
        options = {"response": response.name, "method": response.method, "candidates": response.candidates}
        return options | {"photo_storage": "memory" if cache == "device" else cache}

    @property
    def checkpoint_interval(self) -> int:
        """Iterations of this training between checkpoints."""
        return self.scaled(self.schedule.checkpoint_every)

    def continued_after(self, finished_at: int) -> "Config":
        """Return the config for the steps that follow a training that was finished after `finished_at` iterations.

        The scene must not become worse before it becomes better. So Gaussians are no longer relocated or added, the SH
        degree stays, and positions learn at most at RESTART times their final rate, falling to it. But a training that
        goes on beyond LONGEST_EXTENSION times its iterations was a trial, and this config is returned as it is.
        """
        part = finished_at / self.schedule.iterations
        if not 1 / LONGEST_EXTENSION <= part < 1:
            return self
        end = int(part * REFERENCE_ITERATIONS)
        rates, densification, schedule = self.optimizer, self.densification, self.schedule
        means = min(rates.means, rates.means_final * RESTART ** (1 / (1 - part)))
        interval = min(schedule.sh_degree_interval, max(1, end // (self.model.sh_degree + 1)))
        changed = {
            "optimizer": rates.model_copy(update={"means": means}),
            "densification": densification.model_copy(
                update={"refine_stop_iter": min(densification.refine_stop_iter, end)}
            ),
            "schedule": schedule.model_copy(update={"sh_degree_interval": interval}),
        }
        return self.model_copy(update=changed)

    def degree_at(self, iteration: int) -> int:
        """Return the SH degree of step `iteration`, counted from 1: one more every sh_degree_interval."""
        return min(self.model.sh_degree, iteration // self.scaled(self.schedule.sh_degree_interval))


def _contradictions(config: Config) -> Iterator[str]:
    """Yield one line for each pair of fields that contradict each other."""
    model, fusion, loss = config.model, config.fusion, config.loss
    learned, display = config.response.name == "learned", model.radiance == "display"
    if fusion.enabled and len(fusion.exposures) < 2:
        yield f"fusion.exposures = {list(fusion.exposures)} is too few; a fusion needs two or more"
    if repeated := [text for text in dict.fromkeys(fusion.exposures) if fusion.exposures.count(text) > 1]:
        yield f"fusion.exposures = {list(fusion.exposures)} has {repeated[0]} more than once; give each exposure once"
    if display:
        for path in ("fusion.enabled", "loss.linear_weight", "loss.hdr_weight"):
            if value := attrgetter(path)(config):
                yield f'{path} = {value} needs radiance: model.radiance = "display" has none'
    if learned and (display or fusion.enabled):
        field = "model.radiance = 'display'" if display else "fusion.enabled = True"
        yield f'{field} needs a known response: response.name = "learned" has none'
    if loss.linear_weight > 0 and not (fusion.enabled or loss.hdr_truth):
        setting = f"loss.linear_weight = {loss.linear_weight}"
        yield f"{setting} has nothing to compare: needs fusion.enabled or loss.hdr_truth"
    if loss.ldr_weight == loss.hdr_weight == loss.linear_weight == 0:
        yield "loss.ldr_weight = 0.0 leaves nothing to compare: set loss.hdr_weight or loss.ldr_weight"
    if loss.anchor_weight > 0 and not learned:
        yield f'loss.anchor_weight = {loss.anchor_weight} has no effect: needs response.name = "learned"'
    if config.optimizer.means_final > config.optimizer.means:
        yield f"optimizer.means_final = {config.optimizer.means_final} is greater than optimizer.means"
    fields = {name for name, value in config if not isinstance(value, BaseModel)}
    fields |= {f"{table}.{name}" for table, value in config if table not in fields for name, _ in value}
    unknown = [path for path in config.plan.keep if path not in fields]
    if unknown and config.plan.enabled:  # False in the config of a run, which loads although its names are wrong.
        yield f"plan.keep has {unknown[0]!r:.80}, which is not a field"
