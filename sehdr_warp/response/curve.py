"""Camera response: the interface and the differentiation that every curve shares."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property, wraps
from typing import Any, ClassVar, Protocol, TypeAlias, cast, overload

import numpy as np
import torch

from ..errors import SehdrError
from ..json_values import damage

HALF_CODE = 0.5 / 255  # An encoded value nearer to white than this is stored as 255
# Rise of encode_extended beyond the clip point for each factor of e in exposure: a tenth of a gamma curve's just below
# white, enough for a gradient.
EXTENSION_SLOPE = 0.05
START_FLOOR = 1e-6
Numbers: TypeAlias = np.ndarray | float | Sequence[Any]  # Values that can be turned into an array


class _OfNumbers(Protocol):
    """A method of tensors that takes other numbers, too."""

    @overload
    def __call__(self, numbers: torch.Tensor, /) -> torch.Tensor: ...

    @overload
    def __call__(self, numbers: Numbers, /) -> np.ndarray: ...


def _for_arrays(method: Callable[[Any, torch.Tensor], torch.Tensor]) -> _OfNumbers:
    """Let a method of tensors, float32 or float64, take what can be turned into an array, and return an array then."""

    @wraps(method)
    def call(self: "Response", numbers: torch.Tensor | Numbers) -> torch.Tensor | np.ndarray:
        if isinstance(numbers, torch.Tensor):
            if numbers.dtype not in (torch.float32, torch.float64):
                raise TypeError(f"a response takes float32 or float64 tensors, not {numbers.dtype}")
            return method(self, numbers)
        array = np.asarray(numbers)
        if array.dtype in (np.uint8, np.uint16):
            raise TypeError(f"a response takes floats, not {array.dtype}; divide codes by {np.iinfo(array.dtype).max}")
        if array.dtype.kind not in "fiub":
            raise TypeError(f"a response takes numbers, not {array.dtype}")
        if array.dtype.kind in "iu" and method.__name__ == "decode" and array.max(initial=0) > 1:
            raise TypeError(f"a response decodes values from 0 to 1, not {array.max()}; divide codes by 255")
        if array.dtype not in (np.float32, np.float64):
            array = array.astype(np.float32 if array.dtype == np.float16 else np.float64)
        # A copy: a negative stride or a read-only array is not a tensor.
        return method(self, torch.from_numpy(np.array(array, order="C"))).numpy()

    return cast(Any, call)


class Response(ABC):
    """A camera response function f: exposure x = E dt >= 0 to encoded value in [0, 1], increasing unless it is learned.

    Sources: SeHDR, Eq. 1 (Z = f(E dt)); Grossberg and Nayar 2004 for the normalization of tabulated curves.

    encode, encode_extended and decode take a torch tensor (float32 or float64, any shape, any device; differentiable
    once) and return one like it, or a NumPy array or number and return a NumPy array. NaN stays NaN.

    Attributes:
        name: what response_by_name takes, or the curve's source.
        black: f(0), in [0, 1).
        peak: the largest value that the curve takes or approaches, at most 1.
        clip_exposure: the smallest exposure with f = peak; infinity for a curve that only approaches it.
        notes: one line each on what was repaired in measured samples.
        learnable: whether it is an nn.Module that is trained with the scene, and can decode photos only after that.
    """

    name: str
    black: float
    peak: float
    clip_exposure: float
    notes: tuple[str, ...] = ()
    learnable: bool = False
    _kinds: ClassVar[dict[str, type["Response"]]] = {}

    def __init_subclass__(cls, *, kind: str | None = None, **options):
        """Register a subclass under the kind by which from_dict finds it."""
        super().__init_subclass__(**options)
        if kind is not None:
            Response._kinds[kind] = cls

    @abstractmethod
    def _encode(self, exposure: torch.Tensor, extension_slope: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Return f and its slope, which is 0 below 0, without autograd.

        Beyond the clip point extension_slope * log(x / clip) is added.
        """

    @abstractmethod
    def _invert(self, value: torch.Tensor) -> torch.Tensor:
        """Return the exposure for values within [black, peak), without autograd."""

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON that Response.from_dict turns back into the same curve."""

    @classmethod
    @abstractmethod
    def _from_dict(cls, values: dict[str, Any]) -> "Response": ...

    @staticmethod
    def from_dict(values: dict[str, Any]) -> "Response":
        """Return the curve that to_dict described.

        Raises:
            SehdrError: if the description is damaged or of an unknown kind.
        """
        kind = values.get("kind") if isinstance(values, dict) else None
        if not isinstance(kind, str) or kind not in Response._kinds:
            raise SehdrError(f"response: kind = {kind!r:.60} is not one of {', '.join(sorted(Response._kinds))}")
        try:
            return Response._kinds[kind]._from_dict(values)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise SehdrError(f"response: the stored {kind} curve is damaged ({damage(error)})") from error

    def start_exposures(self, encoded: np.ndarray) -> np.ndarray:
        """Return exposures above 0 for Gaussians to start from, of encoded values in (0, 1); float64 of one shape."""
        return np.maximum(self.decode(np.asarray(encoded, np.float64)), START_FLOOR)

    @property
    def clips(self) -> bool:
        """True if every exposure beyond some finite one gives the same value."""
        return math.isfinite(self.clip_exposure)

    @cached_property
    def white(self) -> float:
        """The smallest exposure that is stored as the brightest 8-bit code: f(white) = peak - 0.5/255."""
        return float(self._invert(torch.tensor(self.peak - HALF_CODE, dtype=torch.float64)))

    @_for_arrays
    def encode(self, exposure: torch.Tensor) -> torch.Tensor:
        """Return f(x) in [black, peak]; the gradient is 0 below exposure 0 and beyond the clip point."""
        return _Pointwise.apply(exposure, self._encode, 0.0)

    @_for_arrays
    def encode_extended(self, exposure: torch.Tensor) -> torch.Tensor:
        """Return f(x) up to the clip point, and f(clip) + EXTENSION_SLOPE log(x / clip) beyond it.

        The extension leaves a gradient and a surplus over 1 that a hinge can weigh. For a curve that never clips this
        equals encode.
        """
        return _Pointwise.apply(exposure, self._encode, EXTENSION_SLOPE)

    @_for_arrays
    def decode(self, value: torch.Tensor) -> torch.Tensor:
        """Return the exposure of a value, which is limited to [black, peak].

        decode(encode(x)) = x for x in [0, clip_exposure].

        A curve that only approaches its peak is inverted up to `white`, since the exact inverse of 1 is infinite.
        """
        return _Pointwise.apply(value, self._decode) if value.requires_grad else self._exposure_of(value)

    def rise(self, value: np.ndarray) -> np.ndarray:
        """Return the derivative d ln x / dz at values z in (black, peak) of exposures x, float64."""
        exposure = np.asarray(self.decode(value))
        return 1 / (exposure * np.maximum(np.asarray(self.slope(exposure)), 1e-9))

    @_for_arrays
    def slope(self, exposure: torch.Tensor) -> torch.Tensor:
        """Return df/dx of encode, shaped like the exposures and 0 beyond the clip point; it is not differentiable."""
        return self._encode(exposure.detach(), 0.0)[1]

    @property
    def _limit(self) -> float:
        return self.peak if self.clips else self.peak - HALF_CODE

    @torch.no_grad()
    def _exposure_of(self, value: torch.Tensor) -> torch.Tensor:
        return self._invert(value.clamp(self.black, self._limit)).clamp_max(self.clip_exposure)

    def _decode(self, value: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        exposure = self._exposure_of(value)
        _, slope = self._encode(exposure, 0.0)
        return exposure, torch.where((value < self.black) | (value > self._limit), 0.0, 1.0 / slope)

    def __repr__(self) -> str:
        """Return the class and name."""
        return f"{type(self).__name__}({self.name!r})"


class _Pointwise(torch.autograd.Function):
    """A function of each number by itself that gives values and slopes."""

    @staticmethod
    def forward(ctx, argument, function, *options):
        value, slope = function(argument, *options)
        ctx.save_for_backward(slope)
        return value

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient):
        (slope,) = ctx.saved_tensors
        return gradient * slope, None, None
