"""Cost of a training: time, memory, network and disk as functions of photos, pixels, Gaussians, GPUs and nodes.

The constants are fitted to the measurements in docs/reports (step, gpus, large, captures, blocks) on one and two H100
and H200. Estimates within their range are marked as such, and all others as predictions: more than two GPUs, several
nodes, or more Gaussians than were measured.
"""

import math
from dataclasses import asdict, dataclass, replace

import torch

from ..limits import format_bytes
from ..parallel import thread_count
from ..progress import format_duration

STEP_SECONDS, PIXEL_SECONDS, GAUSSIAN_SECONDS = 2.0e-4, 3.4e-10, 2.4e-9
"""Duration of a captured step on one GPU: fixed part, per pixel of a photo, per Gaussian, with densification."""
NUMBERS, RANK_NUMBERS = 11, 3  # Floats per Gaussian in the all-reduce: 11, plus 3 color gradients per rank
EXCHANGE_SECONDS, NUMBER_SECONDS = 1.5e-4, 2.3e-11
"""Additional duration on two GPUs of one node: to start the all-reduce, and per float of the gradients."""
NETWORK = 12.5e9  # Bytes a second between nodes, of 100 Gb/s; not measured
GAUSSIAN_BYTES, PIXEL_BYTES, FIXED_BYTES = 1120, 177, 45e6
"""Memory on the GPU: of a Gaussian with gradients, optimizer state and its part of the tile lists, of a pixel of a
photo in a step, and of any training. Fitted to trainings on ten captures, to a town of 5.5 million Gaussians and to a
block of it, which they give within 10 %. Where Gaussians are small in the photo, 920 for each are enough."""
STATE_BYTES = 940  # Of a Gaussian in a checkpoint: parameters, moments, moving average
CPU_PIXEL, CPU_GAUSSIAN = 1.0e-6, 1.5e-6  # Seconds of one core for each in a step, measured on two of an AMD EPYC
GROWTH = 1.5  # Final number of Gaussians relative to the mean over a training that grows for half of its steps
START_SECONDS = 10.0  # To start a process with torch and to prepare a training
PHOTO_SECONDS = 0.026  # To read a photo, to match it before the training, and to measure confidence on it after
SAVE_SECONDS = 2.5e-6  # Of a Gaussian in a checkpoint: copied, hashed and written
SAVES_APART, MOST_SAVES = 10.0, 6  # Seconds between checkpoints, and their number with the default interval
OVERLAP = 1.3  # Photos and Gaussians of all blocks together, relative to the whole set
MOST_GPUS, MOST_GAUSSIANS = 2, 5_000_000  # Range of the measurements
SAVES = 1.2  # Blocks or more GPUs are recommended if they need this many times less


@dataclass(frozen=True)
class Workload:
    """Size of a training."""

    photos: int  # Number of training photos
    pixels: float  # Pixels of a photo
    gaussians: float  # Final number of Gaussians
    iterations: int  # Photos that are trained on
    pixel_bytes: int = 3  # Bytes of a pixel's codes and, if photos have masks, 4 of its mask


@dataclass(frozen=True)
class Cost:
    """Cost of a training."""

    seconds: float  # Duration from the start of its process to its end
    gpu_bytes: float  # Peak memory of each GPU, without the photos
    network_bytes: float  # Bytes that each node sends and receives
    disk_bytes: float  # Of the run folder
    photo_bytes: float  # Of the photos and masks in memory, on each node
    predicted: bool  # Whether it is outside of what was measured


def step_seconds(pixels: float, gaussians: float) -> float:
    """Return the duration of a step on one GPU, seconds."""
    return STEP_SECONDS + PIXEL_SECONDS * pixels + GAUSSIAN_SECONDS * gaussians


def exchange_bytes(gaussians: float, gpus: int) -> float:
    """Return the bytes that each GPU sends in the all-reduce of a step, by a ring."""
    return 8 * (1 - 1 / gpus) * (NUMBERS + RANK_NUMBERS * gpus) * gaussians


def exchange_seconds(gaussians: float, gpus: int, nodes: int = 1) -> float:
    """Return the additional duration of a step on several GPUs, seconds."""
    if gpus == 1:
        return 0.0
    size = exchange_bytes(gaussians, gpus)
    return EXCHANGE_SECONDS + max(size / 4 * NUMBER_SECONDS, size / NETWORK if nodes > 1 else 0.0)


def gain_of_ranks(count: int, gaussians: int, pixels: int, photos: int, device: torch.device) -> str:
    """Return a log line about the expected speed of a training of `photos` iterations on `count` ranks."""
    if device.type == "cpu":
        shared = f"{count} processes share this machine's {thread_count() * count} threads"
        return f"plan: ranks: {shared}: no faster than one"
    step = step_seconds(pixels, gaussians)
    alone, together = photos * step, photos / count * (step + exchange_seconds(gaussians, count))
    estimate = (
        f"an estimated {alone / together:.1f} times one for {gaussians} Gaussians and {pixels / 1e6:.2g} megapixels"
    )
    if alone < together + START_SECONDS:
        estimate = f"about {alone:.1g} s of steps are too few to gain by more processes ({estimate})"
    return f"plan: ranks: {count} GPUs, a photo each in a step: {estimate}"


def training_cost(work: Workload, gpus: int = 1, nodes: int = 1) -> Cost:
    """Return the cost of one training on GPUs of all nodes, by data parallelism: each takes a photo in a step."""
    mean = work.gaussians / GROWTH
    steps = math.ceil(work.iterations / gpus)
    seconds = steps * (step_seconds(work.pixels, mean) + exchange_seconds(mean, gpus, nodes))
    saves = 1 + min(MOST_SAVES - 1, int(seconds / SAVES_APART))
    around = START_SECONDS + PHOTO_SECONDS * work.photos + saves * SAVE_SECONDS * work.gaussians
    photos = work.photos * work.pixels * work.pixel_bytes
    return Cost(
        seconds + around,
        FIXED_BYTES + GAUSSIAN_BYTES * work.gaussians + PIXEL_BYTES * work.pixels,
        steps * exchange_bytes(mean, gpus) if nodes > 1 else 0.0,
        STATE_BYTES * work.gaussians,
        photos,
        gpus > MOST_GPUS or nodes > 1 or work.gaussians > MOST_GAUSSIANS,
    )


def block_cost(work: Workload, blocks: int, gpus: int = 1) -> Cost:
    """Return the cost of the same training in blocks, `gpus` of them at once."""
    share = OVERLAP / blocks
    block = replace(
        work,
        photos=math.ceil(work.photos * share),
        gaussians=work.gaussians * share,
        iterations=math.ceil(work.iterations * share),
    )
    one = training_cost(block)
    rounds = math.ceil(blocks / gpus)
    merged_bytes = STATE_BYTES / 4 * work.gaussians
    return replace(
        one,
        seconds=rounds * one.seconds,
        disk_bytes=blocks * one.disk_bytes + merged_bytes,
        photo_bytes=one.photo_bytes * min(gpus, blocks),
        predicted=one.predicted or gpus > MOST_GPUS,
    )


def cpu_seconds(pixels: float, gaussians: float, threads: int) -> float:
    """Return the mean duration of a step on the CPU of a training that ends with so many Gaussians, seconds."""
    return (CPU_PIXEL * pixels + CPU_GAUSSIAN * gaussians / GROWTH) / threads


def cpu_cost(work: Workload, threads: int) -> Cost:
    """Return the cost of a training on the CPU."""
    photos = work.photos * work.pixels * work.pixel_bytes
    seconds = work.iterations * cpu_seconds(work.pixels, work.gaussians, threads)
    return Cost(seconds, 0.0, 0.0, STATE_BYTES * work.gaussians, photos, False)


@dataclass(frozen=True)
class Choice:
    """A way to train a set, with its cost."""

    name: str  # In words, such as "4 GPUs"
    cost: Cost  # Its cost
    fits: bool = True  # Whether it fits into the memory of a GPU

    def line(self) -> str:
        """Return the choice and its cost in one line."""
        cost = self.cost
        parts = [format_duration(cost.seconds)]
        parts += [f"{format_bytes(cost.gpu_bytes)} on each GPU"] if cost.gpu_bytes else []
        parts += [f"{format_bytes(cost.photo_bytes)} of photos", f"{format_bytes(cost.disk_bytes)} on the disk"]
        parts += [f"{format_bytes(cost.network_bytes)} by network"] if cost.network_bytes else []
        text = f"{self.name:<26}{', '.join(parts)}"
        text += "" if self.fits else "; does not fit"
        return text + (" (prediction)" if cost.predicted else "")

    def to_dict(self) -> dict:
        """Return plain values for --json."""
        return {"name": self.name, "fits": self.fits, **asdict(self.cost)}


def choices(whole: Workload, divided: Workload, blocks: int, memory: float | None, gpus: int = 1) -> list[Choice]:
    """Return ways to train a set on GPUs: on one, on `gpus`, on several that need SAVES times less, in blocks.

    Args:
        whole: Size of one training.
        divided: Size of all blocks together, without their overlap.
        blocks: Number of blocks for the set; 1 if one training is enough.
        memory: Bytes of a GPU's memory; None if there is none to compare with.
        gpus: GPUs that may be used on this machine.
    """
    costs = {f"{count} GPU" + "s" * (count > 1): training_cost(whole, count) for count in sorted({1, 2, 4, 8, gpus})}
    costs["8 nodes of 8 GPUs"] = training_cost(whole, 64, 8)
    alone = costs["1 GPU"].seconds
    names = "1 GPU", f"{gpus} GPUs"
    costs = {name: cost for name, cost in costs.items() if name in names or alone > SAVES * cost.seconds}
    for count in sorted({1, gpus, min(blocks, 8)}) if blocks > 1 else ():
        costs[f"{blocks} blocks on {count} GPU" + "s" * (count > 1)] = block_cost(divided, blocks, count)
    return [Choice(name, cost, memory is None or cost.gpu_bytes <= memory) for name, cost in costs.items()]


def recommend(whole: Workload, divided: Workload, blocks: int, memory: float | None, gpus: int = 1) -> str:
    """Return which way suits a machine with `gpus` GPUs, and why, in one line; arguments as of choices()."""
    several = training_cost(whole, gpus)
    if blocks > 1:
        return f"--blocks {blocks}: the set fills {blocks} trainings of 30,000 steps or of 3 million Gaussians"
    if memory is not None and several.gpu_bytes > memory:
        needs = f"{format_bytes(several.gpu_bytes)} are more than the {format_bytes(memory)} of a GPU"
        return f"--blocks {max(2, math.ceil(OVERLAP * training_cost(divided).gpu_bytes / memory))}: {needs}"
    alone = training_cost(whole)
    if gpus > 1 and alone.seconds > SAVES * several.seconds:
        return f"--gpus {gpus}: {alone.seconds / several.seconds:.1f} times as fast as one"
    return "one GPU: " + ("more gain little" if gpus > 1 else "the set is one training")
