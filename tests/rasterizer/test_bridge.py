"""Any Warp kernel becomes a differentiable torch operation; test_torch_contract.py holds it to torch's promises."""

import gc
import weakref

import pytest
import torch
import warp as wp

from sehdr_warp.rasterizer import differentiable


@wp.kernel
def square_kernel(values: wp.array(dtype=wp.vec3), squared: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    squared[i] = wp.cw_mul(values[i], values[i])


@wp.kernel
def scale_kernel(
    range_start: int, values: wp.array(dtype=wp.vec3), gain: wp.array(dtype=wp.float32), scaled: wp.array(dtype=wp.vec3)
):
    i = range_start + wp.tid()
    scaled[i] = gain[0] * values[i]


ALIVE: list[weakref.ref] = []  # The programs that have run


@differentiable
def scale_and_square(program, values, gain):
    scaled = program.empty_output(values.shape)
    squared = program.empty_output(values.shape)
    program.launch(scale_kernel, len(values), [values, gain], [scaled])
    program.launch(square_kernel, len(values), [scaled], [squared])
    ALIVE.append(weakref.ref(program))
    return scaled, squared


def leaves(device):
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(50, 3, generator=generator).to(device).requires_grad_()
    return values, torch.tensor([1.7], device=device, requires_grad=True)


def test_gradients_flow_through_the_launches(device):
    values, gain = leaves(device)
    scaled, squared = scale_and_square(values, gain)
    (2.0 * scaled + squared).sum().backward()
    torch.testing.assert_close(values.grad, 2.0 * gain + 2.0 * gain**2 * values)
    torch.testing.assert_close(gain.grad, (2.0 * values + 2.0 * gain * values**2).sum().reshape(1))


def test_memory_is_shared_not_copied(device):
    values, _ = leaves(device)
    calls = []

    @differentiable
    def look(program, tensor):
        calls.append(tensor.data_ptr())
        return program.empty_output(tensor.shape)

    result = look(values)
    assert calls == [values.data_ptr()]
    assert result.device == values.device


def test_an_output_that_later_launches_read_gets_all_of_its_gradient(device):
    values, gain = leaves(device)
    scaled, squared = scale_and_square(values, gain)
    scaled.retain_grad()
    (3.0 * scaled + squared).sum().backward()
    torch.testing.assert_close(scaled.grad, torch.full_like(scaled, 3.0))
    torch.testing.assert_close(values.grad, 3.0 * gain + 2.0 * gain**2 * values)
    by_squared = torch.autograd.grad(scale_and_square(values, gain)[1].sum(), values)[0]
    torch.testing.assert_close(by_squared, 2.0 * gain**2 * values)


def test_an_output_changed_in_place_before_the_backward_pass_raises_torchs_error(device):
    scaled, squared = scale_and_square(*leaves(device))
    with torch.no_grad():
        scaled.mul_(2.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        squared.sum().backward()


@pytest.mark.parametrize(
    "arguments, error, message",
    [
        ((), TypeError, "scale_and_square.. got no tensor"),
        ((3.0,), TypeError, "argument 0 is a float"),
        ((torch.zeros(4, 3), [1.0]), TypeError, "argument 1 is a list"),
        (
            (torch.zeros(4, 3, device="meta"), torch.zeros(1)),
            ValueError,
            "argument 1 is on cpu, but argument 0 is on meta",
        ),
        (
            (torch.zeros(4, 3, device="meta"), torch.zeros(1, device="meta")),
            ValueError,
            "argument 0 is on meta, expected the CPU or a CUDA device",
        ),
        ((torch.zeros(4, 3), torch.zeros(1, 1)), TypeError, "gain takes a tensor with 1 dimensions"),
        ((torch.zeros(4, 3, dtype=torch.float64), torch.zeros(1)), TypeError, "float64"),
    ],
)
def test_wrong_arguments_are_named(arguments, error, message):
    with pytest.raises(error, match=message):
        scale_and_square(*arguments)


def test_what_a_program_returns_it_must_have_written(device):
    @differentiable
    def same(program, tensor):
        return tensor

    with pytest.raises(TypeError, match="did not make"):
        same(torch.zeros(3, device=device, requires_grad=True))


@pytest.mark.parametrize("differentiated", [False, True], ids=["dropped", "differentiated"])
def test_memory_goes_with_the_result_without_the_garbage_collector(device, differentiated):
    values, gain = leaves(device)
    ALIVE.clear()
    gc.disable()
    try:
        for _ in range(3):
            result = scale_and_square(values, gain)
            if differentiated:
                result[0].sum().backward()
            del result
        assert [program() for program in ALIVE] == [None] * 3
    finally:
        gc.enable()


def test_runs_on_a_side_stream():
    if not torch.cuda.is_available():
        pytest.skip("streams are CUDA's")
    values, gain = leaves("cuda:0")
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        busy = torch.randn(4000, 4000, device="cuda:0")
        for _ in range(20):
            busy = busy @ busy * 1e-3
        moved = values * 2.0 + busy[0, 0] * 0.0
        scaled, _ = scale_and_square(moved.nan_to_num(), gain)
    torch.cuda.synchronize()
    torch.testing.assert_close(scaled, 2.0 * gain * values)


@pytest.mark.parametrize("body", [None, 5, torch.ones(3)])
def test_what_is_no_function_is_no_program(body):
    with pytest.raises(TypeError, match="@differentiable takes a function of a program, not"):
        differentiable(body)
