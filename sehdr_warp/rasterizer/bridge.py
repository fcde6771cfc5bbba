"""Warp programs as differentiable torch operations: the one place where tapes meet autograd.

A *program* is a function that launches kernels on torch tensors, on a tape, and returns the tensors it wrote.
`@differentiable` turns it into a torch operation: data is shared, never copied; launches go to torch's current stream;
the tape is replayed when torch asks for gradients, and not recorded when nobody will.

    @differentiable
    def scaled(program, values, *, gain):
        result = program.write(values.shape)
        program.launch(scale, len(values), [values, gain], [result])
        return result

Positional arguments are tensors and take part in autograd; keyword arguments are passed on as they are.
"""

from collections.abc import Callable, Sequence
from functools import wraps
from itertools import accumulate
from typing import Any, Concatenate, ParamSpec, overload

import torch
import warp as wp
from torch import Tensor

from .warp_launch.launching import launch
from .warp_launch.threads import torch_threads, whole

P = ParamSpec("P")


class Program:
    """What a program sees while it runs: memory to write to, and a tape that takes its launches."""

    def __init__(self, tensors: Sequence[Tensor], recording: bool):
        self.device = tensors[0].device
        self.tape = wp.Tape() if recording else None
        self.constant: set[int] = set()
        self.gradients: dict[int, Tensor] = {}
        """By place in `known`: the arguments, then what was written."""
        self.known: list[Tensor] = []
        self._places: dict[int, int] = {}
        for tensor in tensors:
            self._know(tensor)

    def write(self, shape: Sequence[int], dtype: torch.dtype = torch.float32, *, differentiable: bool = True) -> Tensor:
        """A new tensor for one launch to write to. A vector type's components are its last dimension."""
        tensor = torch.empty(tuple(shape), dtype=dtype, device=self.device)
        if not differentiable:
            self.constant.add(len(self.known))
        self._know(tensor)
        return tensor

    def _know(self, tensor: Tensor) -> None:
        self._places[id(tensor)] = len(self.known)
        self.known.append(tensor)

    def launch(self, kernel: Any, dim: int | Sequence[int], inputs: Sequence[Any], outputs: Sequence[Any] = ()) -> None:
        """Launch a kernel, tensors in the place of its arrays; its generated adjoint runs in the backward pass.

        inputs: kept until then. outputs: what the kernel writes and does not read; the adjoint does without.
        A vector or matrix type takes up a tensor's last one or two dimensions. Gradients reach the program's arguments
        and what it wrote; other tensors are constants.
        A kernel whose first parameter is an integer `first` adds it to its thread's index and writes only what belongs
        to that item: it is given the start of a range, and on the CPU ranges run side by side, adjoint too, but for an
        adjoint that adds to an input which items share.
        """
        launch(kernel, dim, *inputs, *outputs)
        if self.tape is None:
            return
        gradients, places = self.gradients, [self.place(argument) for argument in (*inputs, *outputs)]
        kept = [*inputs, *(None,) * len(outputs)]

        # The tape holds this. If it held the program or the tape, memory would wait for the garbage collector.
        def adjoint() -> None:
            given = [gradients.get(place) for place in places]
            read = zip(inputs, given, strict=False)
            shared = any(gradient is not None and len(tensor) != dim for tensor, gradient in read)
            launch(kernel, dim, *kept, gradients=given, ranges=whole(dim) if shared and isinstance(dim, int) else None)

        self.tape.record_func(adjoint, arrays=[])

    def place(self, tensor: Any) -> int:
        """Under which the gradient of an argument or of what was written is found; -1 for anything else."""
        return self._places.get(id(tensor), -1)


def zero_gradients(tensors: Sequence[Tensor], needed: Sequence[bool], leaves: Sequence[bool]) -> list[Tensor | None]:
    """For each tensor that needs a gradient zeros to add it to, for others None. leaves: which of them are leaves."""
    made: dict[int, Tensor] = {}
    device = tensors[0].device
    if device.type != "cpu":
        # Leaves, whose gradients stay, have them in one memory; others' are soon let go, each by itself.
        kept = [place for place, need in enumerate(needed) if need and leaves[place]]
        made.update(zip(kept, _zeros_together([tensors[place] for place in kept]), strict=False))
    with torch_threads(device):
        for place, need in enumerate(needed):
            if need and place not in made:
                made[place] = torch.zeros_like(tensors[place], memory_format=torch.contiguous_format)
    return [made.get(place) for place in range(len(tensors))]


def kernel_layout(gradient: Tensor | None) -> Tensor | None:
    """A gradient as kernels read it: any rows, but a vector in one piece."""
    if gradient is None or gradient.ndim < 2 or gradient.is_contiguous():
        return gradient
    if gradient.stride(1) == 1 if gradient.ndim == 2 else gradient[0].is_contiguous():
        return gradient
    return gradient.contiguous()


def _zeros_together(tensors: list[Tensor]) -> list[Tensor]:
    """Zeros of the tensors' shapes, filled by a single launch; none where they are not several of one type, each
    contiguous."""
    alike = len({tensor.dtype for tensor in tensors}) == 1 and all(tensor.is_contiguous() for tensor in tensors)
    if len(tensors) < 2 or not alike:
        return []
    # Each starts at a multiple of 64 numbers, as memory of its own would.
    rooms = [-(-tensor.numel() // 64) * 64 for tensor in tensors]
    whole, starts = tensors[0].new_zeros(sum(rooms)), accumulate(rooms, initial=0)
    return [whole.as_strided(t.shape, t.stride(), start) for t, start in zip(tensors, starts, strict=False)]


class _ProgramFunction(torch.autograd.Function):
    @staticmethod
    def forward(ctx, body, options, *tensors):
        plain = tuple(tensor.detach() for tensor in tensors)
        program = Program(plain, True)
        result = body(program, *plain, **options)
        outputs = result if isinstance(result, tuple) else (result,)
        places = [program.place(tensor) for tensor in outputs]
        # torch makes this node the origin of what it is given: held by the tape as well, neither would ever be freed.
        given = tuple(tensor.detach() for tensor in outputs)
        ctx.mark_non_differentiable(*(t for t, place in zip(given, places, strict=True) if place in program.constant))
        ctx.set_materialize_grads(False)
        ctx.tape, ctx.gradients, ctx.plain, ctx.places = program.tape, program.gradients, plain, places
        ctx.leaves = [tensor.is_leaf for tensor in tensors]
        passed = {*range(len(plain)), *places, *program.constant}
        ctx.between = {place: t for place, t in enumerate(program.known) if place not in passed}
        return given if isinstance(result, tuple) else given[0]

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *upstream):
        tape, plain, gradients = ctx.tape, ctx.plain, ctx.gradients
        if tape is None:
            raise RuntimeError("this Warp operation was already differentiated once; run its forward pass again")
        ctx.tape = ctx.plain = ctx.gradients = None
        gradients |= {
            p: kernel_layout(given) for p, given in zip(ctx.places, upstream, strict=True) if given is not None
        }
        gradients |= {place: torch.zeros_like(tensor) for place, tensor in ctx.between.items()}
        results = zero_gradients(plain, ctx.needs_input_grad[2:], ctx.leaves)
        gradients |= {place: made for place, made in enumerate(results) if made is not None}
        tape.backward()
        return (None, None, *results)


@overload
def differentiable(body: Callable[Concatenate[Program, P], tuple[Tensor, ...]]) -> Callable[P, tuple[Tensor, ...]]: ...


@overload
def differentiable(body: Callable[Concatenate[Program, P], Tensor]) -> Callable[P, Tensor]: ...


def differentiable(body: Callable[..., Any]) -> Callable[..., Any]:
    """Make a torch operation of a program.

    The operation takes the tensors positionally (on one device) and the options by keyword, returns the tensors that
    body returns, and can be differentiated once with respect to every positional tensor.

    Args:
        body: body(program, *tensors, **options) -> tensors made by program.write().
    """

    @wraps(body)
    def operation(*tensors: Tensor, **options: Any) -> Any:
        if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors):
            return _ProgramFunction.apply(body, options, *tensors)
        return body(Program(tensors, False), *tensors, **options)

    return operation
