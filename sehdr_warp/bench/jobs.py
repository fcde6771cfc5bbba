"""The jobs of `bench quality`: every combination of methods with scenes and exposures, each with its folder and key."""

import hashlib
import json
import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from ..errors import InputError, SehdrError
from ..response import response_by_name
from ..scene import embedded_folder, is_embedded
from ..training.config import REFERENCE_ITERATIONS, Config
from ..training.config_files import config_to_dict, load_config, override_config, preset_names

LOG = logging.getLogger(__name__)
FORMAT = 3  # Of a job and of its result; others are run again.
RESULT, FAILURE = "result.json", "failure.json"
TESTS, FIRST_TEST = 16, 100
"""A training tests its held-out views this often, at iterations spaced evenly on a log scale from 1/100 of all."""
EXPOSURES, FACTOR = 5, 4.0
"""A scene's ladder: so many exposures, each so many times longer than the last, around a well exposed one."""
KNOWN, BLIND, LEARNED = "known", "blind", "learned"
"""Whether a method is told the curve, chooses one, or learns it: then known and blind are one training."""
UPPER_BOUND = "truth"
"""3DGS trained on the HDR truth, which every method is compared with."""
WITH_TRUTH = ("truth", "paper-truth", "hdr-gs-truth")
"""Presets that see the HDR truth of the training views; no other method does."""


@dataclass(frozen=True)
class Job:
    """One training and its evaluation.

    config: everything that decides the result, plain values; its hash is the key. place: where the scene is, which is
    no part of the key, since folders move.
    """

    config: dict
    place: str

    @property
    def key(self) -> str:
        text = json.dumps(self.config, sort_keys=True, ensure_ascii=False)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def label(self) -> str:
        """The job in words."""
        config = self.config
        where = f"{config['scene']['name']} {config['curve']} exposure {config['exposure']}"
        return f"{where} {config['method']} {config['response']} seed {config['seed']}"

    def folder(self, out: Path) -> Path:
        return out / "jobs" / f"{re.sub(r'[^A-Za-z0-9.]+', '-', self.label)[:100].strip('-')}-{self.key}"

    def result(self, out: Path) -> dict | None:
        """The complete result; None where there is none, or one that was cut short or is another config's."""
        found = read_json(self.folder(out) / RESULT)
        whole = isinstance(found, dict) and "figures" in found
        return found if whole and (found.get("format"), found.get("key")) == (FORMAT, self.key) else None


def plan_jobs(
    scenes: Sequence[str],
    methods: Sequence[str],
    *,
    curves: Sequence[str] = ("hdr-nerf",),
    exposures: Sequence[int] = (2,),
    responses: Sequence[str] = (KNOWN,),
    seeds: Sequence[int] = (0,),
    iterations: int | None = None,
    max_size: int | None = None,
    device: str = "cpu",
    lpips: bool = False,
) -> list[Job]:
    """Every combination. Methods that learn the response have one job for known and blind together; those that take
    nothing from photos have none that is blind.

    scenes: folders with HDR truth, or names that load_scene knows. methods: presets, or TOML files. curves: responses
    that expose the truth. exposures: places in the ladder. iterations: None is the preset's own, or its plan's. device:
    kind, "cpu" or "cuda". lpips: whether it is judged.

    Raises SehdrError for a preset, field, curve or folder that cannot be used, before anything runs.
    """
    for item in set(exposures) - set(range(EXPOSURES)):
        raise SehdrError(f"exposure {item} is not one of 0 to {EXPOSURES - 1}")
    for item in set(responses) - {KNOWN, BLIND}:
        raise SehdrError(f"response {item!r} is not one of {KNOWN}, {BLIND}")
    for note in (note for curve in curves for note in response_by_name(curve).notes):
        LOG.info("%s", note)
    found = {place: {"name": _scene_name(place), "sha256": _digest(place)} for place in dict.fromkeys(scenes)}
    for what, names, file in (
        ("scenes", [scene["name"] for scene in found.values()], "folder"),
        ("methods", [Path(method).stem for method in methods], "TOML file"),
    ):
        if len(set(names)) < len(names):
            raise SehdrError(f"two {what} have one name; rename a {file} so that tables can tell them apart")
    jobs = []
    for method, seed, place, curve, exposure, response in product(
        methods, *(dict.fromkeys(items) for items in (seeds, scenes, curves, exposures, responses))
    ):
        config = _training(method, iterations, seed)
        if config.response.name == LEARNED:
            if response != responses[0]:
                continue
            response = LEARNED
        elif config.loss.ldr_weight == 0 and response == BLIND:
            continue
        named = {KNOWN: curve, BLIND: "auto"}.get(response, config.response.name)
        trained = override_config(config, {"response.name": named}, method)
        decided = {
            "format": FORMAT,
            "scene": found[place] | {"max_size": max_size},
            "curve": curve,
            "curve_sha256": _digest(curve) if Path(curve).is_file() else None,
            "exposure": exposure,
            "method": Path(method).stem,
            "sees_truth": method in WITH_TRUTH,
            "response": response,
            "seed": seed,
            "device": device,
            "lpips": lpips,
            "training": json.loads(json.dumps(config_to_dict(trained))),
        }
        jobs.append(Job(decided, place if is_embedded(place) else str(Path(place).absolute())))
    if not jobs:
        raise SehdrError(
            f"there is nothing to train: choose methods from {', '.join(preset_names())}; those that take nothing from "
            "photos need known in --responses"
        )
    return jobs


def _training(method: str, iterations: int | None, seed: int) -> Config:
    """The method's training, tested on a log scale of its length; what is stated is no plan's to change."""
    stated = {} if iterations is None else {"schedule.iterations": iterations}
    steps = {max(1, round(REFERENCE_ITERATIONS * FIRST_TEST ** (-k / (TESTS - 1)))) for k in range(TESTS)}
    config = load_config(method, {"seed": seed, **stated})
    times = {"schedule.evaluate_at": sorted(steps), "schedule.checkpoint_every": REFERENCE_ITERATIONS}
    return override_config(config, times | {"plan.keep": sorted({*config.plan.keep, *stated, "response.name"})}, method)


def read_json(path: Path):
    """What a JSON file holds; None where it is missing or damaged."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None


def _scene_name(place: str) -> str:
    return place.removeprefix("embedded:") if is_embedded(place) else Path(place).resolve().name


def _digest(place: str) -> str:
    """A hash of a file, or of all files of a folder or embedded scene with their names."""
    folder = embedded_folder(place) if is_embedded(place) else Path(place)
    if not folder.exists():
        raise InputError(place, "no such folder", "give folders with HDR truth, or embedded")
    digest = hashlib.sha256()
    for path in sorted(path for path in [folder, *folder.rglob("*")] if path.is_file()):
        digest.update(str(path.relative_to(folder)).encode() + b"\0")
        with open(path, "rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()
