"""Small configs and runs to damage, and their readers."""

import hashlib
import json
from contextlib import suppress
from importlib import resources
from pathlib import Path

import torch

from sehdr_warp.blocks.block_plan import BlockPlan
from sehdr_warp.errors import SehdrError
from sehdr_warp.model.confidence import Evidence
from sehdr_warp.model.gaussians import Gaussians
from sehdr_warp.output.lighting.unit import read_light_unit
from sehdr_warp.output.world_transform import read_orientation
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.runs.field import assemble_field
from sehdr_warp.runs.run import load_run
from sehdr_warp.runs.run_folder import RunFolder
from sehdr_warp.runs.run_writer import RunWriter, write_confidence
from sehdr_warp.runs.values import FORMAT
from sehdr_warp.training.train import create_trainer
from sehdr_warp.training.trainer import Trainer
from sehdr_warp.training.training_state import state_of
from tests.training.toy import toy_scene
from tests.trial.test_blocks import PLAN as BLOCKS

from .reader import Reader, each


def make_config(folder: Path) -> None:
    (folder / "own.toml").write_text('base = "paper"\nseed = 3\n[schedule]\niterations = 100\nevaluate_at = [1, 2]\n')
    (folder / "all.toml").write_text((resources.files("sehdr_warp.configs") / "default.toml").read_text())


PLAN = {"decisions": [{"name": "brackets", "choice": "plain scaling", "reason": "8 bits", "fields": {"seed": 3}}]}
REGION = {"photo": "r_0", "pixels": 9, "column": 3.0, "row": 4.0, "stops": 1.5, "box": [1, 2, 3, 4]}
SUMMARY = {"iteration": 10, "train_seconds": 2.0, "finished": True, "gaussians": 4, "device": "cpu (1 threads)"}
SUMMARY |= {"unexplained": {"regions": 1, "photos": 1, "worst": [REGION]}}


def make_run(folder: Path) -> None:
    config = load_config("paper", {"schedule.iterations": 10})
    gaussians = Gaussians.from_points(torch.rand(4, 3), torch.zeros(4, 3), 3)
    scene = toy_scene(2, 8)
    field = assemble_field(gaussians, config, response_by_name("srgb"), 0.25)
    run = RunWriter(folder)
    state = state_of(Trainer(scene, config, field))
    state.values["seconds"] = 1.0
    run.begin(scene, config, field, {"path": "embedded"}, PLAN, state)
    run.unlock()
    run.append_metrics({"iteration": 1, "seconds": 0.5, "psnr_ldr": 20.0})
    run.write_summary(SUMMARY)


def read_run(folder: Path):
    run = load_run(folder)
    return run.metrics(), run.summary(), run.decisions(), run.degree


def make_confidence(folder: Path) -> None:
    make_run(folder)
    checkpoint = RunFolder(folder).newest_checkpoint()
    write_confidence(RunFolder(folder), Evidence(*torch.rand(5, 4)), checkpoint.values["sha256"])


def read_confidence(folder: Path):
    return load_run(folder).clipped_share()


def resume(folder: Path):
    return create_trainer(toy_scene(2, 8), folder, device="cpu", resume=True)


def sign_again(folder: Path) -> None:
    for path in folder.glob("checkpoints/*/checkpoint.json"):
        with suppress(OSError, ValueError, TypeError, RecursionError, SehdrError):
            values = json.loads(path.read_bytes())
            data = (path.parent / "state.safetensors").read_bytes()
            hashes = {"sha256": hashlib.sha256(data).hexdigest(), "run": RunFolder(folder).hashes()}
            path.write_text(json.dumps(values | hashes))


def make_summary(folder: Path) -> None:
    (folder / "summary.json").write_text(json.dumps({"format": FORMAT} | SUMMARY))


def make_plan(folder: Path) -> None:
    (folder / "plan.json").write_text(json.dumps({"format": FORMAT} | PLAN))


def make_metrics(folder: Path) -> None:
    lines = [{"iteration": n, "seconds": 0.5, "psnr_ldr": 20.0, "psnr_hdr": None} for n in range(3)]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


def make_blocks(folder: Path) -> None:
    (folder / "blocks.json").write_text(json.dumps(BLOCKS))


def make_facts(folder: Path) -> None:
    make_run(folder)
    (folder / "light_unit.json").write_text(
        json.dumps({"luminance": 100.0, "pixel": [1, 2], "view": "a", "reading": "incident"})
    )
    (folder / "orientation.json").write_text(json.dumps({"up": [0.0, 0.0, 1.0], "scale": 2.0}))
    (folder / "extension.json").write_text(json.dumps({"iterations": 20}))


def read_facts(folder: Path) -> None:
    """Damage what users add to a run; its own files are whole."""
    each(read_light_unit, read_orientation, lambda run: run.folder.read_config())(load_run(folder))


RUN_FILES = ("*.json", "metrics.jsonl")
READERS = {
    "blocks": Reader(make_blocks, ("blocks.json",), BlockPlan.read, text=True),
    "facts": Reader(
        make_facts, ("light_unit.json", "orientation.json", "extension.json"), read_facts, text=True, cost=5
    ),
    "config": Reader(make_config, ("*.toml",), each(load_config), text=True, cost=0.6),
    "run": Reader(make_run, RUN_FILES, read_run, text=True, repair=sign_again, cost=5),
    "checkpoint": Reader(make_run, ("checkpoints/*/*",), read_run, text=True, repair=sign_again, cost=4),
    "confidence": Reader(make_confidence, ("confidence.safetensors",), read_confidence, cost=5),
    "resume": Reader(make_run, (*RUN_FILES, "checkpoints/*/*"), resume, text=True, repair=sign_again, cost=20),
    "summary": Reader(make_summary, ("*",), lambda folder: RunFolder(folder).read_summary(), text=True, cost=0.6),
    "plan": Reader(make_plan, ("*",), lambda folder: RunFolder(folder).read_decisions(), text=True, cost=0.5),
    "metrics": Reader(make_metrics, ("*",), lambda folder: RunFolder(folder).read_metrics(), text=True, cost=0.5),
}
