"""Warp programs as differentiable torch operations: the one place where tapes meet autograd.

A *program* is a function that reads torch tensors as Warp arrays, launches kernels on a tape and returns the arrays
it wrote. `@differentiable` turns it into a torch operation: data is shared, never copied; launches go to torch's
current stream; the tape is replayed when torch asks for gradients, and not recorded when nobody will.

    @differentiable
    def scaled(program, values, *, gain):
        result = program.write(values.shape, wp.vec3)
        program.launch(scale, len(values), [program.read(values, wp.vec3), gain], [result])
        return result

Positional arguments are tensors and take part in autograd; keyword arguments are passed on as they are.
"""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import wraps
from typing import Any, Concatenate, ParamSpec, overload

import torch
import warp as wp
from torch import Tensor

from . import threads
from .launching import launch_ranges, parameters, torch_stream

P = ParamSpec("P")


class Program:
    """What a program sees while it runs: arrays over torch memory, and a tape that takes its launches."""

    def __init__(self, device: torch.device, recording: bool):
        self.device = wp.device_from_torch(device)
        self.torch_device = device
        self.tape = wp.Tape() if recording else None
        self.inputs: list[tuple[Tensor, wp.array]] = []
        self.outputs: dict[int, tuple[Tensor, wp.array, bool]] = {}

    def read(self, tensor: Tensor, dtype: Any = None) -> wp.array:
        """The tensor's memory as a Warp array; a vector or matrix dtype takes up the last one or two dimensions."""
        array = _array(tensor, dtype)
        self.inputs.append((tensor, array))
        return array

    def write(self, shape: Sequence[int], dtype: Any, *, differentiable: bool = True) -> wp.array:
        """A new array over torch memory. `shape` is the tensor's, with the components of a vector dtype last."""
        tensor = torch.empty(tuple(shape), dtype=_scalar(dtype), device=self.torch_device)
        array = _array(tensor, dtype)
        self.outputs[id(array)] = (tensor, array, differentiable)
        return array

    def launch(self, kernel: Any, dim: int | Sequence[int], inputs: Sequence[Any], outputs: Sequence[Any] = ()) -> None:
        """Launch a kernel; its generated adjoint runs in the backward pass.

        A kernel whose first parameter is an integer `first` adds it to its thread's index and writes only what belongs
        to that item: it is given the start of a range, and on the CPU ranges run side by side, adjoint too, but for an
        adjoint that adds to an input which items share.
        """
        ranged, _ = parameters(kernel)
        if ranged and self.device.is_cpu and isinstance(dim, int):
            self._launch_ranges(kernel, dim, [*inputs], [*outputs])
            return
        inputs = [0, *inputs] if ranged else [*inputs]
        with nullcontext() if self.tape is None else self.tape:
            wp.launch(kernel, dim, inputs, [*outputs], device=self.device)

    def _launch_ranges(self, kernel, count: int, inputs: list, outputs: list) -> None:
        arguments = [*inputs, *outputs]
        launch_ranges(kernel, threads.even_ranges(count), arguments)
        if self.tape is None:
            return

        # The tape holds the adjoint. If that held the program or the tape, memory would wait for the garbage collector.
        def adjoint() -> None:
            tape = wp.Tape()
            gradients = [tape.get_adjoint(argument) for argument in arguments]
            arrays = [argument for argument in inputs if isinstance(argument, wp.array) and argument.grad is not None]
            shared = any(array.shape[0] != count for array in arrays)
            ranges = [(0, count)] if shared or count == 0 else threads.even_ranges(count)
            by_inputs, by_outputs = [None, *gradients[: len(inputs)]], gradients[len(inputs) :]
            options = {"outputs": outputs, "adj_inputs": by_inputs, "adj_outputs": by_outputs, "adjoint": True}
            launch_ranges(kernel, ranges, inputs, **options)

        self.tape.record_func(adjoint, arrays=[])


def _scalar(dtype) -> torch.dtype:
    return dtype if isinstance(dtype, torch.dtype) else wp.dtype_to_torch(getattr(dtype, "_wp_scalar_type_", dtype))


def _array(tensor: Tensor, dtype=None) -> wp.array:
    dtype = None if isinstance(dtype, torch.dtype) else dtype
    tensor = tensor.detach()
    if tensor.is_contiguous():
        # torch leaves the stride of an axis of length 1 as it was; Warp wants an array's and its gradient's alike.
        tensor = tensor.view(-1).view(tensor.shape)
    return wp.from_torch(tensor, dtype=dtype, requires_grad=False)


def _zeros_like(tensors: list[Tensor]) -> list[Tensor]:
    """Contiguous zeros of the tensors' shapes; where all are of one type in one memory, filled by a single launch."""
    if len(tensors) < 2 or len({tensor.dtype for tensor in tensors}) > 1:
        return [torch.zeros_like(tensor, memory_format=torch.contiguous_format) for tensor in tensors]
    # Each starts at a multiple of 64 numbers, as memory of its own would.
    sizes = [tensor.numel() for tensor in tensors]
    rooms = [-(-size // 64) * 64 for size in sizes]
    parts = tensors[0].new_zeros(sum(rooms)).split(rooms)
    return [part[:size].view(tensor.shape) for part, size, tensor in zip(parts, sizes, tensors, strict=True)]


class _ProgramFunction(torch.autograd.Function):
    @staticmethod
    def forward(ctx, body, options, *tensors):
        device = tensors[0].device
        recording = any(ctx.needs_input_grad[2:])
        program = Program(device, recording)
        plain = tuple(tensor.detach() for tensor in tensors)
        with torch_stream(device):
            result = body(program, *plain, **options)
        arrays = result if isinstance(result, tuple) else (result,)
        outputs = tuple(program.outputs[id(array)][0] for array in arrays)
        ctx.mark_non_differentiable(
            *(tensor for tensor, array in zip(outputs, arrays, strict=True) if not program.outputs[id(array)][2])
        )
        # torch makes this node the outputs' origin: held here as well, neither would ever be freed.
        program.outputs = {key: (t.detach(), array, smooth) for key, (t, array, smooth) in program.outputs.items()}
        ctx.set_materialize_grads(False)
        if recording:
            # The tape holds the arrays, hence the memory, until torch frees this node.
            ctx.program, ctx.arrays, ctx.plain = program, arrays, plain
            ctx.leaves = [tensor.is_leaf for tensor in tensors]
        return outputs if isinstance(result, tuple) else outputs[0]

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *gradients):
        program = ctx.program
        if program is None:
            raise RuntimeError("this Warp operation was already differentiated once; run its forward pass again")
        arrays, plain = ctx.arrays, ctx.plain
        ctx.program = ctx.arrays = ctx.plain = None
        with torch_stream(program.torch_device):
            for array, gradient in zip(arrays, gradients, strict=True):
                if not program.outputs[id(array)][2]:
                    continue
                tensor = program.outputs[id(array)][0]
                if gradient is None:
                    gradient = torch.zeros_like(tensor)
                elif gradient.stride() != tensor.stride():
                    gradient = torch.empty_like(tensor).copy_(gradient)
                array.grad = _array(gradient, array.dtype)
                array.retain_grad = True  # the gradient is torch's: adjoint kernels must not clear it
            results: list[Tensor | None] = [None] * len(plain)
            by_memory = {}
            wanted = [position for position, needed in enumerate(ctx.needs_input_grad[2:]) if needed]
            # On a GPU leaves, whose gradients stay, have them in one memory; others' are soon let go, each by itself.
            together = [p for p in wanted if ctx.leaves[p] and program.torch_device.type != "cpu"]
            for group in (together, *([p] for p in wanted if p not in together)):
                for position, zeros in zip(group, _zeros_like([plain[p] for p in group]), strict=True):
                    results[position] = zeros
                    by_memory[id(plain[position])] = zeros
            for tensor, array in program.inputs:
                if id(tensor) in by_memory:
                    gradient = by_memory[id(tensor)]
                    if tensor.is_contiguous() and gradient.stride() != tensor.stride():
                        # A dimension of one element may have any stride, and Warp wants the gradient's to be the same.
                        gradient = gradient.as_strided(tensor.shape, tensor.stride())
                    array.grad = _array(gradient, array.dtype)
            program.tape.backward()
        return (None, None, *results)


@overload
def differentiable(
    body: Callable[Concatenate[Program, P], tuple["wp.array[Any, Any]", ...]],
) -> Callable[P, tuple[Tensor, ...]]: ...


@overload
def differentiable(body: Callable[Concatenate[Program, P], "wp.array[Any, Any]"]) -> Callable[P, Tensor]: ...


def differentiable(body: Callable[..., Any]) -> Callable[..., Any]:
    """Make a torch operation of a program: body(program, *tensors, **options) -> Warp arrays made by program.write().

    The operation takes the tensors positionally (on one device) and the options by keyword, returns the tensors
    behind the arrays, and can be differentiated once with respect to every tensor that body passed to program.read().
    """

    @wraps(body)
    def operation(*tensors: Tensor, **options: Any) -> Any:
        return _ProgramFunction.apply(body, options, *tensors)

    return operation
