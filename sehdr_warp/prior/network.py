"""The network that estimates how much light clipped pixels hold."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

WIDTH = 20  # Channels of the first level
LEVELS = 4  # Halvings of the picture
DARKEST = -12.0  # log2 of exposure over white below which pixels look alike to the network
STOPS = 12.0  # Largest log2 excess that the network is trained on
LEAST_DEVIATION = 0.05  # Stops
INPUTS = 6
DROPOUT = 0.25  # Share of the channels of the coarsest level that a step of the training leaves out


class LightNetwork(nn.Module):
    """Estimate the log2 excess of clipped pixels over white, with a deviation, by a small U-Net.

    The input is what `network_input` returns. The mean over the whole picture is added at the coarsest level, because
    the exposure of a picture is correlated with its lights.
    """

    def __init__(self, width: int = WIDTH):
        """Make the layers; width: channels of the first level."""
        super().__init__()
        widths = [width * min(2**level, 4) for level in range(LEVELS)]
        self.down = nn.ModuleList(_Block(a, b) for a, b in zip([INPUTS, *widths], widths, strict=False))
        self.middle = _Block(widths[-1], widths[-1])
        below = [widths[-1], *widths[:0:-1]]
        self.up = nn.ModuleList(_Block(a + b, b) for a, b in zip(below, reversed(widths), strict=True))
        self.out = nn.Conv2d(widths[0], 6, 1)
        nn.init.zeros_(self.out.weight)
        nn.init.constant_(self.out.bias, 0.5)  # pyright: ignore[reportArgumentType]

    def forward(self, pictures: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean and the deviation of log2 excess over white.

        Args:
            pictures: [B, 6, H, W] of `network_input`.

        Returns:
            Two tensors [B, 3, H, W] in stops: a mean of at least 0, and a deviation of at least LEAST_DEVIATION.
        """
        height, width = pictures.shape[2:]
        step = 2**LEVELS
        x = F.pad(pictures, (0, -width % step, 0, -height % step), mode="replicate")
        levels = []
        for block in self.down:
            x = block(x)
            levels.append(x)
            x = F.avg_pool2d(x, 2)
        x = self.middle(F.dropout2d(x + x.mean((2, 3), keepdim=True), DROPOUT, self.training))
        x = F.dropout2d(x, DROPOUT, self.training)
        for block in self.up:
            across = levels.pop()
            x = block(torch.cat([F.interpolate(x, size=across.shape[2:], mode="nearest"), across], 1))
        mean, deviation = F.softplus(self.out(x)[..., :height, :width]).split(3, dim=1)
        return mean, deviation + LEAST_DEVIATION


class _Block(nn.Module):
    """Two convolutions with a normalisation of groups of channels between them."""

    def __init__(self, inputs: int, outputs: int):
        """Make the layers; inputs, outputs: channels."""
        super().__init__()
        self.first = nn.Conv2d(inputs, outputs, 3, padding=1)
        self.norm = nn.GroupNorm(4, outputs)
        self.second = nn.Conv2d(outputs, outputs, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Return the features of [B, inputs, H, W] as [B, outputs, H, W]."""
        return F.silu(self.second(F.silu(self.norm(self.first(x)))))


def network_input(exposure: Tensor, clipped: Tensor) -> Tensor:
    """Return what the network sees of pictures.

    Args:
        exposure: [B, 3, H, W], decoded, in units of the exposure that a picture shows as white.
        clipped: [B, 3, H, W], the share in [0, 1] of each value that is clipped.

    Returns:
        [B, 6, H, W]: scaled logarithms of the exposure, and the share.
    """
    logarithms = exposure.clamp_min(2.0**DARKEST).log2().clamp_max(0.0)
    return torch.cat([logarithms / 4 + 1, clipped], 1)
