"""The rules of a plan: one function a decision, from the scene's figures and the config to fields and a reason."""

import math
from collections.abc import Callable
from dataclasses import dataclass

from .config import Config
from .plan_scene import SceneFacts
from .relocation import gaussian_budget

PASSES = 900
"""Steps on each photo. A second look at the same photos teaches less and less, and in the end their noise."""
FEWEST_ITERATIONS = 3000


@dataclass(frozen=True)
class Decision:
    """name: of RULES. fields: dotted names of the config and their values. choice: in words; reason: with
    the figures it rests on."""

    name: str
    fields: dict[str, object]
    choice: str
    reason: str


def _response(facts: SceneFacts, config: Config) -> Decision:
    if config.response.name == "learned":
        return Decision("response", {}, "learned", "response.name = learned: one with the scene, nothing to search")
    if config.response.name != "auto":
        return Decision("response", {}, "no search", f"{config.response.name} was named")
    made = "a camera made the files" if facts.from_camera else "nothing says what made the files"
    return Decision(
        "response", {}, "search", f"no curve was named, and {made}: it is chosen from {facts.photos} photos"
    )


def _brackets(facts: SceneFacts, config: Config) -> Decision:
    darker, brighter = (2 if facts.clipped < 0.001 else 4), (2 if facts.black < 0.001 else 4)
    reason = (
        f"{facts.clipped:.1%} of the pixels clip, {facts.black:.1%} are black: look at -{darker} to +{brighter} EV "
        f"(render --evs=-{darker},0,{brighter}); all are scalings of one render, made at export"
    )
    if not config.fusion.enabled:
        return Decision("brackets", {}, "plain scaling", reason)
    fields: dict[str, object] = {"fusion.enabled": False}
    if config.loss.linear_weight > 0 and not (config.loss.hdr_truth and (facts.truths or config.loss.predictor)):
        fields["loss.linear_weight"] = 0.0
    count = len(config.fusion.exposures)
    return Decision(
        "brackets", fields, "plain scaling", f"{count} brackets of one base hold no light of their own; {reason}"
    )


def _linear_loss(facts: SceneFacts, config: Config) -> Decision:
    if config.loss.linear_weight == 0:
        return Decision("linear-loss", {}, "none", f"loss.linear_weight = 0; {facts.truths} photos have HDR truth")
    if config.loss.hdr_truth and (facts.truths or config.loss.predictor):
        return Decision("linear-loss", {}, "against truth", f"{facts.truths} of {facts.photos} photos have HDR truth")
    return Decision(
        "linear-loss",
        {"loss.linear_weight": 0.0},
        "none",
        f"{facts.truths} of {facts.photos} photos have HDR truth: against its own brackets a base learns nothing",
    )


def _densification(facts: SceneFacts, config: Config) -> Decision:
    options = config.densification
    most = gaussian_budget(options, facts.pixels)
    reason = f"densification.max_gaussians = {options.max_gaussians}"
    if options.budget:
        reason = f"{options.budget:g} times the square root of {facts.pixels} pixels, below {options.max_gaussians}"
    if options.strategy == "relocation":
        start = facts.points or config.model.initial_count
        choice = f"relocation grows to at most {most}" if start < most else "relocation without growth"
        return Decision("densification", {}, choice, f"{reason}; {start} to start with")
    # Relocation has this budget by itself; densification by gradients stops nowhere.
    most = min(options.max_gaussians, max(most, 2 * facts.points))
    fields = {"densification.max_gaussians": most}
    if config.model.initial_count > most // 2 and not facts.points:
        fields["model.initial_count"] = max(100, most // 2)
    return Decision("densification", fields, f"{most} Gaussians", f"{reason}; {facts.points} points to start from")


def _iterations(facts: SceneFacts, config: Config) -> Decision:
    wanted = max(FEWEST_ITERATIONS, PASSES * facts.photos)
    count = min(config.schedule.iterations, math.ceil(wanted / 100) * 100)
    return Decision(
        "iterations",
        {"schedule.iterations": count},
        f"{count}",
        f"{PASSES} steps on each of {facts.photos} photos, no fewer than {FEWEST_ITERATIONS}, no more than the "
        f"preset's {config.schedule.iterations}",
    )


def _confidence(facts: SceneFacts, config: Config) -> Decision:
    unsure = facts.clipped + facts.black
    return Decision(
        "confidence",
        {},
        "worth a look" if unsure >= 0.001 or facts.seen < 4 else "high throughout",
        f"{unsure:.1%} of the pixels state a bound alone, and a place is seen by {facts.seen:.1f} photos",
    )


RULES: dict[str, Callable[[SceneFacts, Config], Decision]] = {
    "response": _response,
    "brackets": _brackets,
    "linear-loss": _linear_loss,
    "densification": _densification,
    "iterations": _iterations,
    "confidence": _confidence,
}
"""What a plan decides, in this order."""
