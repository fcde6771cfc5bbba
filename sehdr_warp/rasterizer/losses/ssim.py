"""Structural similarity of two images as a differentiable torch operation (kernels/ssim.py, kernels/ssim_cuda.py)."""

from functools import partial

import torch
from torch import Tensor

from ...kernels.ssim import RADIUS, ssim_kernels, window
from ...kernels.ssim_cuda import ssim_patch_kernels
from ..checks import check_memory, check_tensors
from ..gradients import constant, unit_gradient
from ..torch_contract import once_differentiable, torch_operation
from ..warp_launch.launching import launch, warp_scalar
from . import patches

CPU_LANES = 16  # Numbers that one step of the CPU kernels takes: one AVX-512 register of float32
STEPS_PER_THREAD = 1024  # Smallest share of such steps that is worth handing to another thread: about 0.1 ms of work


@partial(torch_operation, compiles=True)
def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Return the mean structural similarity (Wang et al. 2004): 11 x 11 Gaussian window, sigma 1.5, data range 1.

    Beyond the border both images count as zero and every pixel is averaged, as in 3DGS's loss.

    Args:
        a: [H, W, C] float32 or float64, any size from 1 x 1 x 1.
        b: likewise, on the same device.

    Returns:
        A scalar of the same type, at most 1, differentiable once with respect to both images, the same whatever the
        number of threads.

    Raises:
        TypeError: for what is not a tensor.
        ValueError: if shapes, types or devices differ or are others.
    """
    return _Similarity.apply(a, b, True)


@partial(torch_operation, compiles=True)
def ssim_map(a: Tensor, b: Tensor) -> Tensor:
    """Return the [H, W, C] values whose mean is ssim(a, b); same arguments, same errors, differentiable as well."""
    return _Similarity.apply(a, b, False)


def image_distance(a: Tensor, b: Tensor, distance_weight: float, dissimilarity_weight: float) -> Tensor:
    """Return distance_weight mean |a - b| + dissimilarity_weight (1 - ssim(a, b)), a scalar.

    Takes one launch more than ssim(). Differentiable once with respect to a. a, b: as of ssim(), with its errors.
    """
    _check(a, b)
    other, weights = b.detach().contiguous(), (distance_weight, dissimilarity_weight)
    return patches.loss_of(a, lambda image, needs_gradient: distance_terms(image, other, *weights, needs_gradient))


def distance_terms(
    a: Tensor,
    b: Tensor,
    distance_weight: float,
    dissimilarity_weight: float,
    needs_gradient: bool,
    slopes: Tensor | None = None,
) -> tuple[Tensor, Tensor | None]:
    """Return the terms whose total() is image_distance() of contiguous images, and if needs_gradient their derivatives.

    Derivatives [H, W, C] are with respect to the variable of which `a` has the slopes, or to `a` itself.
    """
    weights = distance_weight / a.numel(), dissimilarity_weight / a.numel()
    terms, derivatives = _compare(a, b, weights)
    # Made at once: it takes a fifth of the memory of what it is made of.
    return terms, _gradient(a, b, derivatives, unit_gradient(a), weights, slopes) if needs_gradient else None


class _Similarity(torch.autograd.Function):
    @staticmethod
    def forward(ctx, a, b, mean):
        _check(a, b)
        similarity, derivatives = _compare(a.detach().contiguous(), b.detach().contiguous())
        ctx.save_for_backward(a, b, derivatives)
        ctx.mean = mean
        # Sums within rows first: each is one thread's work, so the order of the additions is fixed.
        return similarity.flatten(1).sum(1).sum() / similarity.numel() if mean else similarity

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream):
        a, b, derivatives = ctx.saved_tensors
        a, b = a.contiguous(), b.contiguous()

        def gradient(x, y, derivatives):
            if ctx.mean:
                return _gradient(x, y, derivatives, upstream / x.numel())
            return _gradient(x, y, derivatives * upstream.reshape(derivatives.shape[1:]), upstream.new_ones(()))

        for_a = gradient(a, b, derivatives) if ctx.needs_input_grad[0] else None
        # Similarity is symmetric: b's derivatives are those of the exchanged comparison.
        for_b = gradient(b, a, _compare(b, a)[1]) if ctx.needs_input_grad[1] else None
        return for_a, for_b, None


def _check(a: Tensor, b: Tensor) -> None:
    check_tensors(a=(a, ("H", "W", "C")), b=(b, ("H", "W", "C")))
    check_memory(a=a, b=b)
    if not a.numel():
        raise ValueError(f"a has shape {list(a.shape)}, expected [H, W, C] with a pixel at least")


def _compare(a: Tensor, b: Tensor, weights: tuple[float, float] | None = None) -> tuple[Tensor, Tensor]:
    """Return the similarity [H, W, C] and its derivatives [3, H, W C] with respect to the moments.

    weights: of |a - b| and of the dissimilarity; if given, the terms of their sum take the place of the similarity.
    """
    values = torch.empty_like(a) if weights is None else patches.new_terms(a)
    derivatives = a.new_empty(3, a.shape[0], a.shape[1] * a.shape[2])
    if patches.in_patches(a.device):
        results = (None, values) if weights else (values.flatten(1), None)
        arguments = a.flatten(1), b.flatten(1), *(weights or (0.0, 0.0)), *results, derivatives
        _launch_patches("compare", a, weights, *arguments)
    else:
        runs = _Runs(a, weights is not None)
        moments, images = runs.view(runs.padded(4)), (runs.view(a), runs.view(b))
        runs.launch(runs.kernels.blur_columns, images, [moments])
        compared = *images, *(weights or (0.0, 0.0)), runs.view(values), runs.view(derivatives)
        runs.launch(runs.kernels.compare, [moments], compared)
    return values, derivatives


def _gradient(
    a, b, derivatives, scale: Tensor, weights: tuple[float, float] | None = None, slopes: Tensor | None = None
) -> Tensor:
    """Return scale, and with weights slopes, times the gradient of the sum of _compare()'s values with respect to a."""
    result = torch.empty_like(a)
    if patches.in_patches(a.device):
        inputs = derivatives, a.flatten(1), b.flatten(1), scale, None if slopes is None else slopes.flatten(1)
        arguments = *inputs, *(weights or (0.0, 0.0)), result.flatten(1)
        _launch_patches("gradient", a, weights, *arguments)
    else:
        runs = _Runs(a, weights is not None)
        blurred = runs.view(runs.padded(3))
        runs.launch(runs.kernels.blur_derivatives, [runs.view(derivatives)], [blurred])
        scaled = scale, None if slopes is None else runs.view(slopes), *(weights or (0.0, 0.0)), runs.view(result)
        runs.launch(runs.kernels.gradient, [blurred, runs.view(a), runs.view(b)], scaled)
    return result


def _launch_patches(name: str, image: Tensor, weights: tuple[float, float] | None, *arguments) -> None:
    kernel = getattr(ssim_patch_kernels(warp_scalar(image.dtype), weights is not None), name)
    taps = constant(tuple(window()), image.dtype, image.device)
    _, width, channels = image.shape
    patches.launch_patches(kernel, image, taps, width, channels, *arguments)


class _Runs:
    """One image size's launches: rows of W C numbers, taken `lanes` at a time."""

    def __init__(self, image: Tensor, distance: bool):
        self.rows, width, self.channels = image.shape
        self.length = width * self.channels
        self.like = image
        self.lanes = CPU_LANES if self.length >= CPU_LANES else 1
        self.kernels = ssim_kernels(warp_scalar(image.dtype), self.lanes, distance)
        self.taps = constant(tuple(window()), image.dtype, image.device)

    def padded(self, count: int) -> Tensor:
        """Return [count, rows, ...] uninitialized rows between the zeros that the blur finds beyond the border."""
        margin = RADIUS * self.channels
        buffer = self.like.new_empty(count, self.rows, self.length + 2 * margin)
        buffer[..., :margin] = 0
        buffer[..., -margin:] = 0
        return buffer

    def view(self, tensor: Tensor) -> Tensor:
        """Return a contiguous image [H, W, C] or stack of rows [..., H, n] as overlapping runs."""
        rows = tensor.shape[:1] if tensor.shape == self.like.shape else tensor.shape[:-1]
        length = tensor.numel() // rows.numel()
        strides = (length,) if len(rows) == 1 else (rows[1] * length, length)
        return tensor.as_strided((*rows, length - self.lanes + 1, self.lanes), (*strides, 1, 1))

    def launch(self, kernel, inputs, results) -> None:
        """Launch a kernel over the whole image."""
        arguments = *inputs, self.taps, self.length, self.channels, *results
        launch(kernel, self.rows * -(-self.length // self.lanes), *arguments, min_range=STEPS_PER_THREAD)
