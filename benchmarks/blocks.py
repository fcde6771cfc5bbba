"""A synthetic survey trained whole and in blocks: quality, errors at borders, memory, blocks at once, many copies.

python -m benchmarks.blocks OUT --json blocks.json

benchmarks.survey makes the photos. Blocks train as many steps on each photo as the whole does. With three GPUs the
whole trains on the third, beside blocks that are not timed; with fewer it trains after all blocks. Copies of the merged
run are rendered from the disk and shown by `sehdr-warp view`. Each row is also a line of OUT/rows.jsonl as soon as it
is known.
"""

import json
import logging
import multiprocessing
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any
from unittest.mock import patch
from urllib.request import Request, urlopen

import torch
import tyro

from sehdr_warp.blocks.block_plan import Block, BlockPlan, make_block_plan
from sehdr_warp.blocks.job import FOLDER
from sehdr_warp.blocks.jobs import run_blocks, visible_gpus
from sehdr_warp.blocks.merge import merge_blocks
from sehdr_warp.blocks.seams import measure_seams
from sehdr_warp.files import write_json
from sehdr_warp.model.gaussians import PARAMETER_NAMES
from sehdr_warp.process import calm_threads
from sehdr_warp.runs.config import Config
from sehdr_warp.runs.config_files import config_from_dict, load_config, override_config
from sehdr_warp.runs.open import load_scene_and_log_notes
from sehdr_warp.runs.run import Run, load_run
from sehdr_warp.runs.run_writer import RunWriter
from sehdr_warp.runs.values import LoadArguments
from sehdr_warp.scene import Camera, View
from sehdr_warp.training.train import create_trainer

from .results import new_result
from .study import run
from .survey import write_survey
from .timing import forget_peaks

AT_ONCE = 2  # Blocks that train at once
WARM_UP = 100  # Steps of a training before the first that is timed; it has refinements, whose kernels are compiled
FRAMES = 20
SIZE = 1920, 1080  # Pixels of the pictures of copies
DRAFT = 480, 270  # Pixels of the viewer's pictures while the camera moves
COPY_SECONDS, VIEW_SECONDS = 30.0, 22.0  # Time that each of both parts needs; without it the part is left out


@dataclass(frozen=True)
class Study:
    """Options of the study, and what it has found."""

    out: tyro.conf.Positional[Path]
    """New folder for the photos, the runs and rows.jsonl."""
    views: int = 400
    """Photos, of which one in eight is held out."""
    size: int = 560
    """Their width in pixels."""
    gaussians: int = 2_300_000
    """Most Gaussians of the whole, and of all blocks together."""
    steps: int = 8700
    """Steps of the whole training."""
    count: int = 4
    """Blocks."""
    copies: int = 20_000_000
    """Gaussians of the copies of the merged run."""
    device_name: Annotated[str, tyro.conf.arg(name="device")] = "cuda:0" if torch.cuda.is_available() else "cpu"
    """cpu or cuda:N; the GPUs that follow it are used, too."""
    seconds: float = 1e9
    """Time for the study; what does not fit into it is left out."""
    json: Annotated[Path | None, tyro.conf.arg(help_behavior_hint="")] = None
    """Result, which is written even if a part of the study fails."""
    began: tyro.conf.Suppress[float] = field(default_factory=time.monotonic)
    """Start of the study, monotonic seconds."""
    rows: tyro.conf.Suppress[list[dict[str, Any]]] = field(default_factory=list)
    """Results of the study."""

    @property
    def device(self) -> torch.device:
        """The first device."""
        return torch.device(self.device_name)

    def add(self, what: str, **values: Any) -> None:
        """Add a row, and write it."""
        row = {"what": what, **values}
        self.rows.append(row)
        with open(self.out / "rows.jsonl", "a") as file:
            file.write(json.dumps({"at": round(time.monotonic() - self.began, 1), **row}) + "\n")
        print(row, flush=True)

    @property
    def left(self) -> float:
        """Seconds that are left."""
        return self.seconds - (time.monotonic() - self.began)

    def seconds_left(self, but: float) -> float:
        """Return the seconds to wait for a process if `but` seconds are to be left; at least 1, at most a day."""
        return min(max(1.0, self.left - but), 86_400.0)

    @property
    def devices(self) -> list[torch.device]:
        """Devices from the first on: of the blocks that train at once, and of the whole."""
        if self.device.type == "cpu":
            return [self.device] * AT_ONCE
        first = self.device.index or 0
        return [torch.device("cuda", index) for index in range(first, min(torch.cuda.device_count(), first + 3))]


class _Spans(logging.Handler):
    """Note when the training of each block begins and ends, monotonic seconds."""

    def __init__(self, first_done: Callable[[], None] | None) -> None:
        """Begin with none; call `first_done` once the first AT_ONCE blocks have ended."""
        super().__init__()
        self.first_done = first_done
        self.begin: dict[str, float] = {}
        self.end: dict[str, float] = {}

    def emit(self, record: logging.LogRecord) -> None:
        """Note the time of a message of run_blocks()."""
        name, _, message = record.getMessage().partition(": ")
        if message.startswith("training begins"):
            self.begin[name] = time.monotonic()
        elif message.startswith("finished"):
            self.end[name] = time.monotonic()
            if self.first_done is not None and len(self.end) == AT_ONCE:
                self.first_done()


def run_study(study: Study) -> None:
    """Train the survey in both ways, and add what is found."""
    survey = study.out / "survey"
    write_survey(survey, study.views, study.size, study.gaussians * 13 // 10, study.device_name)
    data: LoadArguments = {"path": str(survey.absolute()), "exposure_index": None, "max_size": None, "holdout": None}
    config = _config(study)
    plan = make_block_plan(data, config, study.device, study.count)
    assert plan is not None
    fraction = sum(block.fraction for block in plan.blocks) / study.count
    plan = replace(plan, config=override_config(plan.config, {"schedule.iterations": round(study.steps * fraction)}))
    devices = study.devices
    at_once = min(AT_ONCE, len(devices))
    _warm_up(study, plan, at_once)
    arguments = data, config.model_dump(), study.out / "whole", devices[-1].type
    whole = multiprocessing.get_context("spawn").Process(target=_train_whole, args=arguments, daemon=True)

    def start_whole() -> None:
        # The process sees one GPU alone, as the job of a block does.
        visible = {"CUDA_VISIBLE_DEVICES": visible_gpus(devices[-1], 1)[0]} if devices[-1].type == "cuda" else {}
        with patch.dict(os.environ, visible):
            whole.start()

    # The two longest blocks train first, beside each other and without the whole, which would make them slower.
    pair = sorted(plan.blocks, key=lambda block: -block.fraction)[:AT_ONCE]
    spans = _train_blocks(study, plan, "at_once", at_once, start_whole if len(devices) > AT_ONCE else None)
    both = max(spans[block.name][1] for block in pair)
    forget_peaks(study.device)
    began = time.monotonic()
    merge_blocks(study.out / "at_once", plan, study.device)
    seconds = time.monotonic() - began
    memory = torch.cuda.max_memory_allocated(study.device) if study.device.type == "cuda" else None
    study.add("merging and refining borders", seconds=seconds, peak_memory_bytes=memory)
    run = load_run(study.out / "at_once", device=study.device)
    held_out = [entry.name for entry in run.cameras if entry.split == "test"]
    views = load_scene_and_log_notes({**data, "views": held_out}, response="srgb").views
    figures = {"gaussians": run.gaussian_count, "seconds": max(end for _, end in spans.values())}
    peak = max(row["peak_memory_bytes"] or 0 for row in study.rows)
    errors = measure_seams(run, views, plan.division)
    study.add(f"{study.count} blocks, {at_once} at once, merged", **figures, peak_memory_bytes=peak, **asdict(errors))
    if at_once > 1:
        names = " and ".join(block.name for block in pair)
        study.add(f"{names} at once", seconds=both, beside_whole=False)
        if whole.pid is not None:
            whole.join(study.seconds_left(3 * both))
        if study.left > 2.2 * both:
            _add_one_by_one(study, plan, pair, both, beside_whole=whole.pid is not None and whole.is_alive())
    if whole.pid is None:
        start_whole()
    whole.join(study.seconds_left(15))
    if not whole.is_alive() and (study.out / "whole" / "summary.json").is_file():
        _add_whole(study, run, views, plan)
    if study.left > COPY_SECONDS:
        _add_copies(study, run, views)


def _add_one_by_one(study: Study, plan: BlockPlan, pair: Sequence[Block], both: float, *, beside_whole: bool) -> None:
    """Train the blocks of a pair again, one after the other, and compare with the seconds that both took at once."""
    for block in plan.blocks:
        if block not in pair:  # Finished blocks are not trained again.
            place = Path(FOLDER) / block.name
            shutil.copytree(study.out / "at_once" / place, study.out / "one_by_one" / place)
    alone = _train_blocks(study, plan, "one_by_one", 1)
    seconds = max(end for _, end in alone.values())
    names = " and ".join(block.name for block in pair)
    study.add(f"{names}, one after the other", seconds=seconds, ratio=both / seconds, beside_whole=beside_whole)


def _config(study: Study) -> Config:
    """Return the default preset with a stated number of Gaussians and steps."""
    fields = {
        "response.name": "srgb",
        "densification.cap_max": study.gaussians,
        "mcmc.cap_density": 0.0,
        "schedule.iterations": study.steps,
        "schedule.evaluate_at": [30_000],
        "loss.light_prior": False,
        "model.initial_density": 100.0,
        "model.exposure_compensation": "never",
        "seed": 0,
    }
    return override_config(load_config("default", fields), {"plan.keep": sorted(fields)})


def _warm_up(study: Study, plan: BlockPlan, at_once: int) -> None:
    """Train two blocks for a moment, so that no timed job is the first to compile kernels or to read its program."""
    short = override_config(plan.config, {"schedule.iterations": WARM_UP})
    plan, out = replace(plan, config=short, blocks=plan.blocks[:AT_ONCE]), study.out / "warm"
    out.mkdir(exist_ok=True)
    plan.write(out)
    run_blocks(out, plan, device=study.device, gpus=at_once)


def _train_whole(data: LoadArguments, config: Mapping[str, Any], out: Path, device: str) -> None:
    """Train the whole survey, in a process of its own."""
    logging.basicConfig(filename=out.with_suffix(".log"), level=logging.INFO, format="%(asctime)s %(message)s")
    scene = load_scene_and_log_notes(data, response="srgb")
    create_trainer(scene, out, config_from_dict(dict(config), "config"), device=device, overwrite=True).train()


def _train_blocks(
    study: Study, plan: BlockPlan, name: str, at_once: int, first_done: Callable[[], None] | None = None
) -> dict[str, tuple[float, float]]:
    """Train the unfinished blocks in OUT/name and add a row for each; see _Spans for `first_done`.

    Returns:
        For each of them when it began and ended, seconds from the start of the first.
    """
    out = study.out / name
    out.mkdir(exist_ok=True)
    plan.write(out)
    handler = _Spans(first_done)
    logging.getLogger("sehdr_warp").addHandler(handler)
    began = time.monotonic()
    try:
        run_blocks(out, plan, device=study.device, gpus=at_once)
    finally:
        logging.getLogger("sehdr_warp").removeHandler(handler)
    spans = {block: (begin - began, handler.end[block] - began) for block, begin in handler.begin.items()}
    for block in plan.blocks:
        if block.name in spans:
            begin, end = spans[block.name]
            summary = json.loads((out / FOLDER / block.name / "summary.json").read_text())
            values = {"photos": len(block.views), "steps": plan.config.schedule.iterations, "seconds": end - begin}
            beside = "while another trains" if at_once > 1 else "alone"
            study.add(f"{block.name}, {beside}", **values, **_facts(summary))
    return spans


def _facts(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Return the Gaussians, seconds of steps and memory of a training: a GPU's, or that of its process."""
    peak = summary.get("peak_gpu_memory_bytes") or summary.get("peak_memory_bytes")
    values = {"gaussians": summary["gaussians"], "step_seconds": summary["train_seconds"]}
    return values | {"peak_memory_bytes": peak}


def _add_whole(study: Study, merged: Run, views: Sequence[View], plan: BlockPlan) -> None:
    """Add the figures of the whole; the merged run tells which pixels are near borders."""
    run = load_run(study.out / "whole", device=study.device)
    errors = measure_seams(run, tuple(views), plan.division, depths=merged)
    photos = sum(entry.split == "train" for entry in run.cameras)
    study.add("the whole", photos=photos, steps=study.steps, **_facts(run.summary()), **asdict(errors))


def _add_copies(study: Study, run: Run, views: Sequence[View]) -> None:
    """Write copies of the merged run side by side as a run, render it from the disk, and look at it."""
    tensors = {name: tensor.detach().cpu() for name, tensor in run.field.gaussians.tensors().items()}
    means = tensors["means"]
    span = (means.amax(0) - means.amin(0)).clamp(max=4)
    shifts = [torch.tensor([k % 4 - 1.5, k // 4 - 1.0, 0.0]) * span for k in range(-(-study.copies // len(means)))]
    many = {f"gaussians.{name}": torch.cat([tensors[name]] * len(shifts))[: study.copies] for name in PARAMETER_NAMES}
    many["gaussians.means"] = torch.cat([means + shift for shift in shifts])[: study.copies]
    folder = study.out / "at_once"
    RunWriter(folder).write_checkpoint(many, {"iteration": run.iterations + 1, "seconds": 1.0}, keep=1)
    del many, run, tensors, means
    cuda = study.device.type == "cuda"
    if cuda:
        torch.cuda.empty_cache()
    before = torch.cuda.mem_get_info(study.device)[0] if cuda else 0
    run = load_run(folder, device=study.device)
    frames = []
    for view in [*views[:1], *list(views)[:FRAMES]]:  # The first one is not counted.
        began = time.perf_counter()
        float(run.render(view.camera.resized(*SIZE)).hdr.mean())
        frames.append(time.perf_counter() - began)
    memory = before - torch.cuda.mem_get_info(study.device)[0] if cuda else None
    study.add("copies, rendered", gaussians=run.gaussian_count, **_milliseconds(frames), peak_memory_bytes=memory)
    cameras = [view.camera for view in views]
    del run
    if cuda:
        torch.cuda.empty_cache()
    if study.left > VIEW_SECONDS:
        _add_view(study, folder, cameras)


def _add_view(study: Study, folder: Path, cameras: Sequence[Camera]) -> None:
    """Ask `sehdr-warp view` for pictures as its page does: small ones while it moves, then a full one."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    cuda = study.device.type == "cuda"
    before = torch.cuda.mem_get_info(study.device)[0] if cuda else 0

    def ask(path: str, body: dict | None = None) -> bytes:
        data = None if body is None else json.dumps(body).encode()
        request = Request(f"http://127.0.0.1:{port}{path}", data, {"Content-Type": "application/json"})
        with urlopen(request, timeout=60) as answer:
            return answer.read()

    words = [sys.executable, "-m", "sehdr_warp", "view", folder, "--port", str(port), "--device", str(study.device)]
    with open(study.out / "view.log", "w") as log:
        process = subprocess.Popen(words, stdout=log, stderr=log)
    try:
        while True:
            try:
                ask("/versions")
                break
            except OSError:
                if process.poll() is not None or study.left < 5:
                    raise
                time.sleep(0.2)
        for what, size, draft in (("moving", DRAFT, True), ("at rest", SIZE, False)):
            times = []
            for camera in [cameras[0], *cameras[:FRAMES]]:
                began = time.perf_counter()
                ask("/frame", {"run": 0, "camera": camera.resized(*size).to_dict(), "draft": draft})
                times.append(time.perf_counter() - began)
            memory = before - torch.cuda.mem_get_info(study.device)[0] if cuda else None
            values = {"gaussians": study.copies, "peak_memory_bytes": memory}
            study.add(f"copies, in the viewer, {what}", **values, **_milliseconds(times))
    finally:
        process.terminate()
        process.wait(20)


def _milliseconds(times: Sequence[float]) -> dict[str, float]:
    """Return the median and the longest of times in seconds after the first, in milliseconds."""
    later = sorted(times[1:])
    return {"median_ms": 1e3 * later[len(later) // 2], "slowest_ms": 1e3 * later[-1]}


def main(study: Study) -> None:
    """Run the study."""
    calm_threads()  # The processes that this one starts inherit it.
    study.out.mkdir(parents=True, exist_ok=True)
    settings = {"views": study.views, "size": study.size, "gaussians": study.gaussians, "steps": study.steps}
    settings |= {"blocks": study.count, "GPUs": len(study.devices) if study.device.type == "cuda" else 0}
    result = new_result("blocks", study.device, settings)
    try:
        run_study(study)
    finally:
        result["rows"] = study.rows
        if study.json is not None:
            write_json(study.json, result, overwrite=True)


if __name__ == "__main__":
    run(main)
