"""LPIPS v0.1 (Zhang et al. 2018) on SqueezeNet 1.1 features, with weights from a folder.

The folder is an argument or the environment variable SEHDR_LPIPS. It holds `squeeze.pth` (the v0.1 linear heads
of the lpips package) and SqueezeNet 1.1 as `squeezenet1_1_features.pth` (features only) or under torchvision's own name
`squeezenet1_1-*.pth`.
"""

import os
from pathlib import Path

import torch
from torch import Tensor, nn

from ..errors import InputError, path_of

VARIABLE = "SEHDR_LPIPS"
BACKBONE = "squeeze v0.1"
SMALLEST_EDGE = 17  # Pixels of the shortest edge for which the last pooling has an output
TAPS, WIDTHS = (1, 4, 7, 9, 10, 11, 12), (64, 128, 256, 384, 384, 512, 512)
"""Layers whose outputs are compared, and their channels."""
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # Normalisation of the input, as in the lpips package


class _Fire(nn.Module):
    """SqueezeNet's fire module (Iandola et al. 2016): 1 x 1 squeeze, then 1 x 1 and 3 x 3 expansions side by side."""

    def __init__(self, channels: int, squeezed: int, expanded: int):
        super().__init__()
        self.squeeze = nn.Conv2d(channels, squeezed, 1)
        self.expand1x1 = nn.Conv2d(squeezed, expanded, 1)
        self.expand3x3 = nn.Conv2d(squeezed, expanded, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Return the joined expansions."""
        x = self.squeeze(x).relu()
        return torch.cat([self.expand1x1(x).relu(), self.expand3x3(x).relu()], 1)


def squeezenet_features() -> nn.Sequential:
    """Return SqueezeNet 1.1 up to its last fire module, with layers numbered as in torchvision."""
    channels, layers = 64, [nn.Conv2d(3, 64, 3, stride=2), nn.ReLU()]
    for widths in ((64, 64), (128, 128), (192, 192, 256, 256)):  # Widths of the fire modules between two poolings.
        layers.append(nn.MaxPool2d(3, 2, ceil_mode=True))
        for width in widths:
            layers.append(_Fire(channels, width // 4, width))
            channels = 2 * width
    return nn.Sequential(*layers)


class Lpips:
    """The distance of two images: 0 for equal ones, larger for less similar ones."""

    def __init__(self, features: nn.Sequential, heads: list[Tensor], device: torch.device | str = "cpu"):
        """Take the backbone, and the weights of the channels of each tap, [C, 1, 1] each."""
        self.features = features.to(device).eval().requires_grad_(False)
        self.heads = [head.to(device) for head in heads]

    @torch.no_grad()
    def __call__(self, prediction: Tensor, truth: Tensor) -> float:
        """Return the distance of two images [H, W, 3] in [0, 1].

        Raises:
            ValueError: for images of different sizes, or with an edge below SMALLEST_EDGE.
        """
        if prediction.shape != truth.shape or min(prediction.shape[:2]) < SMALLEST_EDGE:
            raise ValueError(f"LPIPS takes two images of one size from {SMALLEST_EDGE} pixels on")
        pair = torch.stack([prediction, truth]).to(self.heads[0]).permute(0, 3, 1, 2)
        shift, scale = pair.new_tensor(SHIFT)[:, None, None], pair.new_tensor(SCALE)[:, None, None]
        x = (2 * pair - 1 - shift) / scale
        distance = 0.0
        for number, layer in enumerate(self.features):
            x = layer(x)
            if number in TAPS:
                unit = x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10)
                weighted = (unit[0] - unit[1]).square() * self.heads[TAPS.index(number)]
                distance += float(weighted.sum(0).mean())
        return distance


def load_lpips(folder: Path | str | None = None, device: torch.device | str = "cpu") -> tuple[Lpips | None, str | None]:
    """Load the weights.

    Args:
        folder: of the weights; by default the one of SEHDR_LPIPS.
        device: where distances are computed.

    Returns:
        The metric and None; or None and the reason if there are no weights.

    Raises:
        InputError: for a folder that does not exist, or a file that does not hold what its name says.
    """
    folder = folder or os.environ.get(VARIABLE)
    if not folder:
        return None, f"no LPIPS weights: set {VARIABLE} or name a folder with squeeze.pth and SqueezeNet 1.1"
    folder = path_of(folder, "lpips_weights")
    if not folder.is_dir():
        raise InputError(folder, "the folder of LPIPS weights does not exist", "name the folder that holds squeeze.pth")
    backbones = [*folder.glob("squeezenet1_1_features.pth"), *sorted(folder.glob("squeezenet1_1-*.pth"))]
    heads = folder / "squeeze.pth"
    if not backbones or not heads.is_file():
        missing = "squeeze.pth" if backbones else "a SqueezeNet 1.1 backbone (squeezenet1_1_features.pth)"
        return None, f"{folder} lacks {missing}"
    features, state = squeezenet_features(), _tensors(backbones[0])
    backbone = {name.removeprefix("features."): state[name] for name in state if not name.startswith("classifier.")}
    try:
        features.load_state_dict(backbone)
    except RuntimeError as error:
        raise InputError(backbones[0], "is not SqueezeNet 1.1", "take torchvision's squeezenet1_1 weights") from error
    state = _tensors(heads)
    linear = [state.get(f"lin{number}.model.1.weight", torch.zeros(0)) for number in range(len(WIDTHS))]
    if any(head.shape != (1, width, 1, 1) for head, width in zip(linear, WIDTHS)):
        raise InputError(heads, "does not hold the seven linear heads of LPIPS-squeeze", "take v0.1's squeeze.pth")
    return Lpips(features, [head[0].float() for head in linear], device), None


def _tensors(path: Path) -> dict[str, Tensor]:
    """Read a table of tensors; raise InputError for any other file."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)  # Plain tensors, which cannot run code.
    except Exception as error:  # torch reports damaged archives, pickles and missing files in many ways
        raise InputError(path, f"cannot be read as weights ({type(error).__name__})", "download it again") from error
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise InputError(path, "is not a table of tensors", "take the file of the lpips package or of torchvision")
    return state
