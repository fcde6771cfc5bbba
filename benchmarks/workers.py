"""`python -m benchmarks workers`: training steps on more and more threads of the CPU, or on more and more GPUs."""

import logging
import os
import tempfile
import time
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from unittest.mock import patch

import torch
import torch.multiprocessing as processes

from sehdr_warp.errors import SehdrError
from sehdr_warp.files import read_json, write_json
from sehdr_warp.parallel import thread_count
from sehdr_warp.runs.config import Config
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.training.launch import RankInfo, device_of_rank
from sehdr_warp.training.process_settings import torch_settings
from sehdr_warp.training.ranks import GO, Ranks, join_ranks

from .results import check, new_result
from .splats import Size, make_photo_scene
from .step import amortize, make_trainer, step_variant
from .timing import time_variants, wait

LOG = logging.getLogger(__name__)
PRESET, PHOTOS = "default", 8
WARM_UP = 20  # Steps on GPUs before the timed ones: launched, captured, and some replayed
STEPS = 10  # Steps on GPUs for each repetition, one after the other without a pause, as in a training
BOUND = 1e-12  # Largest difference of losses between numbers of threads: less than float32 resolves


def bench_workers(sizes: Sequence[Size], device: torch.device, *, repetitions: int) -> dict:
    """Time a row for each size and 1, 2, 4 ... threads of the CPU, or GPUs; return the result.

    Times are by photo; each GPU takes one photo in a step.
    """
    result = new_result("workers", device, {"device": str(device), "repetitions": repetitions, "preset": PRESET})
    cpu = device.type == "cpu"
    for size in sizes:
        first: dict | None = None
        for count in doubled(thread_count() if cpu else torch.cuda.device_count()):
            row = time_threads(size, count, repetitions) if cpu else time_ranks(size, count, "cuda", repetitions)
            first = first or row
            row["times_one"] = first["photo_ms"] / row["photo_ms"]
            place = {"gaussians": size.gaussians, "width": size.width, "height": size.height}
            result["rows"].append(place | {"kind": "threads" if cpu else "GPUs", "workers": count} | row)
            if cpu:
                difference = abs(row["loss"] - first["loss"])
                result["checks"].append(check(f"{size}: loss on {count} threads", "one thread", difference, BOUND))
            LOG.info("%s: %d done", size, count)
    return result


def doubled(most: int) -> list[int]:
    """1, 2, 4 ... and the most itself."""
    return sorted({most, *(1 << power for power in range(most.bit_length()) if 1 << power <= most)})


def time_threads(size: Size, count: int, repetitions: int) -> dict:
    """Time a step on `count` threads; also return the loss after the same few steps."""
    with patch.dict(os.environ, SEHDR_THREADS=str(count)):
        trainer = make_trainer(make_photo_scene(size, PHOTOS), _config(size), torch.device("cpu"))
        variant = step_variant(trainer)
        with torch_settings(trainer.config.deterministic):
            for _ in range(3):
                variant.once()
            loss = trainer.loss
            timing = time_variants({"step": variant}, trainer.device, repetitions=repetitions)["step"]
    return {"photo_ms": timing["median_ms"], "repetitions": timing["repetitions"], "loss": loss}


def time_ranks(size: Size, count: int, device_type: str, repetitions: int) -> dict:
    """Time steps by photo on several devices, each with a process of its own."""
    with tempfile.TemporaryDirectory(prefix="sehdr-warp-") as folder:
        arguments = count, Path(folder), size, device_type, repetitions
        try:
            processes.start_processes(_rank, arguments, count, start_method="spawn")
        except (processes.ProcessRaisedException, processes.ProcessExitedException) as error:
            reason = str(error).strip().splitlines()[-1]
            raise SehdrError(f"a training of {size} by {count} processes ended early: {reason}") from error
        return read_json(Path(folder) / "timing.json")


def _rank(rank: int, count: int, folder: Path, size: Size, device_type: str, repetitions: int) -> None:
    os.environ |= {"WORLD_SIZE": str(count), "SEHDR_RANKS": str(folder / "meeting")}
    device = device_of_rank(rank, device_type)
    with join_ranks(RankInfo(rank, count, rank, count), device) if count > 1 else nullcontext() as ranks:
        timing = _time_steps(ranks, size, device, repetitions)
        if not rank:
            write_json(folder / "timing.json", timing)


def _time_steps(ranks: Ranks | None, size: Size, device: torch.device, repetitions: int) -> dict:
    trainer = make_trainer(make_photo_scene(size, PHOTOS, device), _config(size), device, ranks=ranks)
    variant, photos = step_variant(trainer), trainer.batch

    def step() -> None:
        if ranks is not None:
            ranks.all_reduce_min(GO)
        trainer.step()

    with torch_settings(trainer.config.deterministic):
        for _ in range(WARM_UP):
            variant.prepare()
            step()
        wait(device)
        started = time.perf_counter()
        for _ in range(STEPS * repetitions):
            variant.prepare()
            step()
        wait(device)
        mean = (time.perf_counter() - started) * 1e3 / (STEPS * repetitions)
        whole = amortize(trainer, step)["amortized_ms"]
        trainer.sync_ranks()  # Raises an error if the Gaussians of the ranks differ.
    return {"photo_ms": mean / photos, "amortized_ms": whole / photos, "repetitions": STEPS * repetitions}


def _config(size: Size) -> Config:
    most = size.gaussians * 11 // 10 + 1
    changes = {"densification.cap_max": most, "model.initial_density": 0, "response.name": "srgb"}
    return load_config(PRESET, changes)
