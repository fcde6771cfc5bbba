"""Operations within torch.compile: nodes of one graph, with the same bits, in silence."""

import math
import subprocess
import sys

import pytest
import torch

from sehdr_warp.rasterizer import custom_ops, differentiable, rasterize

from .scenes import random_scene
from .test_torch_contract import HEIGHT, WIDTH, directions, splats

PYTHON = [sys.executable, "-W", "ignore:Guards may run slower", "-c"]  # As torch says of Python 3.13.0
STEP = """
import time, warnings
import torch
with torch.inference_mode():  # Without gradients, in which an import must not leave operators.
    from sehdr_warp.rasterizer import rasterize, rasterize_directions, spherical_harmonics, ssim, ssim_map
from tests.rasterizer.test_torch_contract import HEIGHT, WIDTH, directions, splats

leaves = splats(dtype=torch.float32, channels=3)
coefficients, rays = torch.rand(6, 4, 3), directions().float()

def step(*leaves):
    total = 0.0
    for _ in range(3):
        colors = spherical_harmonics(1, coefficients, leaves[0], torch.zeros(3)) + leaves[4]
        options = {"background": torch.ones(3), "order_axis": torch.tensor([0.3, 0.1, 1.0])}
        splats_and_camera = [*leaves[:4], colors] + list(leaves[5:])
        rendering = rasterize(*splats_and_camera, WIDTH, HEIGHT, depth=True, **options)
        image = rendering.image * 2.0
        total = total + ssim(image, torch.full_like(image, 0.5)) + rendering.alpha.mean() + rendering.depth.mean()
        total = total + (rendering.means2d[:, 0] * rendering.visible).mean() + ssim_map(image, image.detach()).mean()
    around, _ = rasterize_directions(*leaves[:5], torch.zeros(3), rays, focal_length=22.0, axes=torch.eye(3))
    return total + around.sum()

def gradients(function):
    for leaf in leaves:
        leaf.grad = None
    loss = function(*leaves)
    loss.backward()
    return [loss.detach(), *(leaf.grad for leaf in leaves)]

truth = gradients(step)
began = time.perf_counter()
whole = gradients(torch.compile(step, backend="aot_eager", fullgraph=True))
seconds = time.perf_counter() - began
assert all(map(torch.equal, truth, whole)), "other bits"
print(seconds)
"""


def test_a_loop_is_one_graph_with_the_same_bits_in_silence():
    done = subprocess.run([*PYTHON, STEP], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not done.stderr.strip(), done.stderr
    assert float(done.stdout) < 60


def test_an_operation_compiles_by_itself_after_programs_that_do_not():
    program = differentiable(lambda program, values: program.empty_output(values.shape))
    assert program(torch.ones(2)).shape == (2,)
    arguments = *splats(dtype=torch.float32, channels=3), WIDTH, HEIGHT
    compiled = torch.compile(rasterize, backend="aot_eager", fullgraph=True)(*arguments)
    assert torch.equal(compiled.image, rasterize(*arguments).image)


@pytest.mark.parametrize("name", ["background", "order_axis"])
def test_a_compiler_refuses_an_empty_option_too(name):
    arguments = *splats(dtype=torch.float32, channels=3), WIDTH, HEIGHT
    with pytest.raises(Exception, match=rf"{name} has shape \[0\], expected"):
        torch.compile(rasterize, backend="aot_eager")(*arguments, **{name: torch.zeros(0)})


OPTIONS = 0.01, 0.3, 1e-3, False


@pytest.mark.parametrize("options", [(False, None, False, math.inf, math.inf), (True, 400, True, 0.5, 0.4)])
def test_torch_checks_the_node(options, device):
    tensors = [leaf.detach().requires_grad_() for leaf in splats(device, torch.float32)]
    others = torch.ones(2, device=device), torch.ones(3, device=device)
    arguments = [*tensors, *others], WIDTH, HEIGHT, *OPTIONS, *options
    checks = "test_schema", "test_faketensor"
    torch.library.opcheck(torch.ops.sehdr_warp.rasterize.default, arguments, test_utils=checks)
    rays = directions(device).float()
    position = torch.zeros(3, device=device)
    around = [*tensors[:5], position, rays], 22.0, 0.0, False, 0.01, 1e-3
    torch.library.opcheck(torch.ops.sehdr_warp.rasterize_directions.default, around, test_utils=checks)


def test_several_cameras_and_room_have_the_shapes_that_the_compiler_expects(device):
    scene = random_scene(count=20, channels=3).to(torch.float32, device)
    cameras = [torch.stack([tensor.detach()] * 2) for tensor in scene.tensors[5:]]
    arguments = *scene.tensors[:5], *cameras, WIDTH, HEIGHT
    truth = rasterize(*arguments, max_intersections=500, depth=True)
    rendering = custom_ops.compiled_rasterize(*arguments, max_intersections=500, depth=True)
    for name in ("image", "transmittance", "means2d", "depths", "extents", "overflow", "needed_intersections", "depth"):
        mine, true = getattr(rendering, name), getattr(truth, name)
        assert mine.shape == true.shape and torch.equal(mine, true)
    assert rendering.intersection_count == truth.intersection_count == 1000


def test_color_and_depth_of_one_pixel_have_memory_of_their_own():
    arguments = *splats(dtype=torch.float32, channels=3), 1, 1
    truth = rasterize(*arguments, depth=True)
    rendering = torch.compile(rasterize, backend="aot_eager", fullgraph=True)(*arguments, depth=True)
    assert torch.equal(rendering.image, truth.image) and torch.equal(rendering.depth, truth.depth)


def test_a_misfit_is_named_while_compiling():
    leaves = splats(dtype=torch.float32)
    draw = torch.compile(
        lambda means: rasterize(means, *leaves[1:], WIDTH, HEIGHT).image, backend="eager", fullgraph=True
    )
    with pytest.raises(Exception, match=r"means has shape \[6, 2\], expected \[N, 3\]"):
        draw(leaves[0][:, :2])


def test_what_is_no_tensor_is_named_by_the_operation():
    arguments = *splats(dtype=torch.float32), WIDTH, HEIGHT
    draw = torch.compile(lambda color: rasterize(*arguments, background=color).image, backend="eager")
    with pytest.raises(TypeError, match="background is a list, expected a torch tensor"):
        draw([1.0, 1.0])


COMPILED_AUTOGRAD = """
import torch
from sehdr_warp.compat.gsplat import rasterization
from tests.compat.gsplat.scenes import scene
from tests.rasterizer.test_torch_contract import NAMES, operations

torch._dynamo.config.compiled_autograd = True
cases = [operations()[name] for name in NAMES if name != "transmittance"]
leaves, place = scene(count=40)
cases.append((lambda *leaves: rasterization(*leaves, **place._asdict())[0], leaves))
for function, leaves in cases:
    torch._dynamo.reset()
    truth = torch.autograd.grad(function(*leaves).sum(), leaves)
    loss = function(*leaves).sum()
    torch.compile(lambda: loss.backward(), backend="eager")()
    assert all(torch.equal(leaf.grad, true) for leaf, true in zip(leaves, truth)), "other gradients"
"""


def test_compiled_autograd_calls_backward_passes_as_they_are():
    done = subprocess.run([*PYTHON, COMPILED_AUTOGRAD], capture_output=True, text=True, check=False)
    assert done.returncode == 0 and not done.stderr.strip(), done.stderr


def test_half_precision_is_cast_under_autocast():
    leaves = splats(dtype=torch.float32)
    half = leaves[4].detach().bfloat16()

    def draw_colors(colors):
        arguments = [*leaves[:4], colors, *leaves[5:]]
        return rasterize(*arguments, WIDTH, HEIGHT).image

    draw = torch.compile(draw_colors, backend="eager")
    with torch.autocast("cpu", dtype=torch.bfloat16):
        image = draw(half)
    assert torch.equal(image, draw_colors(half.float()))
