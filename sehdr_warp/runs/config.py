"""Every choice of a training: a tree of frozen, validated models, each field with its meaning, range and default.

The defaults are the `default` preset. Iteration numbers other than `schedule.iterations` are stated for a training of
`REFERENCE_ITERATIONS` and scale with it, so a shorter training is the same training, compressed.
"""

from collections.abc import Iterator
from operator import attrgetter
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from ..errors import SehdrError

REFERENCE_ITERATIONS = 30_000  # The length of training for which iteration numbers are stated: 3DGS's

Part = Annotated[float, Field(ge=0.0, le=1.0)]
Weight = Annotated[float, Field(ge=0.0, le=100.0)]
Rate = Annotated[float, Field(gt=0.0, le=1.0)]
Iteration = Annotated[int, Field(ge=1, le=10**12)]
Positive = Annotated[float, Field(gt=0.0, le=1e6)]
Name = Annotated[str, Field(min_length=1)]
Many = Field(strict=False)  # Lists, as TOML and JSON have them, are tuples here


class ConfigError(SehdrError):
    """Fields of a config contradict each other; names field, value and what is allowed."""


class _Table(BaseModel):
    """A table of the config: immutable, no unknown fields, no silent conversions but of whole numbers to floats."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


class ModelConfig(_Table):
    """What a Gaussian's color means and how an image comes of it."""

    radiance: Literal["log", "linear", "display"] = "log"
    """log: log exposure is a harmonic series, so radiance is always positive; linear: exposure itself is (SeHDR);
    display: encoded values are, with 3DGS's offset of 0.5"""
    tone_map: Literal["pixel", "gaussian"] = "pixel"
    """pixel: composite radiance, then apply the response to each pixel; gaussian: apply it to each Gaussian (SeHDR)"""
    sh_degree: Annotated[int, Field(ge=0, le=3)] = 3
    """highest degree of the spherical harmonics"""
    initial_density: Annotated[float, Field(ge=0.0, le=1000.0)] = 20.0
    """Gaussians to start from, times the square root of the training photos' pixels: the scene's points and, up to so
    many, points matched between the photos; 0: the scene's points alone"""
    exposure_compensation: Literal["auto", "unstated", "always", "never"] = "auto"
    """take out of the photos what the camera changed between them (exposure, white balance, falloff towards the
    corners), where points that they share show that it did; auto: exposure only where photos state no times, or times
    that the points contradict; unstated: only photos that state none; needs the plan and matched points"""
    init_file: str = ""
    """a file of Gaussians to start from in place of points, in the scene's coordinates: PLY, OpenUSD or glTF;
    empty: none"""
    antialiased: bool = False
    """lower opacity where the low-pass filter widens a small Gaussian (Mip-Splatting)"""


class ResponseConfig(_Table):
    """The camera response f: exposure (radiance x seconds) to encoded values."""

    name: Name = "auto"
    """a response's name, a file, auto: the one that fits the photos best, or learned: a perceptron for each channel,
    trained with the scene (HDR-GS)"""
    method: Literal["posterior", "paper"] = "posterior"
    """how auto chooses; posterior: by edges, by the spread of light and by what cameras do; paper: dynamic range and
    smoothness on one random training photo (SeHDR)"""
    candidates: Annotated[tuple[Name, ...], Many] = ()
    """what auto chooses from: names, and files of one curve or many; empty: the built-in ones and those between"""


class FusionConfig(_Table):
    """Exposure brackets and their neural fusion (SeHDR, equations 6 to 9)."""

    enabled: bool = False
    """fuse exposure brackets into the HDR color; off, the base color is the HDR color"""
    exposures: Annotated[tuple[Name, ...], Many] = ("1/8x", "1/4x", "1x", "8x", "16x")
    """exposures of the brackets: multiples of the photos' own (1/8x), stops from it (-3ev) or seconds (1/125)"""
    radiance_scale: Literal["unit", "base"] = "unit"
    """the radiance of a fused value of 1; unit: 1, as printed in the paper; base: 1 / dt_1, an exposure of 1"""


class LossConfig(_Table):
    """What the renders are compared with, and how."""

    form: Literal["sum", "blend"] = "sum"
    """sum: L1 + w (1 - SSIM), SeHDR; blend: (1 - w) L1 + w (1 - SSIM), 3DGS"""
    ssim_weight: Part = 0.2
    """w above"""
    ldr_weight: Weight = 1.0
    """weight of the photos; 0 leaves them out"""
    hdr_weight: Weight = 0.0
    """weight of the HDR color against HDR truth in the mu-law, where a view has it (HDR-GS: 0.6)"""
    clipping: bool = True
    """a clipped pixel only says `at least`, a black one only `at most`; where exposures are compared, in the last part
    of a training a code that stands for much light says no more than that; off: all are plain values"""
    clipped_smoothness: Weight = 0.001
    """weight of how far the log light of a clipped pixel is from the mean of those around it, squared, where exposures
    are compared"""
    clipped_lift: Weight = 0.0003
    """weight of the log light of clipped pixels beside others, which goes up: the blur of Gaussians takes from it"""
    clipped_estimate: Weight = 0.003
    """weight of the squared distance of the log light of clipped pixels from its estimates, in their deviations, where
    exposures are compared; estimates come from the learned prior and from gain maps"""
    light_prior: bool = False
    """estimate the light of clipped pixels from the rest of each photo, by a learned prior; off: gain maps alone"""
    linear_weight: Weight = 0.0
    """weight of the linear loss (SeHDR: 0.5)"""
    hdr_truth: bool = False
    """compare the base color with HDR truth in the linear loss, where a view has it"""
    anchor_weight: Weight = 0.0
    """learned response: weight of (f(1) - 1/2)^2, which holds the scale (HDR-NeRF: 0.5)"""
    opacity_weight: Annotated[float, Field(ge=0.0, le=10.0)] = 0.01
    """weight of the mean opacity, which lets unneeded Gaussians fade for mcmc to relocate (3DGS-MCMC: 0.01)"""

    @property
    def uses_hdr(self) -> bool:
        """Whether HDR truth of the training views takes part in the loss."""
        return self.hdr_weight > 0 or (self.linear_weight > 0 and self.hdr_truth)


class DensificationConfig(_Table):
    """When and how far the number of Gaussians changes; options of one strategy are in the tables mcmc and adc."""

    strategy: Literal["mcmc", "adc"] = "mcmc"
    """mcmc: relocate transparent Gaussians to opaque ones (3DGS-MCMC); adc: duplicate and split where image gradients
    are large (3DGS's adaptive density control)"""
    refine_start_iter: Annotated[int, Field(ge=0, le=10**12)] = 500
    """iteration after which the number of Gaussians may change"""
    refine_stop_iter: Annotated[int, Field(ge=0, le=10**12)] = 15_000
    """iteration from which it stays"""
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
    growth_rate: Part = 0.05
    """fraction of new Gaussians per change; more in a training too short to reach the cap at this rate"""
    seed_fraction: Part = 0.2
    """fraction of the relocated and new Gaussians that is placed where a photo is reproduced worst, at depths on which
    photos agree; 0 disables"""
    noise_lr: Annotated[float, Field(ge=0.0, le=1e12)] = 5e5
    """strength of the noise on positions, in units of their learning rate; 0 disables"""
    prune_near_angle: Weight = 0.0
    """relocate Gaussians whose standard deviation exceeds this multiple of the distance to the nearest training camera
    (floaters in front of cameras); 0 disables"""


class AdcConfig(_Table):
    """Options of densification.strategy = "adc" (3DGS, section 5.2)."""

    grow_grad2d: Positive = 0.0002
    """mean gradient of the projected position, in normalised screen units, above which a Gaussian is duplicated or
    split"""
    grow_scale3d: Positive = 0.01
    """split Gaussians larger than this fraction of the scene, duplicate smaller ones"""
    prune_scale3d: Positive = 0.1
    """remove Gaussians larger than this fraction of the scene, after the first reset"""
    reset_every: Iteration = 3000
    """iterations between resets of the opacities"""


class OptimizerConfig(_Table):
    """Adam's learning rates. Positions are in units of the scene's extent."""

    means: Rate = 1.6e-4
    """positions, at the start"""
    means_final: Rate = 1.6e-6
    """positions, at the end; exponential in between"""
    log_scales: Rate = 5e-3
    """logarithms of the sizes"""
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
    """what a learned response is made of (HDR-GS: 0.0005)"""


class ScheduleConfig(_Table):
    """When things happen."""

    iterations: Annotated[int, Field(ge=1, le=10_000_000)] = 30_000
    """training steps; one photo each"""
    sh_degree_interval: Iteration = 1000
    """iterations between degrees of the harmonics; degree 0 first"""
    ema_window: Annotated[int, Field(ge=0, le=10**12)] = 750
    """the scene is the mean over about so many of the last iterations, the later the more; 0: the last alone"""
    evaluate_at: Annotated[tuple[Iteration, ...], Many] = (500, 1000, 2000, 4000, 7000, 10_000, 14_000, 20_000, 30_000)
    """iterations that test the held-out views; the last always does"""
    checkpoint_every: Iteration = 5000
    """iterations between checkpoints; one is always written at the end"""
    keep_checkpoints: Annotated[int, Field(ge=1, le=1000)] = 1
    """older checkpoints are deleted"""
    photo_cache: Literal["auto", "device", "memory", "disk"] = "auto"
    """where photos are kept: on the device, in memory and copied to the device a step ahead, on the disk and read from
    there, or as far down as they must be to fit; on a CPU device and memory are one"""
    use_cuda_graph: bool = True
    """on a GPU, replay training steps as CUDA graphs; off, launch each: much slower"""


class PlanConfig(_Table):
    """What is left out because the scene does not need it."""

    enabled: bool = True
    """read the scene before the training and leave out what it does not need"""
    keep: Annotated[tuple[Name, ...], Many] = ()
    """fields that the plan leaves as they are, such as those given on the command line"""


class Config(_Table):
    """Every choice of a training; see the parts."""

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
    """of every random number in the training"""
    deterministic: bool = False
    """on a GPU, the same bits every time, for some speed and memory; a CPU always does"""

    @model_validator(mode="after")
    def _fits_together(self) -> "Config":
        if problem := next(_contradictions(self), None):
            raise ConfigError(problem)
        return self

    def scaled(self, iteration: int) -> int:
        """An iteration number of the config as a number of this training's iterations, at least 1."""
        return max(1, round(iteration * self.schedule.iterations / REFERENCE_ITERATIONS))

    def degree_at(self, iteration: int) -> int:
        """The degree of the harmonics that a step after so many uses: one more every sh_degree_interval."""
        return min(self.model.sh_degree, iteration // self.scaled(self.schedule.sh_degree_interval))


def _contradictions(config: Config) -> Iterator[str]:
    """One line for each pair of fields that contradict each other."""
    model, fusion, loss = config.model, config.fusion, config.loss
    learned, display = config.response.name == "learned", model.radiance == "display"
    if fusion.enabled and len(fusion.exposures) < 2:
        yield f"fusion.exposures = {list(fusion.exposures)} is too few; a fusion needs two or more"
    if display:
        for path in ("fusion.enabled", "loss.linear_weight", "loss.hdr_weight"):
            if value := attrgetter(path)(config):
                yield f'{path} = {value} needs radiance: model.radiance = "display" has none'
    if learned and (display or fusion.enabled):
        field = "model.radiance = 'display'" if display else "fusion.enabled = True"
        yield f'{field} needs a known response: response.name = "learned" has none'
    if loss.linear_weight > 0 and not (fusion.enabled or loss.hdr_truth):
        given = f"loss.linear_weight = {loss.linear_weight}"
        yield f"{given} has nothing to compare: needs fusion.enabled or loss.hdr_truth"
    if loss.ldr_weight == loss.hdr_weight == loss.linear_weight == 0:
        yield "loss.ldr_weight = 0.0 leaves nothing to compare: give loss.hdr_weight or loss.ldr_weight"
    if loss.anchor_weight > 0 and not learned:
        yield f'loss.anchor_weight = {loss.anchor_weight} is for nothing: needs response.name = "learned"'
    if config.optimizer.means_final > config.optimizer.means:
        yield f"optimizer.means_final = {config.optimizer.means_final} is greater than optimizer.means"
