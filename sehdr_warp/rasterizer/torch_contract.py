"""Keep torch's contract at the border of an operation: compilation, autocast, transforms, and graphs kept for reuse."""

import contextlib
from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor
from torch._C._dynamo.eval_frame import _FrameAction, _FrameExecStrategy, set_code_exec_strategy
from torch.autograd import forward_ad

P = ParamSpec("P")
T = TypeVar("T")

HALF = torch.float16, torch.bfloat16

NOT_TWICE = "operations of sehdr_warp are differentiable once, not twice (once_differentiable)"
NOT_BATCHED = (
    "operations of sehdr_warp do not differentiate batches of gradients (vectorize=True, is_grads_batched=True); "
    "call torch.autograd.grad() for each"
)

_BATCHES: Any = torch._C._parse_dispatch_key("VmapMode")
_includes_key = torch._C._dispatch_tls_is_dispatch_key_included
_transforms_are_active = torch._C._are_functorch_transforms_active

keeps_graph: Callable[[], bool] = torch._C._autograd._get_current_graph_task_keep_graph  # pyright: ignore[reportAttributeAccessIssue]
"""Return whether the backward pass that is running was asked to retain the graph.

If not, what a node holds beside its saved tensors can be freed: a further backward pass is refused by torch."""

_compiled: dict[str, Callable[..., Any]] = {}


def register_compiled(**operations: Callable[..., Any]) -> None:
    """Name what takes the place of an operation within torch.compile and torch.export."""
    _compiled.update(operations)


def torch_operation(function: Callable[P, T], *, compiles: bool = False) -> Callable[P, T]:
    """Make a public operation of a function that launches kernels on tensors.

    - torch.compile calls what register_compiled() named if it `compiles`. Else it calls the operation as it is: the
      graph breaks there, nothing inside is traced.
    - Under torch.autocast, half-precision tensors become float32, as torch.amp.custom_fwd(cast_inputs=...) does.
    - torch.func transforms, forward-mode differentiation and torch.jit.trace() are refused by a sentence.

    Raises:
        NotImplementedError: within torch.func transforms and torch.jit.trace(), and for dual tensors of forward-mode
            differentiation.
    """
    name = function.__name__

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        if compiles and torch.compiler.is_compiling():
            return _compiled[name](*args, **kwargs)  # Registered by custom_ops.py, which the package imports.
        if _transforms_are_active():
            raise NotImplementedError(f"{name}() does not support torch.func; use torch.autograd")
        if torch._C._is_tracing():
            raise NotImplementedError(f"{name}() cannot be traced by torch.jit; use torch.compile or torch.export")
        if forward_ad._current_level >= 0 and any(map(_has_tangent, (*args, *kwargs.values()))):
            raise NotImplementedError(f"{name}() has no forward-mode derivative; use torch.autograd.grad()")
        if torch._C._is_any_autocast_enabled():
            return _without_autocast(function, args, kwargs)
        return function(*args, **kwargs)

    if not compiles:
        _hide_from_dynamo(call)
    return call


def _hide_from_dynamo(function: Any) -> None:
    """Do what torch.compiler.disable() does, without its import of Dynamo, which takes two seconds."""
    function.__code__ = function.__code__.replace()  # Dynamo marks code, which functions share.
    function._torchdynamo_disable = True
    function._torchdynamo_disable_msg = "it launches Warp kernels"
    set_code_exec_strategy(function.__code__, _FrameExecStrategy(_FrameAction.SKIP, _FrameAction.SKIP))


def _has_tangent(value: Any) -> bool:
    if isinstance(value, tuple | list):
        return any(map(_has_tangent, value))
    return isinstance(value, Tensor) and forward_ad.unpack_dual(value).tangent is not None


def _without_autocast(function: Callable[..., T], args: tuple, kwargs: dict) -> T:
    enabled = [device for device in ("cuda", "cpu") if torch.is_autocast_enabled(device)]

    def cast(value: Any) -> Any:
        if isinstance(value, tuple | list):
            return type(value)(map(cast, value))
        is_half = isinstance(value, Tensor) and value.dtype in HALF and value.device.type in enabled
        return value.float() if is_half else value

    with contextlib.ExitStack() as stack:
        for device in enabled:
            stack.enter_context(torch.autocast(device, enabled=False))
        return function(*map(cast, args), **{name: cast(value) for name, value in kwargs.items()})


def once_differentiable(backward: Callable[..., T]) -> Callable[..., T]:
    """Let what differentiates a gradient raise RuntimeError, and a batch of gradients NotImplementedError.

    torch.autograd.function.once_differentiable() raises nothing if the upstream gradient is a constant, as below a sum:
    the second derivative would then silently lack this node's part. This one also refuses derivatives with
    respect to the inputs that the node has saved.
    """

    @wraps(backward)
    def call(ctx: Any, *upstream: Any) -> Any:
        if _includes_key(_BATCHES):
            raise NotImplementedError(NOT_BATCHED)
        if not torch.is_grad_enabled():
            return backward(ctx, *upstream)
        with torch.no_grad():
            gradients = backward(ctx, *upstream)
        parts: tuple[Any, ...] = gradients if isinstance(gradients, tuple) else (gradients,)
        sources = [tensor for tensor in (*ctx.saved_tensors, *upstream) if tensor is not None and tensor.requires_grad]
        if not sources:
            devices = [part.device for part in parts if part is not None]
            if not devices:
                return gradients
            sources = [torch.zeros((), device=devices[0], requires_grad=True)]
        tensors = [*parts, *sources]
        return _Once.apply(len(parts), *tensors)

    _hide_from_dynamo(call)  # From compiled autograd, which would trace it
    return call


class _Once(torch.autograd.Function):
    """Makes gradients functions of their sources that cannot be differentiated."""

    @staticmethod
    def forward(ctx, count: int, *tensors: Tensor | None) -> tuple[Tensor | None, ...]:
        return tuple(None if tensor is None else tensor.detach() for tensor in tensors[:count])

    @staticmethod
    def backward(ctx, *upstream: Tensor) -> Any:
        raise RuntimeError(NOT_TWICE)


def direct_apply(function: type[torch.autograd.Function]) -> Callable[..., Any]:
    """Return the apply() of an autograd.Function in C++, and let C++ call its backward().

    Leaves out the Python functions of torch in between, whose work for torch.func and vjp() operations do not need.
    """
    node: Any = function._backward_cls  # pyright: ignore[reportAttributeAccessIssue]
    node.apply = function.backward
    apply: Any = super(torch.autograd.Function, function)
    return apply.apply
