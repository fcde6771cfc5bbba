"""Train the prior for clipped light: `python -m priors.train PACK --out WEIGHTS`.

One run is deterministic on one machine. With --judge the held-out panoramas are left out, and the figures of the model
card are printed and written beside the weights.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor

from sehdr_warp.prior import load_prior
from sehdr_warp.prior.network import STOPS, WIDTH, LightNetwork, network_input

from .judge import judge
from .panoramas import Pack, read_pack
from .photos import Camera, Photos

BATCH = 32
RATE = 2e-3
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
    seconds: float,
    seed: int,
    device: str,
    begin: Path | None = None,
    batch: int = BATCH,
    rate: float = RATE,
) -> LightNetwork:
    """Return a network trained on some panoramas and the rooms.

    Args:
        pack: of `read_pack`.
        chosen: indices of the panoramas.
        steps: most steps; the learning rate follows one cycle over them.
        seconds: most seconds; the cycle is over by then too. Only 0 (no bound) is reproducible.
        seed: of every random number.
        device: "cpu", "cuda:0" ...
        begin: weights to go on from; None: random ones.
        batch: photos of a step.
        rate: the largest learning rate.
    """
    torch.manual_seed(seed)
    network = LightNetwork(WIDTH) if begin is None else load_prior("cpu", begin).network
    network = network.to(device).train().requires_grad_()
    camera = Camera(pack, device, chosen, rooms=True, seed=seed)
    optimizer = torch.optim.AdamW(network.parameters(), rate, weight_decay=1e-3)
    decay = min(0.998, 1 - 10 / steps)
    average = torch.optim.swa_utils.AveragedModel(
        network, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(decay)
    )
    warm_up = min(300, steps / 10)
    started = time.perf_counter()
    for step in range(steps):
        done = step / steps
        if seconds:
            done = max(done, (time.perf_counter() - started) / seconds)
        if done >= 1:
            break
        for group in optimizer.param_groups:
            group["lr"] = rate * min(1.0, step / warm_up + 0.05) * (0.5 + 0.5 * np.cos(np.pi * done))
        photos = camera.take(batch)
        loss = pixel_loss(*network(network_input(photos.exposure, photos.clipped)), photos)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        average.update_parameters(network)
        if step % 200 == 0 or step % (steps // 10) == 0:
            line = {
                "step": step,
                "loss": round(float(loss.detach()), 4),
                "seconds": round(time.perf_counter() - started, 1),
            }
            print(json.dumps(line), flush=True)
    return average.module


def fit_scale(network: LightNetwork, pack: Pack, chosen: np.ndarray, *, seed: int, device: str) -> float:
    """Return the factor of the deviations at which 68 % of clipped values lie within one, on photos of panoramas."""
    camera, parts = Camera(pack, device, chosen, rooms=False, seed=seed), []
    with torch.no_grad():
        for _ in range(SCALE_PHOTOS // BATCH):
            photos = camera.take(BATCH, 96)
            mean, deviation = network(network_input(photos.exposure, photos.clipped))
            off = ((photos.truth - mean).abs() / deviation)[photos.clipped > 0]
            parts.append(off[torch.randperm(len(off), device=off.device)[:4000]].cpu())
    return float(torch.cat(parts).quantile(0.683))


def main() -> None:
    """Train, judge where asked to, and write the weights."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pack", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=9000)
    parser.add_argument("--seconds", type=float, default=0.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--begin", type=Path, help="go on from these weights")
    parser.add_argument("--batch", type=int, default=BATCH, help="photos of a step")
    parser.add_argument("--rate", type=float, default=RATE, help="largest learning rate")
    parser.add_argument("--judge", action="store_true", help="leave out the held-out panoramas and judge on them")
    parser.add_argument("--deviation-scale", type=float, default=1.0, help="of a judged run, for one on all panoramas")
    args = parser.parse_args()
    torch.use_deterministic_algorithms(True, warn_only=True)
    pack = read_pack(args.pack)
    chosen = np.flatnonzero(~pack.held_out) if args.judge else np.arange(len(pack.panoramas))
    names = "steps", "seconds", "seed", "device", "begin", "batch", "rate"
    options = {name: getattr(args, name) for name in names}
    network = train(pack, chosen, **options).eval()
    scale, unseen = args.deviation_scale, np.flatnonzero(pack.held_out)
    if args.judge:
        # Halves: on one the deviations are scaled, on the other all is judged.
        scale = fit_scale(network, pack, unseen[::2], seed=1, device=args.device)
    tensors = {name: value.detach().half().cpu().contiguous() for name, value in network.state_dict().items()}
    args.out.parent.mkdir(parents=True, exist_ok=True)
    save_file(tensors, args.out, {"deviation_scale": f"{scale:.4f}"})
    if args.judge:
        figures = judge(network, scale, pack, unseen, chosen, seed=2, device=args.device)
        args.out.with_suffix(".json").write_text(json.dumps(figures))
        print(json.dumps(figures))


if __name__ == "__main__":
    main()
