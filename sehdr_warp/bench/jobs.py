"""The jobs of `bench quality`: methods, every combination with scenes and exposures, and each job's folder and key."""

import hashlib
import itertools
import json
import logging
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from ..errors import InputError, SehdrError
from ..files import write_json
from ..scene import embedded_folder, is_embedded
from ..training.config import REFERENCE_ITERATIONS, Config
from ..training.config_files import config_to_dict, load_config, override_config, preset_names, toml_value

LOG = logging.getLogger(__name__)
FORMAT = 2
"""Version of a job and of its result; others are run again."""
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
class Method:
    """What is trained: a preset (a name, or a TOML file), with overrides of dotted fields where it is a variant."""

    name: str
    preset: str
    overrides: dict = field(default_factory=dict)

    @property
    def sees_truth(self) -> bool:
        return self.preset in WITH_TRUTH


def choose_methods(names: Iterable[str], variants: Sequence[str] = ()) -> list[Method]:
    """The methods asked for, then their variants `NAME:BASE:field=value,field=value`, values as in TOML.

    Raises:
        SehdrError: for a name that is none, or comes twice. Fields and values are checked by load_config.
    """
    chosen = [_method(name) for name in names] + [_variant(text) for text in variants]
    if not chosen:
        raise SehdrError(f"no method is asked for; choose from {', '.join(preset_names())}, or give a variant")
    for method in chosen:
        if sum(other.name == method.name for other in chosen) > 1:
            raise SehdrError(f"method {method.name} is asked for twice; give each variant a name of its own")
    return chosen


def _method(name: str) -> Method:
    if name in preset_names():
        return Method(name, name)
    if name.endswith(".toml") and Path(name).is_file():
        return Method(Path(name).stem, str(Path(name).absolute()))
    raise SehdrError(f"method {name!r} is unknown; choose from {', '.join(preset_names())}, or give a TOML file")


def _variant(text: str) -> Method:
    name, _, rest = text.partition(":")
    base, _, settings = rest.partition(":")
    # Values may hold commas (lists): a new field starts where a name and an equals sign follow.
    items = [item.partition("=") for item in re.split(r",(?=\s*[A-Za-z_][\w.]*\s*=)", settings) if item.strip()]
    if not name or not base or not items or not all(equals for _, equals, _ in items):
        raise SehdrError(f"--variant {text}: not NAME:BASE:field=value,...; write no-clip:default:loss.clipping=false")
    overrides = {key.strip(): toml_value(value.strip()) for key, _, value in items}
    return replace(_method(base), name=name, overrides=overrides)


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
        return (
            f"{config['scene']['name']} {config['curve']} exposure {config['exposure']} {config['method']} "
            f"{config['response']} seed {config['seed']}"
        )

    def folder(self, out: Path) -> Path:
        """Readable, with the key at its end."""
        return out / "jobs" / f"{re.sub(r'[^A-Za-z0-9.]+', '-', self.label)[:100].strip('-')}-{self.key}"


def plan_jobs(
    scenes: Sequence[str],
    methods: Sequence[Method],
    *,
    curves: Sequence[str] = ("hdr-nerf",),
    exposures: Sequence[int] = (2,),
    responses: Sequence[str] = (KNOWN,),
    seeds: Sequence[int] = (0,),
    iterations: int | None = None,
    max_size: int | None = None,
    device: str = "cpu",
    judged_by: Sequence[str] = (),
) -> list[Job]:
    """Every combination. Methods that learn the response have one job for known and blind together; those that take
    nothing from photos have none that is blind.

    Args:
        scenes: folders with HDR truth, or names that load_scene knows. curves: responses that expose the truth.
        exposures: places in the ladder. iterations: None is the preset's own, or its plan's.
        device: kind, "cpu" or "cuda". judged_by: further measures, `lpips` and `flip`.

    Raises:
        InputError, SehdrError: for a preset, field, curve or folder that cannot be used, before anything runs.
    """
    from ..response import response_by_name

    for exposure in exposures:
        if not 0 <= exposure < EXPOSURES:
            raise SehdrError(f"exposure {exposure} is not one of 0 to {EXPOSURES - 1}")
    for response in responses:
        if response not in (KNOWN, BLIND):
            raise SehdrError(f"response {response!r} is not one of {KNOWN}, {BLIND}")
    for note in itertools.chain.from_iterable(response_by_name(curve).notes for curve in curves):
        LOG.info("%s", note)
    found = {place: {"name": _scene_name(place), "sha256": _digest(place)} for place in dict.fromkeys(scenes)}
    if len({scene["name"] for scene in found.values()}) < len(found):
        raise SehdrError("two scenes have one name; rename a folder so that tables can tell them apart")
    jobs = []
    for method, seed, place, curve, exposure, response in itertools.product(
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
        trained = override_config(config, {"response.name": named}, method.preset)
        decided = {
            "format": FORMAT,
            "scene": found[place] | {"max_size": max_size},
            "curve": curve,
            "curve_sha256": _digest(curve) if Path(curve).is_file() else None,
            "exposure": exposure,
            "method": method.name,
            "preset": method.preset,
            "overrides": method.overrides,
            "sees_truth": method.sees_truth,
            "response": response,
            "seed": seed,
            "device": device,
            "judged_by": sorted(judged_by),
            "training": json.loads(json.dumps(config_to_dict(trained))),
        }
        jobs.append(Job(decided, place if is_embedded(place) else str(Path(place).absolute())))
    if not jobs:
        raise SehdrError("none of the methods makes sense without the response; add known to --responses")
    return jobs


def _training(method: Method, iterations: int | None, seed: int) -> Config:
    """The method's training, tested on a log scale of its length; what is stated is no plan's to change."""
    stated = method.overrides | ({} if iterations is None else {"schedule.iterations": iterations})
    steps = {max(1, round(REFERENCE_ITERATIONS * FIRST_TEST ** (-k / (TESTS - 1)))) for k in range(TESTS)}
    config = load_config(method.preset, {"seed": seed, **stated})
    times = {"schedule.evaluate_at": sorted(steps), "schedule.checkpoint_every": REFERENCE_ITERATIONS}
    keep = sorted({*config.plan.keep, *stated, "response.name"})
    return override_config(config, times | {"plan.keep": keep}, method.preset)


def read_result(folder: Path) -> dict | None:
    """The job's complete result; None where there is none, or one that was cut short or is another config's."""
    result = _read_json(folder / RESULT)
    whole = isinstance(result, dict) and result.get("format") == FORMAT and "figures" in result
    return result if whole and folder.name.endswith(str(result.get("key"))) else None


def read_failure(folder: Path) -> dict | None:
    """Why the last attempt of a job failed: {"run", "error"}; None if it did not."""
    failure = _read_json(folder / FAILURE)
    return failure if isinstance(failure, dict) and isinstance(failure.get("error"), str) else None


def write_failure(folder: Path, run: str, error: str) -> None:
    write_json(folder / FAILURE, {"run": run, "error": " ".join(error.split())[:1000]}, overwrite=True)


def _read_json(path: Path):
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None


def _scene_name(place: str) -> str:
    return place.removeprefix("embedded:") if is_embedded(place) else Path(place).resolve().name


def _digest(place: str) -> str:
    """A hash of a file, or of all files of a folder or embedded scene with their names."""
    folder = embedded_folder(place) if is_embedded(place) else Path(place)
    if folder.is_file():
        return hashlib.sha256(folder.read_bytes()).hexdigest()
    if not folder.is_dir():
        raise InputError(place, "no such folder", "give folders with HDR truth, or embedded")
    digest = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        digest.update(str(path.relative_to(folder)).encode() + b"\0")
        with open(path, "rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()
