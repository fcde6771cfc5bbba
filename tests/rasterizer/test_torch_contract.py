"""The public operations keep what torch promises of its own."""

import copy
import multiprocessing
import pickle
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
import torch.utils.checkpoint
import warp as wp

from sehdr_warp.rasterizer import (
    differentiable,
    rasterize,
    rasterize_directions,
    spherical_harmonics,
    ssim,
    ssim_map,
)

from .scenes import random_scene

WIDTH, HEIGHT = 20, 14


@wp.kernel
def cube_kernel(range_start: int, values: wp.array(dtype=wp.float64), cubes: wp.array(dtype=wp.float64)):
    i = range_start + wp.tid()
    cubes[i] = values[i] * values[i] * values[i]


@differentiable
def cube(program, values):
    cubes = program.empty_output(values.shape, values.dtype)
    program.launch(cube_kernel, len(values), [values], [cubes])
    return cubes


def splats(device="cpu", dtype=torch.float64, count=6, channels=2):
    """Leaves of rasterize(): few Gaussians, all of them well inside of the picture and none opaque."""
    generator = torch.Generator().manual_seed(4)
    means = torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5
    means[:, 2] += 3.0
    tensors = (
        means,
        torch.randn(count, 3, generator=generator, dtype=torch.float64) * 0.2 - 1.6,
        torch.randn(count, 4, generator=generator, dtype=torch.float64),
        torch.rand(count, generator=generator, dtype=torch.float64) * 0.5 + 0.2,
        torch.rand(count, channels, generator=generator, dtype=torch.float64),
        torch.eye(4, dtype=torch.float64),
        torch.tensor([22.0, 21.0, 10.3, 7.2], dtype=torch.float64),
    )
    return [tensor.to(device, dtype).requires_grad_() for tensor in tensors]


def directions(device="cpu"):
    x, y = torch.meshgrid(torch.linspace(-0.3, 0.3, 10), torch.linspace(-0.2, 0.2, 6), indexing="xy")
    rays = torch.stack([x, y, torch.ones_like(x)], dim=-1).double().to(device)
    return torch.nn.functional.normalize(rays, dim=-1)


def operations(device="cpu"):
    """Each public operation as a function of its leaves in float64."""
    leaves, generator = splats(device), torch.Generator().manual_seed(5)

    def random(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64).to(device).requires_grad_()

    position = torch.zeros(3, dtype=torch.float64, device=device, requires_grad=True)
    images = random(7, 6, 3), random(7, 6, 3)
    rays, look = directions(device), {"focal_length": 22.0, "alpha_threshold": 1e-9}
    return {
        # Without a threshold: at its border the picture is not continuous, and differences are no derivatives.
        "rasterize": (lambda *t: rasterize(*t, WIDTH, HEIGHT, alpha_threshold=1e-9).image, leaves),
        "transmittance": (lambda *t: rasterize(*t, WIDTH, HEIGHT, alpha_threshold=1e-9).transmittance, leaves),
        "depth": (lambda *t: rasterize(*t, WIDTH, HEIGHT, depth=True, alpha_threshold=1e-9).depth, leaves),
        "directions": (lambda *t: rasterize_directions(*t, rays, **look)[0], [*leaves[:5], position]),
        "harmonics": (lambda *t: spherical_harmonics(3, *t), [random(5, 16, 3), random(5, 3), position]),
        "ssim": (ssim, images),
        "ssim_map": (ssim_map, images),
        "differentiable": (cube, (random(40),)),
    }


NAMES = list(operations())


@pytest.mark.parametrize("name", NAMES)
def test_gradcheck_passes(name, device):
    function, leaves = operations(device)[name]
    assert torch.autograd.gradcheck(function, leaves, eps=1e-6, atol=1e-5, rtol=1e-3, nondet_tol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_a_retained_graph_gives_the_same_gradients_and_a_freed_one_torchs_error(name):
    function, leaves = operations()[name]
    loss = function(*leaves).square().sum()
    first = torch.autograd.grad(loss, leaves, retain_graph=True)
    second = torch.autograd.grad(loss, leaves)
    assert all(map(torch.equal, first, second))
    with pytest.raises(RuntimeError, match="second time"):
        torch.autograd.grad(loss, leaves)


@pytest.mark.parametrize("name", NAMES)
def test_changes_in_place_raise_torchs_error_or_change_no_gradient(name):
    function, leaves = operations()[name]
    truth = torch.autograd.grad(function(*leaves).sum(), leaves)
    errors = 0
    for place in range(len(leaves)):
        function, leaves = operations()[name]
        loss = function(*leaves).sum()
        with torch.no_grad():
            leaves[place].mul_(1.5)
        try:
            gradients = torch.autograd.grad(loss, leaves)
        except RuntimeError as error:
            assert "modified by an inplace operation" in str(error)
            errors += 1
        else:
            assert all(map(torch.equal, gradients, truth))
    assert errors


@pytest.mark.parametrize("total", [torch.sum, lambda result: result.square().sum()], ids=["sum", "squares"])
@pytest.mark.parametrize("name", NAMES)
def test_gradients_of_gradients_are_refused(name, total):
    function, leaves = operations()[name]
    gradient = torch.autograd.grad(total(function(*leaves)), leaves[0], create_graph=True)[0]
    with pytest.raises(RuntimeError, match="differentiable once, not twice"):
        (gradient * leaves[0]).sum().backward()


@pytest.mark.parametrize("name", NAMES)
def test_batches_of_gradients_are_refused_by_a_sentence(name):
    function, leaves = operations()[name]
    result = function(*leaves)
    with pytest.raises(NotImplementedError, match="do not differentiate batches of gradients"):
        torch.autograd.grad(result, leaves, torch.ones(2, *result.shape).to(result), is_grads_batched=True)


@pytest.mark.parametrize("name", NAMES)
def test_a_default_device_of_the_user_changes_nothing(name):
    function, leaves = operations()[name]
    truth = torch.autograd.grad(function(*leaves).sum(), leaves)
    with torch.device("meta"):
        gradients = torch.autograd.grad(function(*leaves).sum(), leaves)
    assert all(map(torch.equal, gradients, truth))


@pytest.mark.parametrize("name", NAMES)
def test_function_transforms_and_forward_mode_are_refused_by_a_sentence(name):
    function, leaves = operations()[name]
    rest = leaves[1:]
    with pytest.raises(NotImplementedError, match=r"does not support torch\.func"):
        torch.func.grad(lambda first: function(first, *rest).sum())(leaves[0].detach())
    with pytest.raises(NotImplementedError, match="forward-mode"):
        dual = torch.autograd.forward_ad
        with dual.dual_level():
            function(dual.make_dual(leaves[0].detach(), torch.ones_like(leaves[0])), *rest)


@pytest.mark.parametrize("half", [torch.bfloat16, torch.float16])
def test_autocast_casts_half_precision_and_without_it_the_argument_is_named(half):
    leaves = splats(dtype=torch.float32)
    halves = [leaf.detach().to(half).requires_grad_() for leaf in leaves[:5]]
    arguments = [*halves, *leaves[5:]]
    with pytest.raises(ValueError, match=f"means is {half}, expected torch.float32"):
        rasterize(*arguments, WIDTH, HEIGHT)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        image = rasterize(*arguments, WIDTH, HEIGHT).image
        assert torch.is_autocast_enabled("cpu")
    image.sum().backward()
    truth = rasterize(*(argument.detach().float() for argument in arguments), WIDTH, HEIGHT).image
    assert image.dtype == torch.float32 and torch.equal(image, truth)
    assert all(leaf.grad is not None and leaf.grad.dtype == half for leaf in halves)


def test_inputs_that_are_not_contiguous_or_expanded_give_the_same(device):
    leaves = [leaf.detach() for leaf in splats(device, torch.float32)]
    count = len(leaves[0])
    repeated = [*leaves[:3], leaves[3][:1].repeat(count), *leaves[4:]]
    truth = rasterize(*repeated, WIDTH, HEIGHT)
    strided = [torch.stack([leaf, leaf], dim=-1)[..., 0] for leaf in leaves]
    strided[3] = leaves[3][:1].expand(count)
    assert not strided[0].is_contiguous()
    strided[0].requires_grad_()
    rendering = rasterize(*strided, WIDTH, HEIGHT)
    assert torch.equal(rendering.image, truth.image)
    rendering.image.sum().backward()
    assert strided[0].grad is not None


def test_imaginary_parts_of_conjugates_are_negated(device):
    """Torch leaves such a view's numbers in memory as they were."""
    values = torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64, device=device)
    view = torch.complex(values, values).conj().imag
    torch.testing.assert_close(cube(view), -(values**3))
    leaves = splats(device)
    for result_of in (lambda: cube(leaves[3]), lambda: rasterize(*leaves, WIDTH, HEIGHT).depths):
        result = result_of()
        expected = torch.autograd.grad(-result.sum(), leaves, retain_graph=True, allow_unused=True)
        z = torch.complex(torch.zeros_like(result), result)
        actual = torch.autograd.grad(z.conj().imag.sum(), leaves, allow_unused=True)
        for mine, true in zip(actual, expected, strict=True):
            assert (mine is None) == (true is None) and (mine is None or torch.equal(mine, true))


def test_results_can_be_copied_and_operations_pickled():
    with torch.no_grad():
        rendering = rasterize(*splats(), WIDTH, HEIGHT)
    for copied in (copy.deepcopy(rendering), pickle.loads(pickle.dumps(rendering))):
        assert torch.equal(copied.image, rendering.image) and copied.intersection_count == rendering.intersection_count
    assert pickle.loads(pickle.dumps(cube)) is cube and pickle.loads(pickle.dumps(rasterize)) is rasterize


def test_threads_work_at_the_same_time():
    def gradients(_):
        leaves = splats(dtype=torch.float32)
        rasterize(*leaves, WIDTH, HEIGHT).image.square().sum().backward()
        return [leaf.grad for leaf in leaves]

    truth = gradients(0)
    with ThreadPoolExecutor(4) as pool:
        for results in pool.map(gradients, range(12)):
            assert all(map(torch.equal, results, truth))
    assert threading.active_count() >= 1


def _picture(queue):
    with torch.no_grad():
        queue.put(rasterize(*splats(dtype=torch.float32), WIDTH, HEIGHT).image.numpy())


@pytest.mark.skipif(not hasattr(multiprocessing, "get_context") or sys.platform == "win32", reason="no fork")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_other_processes_render_too(method):
    truth = rasterize(*splats(dtype=torch.float32), WIDTH, HEIGHT).image
    if torch.cuda.is_initialized() and method == "fork":
        pytest.skip("CUDA forbids it")
    context = multiprocessing.get_context(method)
    queue = context.Queue()
    process = context.Process(target=_picture, args=(queue,))
    process.start()
    image = queue.get(timeout=120)
    process.join(30)
    assert process.exitcode == 0 and torch.equal(torch.from_numpy(image), truth.detach())


COMPILED = """
import sys
import sehdr_warp.rasterizer
assert "torch._dynamo" not in sys.modules, "importing the package imports the compiler"
import torch
from tests.rasterizer.test_torch_contract import cube

def step(values):
    total = 0.0
    for _ in range(3):
        total = total + (cube(values * 2.0) + 1.0).sum()
    return total

values = torch.rand(40, dtype=torch.float64).requires_grad_()
truth = step(values), torch.autograd.grad(step(values), values)[0]
loss = torch.compile(step, backend="aot_eager")(values)
assert torch.equal(loss, truth[0]) and torch.equal(torch.autograd.grad(loss, values)[0], truth[1]), "other bits"
"""


def test_programs_break_a_compiled_graph_in_silence_and_give_the_same_bits():
    done = subprocess.run([sys.executable, "-c", COMPILED], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not done.stderr.strip(), done.stderr


@pytest.mark.parametrize("what", ["nothing", "all"])
def test_no_gaussians_at_all_have_gradients(what, device):
    scene = random_scene(count=4, channels=3).to(torch.float32, device)
    tensors = [tensor[:0] if what == "nothing" else tensor for tensor in scene.tensors[:5]]
    if what == "all":
        tensors[0] = tensors[0] - torch.tensor([0.0, 0.0, 100.0], device=device)
    leaves = [tensor.detach().requires_grad_() for tensor in (*tensors, *scene.tensors[5:])]
    rasterize(*leaves, WIDTH, HEIGHT, background=torch.ones(3, device=device)).image.sum().backward()
    assert all(bool((leaf.grad == 0).all()) for leaf in leaves)


def test_checkpointing_and_inference_mode_work():
    leaves = splats(dtype=torch.float32)
    truth = torch.autograd.grad(rasterize(*leaves, WIDTH, HEIGHT).image.square().sum(), leaves)
    image = torch.utils.checkpoint.checkpoint(
        lambda *t: rasterize(*t, WIDTH, HEIGHT).image, *leaves, use_reentrant=False
    )
    assert all(map(torch.equal, torch.autograd.grad(image.square().sum(), leaves), truth))
    with torch.inference_mode():
        assert torch.equal(rasterize(*leaves, WIDTH, HEIGHT).image, image)
