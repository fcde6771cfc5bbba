"""Warp programs as differentiable torch operations.

A *program* is a function that launches kernels on torch tensors and returns the tensors it wrote. `@differentiable`
turns it into a torch operation: data is shared, never copied; launches go to torch's current stream; the generated
adjoints of the kernels run when torch asks for gradients.

    @differentiable
    def scaled(program, values, *, gain):
        result = program.empty_output(values.shape)
        program.launch(scale, len(values), [values, gain], [result])
        return result

Positional arguments are tensors and take part in autograd; keyword arguments are passed on as they are.
"""

from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any, Concatenate, NamedTuple, ParamSpec, overload

import torch
from torch import Tensor

from .checks import DEVICES
from .gradients import kernel_layout
from .torch_contract import once_differentiable, torch_operation
from .warp_launch.launching import launch
from .warp_launch.packing import check_dimensions
from .warp_launch.threads import single_range

P = ParamSpec("P")


class _TensorIndex(int):
    """Index of a tensor among those of a program."""


class _Launch(NamedTuple):
    """A launch that the backward pass repeats as its adjoint; tensors stand as their indices."""

    kernel: Any
    dim: int | Sequence[int]
    inputs: list[Any]
    outputs: list[Any]


class Program:
    """Memory to write to and kernels to launch, as a program's first argument.

    Attributes:
        device: of the program's tensors.
    """

    def __init__(self, tensors: Sequence[Tensor], differentiable: bool) -> None:
        """Take a program's arguments; differentiable: keep what its backward pass needs."""
        self.device = tensors[0].device
        self._differentiable, self._launches = differentiable, list[_Launch]()
        self._tensors: list[Tensor] = []
        self._indices: dict[int, _TensorIndex] = {}
        self._written: set[int] = set()
        self._constant: set[int] = set()
        for tensor in tensors:
            self._index_of(tensor)

    def empty_output(
        self, shape: Sequence[int], dtype: torch.dtype = torch.float32, *, differentiable: bool = True
    ) -> Tensor:
        """Allocate a tensor for one launch to write to. A vector type's components are its last dimension."""
        tensor = torch.empty(tuple(shape), dtype=dtype, device=self.device)
        if self._differentiable:
            index = self._index_of(tensor)
            self._written.add(index)
            if not differentiable or not dtype.is_floating_point:
                self._constant.add(index)
        return tensor

    def launch(self, kernel: Any, dim: int | Sequence[int], inputs: Sequence[Any], outputs: Sequence[Any] = ()) -> None:
        """Launch a kernel on tensors in the place of its arrays; its generated adjoint runs in the backward pass.

        Gradients reach the program's arguments and what it wrote; other tensors are constants.

        A kernel whose first parameter is an integer `range_start` adds it to its thread index and writes only what
        belongs to that index. On the CPU it then runs in parallel over ranges of indices, and so does its adjoint,
        unless that adds to an input which indices share.

        Args:
            kernel: a Warp kernel, with backward enabled.
            dim: number of threads.
            inputs: the kernel's first arguments. A vector or matrix type takes up a tensor's last one or two
                dimensions.
            outputs: the kernel's last arguments, which it writes and does not read.

        Raises:
            TypeError: if a tensor's dtype or number of dimensions does not fit the kernel.
        """
        arguments = [*inputs, *outputs]
        check_dimensions(kernel, arguments)
        launch(kernel, dim, *arguments)
        if self._differentiable:
            indices = [[self._index_of(v) if isinstance(v, Tensor) else v for v in part] for part in (inputs, outputs)]
            self._launches.append(_Launch(kernel, dim, *indices))

    def _index_of(self, tensor: Tensor) -> _TensorIndex:
        """Return the tensor's index; one that is neither an argument nor written becomes a constant of the program."""
        index = self._indices.get(id(tensor))
        if index is None:
            index = self._indices[id(tensor)] = _TensorIndex(len(self._tensors))
            self._tensors.append(tensor)
        return index


class _ProgramFunction(torch.autograd.Function):
    @staticmethod
    def forward(ctx, body, options, *tensors):
        plain = tuple(tensor.detach() for tensor in tensors)
        program = Program(plain, True)
        result = body(program, *plain, **options)
        outputs = result if isinstance(result, tuple) else (result,)
        launches = program._launches
        tensors_of_program = *tensors, *program._tensors[len(tensors) :]
        indices = [program._indices.get(id(tensor), -1) for tensor in outputs]
        if not program._written.issuperset(indices):
            raise TypeError(f"{body.__name__}() returns what program.empty_output() did not make")
        # Torch makes this node the origin of what it returns; saved as well, neither would ever be freed.
        returned = tuple(tensor.detach() for tensor in outputs)
        ctx.mark_non_differentiable(
            *(t for t, index in zip(returned, indices, strict=True) if index in program._constant)
        )
        ctx.set_materialize_grads(False)
        read = {value for each in launches for value in each.inputs if isinstance(value, _TensorIndex)}
        ctx.save_for_backward(*(tensor if index in read else None for index, tensor in enumerate(tensors_of_program)))
        ctx.launches, ctx.indices = launches, indices
        ctx.argument_likes = [(tensor.shape, tensor.dtype) for tensor in plain]
        ctx.intermediates = (program._written - program._constant) & read
        return returned if isinstance(result, tuple) else returned[0]

    @staticmethod
    @once_differentiable
    def backward(ctx, *upstream):
        saved, needed = ctx.saved_tensors, ctx.needs_input_grad[2:]
        device = next((gradient.device for gradient in upstream if gradient is not None), None)
        if device is None:
            return (None,) * (2 + len(needed))
        gradients: dict[int, Any] = {index: torch.zeros_like(saved[index]) for index in ctx.intermediates}
        for index, (shape, dtype) in enumerate(ctx.argument_likes):
            if needed[index]:
                gradients[index] = torch.zeros(shape, dtype=dtype, device=device)
        for index, gradient in zip(ctx.indices, upstream, strict=True):
            if gradient is None:
                continue
            if index in gradients:  # The adjoint of a later launch adds to it, and torch's own must stay as it is.
                gradients[index] += gradient
            else:
                gradients[index] = kernel_layout(gradient)  # pyright: ignore[reportArgumentType]
        for each in reversed(ctx.launches):
            _launch_adjoint(each, saved, gradients)
        return None, None, *(gradients.get(index) if need else None for index, need in enumerate(needed))


def _launch_adjoint(forward: _Launch, saved: Sequence[Tensor | None], gradients: dict[int, Any]) -> None:
    kernel, dim, inputs, outputs = forward
    values: list[Any] = [saved[value] if isinstance(value, _TensorIndex) else value for value in inputs]
    grad_values = [gradients.get(v) if isinstance(v, _TensorIndex) else None for v in (*inputs, *outputs)]
    if all(gradient is None for gradient in grad_values):
        return
    pairs = zip(values, grad_values, strict=False)
    shared = any(gradient is not None and tensor is not None and len(tensor) != dim for tensor, gradient in pairs)
    ranges = single_range(dim) if shared and isinstance(dim, int) else None
    arguments = values + [None] * len(outputs)
    launch(kernel, dim, *arguments, gradients=grad_values, ranges=ranges)


@overload
def differentiable(body: Callable[Concatenate[Program, P], tuple[Tensor, ...]]) -> Callable[P, tuple[Tensor, ...]]: ...


@overload
def differentiable(body: Callable[Concatenate[Program, P], Tensor]) -> Callable[P, Tensor]: ...


def differentiable(body: Callable[..., Any]) -> Callable[..., Any]:
    """Make a torch operation of a program.

    The operation takes the tensors positionally (on one device) and the options by keyword, and returns the tensors
    that body returns. It can be differentiated once with respect to every positional tensor, also repeatedly through
    a retained graph; a tensor that is changed in place before that raises torch's own error.

    Args:
        body: body(program, *tensors, **options) -> tensors made by program.empty_output().

    Raises:
        TypeError: for what is not a function.
    """
    if not callable(body):
        raise TypeError(f"@differentiable takes a function of a program, not {body!r:.60}")

    @torch_operation
    @wraps(body)
    def operation(*tensors: Tensor, **options: Any) -> Any:
        _check_tensors(body, tensors)
        tensors = tuple(tensor.resolve_neg() for tensor in tensors)
        if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors):
            return _ProgramFunction.apply(body, options, *tensors)
        return body(Program(tensors, False), *tensors, **options)

    return operation


def _check_tensors(body: Callable[..., Any], tensors: Sequence[Any]) -> None:
    name = getattr(body, "__name__", "the operation")
    if not tensors:
        raise TypeError(f"{name}() got no tensor, expected at least one positional argument")
    for index, value in enumerate(tensors):
        if not isinstance(value, Tensor):
            raise TypeError(f"{name}(): argument {index} is a {type(value).__name__}, expected a torch tensor")
        if value.device != tensors[0].device:
            raise ValueError(
                f"{name}(): argument {index} is on {value.device}, but argument 0 is on {tensors[0].device}"
            )
    if tensors[0].device.type not in DEVICES:
        raise ValueError(f"{name}(): argument 0 is on {tensors[0].device}, expected the CPU or a CUDA device")
