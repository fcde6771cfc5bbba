"""Scenes that no plan makes sense for, and values that a scene contradicts: one line why, and what to try."""

import json
from collections.abc import Collection

from ..errors import InputError
from ..field.exposure import exposure_times, is_seconds
from ..scene import Scene
from .config import Config
from .initialization import base_exposure_time
from .plan_scene import SceneFacts

FEWEST_PHOTOS = 3
LEAST_OVERLAP = 0.02
"""Part of the places that must be in two photos' fields of view."""
LEAST_CONTRAST = 1 / 255
REACH = 2.0**16
"""Brackets farther from the photos' exposure than this are black or white in all pixels of 8 bits and some headroom."""


def check_scene(scene: Scene, facts: SceneFacts) -> None:
    """Raises InputError for a scene that no training can make sense of."""
    if facts.photos < FEWEST_PHOTOS:
        raise InputError(
            scene.name,
            f"{facts.photos} training photos: depth and light cannot be told apart from so few",
            f"take {FEWEST_PHOTOS} or more photos from different places, better 20; without a plan it trains anyway",
        )
    if facts.contrast < LEAST_CONTRAST:
        raise InputError(
            scene.name,
            f"all photos show a single colour (standard deviation {255 * facts.contrast:.2f} of 255): nothing to match",
            "check that the files are the photos, and their exposure",
        )
    if facts.overlap < LEAST_OVERLAP:
        raise InputError(
            scene.name,
            f"the photos share no view: {facts.overlap:.1%} of the places that one shows are in the field of view of "
            "another",
            "check the poses and the axes' convention, or take photos that overlap by a half",
        )


def check_fields(scene: Scene, facts: SceneFacts, config: Config, given: Collection[str]) -> None:
    """Raises InputError, with both values, for fields that the user gave and the scene contradicts. given: names."""

    def refuse(path: str, value, problem: str, remedy: str) -> None:
        raise InputError(scene.name, f"{path} = {json.dumps(value)}, but {problem}", remedy)

    if "fusion.exposures" in given:
        _check_exposures(scene, config, refuse)
    if {"loss.hdr_truth", "loss.linear_weight", "loss.hdr_weight"} & set(given) and not facts.truths:
        none = f"0 of {facts.photos} training photos have HDR truth"
        remedy = "take a scene with HDR truth, leave the field out, or use --predict-hdr"
        predicted = bool(config.loss.predictor)
        if config.loss.hdr_truth and not predicted:
            refuse("loss.hdr_truth", True, none, remedy)
        if config.loss.hdr_weight > 0 and not predicted:
            refuse("loss.hdr_weight", config.loss.hdr_weight, none, remedy)
    budget = config.densification.max_gaussians
    if "densification.max_gaussians" in given and budget < facts.points:
        refuse(
            "densification.max_gaussians",
            budget,
            f"the scene starts from {facts.points} points",
            f"use {facts.points} or more, or leave the field out",
        )


def _check_exposures(scene: Scene, config: Config, refuse) -> None:
    exposures, base = list(config.fusion.exposures), base_exposure_time(scene)
    timed = [item for item in exposures if is_seconds(item)]
    if timed and not scene.exposure_times_known:
        refuse(
            "fusion.exposures",
            exposures,
            f"{timed[0]} is a time and the photos state none",
            "write multiples of the photos' exposure (1/8x) or stops from it (-3ev)",
        )
    for time in exposure_times(base, exposures):
        if not 1 / REACH <= time / base <= REACH:
            refuse(
                "fusion.exposures",
                exposures,
                f"{time:.3g} s is {time / base:.3g} times the photos' {base:.3g} s",
                f"stay within 1/{REACH:.0f} and {REACH:.0f} times",
            )
