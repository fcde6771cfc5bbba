"""A synthetic survey trained whole and in blocks: quality, error at borders, memory, and blocks at once on two GPUs.

python -m benchmarks.blocks OUT --views 400 --size 640 --gaussians 2000000

Blocks train as many steps on each photo as the whole does. Findings are lines of OUT/results.jsonl. The last is a
render of copies of the merged scene with 20 million Gaussians.
"""

import argparse
import json
import logging
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch

from sehdr_warp.blocks.block_plan import BlockPlan, make_block_plan
from sehdr_warp.blocks.jobs import run_blocks
from sehdr_warp.blocks.merge import merge_blocks
from sehdr_warp.blocks.seams import measure_seams
from sehdr_warp.model.gaussians import PARAMETER_NAMES, Gaussians
from sehdr_warp.runs.config import Config
from sehdr_warp.runs.config_files import load_config, override_config
from sehdr_warp.runs.load_arguments import LoadArguments
from sehdr_warp.runs.open import load_photos
from sehdr_warp.runs.run import Run, load_run
from sehdr_warp.training.train import create_trainer

from .survey import write_survey

WARM_UP = 30  # Steps of a training before the first that is timed, in which kernels are compiled
COPIES = 20_000_000
FRAMES = 20


@dataclass(frozen=True)
class Study:
    """Sizes of the study."""

    out: Path
    views: int
    size: int
    gaussians: int
    steps: int
    count: int
    device: torch.device

    def note(self, what: str, **values) -> None:
        """Write a finding."""
        with open(self.out / "results.jsonl", "a") as file:
            file.write(json.dumps({"what": what, **values}) + "\n")
        print(what, values, flush=True)


def run_study(study: Study) -> None:
    """Train the survey in both ways, and write what is found."""
    study.out.mkdir(parents=True, exist_ok=True)
    device, survey = study.device, study.out / "survey"
    gpus = torch.cuda.device_count() if device.type == "cuda" else 1
    study.note("machine", device=str(device), gpus=gpus, torch=torch.__version__, **_sizes(study))
    if not survey.is_dir():
        write_survey(survey, study.views, study.size, study.gaussians * 3 // 2, device)
    config = _config(study)
    data: LoadArguments = {"path": str(survey.absolute()), "exposure_index": None, "max_size": None, "holdout": None}
    plan = make_block_plan(data, config, device, study.count)
    assert plan is not None
    fraction = sum(block.fraction for block in plan.blocks) / study.count
    plan = replace(plan, config=override_config(config, {"schedule.iterations": round(study.steps * fraction)}))
    study.note("plan", photos=[len(block.views) for block in plan.blocks], fraction=fraction)
    warm = load_photos({**data, "views": list(plan.blocks[0].views)[:12]}, response="srgb")
    short = override_config(config, {"schedule.iterations": WARM_UP})
    create_trainer(warm, study.out / "warm", short, device=device, overwrite=True).train()
    seconds = _blocks(study, plan, "blocks", gpus)
    if gpus > 1:
        study.note("times", at_once_by_one_by_one=seconds / _blocks(study, plan, "one_by_one", 1))
    merge_blocks(study.out / "blocks", plan)
    whole = create_trainer(
        load_photos(data, response="srgb"), study.out / "whole", config, device=device, overwrite=True
    ).train()
    merged = load_run(study.out / "blocks", device=device)
    names = [entry.name for entry in merged.cameras if entry.split == "test"]
    views = load_photos({**data, "views": names}, response="srgb").views
    for name, run in (("merged", merged), ("whole", whole)):
        errors = measure_seams(run, views, plan.division, depths=merged)
        memory = run.summary().get("peak_gpu_memory_bytes") or run.summary().get("peak_memory_bytes")
        study.note(name, gaussians=run.gaussian_count, seconds=run.train_seconds, peak_bytes=memory, **asdict(errors))
    if device.type == "cuda":
        _render_copies(study, merged)


def _sizes(study: Study) -> dict:
    """Return the sizes as plain values."""
    return {name: getattr(study, name) for name in ("views", "size", "gaussians", "steps", "count")}


def _config(study: Study) -> Config:
    """Return the default preset with a stated number of Gaussians and steps."""
    fields = {
        "response.name": "srgb",
        "densification.cap_max": study.gaussians,
        "mcmc.cap_density": 0.0,
        "schedule.iterations": study.steps,
        "schedule.evaluate_at": [30_000],
    }
    return override_config(load_config("default", fields), {"plan.keep": sorted(fields)})


def _blocks(study: Study, plan: BlockPlan, name: str, at_once: int) -> float:
    """Train all blocks; return the seconds that it takes."""
    out = study.out / name
    out.mkdir(exist_ok=True)
    plan.write(out)
    began = time.perf_counter()
    run_blocks(out, plan, device=study.device, gpus=at_once)
    seconds = time.perf_counter() - began
    parts = [json.loads(path.read_text()) for path in sorted(out.glob("blocks/*/summary.json"))]
    figures = {field: [part.get(field) for part in parts] for field in ("gaussians", "train_seconds")}
    study.note(name, at_once=at_once, seconds=seconds, **figures)
    return seconds


def _render_copies(study: Study, run: Run) -> None:
    """Render copies of the scene side by side, COPIES Gaussians in all, at 1920 x 1080."""
    tensors, count = run.field.gaussians.tensors(), run.gaussian_count
    copies = -(-COPIES // count)
    span = tensors["means"].quantile(0.98, dim=0) if count < 10**7 else tensors["means"].amax(0)
    places = [torch.tensor([k % 4 - 1.5, k // 4 - 1.5, 0.0], device=run.device) * span for k in range(copies)]
    many = {name: torch.cat([tensors[name]] * copies)[:COPIES] for name in PARAMETER_NAMES if name != "means"}
    means = torch.cat([tensors["means"] + place for place in places])[:COPIES]
    run.field.gaussians, run.field.confidence = Gaussians(means, **many), None
    del tensors, many, means
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats()
    camera, frames = run.cameras[0].camera.resized(1920, 1080), []
    for _ in range(FRAMES):
        began = time.perf_counter()
        float(run.render(camera).hdr.mean())
        frames.append(time.perf_counter() - began)
    free, total = torch.cuda.mem_get_info()
    study.note(
        "copies",
        gaussians=COPIES,
        median_ms=1e3 * sorted(frames)[FRAMES // 2],
        peak_bytes=torch.cuda.max_memory_allocated(),
        gpu_bytes=total - free,
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    sizes = {"views": 400, "size": 640, "gaussians": 2_000_000, "steps": 6000, "count": 4}
    for name, default in sizes.items():
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--device", type=torch.device, default="cuda" if torch.cuda.is_available() else "cpu")
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    run_study(Study(**vars(parser.parse_args())))
