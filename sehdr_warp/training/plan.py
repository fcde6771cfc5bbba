"""The plan of a training: what its scene does not need, each decision with a reason in figures."""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from operator import attrgetter
from pathlib import Path
from typing import Any

import torch

from ..errors import InputError, require_loaded
from ..model.exposure import exposure_times, is_seconds
from ..parallel import thread_count
from ..progress import format_duration
from ..runs.config import Config, McmcConfig, OptimizerConfig
from ..runs.config_files import as_config, override_config
from ..runs.device import pick_device
from ..scene import Scene
from ..scene.photos import FEWEST_PHOTOS
from ..subsets import counted
from .cost import cpu_seconds
from .hdr_truth import largest_hdr_truth
from .initialization import base_time_of, start_count
from .scene_facts import LARGE_SCENE, SceneFacts, measure_scene
from .strategies import mcmc_cap

STEPS_PER_PHOTO = 75
"""Iterations for each photo. With 300, held-out photos of real captures lose up to 2.6 dB and gain at most 0.3 dB: the
scene fits what moved between the photos and what their poses do not explain."""
FEWEST_ITERATIONS = 4000  # Of a training with few photos, if the config has that number and a CPU has the time
CPU_SECONDS = 60.0  # Duration of a training on a CPU, if CPU_FEWEST iterations take no longer
CPU_FEWEST = 1000  # Iterations on a CPU, however long they take
CPU_STEPS_PER_PHOTO, CPU_MOST_SECONDS = 10, 600.0
"""Steps on each photo, if they take no longer: with 4, the scene is blurred, and held-out photos still gain 1 dB in the
last third."""
CPU_CAP_DENSITY = 60.0  # mcmc.cap_density if time is short: more steps gain more than more Gaussians
GPU_CAP_DENSITY = 480.0
"""mcmc.cap_density on a GPU if there are more than MANY_PHOTOS photos of a scene that is not large. Held-out photos are
then sharper; with fewer, Gaussians fit what single photos show: 240 costs 0.24 dB there. Blocks keep the requested
value: see BlockPlan.config_of()."""
MANY_PHOTOS = 20
RATES_FOR = 30_000  # Length of the trainings that 3DGS's learning rates are for
RATE_POWER, MAX_RATE_SCALE = 0.22, 2.5  # Rates of shorter trainings grow with this power, up to this factor
SCALED_RATE_PHOTOS = 40  # Largest number of photos for that: scenes with 10 to 21 photos gain, with 52 and 84 lose
SCALED_RATES = "means", "means_final", "log_scales", "opacity_logits", "harmonics_rest"
FEW_PHOTOS_HARMONICS = 2.5e-4
"""optimizer.harmonics_rest if there are no more photos than harmonics of a Gaussian. These then fit the light of each
photo and extrapolate between them; a quarter of the usual rate gains 0.6 and 1.1 dB on 10 and 8 photos."""
FEW_PHOTOS_DROPOUT = 0.2
"""model.dropout where photos are as few and each has DROPOUT_STEPS steps or more. Held-out photos of twelve captures
gain 0.3 dB in the mean, and end 0.4 dB below their best in place of 0.6."""
DROPOUT_STEPS = 250
FOCAL_RATIO = 1.25
"""Ratio of the photos' focal lengths in pixels from which model.antialiased is on. In a coarser photo the rasterizer
widens a small Gaussian by more of the scene, so that no brightness of it fits coarse and fine photos."""
MAX_EXPOSURE_RATIO = 2.0**16
"""Largest ratio of a bracket's exposure to the photos'; beyond, all 8-bit pixels are black or white."""
COMPENSATION = "exposure-compensation"  # Name of the decision that compensation.py adds
UNMEASURED = "not measured"  # Its choice if matched points do not show whether the exposure changed
LEAST_OVERLAP = 0.02  # Fraction of places shown by two photos, below which poses or photos are wrong
LEAST_CONTRAST = 1 / 255  # Standard deviation of all encoded values, below which photos show a single color
CLIPPED = 0.002  # Fraction of clipped pixels from which a line says that light above white is an estimate
DRIFT = 3.0  # Stops of brightness between photos that suggest an exposure that changed without being stated


@dataclass(frozen=True)
class Decision:
    """A decision of the plan."""

    fields: dict[str, object]  # Fields of the config that change, with their values; of a rule, those that it asks for
    choice: str  # The choice in words
    reason: str  # The figures it rests on
    name: str = ""  # Name of the rule; make_plan() fills it
    always_log: bool = False  # Whether it is logged although it changes no field


@dataclass(frozen=True)
class Plan:
    """The options of a training for a scene, and why.

    Attributes:
        config: Config to train with.
        facts: Figures of the scene.
        decisions: Decisions in the order of RULES.
        user_fields: Fields that a decision would have changed, but the user had set.
    """

    config: Config
    facts: SceneFacts
    decisions: tuple[Decision, ...]
    user_fields: dict[str, object]

    def to_dict(self) -> dict:
        """Return plain values for plan.json and --json."""
        decisions = [{"name": decision.name, **asdict(decision)} for decision in self.decisions]
        return {"decisions": decisions, "kept": self.user_fields, "facts": asdict(self.facts)}

    def table(self) -> str:
        """Return all decisions as lines: name, choice, reason and values."""
        name, choice = (max(len(getattr(row, column)) for row in self.decisions) for column in ("name", "choice"))
        lines = []
        for row in self.decisions:
            lines.append(f"{row.name:{name}}  {row.choice:{choice}}  {row.reason}")
            lines += [f"{'':{name}}  {'':{choice}}  -> {line}" for line in _format_fields(row.fields)]
        return "\n".join([*lines, *(f"set by you: {line}" for line in _format_fields(self.user_fields))])

    def lines(self) -> list[str]:
        """Return a line for each decision that changes something, and for each field that the user set."""
        lines = [
            f"plan: {row.name}: {row.choice} ({row.reason})" for row in self.decisions if row.fields or row.always_log
        ]
        measured = any(row.name == COMPENSATION and row.choice != UNMEASURED for row in self.decisions)
        if self.facts.drift >= DRIFT and not measured:
            spread = f"the photos' brightness differs by {self.facts.drift:.1f} stops and no exposure times are known"
            lines.append(f"plan: {spread}: if exposure changed between them, give their times in exposures.json")
        if code := self.facts.plateau:
            problem = f"many pixels have code {code} of 255, and hardly any is brighter: they clip"
            lines.append(f"plan: {problem}, but count as not clipped; export the photos with white at 255")
        is_measured = self.facts.unclipped or (self.config.loss.uses_hdr and self.facts.truths)
        if self.facts.clipped_when_dark >= CLIPPED and not is_measured:
            estimated = f"{self.facts.clipped:.1%} of the pixels clip, and their light above white is an estimate"
            remedy = "three photos in which lamps and windows do not clip would measure it"
            if (dark := self.facts.clipped_when_dark) < self.facts.clipped:
                remedy = f"the darkest photos clip, too ({dark:.1%} of their pixels): {remedy}"
            lines.append(f"plan: {estimated}; {remedy}")
        return lines + [f"plan: {line}, as it was set" for line in _format_fields(self.user_fields)]


def _format_fields(fields: dict) -> list[str]:
    """Format fields with their values."""
    return [f"{path} = {json.dumps(value)}" for path, value in fields.items()]


def make_plan(
    scene: Scene,
    config: Config | str | Path | Mapping[str, Any] | None = None,
    device: str | torch.device | None = None,
) -> Plan:
    """Decide what the training of a scene can leave out.

    Args:
        scene: A scene from load_scene().
        config: Requested options, as in create_trainer(); fields in config.plan.keep do not change.
        device: Device to train on.

    Raises:
        InputError: For a scene that cannot be trained, and for fields in plan.keep that the scene contradicts.
    """
    require_loaded("load_scene", scene)
    device, config = pick_device(device), as_config(config) or Config()
    facts = measure_scene(scene, config.seed)
    check_scene(scene, facts)
    check_fields(scene, config)
    planned, decisions, overridden = config, [], {}
    for name, rule in RULES.items():
        decision = rule(facts, planned, device)
        overridden |= {path: attrgetter(path)(planned) for path in decision.fields if path in config.plan.keep}
        changes = {
            path: new
            for path, new in decision.fields.items()
            if path not in overridden and new != attrgetter(path)(planned)
        }
        decisions.append(replace(decision, fields=changes, name=name))
        planned = override_config(planned, changes, f"{scene.name}: plan of {name}")
    planned = override_config(planned, {"plan.enabled": False}, scene.name)
    return Plan(planned, facts, tuple(decisions), overridden)


def check_scene(scene: Scene, facts: SceneFacts) -> None:
    """Raise InputError for a scene that no training can work with."""
    if facts.photos < FEWEST_PHOTOS:
        problem = f"{facts.photos} training photos: depth and light cannot be told apart from so few"
        raise InputError(scene.name, problem, f"take {FEWEST_PHOTOS} or more from different places, better 20")
    if facts.contrast < LEAST_CONTRAST:
        problem = f"all photos show a single color (deviation {255 * facts.contrast:.2f} of 255): nothing to match"
        raise InputError(scene.name, problem, "check that the files are the photos, and their exposure")
    if facts.overlap < LEAST_OVERLAP:
        problem = f"the photos share no view: {facts.overlap:.1%} of the places that one shows another shows too"
        raise InputError(scene.name, problem, "check poses and axes, or take photos that overlap by a half")


def check_fields(scene: Scene, config: Config) -> None:
    """Raise InputError, with both values, for fields in plan.keep, set by the user, that the scene contradicts."""
    user_fields, points = config.plan.keep, len(scene.points)

    def refuse(path: str, problem: str, remedy: str) -> None:
        raise InputError(scene.name, f"{path} = {json.dumps(attrgetter(path)(config))}, but {problem}", remedy)

    if "fusion.exposures" in user_fields:
        base = base_time_of(scene)
        times = [item for item in config.fusion.exposures if is_seconds(item)]
        if times and not scene.exposure_times_known:
            problem = f"{times[0]} is a time and the photos state none"
            refuse("fusion.exposures", problem, "write multiples of their exposure (1/8x) or stops from it (-3ev)")
        for time in exposure_times(base, config.fusion.exposures):
            if not 1 / MAX_EXPOSURE_RATIO <= time / base <= MAX_EXPOSURE_RATIO:
                problem = f"{time:.3g} s is {time / base:.3g} times the photos' {base:.3g} s"
                most = f"{MAX_EXPOSURE_RATIO:.0f}"
                refuse("fusion.exposures", problem, f"stay within 1/{most} and {most} times")
    if {"loss.hdr_truth", "loss.linear_weight", "loss.hdr_weight"} & set(user_fields):
        largest_hdr_truth(scene, config.loss)
    if "densification.cap_max" in user_fields and config.densification.cap_max < points:
        remedy = f"use {points} or more, or leave the field out"
        refuse("densification.cap_max", f"the scene starts from {points} points", remedy)


def _response(facts: SceneFacts, config: Config, device: torch.device) -> Decision:
    name = config.response.name
    if facts.light_known:
        return Decision({}, "no search", "the photos state light, not codes of a curve")
    if name != "auto":
        return Decision({}, "no search", "learned with the scene" if name == "learned" else f"response.name is {name}")
    origin = "files of a camera" if facts.from_camera else "files of unknown origin"
    return Decision({}, "search", f"response.name is auto, {origin}: chosen from {facts.photos} photos")


def _light(facts: SceneFacts, config: Config, device: torch.device) -> Decision:
    if not (facts.unclipped and facts.truths == facts.photos and config.loss.ldr_weight):
        zero_weights: dict[str, object] = (
            {} if facts.clipped else dict.fromkeys(("loss.clipped_smoothness", "loss.clipped_estimate"), 0.0)
        )
        return Decision(zero_weights, "from the photos", f"{facts.clipped:.1%} of the pixels are clipped")
    fields: dict[str, object] = {"loss.ldr_weight": 0.0, "loss.hdr_weight": 1.0, "loss.form": "blend"}
    reason = f"{facts.truths} float images have no white level; encoded, errors of highlights would count little"
    return Decision(fields, "float images, by the mu-law", reason)


def _brackets(facts: SceneFacts, config: Config, device: torch.device) -> Decision:
    darker, brighter = (2 if facts.clipped < 0.001 else 4), (2 if facts.black < 0.001 else 4)
    reason = (
        f"{facts.clipped:.1%} of the pixels clip, {facts.black:.1%} are black: export -{darker} to +{brighter} EV "
        f"(render --evs=-{darker},0,{brighter}); brackets are computed at export, from one render"
    )
    if not config.fusion.enabled:
        return Decision({}, "plain scaling", reason)
    unfused: dict[str, object] = {"fusion.enabled": False}
    unfused |= {} if config.loss.hdr_truth and facts.truths else {"loss.linear_weight": 0.0}
    reason = f"{len(config.fusion.exposures)} brackets computed from one base add no light; {reason}"
    return Decision(unfused, "plain scaling", reason)


def _linear_loss(facts: SceneFacts, config: Config, device: torch.device) -> Decision:
    truths = f"{facts.truths} of {facts.photos} photos have HDR truth"
    if config.loss.linear_weight == 0:
        return Decision({}, "none", f"loss.linear_weight = 0; {truths}")
    if config.loss.hdr_truth and facts.truths:
        return Decision({}, "against truth", truths)
    return Decision({"loss.linear_weight": 0.0}, "none", f"{truths}: its own brackets give no training signal")


def _densification(facts: SceneFacts, config: Config, device: torch.device) -> Decision:
    fields: dict[str, object] = {}
    if _is_short_of_time(facts, config, device) and "mcmc.cap_density" not in config.plan.keep:
        fields = {"mcmc.cap_density": CPU_CAP_DENSITY}
    elif (
        device.type == "cuda"
        and facts.photos > MANY_PHOTOS
        and facts.visibility >= LARGE_SCENE * facts.photos  # Each shows a good part of the scene.
        and config.mcmc.cap_density == McmcConfig().cap_density
        and "mcmc.cap_density" not in config.plan.keep
    ):
        fields = {"mcmc.cap_density": GPU_CAP_DENSITY}
    config = override_config(config, fields, "plan")
    options = config.densification
    most, density = mcmc_cap(config, facts.pixels), config.mcmc.cap_density
    reason = f"densification.cap_max = {options.cap_max}"
    if density:
        reason = f"{density:g} times the square root of {facts.pixels} pixels, below {options.cap_max}"
    if options.strategy == "mcmc":
        start = max(facts.points, start_count(config, facts.pixels))
        choice = f"mcmc, growing to at most {most} Gaussians" if start < most else "mcmc without growth"
        return Decision(fields, choice, f"{reason}; {start} to start with")
    # mcmc has this cap itself; adc has none of its own.
    most = min(options.cap_max, max(most, 2 * facts.points))
    reason += f"; {facts.points} points to start from"
    return Decision({"densification.cap_max": most}, f"{most} Gaussians", reason)


def _is_short_of_time(facts: SceneFacts, config: Config, device: torch.device) -> bool:
    """Return whether a CPU lacks time for FEWEST_ITERATIONS of mcmc, unless the user set as many."""
    options, steps = config.densification, config.schedule.iterations
    if device.type != "cpu" or options.strategy != "mcmc" or config.mcmc.cap_density <= CPU_CAP_DENSITY:
        return False
    set_by_user = "schedule.iterations" in config.plan.keep and steps >= FEWEST_ITERATIONS
    return not set_by_user and FEWEST_ITERATIONS * cpu_step_seconds(facts, config) > CPU_SECONDS


def _iterations(facts: SceneFacts, config: Config, device: torch.device) -> Decision:
    preset = config.schedule.iterations
    number = min(preset, math.ceil(max(FEWEST_ITERATIONS, STEPS_PER_PHOTO * facts.photos) / 100) * 100)
    bounds = f"at least {FEWEST_ITERATIONS}, at most {preset}" if preset > FEWEST_ITERATIONS else f"at most {preset}"
    reason = f"{STEPS_PER_PHOTO} steps on each of {facts.photos} photos, {bounds}"
    if device.type == "cpu":
        step, sharp = cpu_step_seconds(facts, config), math.ceil(CPU_STEPS_PER_PHOTO * facts.photos / 100) * 100
        in_a_minute, most = (math.ceil(seconds / step / 100) * 100 for seconds in (CPU_SECONDS, CPU_MOST_SECONDS))
        most = max(CPU_FEWEST, in_a_minute, min(sharp, most))
        if number > most:
            number, seconds = most, most * step
            threads = counted(thread_count(), "thread", "threads")
            reason = f"about {format_duration(seconds)} on a CPU with {threads}; --iterations for more"
            if seconds > 2 * CPU_SECONDS:
                reason += ", --max-size for smaller photos and less time"
        if round(number / facts.photos) < CPU_STEPS_PER_PHOTO:
            each = f"about {number / facts.photos:.1f} steps on each of {facts.photos} photos leave the scene blurred"
            if sharp >= FEWEST_ITERATIONS and config.mcmc.cap_density == CPU_CAP_DENSITY:  # See _is_short_of_time().
                step = cpu_step_seconds(facts, override_config(config, {"mcmc.cap_density": McmcConfig().cap_density}))
            reason += f"; {each}: --iterations {sharp} takes about {format_duration(sharp * step)}"
    return Decision({"schedule.iterations": number}, f"{number}", reason)


def _rates(facts: SceneFacts, config: Config, device: torch.device) -> Decision:
    # Adam moves a parameter by about its rate in a step, so fewer steps need higher rates.
    steps = config.schedule.iterations
    if facts.photos > SCALED_RATE_PHOTOS:
        return Decision({}, "as they are", f"more than {SCALED_RATE_PHOTOS} photos")
    scale = round(min(MAX_RATE_SCALE, max(1.0, (RATES_FOR / steps) ** RATE_POWER)), 2)
    usual, harmonics, choices, reasons = OptimizerConfig(), (config.model.sh_degree + 1) ** 2, [], []
    as_usual = {name for name in SCALED_RATES if getattr(config.optimizer, name) == getattr(usual, name)}
    slow = {"harmonics_rest"} & as_usual if facts.photos <= harmonics else set()
    scaled = as_usual - slow if scale > 1 else set()
    rates = {name: float(f"{getattr(usual, name) * scale:.3g}") for name in SCALED_RATES if name in scaled}
    if scaled:
        choices.append(f"{scale:g} times")
        reasons.append(f"learning rates are tuned for {RATES_FOR} steps; this training has {steps}")
    if slow:
        rates["harmonics_rest"] = FEW_PHOTOS_HARMONICS
        choices.append(f"{FEW_PHOTOS_HARMONICS:g} for view-dependent color")
        reasons.append(f"{facts.photos} photos are too few for {harmonics} harmonics of each Gaussian")
    if not rates:
        return Decision({}, "as they are", f"{steps} steps")
    return Decision({f"optimizer.{name}": rate for name, rate in rates.items()}, ", ".join(choices), "; ".join(reasons))


def _dropout(facts: SceneFacts, config: Config, device: torch.device) -> Decision:
    steps, harmonics = config.schedule.iterations, (config.model.sh_degree + 1) ** 2
    reason = f"{facts.photos} photos, {steps / facts.photos:.0f} steps on each"
    few = facts.photos <= harmonics and steps >= DROPOUT_STEPS * facts.photos
    if not few or config.densification.strategy != "mcmc" or config.model.dropout:
        return Decision({}, f"{config.model.dropout:g}", reason)
    return Decision({"model.dropout": FEW_PHOTOS_DROPOUT}, f"up to {FEW_PHOTOS_DROPOUT:.0%} of the Gaussians", reason)


def antialiasing(focal_ratio: float, config: Config) -> Decision:
    """Decide whether opacities are compensated, by the ratio of the photos' focal lengths."""
    reason = f"focal lengths of the photos, in pixels, differ by a factor of {focal_ratio:.1f}"
    if config.model.antialiased or focal_ratio < FOCAL_RATIO:
        return Decision({}, "on" if config.model.antialiased else "off", reason)
    return Decision({"model.antialiased": True}, "on", reason)


def _confidence(facts: SceneFacts, config: Config, device: torch.device) -> Decision:
    unsure = facts.clipped + facts.black
    reason = f"{unsure:.1%} of the pixels are clipped or black, and a point is visible in {facts.visibility:.1f} photos"
    return Decision({}, "low in places" if unsure >= 0.001 or facts.visibility < 4 else "high throughout", reason)


RULES: dict[str, Callable[[SceneFacts, Config, torch.device], Decision]] = {
    "response": _response,
    "light": _light,
    "brackets": _brackets,
    "linear-loss": _linear_loss,
    "densification": _densification,
    "iterations": _iterations,
    "rates": _rates,
    "dropout": _dropout,
    "antialiasing": lambda facts, config, device: antialiasing(facts.focal_ratio, config),
    "confidence": _confidence,
}
"""The rules of a plan, in order."""


def cpu_step_seconds(facts: SceneFacts, config: Config) -> float:
    """Return the approximate mean duration of a step on this machine's CPU."""
    count = max(facts.points, start_count(config, facts.pixels), mcmc_cap(config, facts.pixels))
    return cpu_seconds(facts.pixels / facts.photos, min(count, config.densification.cap_max), thread_count())
