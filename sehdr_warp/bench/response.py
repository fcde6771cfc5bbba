"""How well a camera's response is found from photos alone: on rendered truth through known curves, on real stacks."""

import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from ..errors import SehdrError
from ..evaluation.metrics import decibels, mu_law
from ..evaluation.protocols import fit_scale
from ..response import Response, response_by_name
from ..response.selection import ResponseScore, edge_facts, select_response
from ..scene import Scene, load_scene
from ..scene.exposure import made_by_camera
from ..synth.expose import expose, exposure_ladder
from .exposure_stack import read_stack, stack_curve
from .report import new_report

CODES = np.arange(10, 246)
FIXED = ("srgb", "camera")
CURVES = ("hdr-nerf", "srgb", "gamma-2.2", "rec709", "filmic", "aces", "camera")
"""Curves that expose rendered truth where none are named."""
GOOD = 0.35
"""Stops: a chosen curve within them counts as good."""


def curve_stops(response: Response) -> np.ndarray:
    """[236] log2 of the exposures of the codes 10 to 245."""
    return np.log2(response.decode(CODES / 255.0))


def response_error(response: Response, truth: Response | np.ndarray) -> float:
    """RMS over codes 10 to 245 of log2(decoded exposure / true one), best scale removed, stops.

    truth: a response, or [236] log2 of its exposures of those codes.
    """
    difference = curve_stops(response) - (truth if isinstance(truth, np.ndarray) else curve_stops(truth))
    return float(np.sqrt(np.square(difference - difference.mean()).mean()))


def bench_response(
    data: Sequence[str],
    curves: Sequence[str],
    *,
    exposures: int = 5,
    factor: float = 4.0,
    single: bool = False,
    max_size: int | None = None,
    seed: int = 0,
    progress: Callable[[str], None],
) -> dict:
    """A report: for each data set, true curve and method the error of the chosen curve over exposures or photos.

    data: folders of exposure stacks (with exposures.json: each photo is judged alone), and scenes with HDR truth, which
        `curves` expose at a ladder of `exposures` times `factor` apart.
    single: judge a scene by its first training photo instead of all of them.
    Columns of scenes also give the PSNR (mu-law, over the truth's maximum, dB) of the photos decoded by the chosen
    curve: as they are (gt-max) and scaled (aligned), beside that of the true curve. No 3D is involved.
    Raises SehdrError for a scene without truth and for data that cannot be read.
    """
    report = new_report(
        "response",
        torch.device("cpu"),
        {"data": list(data), "curves": list(curves), "exposures": exposures, "factor": factor, "single": single},
    )
    truths = {name: response_by_name(name) for name in curves}
    for truth in truths.values():
        for note in truth.notes:
            progress(note)
    trials = []
    for place in data:
        if (Path(place) / "exposures.json").is_file():
            trials += _stack_trials(Path(place), seed)
        else:
            scene = load_scene(place, max_size=max_size, response="srgb")
            for name, truth in truths.items():
                trials += _scene_trials(scene, name, truth, exposures, factor, single, seed)
                progress(f"{scene.name}: exposed by {name}")
    report["trials"] = trials
    report["rows"] = _summaries(trials)
    report["notes"].append(
        "Error in stops: RMS over codes 10 to 245 of log2 of decoded over true exposure, after one scale. "
        "srgb and camera are taken always, without a look at the photos."
    )
    return report


def _stack_trials(folder: Path, seed: int) -> list[dict]:
    files, images, times = read_stack(folder)
    truth = stack_curve(images, times)[CODES]
    trials = []
    for file, image in zip(files, images, strict=True):
        for method, response in _choices([image], made_by_camera([file]), seed):
            trials.append(_trial("stack", folder.name, "measured", file.name, method, response, truth))
    return trials


def _scene_trials(scene: Scene, name: str, truth: Response, count: int, factor: float, single: bool, seed: int):
    trials = []
    for index, time in enumerate(exposure_ladder(scene, truth, count, factor)):
        views = expose(scene, truth, time).train_views[: 1 if single else None]
        images = [view.codes for view in views]
        known = _decoded_psnr(views, truth, time)
        # A rendered photo is not a camera's file, whatever the data came as.
        for method, response in _choices(images, False, seed):
            trial = _trial("scene", scene.name, name, f"{index}", method, response, curve_stops(truth))
            for key, value, best in zip(
                ("gt_max", "aligned"), _decoded_psnr(views, response, time), known, strict=True
            ):
                trial |= {f"{key}_db": value, f"{key}_known_db": best}
            trials.append(trial)
    return trials


def _choices(images, from_camera: bool, seed: int):
    for name in FIXED:
        yield f"always {name}", response_by_name(name)
    # Photos that are black or white all over say nothing: only what is taken always is judged on them.
    with contextlib.suppress(SehdrError):
        selection = select_response(images, method="posterior", from_camera=from_camera, seed=seed)
        scores, edge_count = selection.scores, selection.edge_count
        yield "posterior", selection.response
        yield "posterior, formulae only", scores[0].response
        for part in ("edges", "density", "highlights", "span", "prior"):
            without = min(scores, key=lambda score, part=part: score.posterior - _weighted(score, part, edge_count))
            yield f"posterior without {part}", without.response
        paper = max(scores, key=lambda score: score.paper_score).response
        yield "paper", paper
        # Without edges, select_response falls back as this does.
        yield "edges", paper if np.isnan(scores[0].edges) else min(scores, key=lambda score: score.edges).response


def _weighted(score: ResponseScore, part: str, edge_count: int) -> float:
    """What a part adds to the posterior."""
    if part == "edges":
        return 0.0 if np.isnan(score.edges) else score.edges * edge_facts(edge_count)
    return getattr(score, part)


def _trial(stage: str, data: str, truth: str, photo: str, method: str, response: Response, stops: np.ndarray) -> dict:
    return {
        "stage": stage,
        "data": data,
        "truth": truth,
        "photo": photo,
        "method": method,
        "chosen": response.name,
        "error": response_error(response, stops),
    }


def _decoded_psnr(views, response: Response, time: float) -> tuple[float, float]:
    """PSNR in dB of the photos' decoded radiance, gt-max and aligned."""
    truths = [torch.from_numpy(view.hdr).double() for view in views]
    decoded = [torch.from_numpy(np.asarray(response.decode(view.image.astype(np.float64)) / time)) for view in views]
    photos = [torch.from_numpy(view.image) for view in views]
    scale = fit_scale((a, b, None, photo) for a, b, photo in zip(decoded, truths, photos, strict=True)) or 1.0
    largest = max(float(truth.max()) for truth in truths)
    result = []
    for factor in (1.0, scale):
        errors = [
            float((mu_law((a * factor / largest).clamp(0, 1)) - mu_law(b / largest)).square().mean())
            for a, b in zip(decoded, truths, strict=True)
        ]
        result.append(decibels(float(np.mean(errors))))
    return tuple(result)


def _summaries(trials: list[dict]) -> list[dict]:
    """Per data set, truth and method over photos or exposures; then per method over everything of its kind."""
    groups: dict[tuple, list[dict]] = {}
    for trial in trials:
        stage, method = trial["stage"], trial["method"]
        groups.setdefault((stage, trial["data"], trial["truth"], method), []).append(trial)
    for trial in trials:
        groups.setdefault((f"{trial['stage']}s", "all", "all", trial["method"]), []).append(trial)
    rows = []
    for (stage, data, truth, method), members in groups.items():
        errors = [member["error"] for member in members]
        names = [member["chosen"] for member in members]
        row = {
            "stage": stage,
            "data": data,
            "truth": truth,
            "method": method,
            "trials": len(members),
            "mean_error": float(np.mean(errors)),
            "worst_error": float(np.max(errors)),
            "good": int(sum(error < GOOD for error in errors)),
            "chosen": ", ".join(f"{name} {names.count(name)}" for name in dict.fromkeys(names)),
        }
        for key in ("gt_max_db", "gt_max_known_db", "aligned_db", "aligned_known_db"):
            if key in members[0]:
                row[key] = float(np.mean([member[key] for member in members]))
        rows.append(row)
    return rows
