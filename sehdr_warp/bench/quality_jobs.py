"""The jobs of `bench quality`: what one is, where it lives, and whether it is done."""

import hashlib
import itertools
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from pathlib import Path

from ..errors import InputError, SehdrError
from ..files import write_json
from ..scene import embedded_folder, is_embedded
from ..training.config import REFERENCE_ITERATIONS, Config
from ..training.config_files import config_to_dict, load_config, override_config
from .methods import Method

FORMAT = 1
"""Version of a job and of its result; others are run again."""
JOB, RESULT, FAILURE, ATTEMPT, LOCK = "job.json", "result.json", "failure.json", "attempt.json", "lock"
TESTS, FIRST_TEST = 16, 100
"""A training tests its held-out views this often, at iterations spaced evenly on a log scale from 1/100 of all."""
RESPONSES = ("known", "blind")
LEARNED = "learned"
"""Of a method that learns the response with the scene: known or blind, it is the same training, and runs once."""


@dataclass(frozen=True)
class Settings:
    """What `bench quality` was asked for; every combination is a job.

    scenes: folders with HDR truth, or names that load_scene knows. curves: responses of response_by_name that expose
    the truth. exposures: places in a ladder of exposure_count times, each exposure_factor times the last.
    responses: out of RESPONSES. iterations: None is the preset's own. noise: (full well, read noise) in electrons.
    predictor: replaces that of methods which predict HDR from single photos; {scene} and {exposure} stand for the
    job's. lpips: whether weights are
    there. device: "cpu" or "cuda".
    """

    scenes: tuple[str, ...]
    methods: tuple[Method, ...]
    curves: tuple[str, ...] = ("hdr-nerf",)
    exposures: tuple[int, ...] = (0, 1, 2, 3, 4)
    responses: tuple[str, ...] = ("known",)
    seeds: tuple[int, ...] = (0,)
    iterations: tuple[int | None, ...] = (None,)
    max_size: int | None = None
    exposure_count: int = 5
    exposure_factor: float = 4.0
    noise: tuple[float, float] | None = None
    predictor: str | None = None
    lpips: bool = False
    flip: bool = False
    device: str = "cpu"

    def __post_init__(self):
        for exposure in self.exposures:
            if not 0 <= exposure < self.exposure_count:
                raise SehdrError(f"exposure {exposure} is not one of 0 to {self.exposure_count - 1}")
        for response in self.responses:
            if response not in RESPONSES:
                raise SehdrError(f"response {response!r} is not one of {', '.join(RESPONSES)}")


@dataclass(frozen=True)
class Job:
    """One training and its evaluation.

    config: everything that decides the result, plain values; its hash is the job's key. name: of the folder, readable,
    with the key at its end. place: where the scene is (not part of the key: folders move).
    """

    config: dict
    place: str

    @property
    def key(self) -> str:
        text = json.dumps(self.config, sort_keys=True, ensure_ascii=False)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def label(self) -> str:
        """The job in words, for progress and errors."""
        config, photo = self.config, self.config["photo"]
        return (
            f"{config['scene']['name']} {photo['curve']} exposure {photo['exposure']} {config['method']['name']} "
            f"{config['response']} seed {config['seed']}"
        )

    @property
    def name(self) -> str:
        return f"{re.sub(r'[^A-Za-z0-9.]+', '-', self.label)[:100].strip('-')}-{self.key}"


def plan_jobs(settings: Settings, *, progress: Callable[[str], None] = lambda line: None) -> list[Job]:
    """Every job of the settings, scene by scene. Blind jobs of methods that cannot be blind are left out; methods that
    learn the response have one job for known and blind together. What was repaired in a curve's file is told.

    Raises InputError or SehdrError for a preset, field, curve or folder that cannot be used, before anything runs.
    """
    from ..response import response_by_name

    scenes = {place: {"name": _scene_name(place), **_digest(place)} for place in dict.fromkeys(settings.scenes)}
    _check_names_differ(scenes)
    for curve in settings.curves:
        for note in response_by_name(curve).notes:
            progress(note)
    configs = {
        (method.name, iterations, seed): _config(method, iterations, seed)
        for method, iterations, seed in itertools.product(settings.methods, settings.iterations, settings.seeds)
    }
    jobs = []
    for place, curve, exposure, seed, iterations, response, method in itertools.product(
        scenes,
        dict.fromkeys(settings.curves),
        dict.fromkeys(settings.exposures),
        dict.fromkeys(settings.seeds),
        dict.fromkeys(settings.iterations),
        dict.fromkeys(settings.responses),
        settings.methods,
    ):
        config = configs[method.name, iterations, seed]
        told = [name for name in settings.responses if name == "known" or method.blind]
        learned = config.response.name == "learned"
        if response not in (told[:1] if learned else told):
            continue
        response = LEARNED if learned else response
        name = curve if response == "known" else "auto"
        changes, files = {} if learned else {"response.name": name}, {}
        if settings.predictor is not None and config.loss.predictor:
            place_of = {"{scene}": scenes[place]["name"], "{exposure}": str(exposure)}
            predictor = reduce(lambda text, item: text.replace(*item), place_of.items(), settings.predictor)
            changes, files = changes | {"loss.predictor": predictor}, {"predictor": _path_digest(predictor)}
        trained = override_config(config, changes, method.preset)
        jobs.append(
            Job(
                {
                    "format": FORMAT,
                    "scene": scenes[place] | {"max_size": settings.max_size},
                    "photo": {
                        "curve": curve,
                        **_file_digest(curve),
                        "exposure": exposure,
                        "count": settings.exposure_count,
                        "factor": settings.exposure_factor,
                        "noise": None if settings.noise is None else list(settings.noise),
                    },
                    "method": {
                        "name": method.name,
                        "truth": method.truth,
                        "base": method.base,
                        "overrides": method.overrides,
                        **files,
                    },
                    "response": response,
                    "seed": seed,
                    "device": settings.device,
                    "lpips": settings.lpips,
                    "flip": settings.flip,
                    "training": json.loads(json.dumps(config_to_dict(trained))),
                },
                place,
            )
        )
    if not jobs:
        raise SehdrError("none of the methods makes sense without the response; add known to --responses")
    return jobs


def _config(method: Method, iterations: int | None, seed: int) -> Config:
    """The method's training, tested on a log scale of its length."""
    overrides = {"seed": seed, "schedule.checkpoints_kept": 1, **method.overrides}
    if iterations is not None:
        overrides["schedule.iterations"] = iterations
    config = load_config(method.preset, overrides)
    if config.plan.enabled:
        # What a variant or --iterations states is no plan's to change.
        stated = [path for path in (*method.overrides, *overrides) if not path.startswith("plan.")]
        config = override_config(config, {"plan.keep": sorted({*config.plan.keep, *stated})}, method.preset)
    steps = (REFERENCE_ITERATIONS * FIRST_TEST ** (-k / (TESTS - 1)) for k in range(TESTS))
    stated = sorted({max(1, round(step)) for step in steps})
    times = {
        "schedule.evaluate_at": stated,
        "schedule.checkpoint_every": max(REFERENCE_ITERATIONS, config.schedule.iterations),
    }
    return override_config(config, times, method.preset)


def write_job(out: Path, job: Job) -> Path:
    """The job's folder, made with job.json in it; job.json of the same key is left as it is, but for the place."""
    folder = out / "jobs" / job.name
    values = {"place": _absolute(job.place), "key": job.key, "config": job.config}
    if _read_json(folder / JOB) != values:
        write_json(folder / JOB, values, overwrite=True)
    return folder


def read_job(folder: Path) -> Job:
    """Raises InputError for a job.json that is missing or damaged."""
    values = _read_json(folder / JOB)
    try:
        job = Job(values["config"], values["place"])
        if job.key != values["key"] or job.config["format"] != FORMAT:
            raise KeyError("key")
    except (TypeError, KeyError):
        raise InputError(
            folder / JOB, "is missing or damaged", "remove this folder and run the benchmark again"
        ) from None
    return job


def read_result(folder: Path) -> dict | None:
    """The job's complete result; None where there is none, or one that was cut short or belongs to another config."""
    result = _read_json(folder / RESULT)
    whole = isinstance(result, dict) and result.get("format") == FORMAT and result.get("complete") is True
    return result if whole and folder.name.endswith(str(result.get("key"))) and "figures" in result else None


def read_failure(folder: Path) -> dict | None:
    """Why the last attempt of a job failed: {"run", "error"}; None if it did not."""
    failure = _read_json(folder / FAILURE)
    return failure if isinstance(failure, dict) and isinstance(failure.get("error"), str) else None


def write_failure(folder: Path, run: str, error: str) -> None:
    write_json(folder / FAILURE, {"run": run, "error": " ".join(error.split())[:1000]}, overwrite=True)


def read_attempt(folder: Path) -> dict | None:
    """Who is at the job, or was when it died: {"run", "worker", "pid"}; None if nobody."""
    attempt = _read_json(folder / ATTEMPT)
    return attempt if isinstance(attempt, dict) else None


def _read_json(path: Path):
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None


def _scene_name(place: str) -> str:
    return place if is_embedded(place) else Path(place).resolve().name


def _absolute(place: str) -> str:
    return place if is_embedded(place) else str(Path(place).absolute())


def _check_names_differ(scenes: dict[str, dict]) -> None:
    names: dict[str, str] = {}
    for place, scene in scenes.items():
        other = names.setdefault(scene["name"], place)
        if other != place:
            raise SehdrError(f"scenes {other} and {place} have one name; rename a folder so that tables can tell them")


def _digest(place: str) -> dict:
    """What tells this scene from others, wherever it lies: a hash of all its files."""
    if is_embedded(place):
        return {"sha256": _path_digest(str(embedded_folder(place)))}
    if not Path(place).is_dir():
        raise InputError(place, "no such folder", "give folders with HDR truth, or embedded")
    return {"sha256": _path_digest(place)}


def _path_digest(place: str) -> str | None:
    """A hash of a file, or of all files of a folder with their names; None where there is neither."""
    folder = Path(place)
    if folder.is_file():
        return hashlib.sha256(folder.read_bytes()).hexdigest()
    if not folder.is_dir():
        return None
    digest = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        digest.update(str(path.relative_to(folder)).encode() + b"\0")
        with open(path, "rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def _file_digest(curve: str) -> dict:
    """A hash of the file that a curve comes from; nothing for a formula."""
    for name in (curve, curve.rpartition(":")[0]):
        if name and Path(name).is_file():
            return {"sha256": _path_digest(name)}
    return {}
