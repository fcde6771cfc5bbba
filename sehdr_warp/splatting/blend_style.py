"""How exactly the blend computes, where exactness can be traded for speed."""

from dataclasses import dataclass

from ..kernels.constants import EXPONENTIAL_DEGREE, TRANSMITTANCE_MIN


@dataclass(frozen=True)
class BlendStyle:
    """Each value is part of the kernels' code: another one compiles another kernel.

    transmittance_min: a pixel is finished before its transmittance would fall to this value; 0 never stops.
    fast_math: CUDA, float32: approximate division and exponential.
    deterministic: CUDA: gradients are summed in a fixed order, so that the same input gives the same bits; slower, and
        the gradients of every (Gaussian, tile) pair take memory. The CPU always sums in a fixed order.
    exponential_degree: CPU, float32: of the polynomial behind the exponential, 3 to 5.
    """

    transmittance_min: float = TRANSMITTANCE_MIN
    fast_math: bool = True
    deterministic: bool = False
    exponential_degree: int = EXPONENTIAL_DEGREE


DEFAULT_STYLE = BlendStyle()
