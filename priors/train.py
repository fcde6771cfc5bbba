"""Train the prior for clipped light: `python -m priors.train PACK --out WEIGHTS`.

One run is deterministic on one kind of machine. With --judge the held-out panoramas are left out, and the figures of
the model card are printed and written beside the weights.
"""

import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple, cast

import numpy as np
import torch
import tyro
from safetensors.torch import save_file
from torch import Tensor

from benchmarks.study import run
from sehdr_warp.prior import load_prior
from sehdr_warp.prior.network import STOPS, LightNetwork, network_input

from .families import LIT_ROOMS, Families
from .judge import DEVICE, judge
from .panoramas import Pack, read_pack
from .photos import Photos
from .rooms import LitRooms

STEPS, BATCH = 6500, 48
TEACHERS = 4  # Networks of other seeds, of which the last one learns
AT_ONCE = 4  # Batches that are simulated at one time
RATE, WARM_UP, WEIGHT_DECAY = 2e-3, 200, 0.1
AVERAGE = 0.998  # Of the weights before and those of a step, of which the result is made
ENERGY_WEIGHT = 0.15  # Of the error of a photo's total light beside the pixels' likelihood
LEAST_PIXELS = 20.0  # A photo with fewer clipped values counts as if it had so many, and some not
USUAL_PIXELS = 800.0  # Clipped values of a photo that counts once
SHARING = 0.6  # 1: photos count alike; 0: clipped values do
SCALE_PHOTOS = 256  # On which the deviations are scaled


class Target(NamedTuple):
    """Mean and variance that a network learns to state for a batch, in stops over white: of truth or of teachers."""

    mean: Tensor  # [B, 3, H, W]
    variance: Tensor  # [B, 3, H, W]; 0 of the truth


def target_of(photos: Photos, teachers: Sequence[torch.nn.Module]) -> Target:
    """Return the truth of a batch, or the mixture of what teachers say of it, each of the same share."""
    truth = photos.truth.clamp_max(STOPS)
    if not teachers:
        return Target(truth, torch.zeros_like(truth))
    with torch.no_grad():
        inputs = network_input(photos.exposure, photos.clipped)
        means, deviations = (torch.stack(each) for each in zip(*(teacher(inputs) for teacher in teachers), strict=True))
    return Target(means.mean(0), deviations.square().mean(0) + means.var(0, correction=0))


def pixel_loss(mean: Tensor, deviation: Tensor, target: Target, photos: Photos) -> Tensor:
    """Return the negative log likelihood of the clipped values, the mean over photos, and the error of their light.

    A photo counts by the number of its clipped values to the power of 1 - SHARING. Of a mixture of teachers it is the
    expected likelihood, which is smallest at the mixture's mean and variance.
    """
    clipped, truth = photos.clipped, photos.truth.clamp_max(STOPS)
    weight = clipped / clipped.sum((1, 2, 3), keepdim=True).clamp_min(LEAST_PIXELS) ** SHARING
    weight = weight * (USUAL_PIXELS ** (SHARING - 1))
    squares = (target.mean - mean).square() + target.variance
    likelihood = 0.5 * squares / deviation.square() + deviation.log()
    # Times the deviation as it is, so that unsure pixels still teach the mean (beta-NLL, Seitzer et al. 2022).
    likelihood = (weight * deviation.detach() * likelihood).sum((1, 2, 3))
    light = (clipped * torch.exp2(mean.clamp_max(STOPS))).sum((1, 2, 3)).clamp_min(1).log2()
    true_light = (clipped * torch.exp2(truth)).sum((1, 2, 3)).clamp_min(1).log2()
    energy = torch.nn.functional.smooth_l1_loss(light, true_light, reduction="none")
    return (likelihood + ENERGY_WEIGHT * energy * (clipped.sum((1, 2, 3)) >= LEAST_PIXELS)).mean()


def train(
    pack: Pack,
    chosen: np.ndarray,
    *,
    steps: int,
    seed: int,
    device: str,
    lit_rooms: LitRooms,
    teachers: Sequence[LightNetwork] = (),
) -> LightNetwork:
    """Return a network trained on some panoramas and the rooms: the average of its last weights.

    Args:
        pack: of `read_pack`.
        chosen: indices of the panoramas.
        steps: the learning rate falls to 0 over them.
        seed: of every random number.
        device: "cpu", "cuda:0" ...
        lit_rooms: rooms whose lamps are in view.
        teachers: networks whose mixture is the target in place of the truth (knowledge distillation, Hinton et al.
            2015). Networks that differ in their seed alone differ as much as those of other recipes.
    """
    torch.manual_seed(seed)
    network = LightNetwork().to(device).train()
    families = Families(pack, device, chosen, rooms=True, seed=seed, lit_rooms=lit_rooms)
    matrices, vectors = ([p for p in network.parameters() if (p.ndim > 1) is matrix] for matrix in (True, False))
    groups = [{"params": matrices, "weight_decay": WEIGHT_DECAY}, {"params": vectors, "weight_decay": 0.0}]
    optimizer = torch.optim.AdamW(groups, RATE)
    decay = max(0.0, min(AVERAGE, 1 - 10 / steps))
    average = torch.optim.swa_utils.AveragedModel(
        network, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(decay)
    )
    started, batches = time.perf_counter(), []
    for step in range(steps):
        batches = batches or families.take(BATCH, AT_ONCE)
        photos = batches.pop()
        for group in optimizer.param_groups:
            group["lr"] = RATE * min(1.0, (step + 1) / WARM_UP) * (0.5 + 0.5 * np.cos(np.pi * step / steps))
        mean, deviation = network(network_input(photos.exposure, photos.clipped))
        loss = pixel_loss(mean, deviation, target_of(photos, teachers), photos)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        average.update_parameters(network)
        if step % 200 == 0:
            seconds = round(time.perf_counter() - started, 1)
            print(json.dumps({"step": step, "loss": round(float(loss.detach()), 4), "seconds": seconds}), flush=True)
    return cast(LightNetwork, average.module)


def fit_scale(network: LightNetwork, pack: Pack, chosen: np.ndarray, *, seed: int, device: str) -> float:
    """Return the factor of the deviations at which 68 % of clipped values lie within one, on photos of panoramas."""
    families, parts = Families(pack, device, chosen, rooms=False, seed=seed), []
    with torch.no_grad():
        for photos in families.take(BATCH, SCALE_PHOTOS // BATCH, 96):
            mean, deviation = network(network_input(photos.exposure, photos.clipped))
            off = ((photos.truth - mean).abs() / deviation)[photos.clipped > 0]
            parts.append(off[torch.randperm(len(off), device=off.device)[:4000]].cpu())
    return float(torch.cat(parts).quantile(0.683))


def save(network: LightNetwork, scale: float, path: Path) -> None:
    """Write a network's weights as half floats, with the factor of its deviations."""
    tensors = {name: value.detach().half().cpu().contiguous() for name, value in network.state_dict().items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    save_file(tensors, path, {"deviation_scale": f"{scale:.4f}"})


def main(
    pack: Path,
    /,
    out: Path,
    teachers: int = TEACHERS,
    steps: int = STEPS,
    seed: int = 0,
    lit_rooms: int = LIT_ROOMS,
    device: str = DEVICE,
    judged: Annotated[bool, tyro.conf.arg(name="judge")] = False,
) -> None:
    """Train teachers, and a network on their mixture; judge it if asked to, and write the weights.

    Args:
        pack: the panoramas, see priors.pack.
        out: file of the weights. Teachers lie beside it as OUT_teacher_SEED.safetensors; those that are there are read.
        teachers: networks of different seeds on whose mixture the last one is trained; 0: it is trained on the truth.
        steps: of each training.
        seed: of all random numbers; teachers have this one and those after it.
        lit_rooms: rooms with lamps in view that are rendered for each training.
        device: cpu or cuda:N.
        judged: leave out the held-out panoramas and judge on them.
    """
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    torch.use_deterministic_algorithms(True, warn_only=True)
    packed = read_pack(pack)
    chosen = np.flatnonzero(~packed.held_out) if judged else np.arange(len(packed.panoramas))

    def train_network(own_seed: int, networks: Sequence[LightNetwork] = ()) -> LightNetwork:
        rooms = LitRooms(lit_rooms, device, own_seed)
        return train(
            packed, chosen, steps=steps, seed=own_seed, device=device, lit_rooms=rooms, teachers=networks
        ).eval()

    networks = []
    for each in range(seed, seed + teachers):
        path = out.with_name(f"{out.stem}_teacher_{each}.safetensors")
        if not path.is_file():
            save(train_network(each), 1.0, path)
        networks.append(load_prior(device, path).network)
    own_seed = seed + teachers
    network = train_network(own_seed, networks)
    # The deviations are scaled on panoramas of the training, or, of a judged run, on half of those that are held out.
    unseen = np.flatnonzero(packed.held_out)
    scale = fit_scale(network, packed, unseen[::2] if judged else chosen, seed=own_seed + 1, device=device)
    save(network, scale, out)
    if judged:
        figures = judge(network, scale, packed, unseen, chosen, seed=own_seed + 2, device=device)
        out.with_suffix(".json").write_text(json.dumps(figures))
        print(json.dumps(figures))


if __name__ == "__main__":
    run(main)
