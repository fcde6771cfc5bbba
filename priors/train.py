"""Train the prior for clipped light: `python -m priors.train PACK --out WEIGHTS`.

One run is deterministic on one kind of machine. With --judge the held-out panoramas are left out, and the figures of
the model card are printed and written beside the weights.
"""

import copy
import json
import os
import time
from pathlib import Path
from typing import Annotated, cast

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
AT_ONCE = 4  # Batches that are simulated at one time
RATE, WARM_UP, WEIGHT_DECAY = 2e-3, 200, 0.1
AVERAGE = 0.998  # Of the weights before and those of a step, of which the result is made
ENERGY_WEIGHT = 0.15  # Of the error of a photo's total light beside the pixels' likelihood
LEAST_PIXELS = 20.0  # A photo with fewer clipped values counts as if it had so many, and some not
USUAL_PIXELS = 800.0  # Clipped values of a photo that counts once
SHARING = 0.6  # 1: photos count alike; 0: clipped values do
SCALE_PHOTOS = 256  # On which the deviations are scaled


def pixel_loss(mean: Tensor, deviation: Tensor, photos: Photos) -> Tensor:
    """Return the negative log likelihood of the clipped values, the mean over photos, and the error of their light.

    A photo counts by the number of its clipped values to the power of 1 - SHARING.
    """
    clipped, truth = photos.clipped, photos.truth.clamp_max(STOPS)
    weight = clipped / clipped.sum((1, 2, 3), keepdim=True).clamp_min(LEAST_PIXELS) ** SHARING
    weight = weight * (USUAL_PIXELS ** (SHARING - 1))
    likelihood = 0.5 * ((truth - mean) / deviation).square() + deviation.log()
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
    begin: Path | None = None,
    rate: float = RATE,
    lit_rooms: LitRooms | None = None,
) -> LightNetwork:
    """Return a network trained on some panoramas and the rooms: the average of its last weights.

    Args:
        pack: of `read_pack`.
        chosen: indices of the panoramas.
        steps: the learning rate falls to 0 over them.
        seed: of every random number.
        device: "cpu", "cuda:0" ...
        begin: weights to go on from; None: random ones.
        rate: the largest learning rate.
        lit_rooms: rooms whose lamps are in view; None: LIT_ROOMS are rendered.
    """
    torch.manual_seed(seed)
    network = LightNetwork() if begin is None else copy.deepcopy(load_prior("cpu", begin).network)
    network = network.to(device).train()
    lit_rooms = lit_rooms or LitRooms(LIT_ROOMS, device, seed)
    families = Families(pack, device, chosen, rooms=True, seed=seed, lit_rooms=lit_rooms)
    matrices, vectors = ([p for p in network.parameters() if (p.ndim > 1) is matrix] for matrix in (True, False))
    groups = [{"params": matrices, "weight_decay": WEIGHT_DECAY}, {"params": vectors, "weight_decay": 0.0}]
    optimizer = torch.optim.AdamW(groups, rate)
    decay = max(0.0, min(AVERAGE, 1 - 10 / steps))
    average = torch.optim.swa_utils.AveragedModel(
        network, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(decay)
    )
    started, batches = time.perf_counter(), []
    for step in range(steps):
        batches = batches or families.take(BATCH, AT_ONCE)
        photos = batches.pop()
        for group in optimizer.param_groups:
            group["lr"] = rate * min(1.0, (step + 1) / WARM_UP) * (0.5 + 0.5 * np.cos(np.pi * step / steps))
        mean, deviation = network(network_input(photos.exposure, photos.clipped))
        loss = pixel_loss(mean, deviation, photos)
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


def main(
    pack: Path,
    /,
    out: Path,
    steps: int = STEPS,
    seed: int = 0,
    device: str = DEVICE,
    begin: Path | None = None,
    rate: float = RATE,
    judged: Annotated[bool, tyro.conf.arg(name="judge")] = False,
    deviation_scale: float = 1.0,
) -> None:
    """Train, judge if asked to, and write the weights.

    Args:
        pack: the panoramas, see priors.pack.
        out: file of the weights.
        steps: of the training.
        seed: of all random numbers.
        device: cpu or cuda:N.
        begin: go on from these weights.
        rate: largest learning rate.
        judged: leave out the held-out panoramas and judge on them.
        deviation_scale: of a judged run, for one on all panoramas.
    """
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    torch.use_deterministic_algorithms(True, warn_only=True)
    packed = read_pack(pack)
    chosen = np.flatnonzero(~packed.held_out) if judged else np.arange(len(packed.panoramas))
    network = train(packed, chosen, steps=steps, seed=seed, device=device, begin=begin, rate=rate).eval()
    scale, unseen = deviation_scale, np.flatnonzero(packed.held_out)
    if judged:
        # Halves: on one the deviations are scaled, on the other all is judged.
        scale = fit_scale(network, packed, unseen[::2], seed=1, device=device)
    tensors = {name: value.detach().half().cpu().contiguous() for name, value in network.state_dict().items()}
    out.parent.mkdir(parents=True, exist_ok=True)
    save_file(tensors, out, {"deviation_scale": f"{scale:.4f}"})
    if judged:
        figures = judge(network, scale, packed, unseen, chosen, seed=2, device=device)
        out.with_suffix(".json").write_text(json.dumps(figures))
        print(json.dumps(figures))


if __name__ == "__main__":
    run(main)
