"""Errors of public operations for arguments that do not fit: one line with the argument's name and what it takes.

Nothing here waits for a GPU: values are looked at on the CPU alone.
"""

import math
import operator
from collections.abc import Callable, Sequence
from numbers import Real
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch._subclasses import FakeTensor

DEVICES = "cpu", "cuda"
SINGULAR = 1e-9  # Least determinant of a camera's rotation, relative to the cube of its largest number


def check_tensors(**arguments: tuple[Any, tuple[int | str, ...]]) -> None:
    """Raise TypeError for an argument that is not a tensor, and ValueError for a wrong shape, dtype or device.

    dtypes are float32 or float64, the same as the first argument's, and so are devices.

    Args:
        **arguments: by name, the value and its shape, in which a letter stands for the size of the first tensor that
            has it.
    """
    sizes: dict[str, int] = {}
    first_name, (first, _) = next(iter(arguments.items()))
    for name, (value, shape) in arguments.items():
        if not isinstance(value, Tensor):
            kind = f"{type(value).__module__.split('.')[0]}.{type(value).__name__}".removeprefix("builtins.")
            raise TypeError(f"{name} is a {kind}, expected a torch tensor [{', '.join(map(str, shape))}]")
        fits = value.ndim == len(shape)
        if fits:
            for size, expected in zip(value.shape, shape, strict=True):
                if size != expected and (isinstance(expected, int) or sizes.setdefault(expected, size) != size):
                    fits = False
        if not fits:
            expected = f"[{', '.join(map(str, shape))}]"
            sizes_text = ", ".join(f"{n} = {sizes[n]}" for n in shape if isinstance(n, str) and n in sizes)
            expected += f" with {sizes_text}" if sizes_text else ": fx, fy, cx, cy" * (name == "intrinsics")
            raise ValueError(f"{name} has shape {list(value.shape)}, expected {expected}")
        if value.layout != torch.strided:
            raise ValueError(f"{name} is a tensor of layout {value.layout}, expected a dense one; use to_dense()")
        if value.dtype not in (torch.float32, torch.float64):
            raise ValueError(f"{name} is {value.dtype}, expected torch.float32 or torch.float64")
        if value.dtype != first.dtype or value.device != first.device:
            other = f"{first_name} is {first.dtype} on {first.device}"
            raise ValueError(f"{name} is {value.dtype} on {value.device}, but {other}")
    if first.device.type not in DEVICES:
        raise ValueError(f"{first_name} is on {first.device}, expected the CPU or a CUDA device")


def check_shape(name: str, value: Any, shape: Sequence[int]) -> None:
    """Raise TypeError or ValueError if a value is not a tensor of this shape, of any dtype."""
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} is a {type(value).__name__}, expected a tensor {list(shape)}")
    if value.shape != torch.Size(shape):
        raise ValueError(f"{name} has shape {list(value.shape)}, expected {list(shape)}")


def integer(name: str, value: Any, least: int, most: int) -> int:
    """Return the value as an int; raise TypeError for another kind of number, ValueError for one out of range."""
    try:
        if isinstance(value, bool):
            raise TypeError
        number = operator.index(value)
    except TypeError:
        raise TypeError(f"{name} is {value!r:.60}, expected a whole number") from None
    if not least <= number <= most:
        raise ValueError(f"{name} {number} is not in {least}..{most}")
    return number


def real(name: str, value: Any, accepts: Callable[[float], bool], expected: str) -> float:
    """Return the value as a float; raise TypeError for what is not a number, ValueError for one that is not accepted.

    expected: what accepts() does, as in "a positive number".
    """
    if not isinstance(value, Real):
        raise TypeError(f"{name} is {value!r:.60}, expected a number")
    if not accepts(number := float(value)):
        raise ValueError(f"{name} {value} is not {expected}")
    return number


def is_positive(number: float) -> bool:
    """Return whether a number is above 0 and finite."""
    return 0.0 < number < math.inf


def is_not_negative(number: float) -> bool:
    """Return whether a number is 0 or more, and finite."""
    return 0.0 <= number < math.inf


def boolean(name: str, value: Any) -> bool:
    """Return Python's or NumPy's bool as Python's; raise TypeError for another type."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} is {value!r:.60}, expected True or False")
    return bool(value)


def check_render_options(near_plane: Any, alpha_threshold: Any) -> None:
    """Raise TypeError or ValueError for options of a render that are of another type or out of range."""
    real("near_plane", near_plane, is_positive, "a positive number")
    # A float32 below 1e-37 is less exact than others, and soon 0.
    real("alpha_threshold", alpha_threshold, lambda number: 1e-37 < number < 1.0, "between 1e-37 and 1")


def check_memory(**tensors: Tensor) -> None:
    """Raise TypeError for tensors without memory, as FakeTensor and DTensor."""
    for name, tensor in tensors.items():
        # Torch warns where the address of a FakeTensor is read.
        if isinstance(tensor, FakeTensor) or (tensor.numel() and not tensor.data_ptr()):
            raise TypeError(f"{name} is a {type(tensor).__name__}, which has no memory; pass a plain tensor")


def check_channels(features: Tensor) -> None:
    """Raise ValueError for features [N, C] without a channel."""
    if not features.shape[-1]:
        raise ValueError(f"features has shape {list(features.shape)}, expected [N, C] with C >= 1")


def check_opacities(opacities: Tensor) -> None:
    """Raise ValueError for opacities on the CPU that are finite and outside of [0, 1], TypeError without memory."""
    check_memory(opacities=opacities)
    if opacities.device.type == "cpu" and opacities.numel():
        values = opacities.detach()
        low, high = (float(value) for value in values.aminmax())
        if not (math.isfinite(low) and math.isfinite(high)):
            finite = values[values.isfinite()]
            low, high = (float(value) for value in finite.aminmax()) if len(finite) else (0.0, 0.0)
        if low < -1e-6 or high > 1 + 1e-6:
            raise ValueError(f"opacities are from {low:g} to {high:g}, expected 0 to 1; give logits through a sigmoid")


def check_position(position: Tensor) -> None:
    """Raise ValueError for a position [3] on the CPU that is not finite."""
    if position.device.type == "cpu" and not all(map(math.isfinite, numbers := position.detach().tolist())):
        raise ValueError(f"position is {numbers}, expected finite numbers")


def check_matrices(**matrices: Tensor) -> None:
    """Raise ValueError for matrices [..., M, M] on the CPU that are not finite, with the index of the first."""
    for name, tensor in matrices.items():
        if tensor.device.type == "cpu" and not (finite := tensor.detach().isfinite().all(-1).all(-1)).all():
            index = ", ".join(map(str, (~finite).nonzero()[0].tolist()))
            raise ValueError(f"{name}[{index}] has a number that is not finite, expected finite numbers")


def check_order_axis(axis: Tensor) -> None:
    """Raise ValueError for an axis [3] on the CPU that has no direction."""
    if axis.device.type == "cpu" and not (all(map(math.isfinite, numbers := axis.detach().tolist())) and any(numbers)):
        raise ValueError(f"order_axis is {numbers}, expected finite numbers that are not all 0")


def check_directions(directions: Tensor) -> None:
    """Raise ValueError for directions [..., 3] that require a gradient, or on the CPU are not finite unit vectors."""
    if directions.requires_grad and torch.is_grad_enabled():
        raise ValueError("directions requires a gradient, which is not computed; pass directions.detach()")
    check_unit_vectors("directions", directions)


def check_unit_vectors(name: str, vectors: Tensor) -> None:
    """Raise ValueError for vectors [..., 3], at least one, on the CPU that are not finite and of length 1."""
    if vectors.device.type == "cpu":
        low, high = (float(length) for length in vectors.detach().norm(dim=-1).aminmax())
        if not (low > 0.99 and high < 1.01):
            raise ValueError(f"{name} have lengths from {low:g} to {high:g}, expected unit vectors")


def is_angle(number: float) -> bool:
    """Return whether a number can be the angle of a pixel, in radians."""
    return 0.0 <= number <= 2 * math.pi


def check_cameras(world_to_camera: Tensor, intrinsics: Tensor) -> None:
    """Raise ValueError for a CPU camera that is not finite or invertible, is transposed, or has no focal length."""
    if world_to_camera.device.type != "cpu":
        return
    lenses, poses = intrinsics.detach().reshape(-1, 4).tolist(), world_to_camera.detach().reshape(-1, 16).tolist()
    for fx, fy, cx, cy in lenses:
        if not (0.0 < fx < math.inf and 0.0 < fy < math.inf and math.isfinite(cx + cy)):
            raise ValueError(
                f"intrinsics are fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g}, expected finite numbers and fx, fy above 0"
            )
    for pose in poses:
        if not all(map(math.isfinite, pose)):
            raise ValueError("world_to_camera has a number that is not finite, expected a rigid transformation")
        a, b, c, _, d, e, f, _, g, h, i, _, *last = pose
        determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
        if abs(determinant) <= SINGULAR * max(map(abs, (a, b, c, d, e, f, g, h, i))) ** 3:
            raise ValueError(
                f"world_to_camera has a 3 x 3 part of determinant {determinant:g}, expected a rotation; "
                "is it the matrix from world to camera?"
            )
        if math.dist(last, (0.0, 0.0, 0.0, 1.0)) > 1e-3:
            raise ValueError(f"world_to_camera has the last row {last}, expected [0, 0, 0, 1]; is it transposed?")
