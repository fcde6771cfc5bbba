"""Target of a render: a photo's codes and HDR truth on the device, and the scale on which codes compare."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ..evaluation.metrics import psnr
from ..rasterizer.losses.code_residual import CodeScale, code_values
from ..response import Response

CODE = 1 / 255  # One step of an 8-bit photo
MU = 5000.0  # Parameter of the mu-law in which HDR images are compared
KNEE = 8.0  # Code of 255 above black at white / mu in the mu-law of photos, linear below and logarithmic above
GAIN_MAP_KNEE = 0.5  # The same exposure, where codes hold four stops more


@dataclass(frozen=True)
class Target:
    """One training photo on the device."""

    codes: Tensor  # [H, W, 3] as from code_tensor(); or, with an index, a stack [V, H, W, 3] that contains the photo
    scale: CodeScale  # Values and intervals that the codes stand for
    mask: Tensor | None = None  # [H, W, 1] in [0, 1]
    exposure_truth: Tensor | None = None  # [H, W, 3] radiance of HDR truth times the base time
    index: Tensor | None = None  # [1] int64, position of the photo in the stack
    estimates: Tensor | None = None  # [h, w, 6] of the light of clipped pixels, see ClippedLight.log_light

    @property
    def encoded(self) -> Tensor:
        """Encoded values [H, W, 3] in [0, 1], computed from the codes at each access."""
        return code_values(select_view(self.codes, self.index))

    def psnr(self, encoded: Tensor) -> float:
        """Return the PSNR of encoded values [H, W, 3] against the photo inside the mask, dB; NaN if it is empty."""
        return psnr(encoded.clamp(0, 1), self.encoded, None if self.mask is None else self.mask[..., 0])


def select_view(stack: Tensor, index: Tensor | None) -> Tensor:
    """Return a copy of element index [1] of a stack [V, ...], on its device; without an index the tensor itself."""
    return stack if index is None else stack.index_select(0, index)[0]


def code_scale(
    largest: int, response: Response | None, device, *, clipping: bool = True, dtype: torch.dtype = torch.float32
) -> CodeScale:
    """Return the scale on which a render is compared with codes: the mu-law of exposures, or encoded values.

    A code stands for a value on this scale: its encoded value, or the middle of the exposures that round to it. With
    `clipping`, the largest code stands for all values from white less half an 8-bit code, and 0 for all up to half a
    code. The half code, for 16 bits too, keeps a response that never quite reaches white from being pulled up.

    The exposures that round to a code near white may span stops. CodeScale.use_intervals() makes all of them equally
    good, less the finest 8-bit step at the ends, so that codes with finer intervals stay values.

    Args:
        largest: Largest code, 255 or 65535.
        response: Response that decodes codes to exposures; None to compare encoded values.
        device: Torch device of the tables.
        clipping: Treat the smallest and the largest code as intervals.
        dtype: Type of the tables.
    """
    mu, white = (0.0, 1.0) if response is None else (mu_of_knee(response), response.white)

    def to_scale(encoded: Tensor) -> Tensor:
        return encoded if response is None else mu_law(response.decode(encoded), white, mu)

    values = torch.arange(largest + 1, dtype=torch.float64) / largest
    centers, between = to_scale(values), to_scale(values[:-1] + 0.5 / largest)
    if response is not None:
        centers[1:-1] = (between[1:] + between[:-1]) / 2
    table, intervals = torch.stack([centers, centers, centers], 1), None
    if clipping:
        table[0, 1], table[-1, 2] = -math.inf, math.inf
        table[0, 2], table[-1, 1] = to_scale(values.new_tensor([CODE / 2, 1 - CODE / 2]))
        if response is not None:
            finest = to_scale((torch.arange(255) + 0.5).double() / 255).diff().min()
            ends = torch.stack([between[:-1] + finest, between[1:] - finest], 1)
            intervals = table.clone()
            intervals[1:-1, 1:] = torch.where(ends[:, :1] < ends[:, 1:], ends, table[1:-1, 1:])
            intervals = intervals.to(device, dtype)
    return CodeScale(table.to(device, dtype), mu, white, intervals)


def mu_of_knee(response: Response) -> float:
    """Return the mu whose knee, white / mu, is the exposure of code KNEE of 255 above black, for any response.

    Log curves have black at a tenth of their codes and more.
    """
    knee = GAIN_MAP_KNEE if response.name == "gain-map" else KNEE
    return response.white / max(float(response.decode(float(response.black) + knee / 255)), 1e-12)


def mu_law(exposure: Tensor, white: float, mu: float = MU) -> Tensor:
    """Return log(1 + mu x / white) / log(1 + mu): 0 for no light, 1 for the exposure that photos show as white."""
    return torch.log1p(exposure * (mu / white)) / math.log1p(mu)
