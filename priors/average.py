"""Average weights of the prior, which went on from the same weights.

`python -m priors.average OUT A.safetensors=0.7 B.safetensors=0.3`; shares are divided by their sum.
"""

from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import save_file

from benchmarks.study import run
from sehdr_warp.errors import UsageError


def average(weights: dict[Path, float], out: Path) -> None:
    """Write the mean of weights files, deviation scales included, by their shares of the sum of the values."""
    total, scale = sum(weights.values()), 0.0
    mean: dict[str, torch.Tensor] = {}
    for path, share in weights.items():
        with safe_open(path, "pt") as file:
            scale += share / total * float(file.metadata()["deviation_scale"])
            for name in file.keys():  # noqa: SIM118 (no mapping)
                mean[name] = mean.get(name, 0) + share / total * file.get_tensor(name).float()
    tensors = {name: values.half().contiguous() for name, values in mean.items()}
    save_file(tensors, out, {"deviation_scale": f"{scale:.4f}"})


def main(out: Path, weights: tuple[str, ...], /) -> None:
    """Average weights of the prior, which went on from the same weights.

    Args:
        out: the file to write.
        weights: FILE=SHARE of each; shares are divided by their sum.
    """
    if not weights:
        raise UsageError("no weights; name some as FILE=SHARE")
    pairs = [each.rpartition("=") for each in weights]
    average({Path(path): float(share) for path, _, share in pairs}, out)


if __name__ == "__main__":
    run(main)
