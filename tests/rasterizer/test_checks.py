"""Inputs that do not fit the public operations end in one line that names them."""

import numpy as np
import pytest
import torch
from torch import distributed
from torch.distributed.tensor import distribute_tensor, init_device_mesh

from sehdr_warp.rasterizer import rasterize, rasterize_directions, spherical_harmonics, ssim
from sehdr_warp.rasterizer.losses.code_residual import CodeScale, code_residual
from sehdr_warp.rasterizer.losses.photo_loss import photo_loss
from sehdr_warp.rasterizer.ops.exposure_fusion import fuse_exposures
from sehdr_warp.rasterizer.ops.interpolation import interpolate
from sehdr_warp.rasterizer.ops.step_updates import AdamStep, adam_steps

from .scenes import random_scene

NAN = float("nan")


def arguments(**changes):
    names = ("means", "log_scales", "quaternions", "opacities", "features", "world_to_camera", "intrinsics")
    args = dict(zip((*names, "width", "height"), random_scene(count=5).arguments, strict=True))
    return args | {name: change(args.get(name)) for name, change in changes.items()}


def with_nan_and_logits(opacities):
    return torch.tensor([NAN, -4.0, float("inf"), 0.0, NAN]).to(opacities)


@pytest.mark.parametrize(
    ("name", "change", "kind", "message"),
    [
        ("means", lambda t: t.detach().numpy(), TypeError, r"means is a numpy.ndarray, expected a torch tensor \[N"),
        ("means", lambda t: t[0, 0], ValueError, r"means has shape \[\], expected \[N, 3\]"),
        ("log_scales", lambda t: t[:-1], ValueError, r"log_scales has shape \[4, 3\], expected \[N, 3\] with N = 5"),
        ("quaternions", lambda t: t[:, :3], ValueError, r"quaternions has shape \[5, 3\], expected \[N, 4\]"),
        ("opacities", lambda t: t.float(), ValueError, "opacities is torch.float32 on cpu, but means is torch.float64"),
        ("opacities", with_nan_and_logits, ValueError, "opacities are from -4 to 0"),
        ("opacities", lambda t: t.detach() + 5, ValueError, "opacities are from 5.* expected 0 to 1; give logits"),
        ("features", lambda t: t[:, :0], ValueError, r"features has shape \[5, 0\], expected \[N, C\] with C >= 1"),
        ("features", lambda t: t.to("meta"), ValueError, "features is torch.float64 on meta, but means is .* on cpu"),
        ("means", lambda t: t.half(), ValueError, "means is torch.float16, expected torch.float32 or torch.float64"),
        ("intrinsics", lambda t: [1.0] * 4, TypeError, r"intrinsics is a list, expected a torch tensor \[4\]"),
        ("intrinsics", lambda t: torch.eye(3), ValueError, r"shape \[3, 3\], expected \[4\]: fx, fy, cx, cy"),
        ("intrinsics", lambda t: t * 0, ValueError, "intrinsics are fx 0, fy 0, .* fx, fy above 0"),
        ("intrinsics", lambda t: -t, ValueError, "intrinsics are fx -.*expected finite numbers"),
        ("intrinsics", lambda t: t * NAN, ValueError, "intrinsics are fx nan, .*expected finite numbers"),
        ("world_to_camera", lambda t: t * NAN, ValueError, "world_to_camera has a number that is not finite"),
        ("world_to_camera", lambda t: t * 0, ValueError, "world_to_camera has .* determinant 0, expected"),
        ("world_to_camera", lambda t: torch.ones_like(t), ValueError, "world_to_camera has .* determinant 0, expected"),
        ("world_to_camera", lambda t: t.mT, ValueError, r"world_to_camera has the last row .* is it transposed"),
        ("means", lambda t: t.detach().to_sparse(), ValueError, "means is .* layout torch.sparse_coo, expected"),
        ("width", lambda _: 1 << 21, ValueError, "width 2097152 is not in 1..1048576"),
        ("width", lambda _: 70.0, TypeError, "width is 70.0, expected a whole number"),
        ("width", lambda _: True, TypeError, "width is True, expected a whole number"),
        ("height", lambda _: 0, ValueError, "height 0 is not in 1.."),
        ("max_intersections", lambda _: 2**31, ValueError, "max_intersections 2147483648 is not in 1.."),
        ("near_plane", lambda _: 0.0, ValueError, "near_plane 0.0 is not"),
        ("near_plane", lambda _: float("nan"), ValueError, "near_plane nan is not"),
        ("eps2d", lambda _: -0.1, ValueError, "eps2d -0.1 is not"),
        ("alpha_threshold", lambda _: float("nan"), ValueError, "alpha_threshold nan is not"),
        ("near_plane", lambda _: None, TypeError, "near_plane is None, expected a number"),
        ("eps2d", lambda _: torch.tensor(0.3), TypeError, r"eps2d is tensor\(0.3000\), expected a number"),
        ("ray_limit_x", lambda _: 0.0, ValueError, "ray_limit_x 0.0 is not above 0"),
        ("ray_limit_y", lambda _: "1", TypeError, "ray_limit_y is '1', expected a number"),
        ("alpha_threshold", lambda _: 1e-50, ValueError, "alpha_threshold 1e-50 is not between 1e-37 and 1"),
        ("antialiased", lambda _: "no", TypeError, "antialiased is 'no', expected True or False"),
        ("depth", lambda _: 1, TypeError, "depth is 1, expected True or False"),
        ("order_axis", lambda _: torch.eye(3).double(), ValueError, r"order_axis has shape \[3, 3\], expected \[3\]"),
        ("order_axis", lambda _: torch.ones(3), ValueError, "order_axis is torch.float32 on cpu, but means is"),
        ("order_axis", lambda _: torch.zeros(3).double(), ValueError, r"order_axis is \[0.0, 0.0, 0.0\], exp"),
        ("order_axis", lambda _: torch.eye(3)[0].double() / 0, ValueError, r"order_axis is \[inf, nan, nan\], exp"),
        ("order_axis", lambda _: (0, 0, 1), TypeError, "order_axis is a tuple, expected a torch tensor"),
    ],
)
def test_misfits_of_a_render_are_named(name, change, kind, message):
    with pytest.raises(kind, match=message) as caught:
        rasterize(**arguments(**{name: change}))
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("name", "value", "kind", "message"),
    [
        ("focal_length", 0.0, ValueError, "focal_length 0.0 is not a positive number"),
        ("focal_length", "60", TypeError, "focal_length is '60', expected a number"),
        ("pixel_angle", NAN, ValueError, "pixel_angle nan is not radians from 0 to 2 pi"),
        ("pixel_angle", 45.0, ValueError, "pixel_angle 45.0 is not radians from 0 to 2 pi"),
        ("near_plane", -1.0, ValueError, "near_plane -1.0 is not a positive number"),
        ("alpha_threshold", 1.0, ValueError, "alpha_threshold 1.0 is not between 1e-37 and 1"),
        ("antialiased", None, TypeError, "antialiased is None, expected True or False"),
        (
            "position",
            torch.tensor([0.0, NAN, 0.0]).double(),
            ValueError,
            "position is .*nan.*, expected finite numbers",
        ),
        (
            "directions",
            torch.ones(2, 2, 3).double(),
            ValueError,
            "directions have lengths from 1.73205 to 1.73205, expected unit vectors",
        ),
        ("directions", torch.full((2, 2, 3), NAN).double(), ValueError, "directions have lengths from nan to nan"),
        ("axes", torch.eye(3).double()[0], ValueError, r"axes has shape \[3\], expected \[A, 3\]"),
        ("axes", torch.zeros(0, 3).double(), ValueError, r"axes has shape \[0, 3\], expected .* at least one axis"),
        ("axes", torch.zeros(2, 3).double(), ValueError, "axes have lengths from 0 to 0, expected unit vectors"),
        ("axes", torch.eye(3).double() * 2, ValueError, "axes have lengths from 2 to 2, expected unit vectors"),
        ("directions", torch.eye(3).double()[None].requires_grad_(), ValueError, r"pass directions\.detach\(\)"),
        (
            "features",
            torch.ones(5, 0).double(),
            ValueError,
            r"features has shape \[5, 0\], expected \[N, C\] with C >= 1",
        ),
    ],
)
def test_misfits_of_a_picture_of_the_sphere_are_named(name, value, kind, message):
    *tensors, features = random_scene(count=5).arguments[:5]
    arguments = {
        "features": features,
        "position": torch.zeros(3).double(),
        "directions": torch.eye(3).double()[:2, None],
        "focal_length": 60.0,
    }
    with pytest.raises(kind, match=message):
        rasterize_directions(*tensors, **arguments | {name: value})


def test_an_image_of_too_many_pixels_is_named():
    with pytest.raises(ValueError, match="an image of 65536 x 32768 has 2\\^31 pixels or more; render parts of it"):
        rasterize(**arguments(width=lambda _: 1 << 16, height=lambda _: 1 << 15))


def test_a_device_without_kernels_is_named():
    args = {name: t.to("meta") if isinstance(t, torch.Tensor) else t for name, t in arguments().items()}
    with pytest.raises(ValueError, match="means is on meta, expected the CPU or a CUDA device"):
        rasterize(**args)


def test_numbers_and_bools_of_numpy_are_options():
    flags = {name: lambda _: np.bool_(1) for name in ("antialiased", "depth", "deterministic")}
    rendering = rasterize(**arguments(width=np.int64, **flags))
    assert rendering.image.shape == (50, 70, 3) and rendering.depth is not None
    truth = rasterize(**arguments(antialiased=lambda _: True, depth=lambda _: True))
    assert torch.equal(rendering.image, truth.image)


@pytest.mark.parametrize(
    ("degree", "change", "kind", "message"),
    [
        (4, {}, ValueError, "degree 4 is not in 0..3"),
        (1.0, {}, TypeError, "degree is 1.0, expected a whole number"),
        (3, {}, ValueError, "needs 16 coefficients, not 4"),
        (1, {"constant": torch.ones(4, 1, 3)}, ValueError, r"coefficients\[0\] has shape \[4, 1, 3\]"),
        (1, {"rest": torch.ones(5, 3, 3, dtype=torch.float64)}, ValueError, r"coefficients\[1\] is torch.float64"),
        (1, {"means": np.ones((5, 3))}, TypeError, "means is a numpy.ndarray"),
        (1, {"camera": torch.zeros(2)}, ValueError, r"camera_position has shape \[2\], expected \[3\]"),
    ],
)
def test_misfits_of_harmonics_are_named(degree, change, kind, message):
    args = {"constant": torch.ones(5, 1, 3), "rest": torch.ones(5, 3, 3)}
    args |= {"means": torch.ones(5, 3), "camera": torch.zeros(3)} | change
    with pytest.raises(kind, match=message):
        spherical_harmonics(degree, (args["constant"], args["rest"]), args["means"], args["camera"])
    if not change and degree == 3:
        with pytest.raises(TypeError, match=r"coefficients is a numpy.ndarray, expected a torch tensor \[N, K, 3\]"):
            spherical_harmonics(1, np.ones((5, 4, 3)), args["means"], args["camera"])


@pytest.mark.parametrize(
    ("a", "b", "kind", "message"),
    [
        (torch.zeros(4, 4), torch.zeros(4, 4), ValueError, r"a has shape \[4, 4\], expected \[H, W, C\]"),
        (torch.zeros(0, 5, 3), torch.zeros(0, 5, 3), ValueError, "with a pixel at least"),
        (torch.zeros(4, 4, 3), torch.zeros(4, 5, 3), ValueError, r"b has shape \[4, 5, 3\], .* H = 4, W = 4, C = 3"),
        (torch.zeros(4, 4, 3), torch.zeros(4, 4, 3).double(), ValueError, "b is torch.float64 on cpu, but a is"),
        (torch.zeros(4, 4, 3).int(), torch.zeros(4, 4, 3).int(), ValueError, "a is torch.int32, expected torch"),
        (np.zeros((4, 4, 3)), torch.zeros(4, 4, 3), TypeError, "a is a numpy.ndarray"),
    ],
)
def test_misfits_of_similarity_are_named(a, b, kind, message):
    with pytest.raises(kind, match=message):
        ssim(a, b)


CODES, SCALE = torch.zeros(2, 3, 3, dtype=torch.uint8), CodeScale(torch.zeros(256, 3))
IMAGE, SQUARE, ONE = torch.zeros(4, 3, 3), torch.zeros(4, 4), torch.ones(())
LEARNED = torch.zeros(3), torch.zeros(3, 2, 8), torch.zeros(3, 1, 8), torch.zeros(3, 8, 1), torch.zeros(3, 1, 1)
WEIGHTS = {"distance_weight": 0.8, "dissimilarity_weight": 0.2}


def step_of(*tensors):
    adam_steps([AdamStep(*tensors, ONE, 0.1)], ONE, betas=(0.9, 0.999), epsilon=1e-15)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: code_residual(IMAGE, CODES, SCALE), r"expected uint8 or int16 \[4, 3, 3\]"),
        (lambda: code_residual(IMAGE, IMAGE.short(), SCALE), r"expected uint8 or int16 \[4, 3, 3\]"),
        (lambda: code_residual(IMAGE, IMAGE, SCALE), r"expected uint8 or int16 \[4, 3, 3\]"),
        (lambda: photo_loss(IMAGE, CODES, SCALE, **WEIGHTS), "expected uint8 or int16"),
        (lambda: fuse_exposures(torch.zeros(3, 9, 2), *LEARNED, scale=1.0), r"encoded has shape \[3, 9, 2\]"),
        (lambda: fuse_exposures(torch.zeros(3, 9, 3).double(), *LEARNED, scale=1.0), "log_sigma is torch.float32"),
        (lambda: interpolate(torch.zeros(3, 3), 0.0, 1.0, torch.zeros(2, 3)), "with 2 nodes at least"),
        (lambda: interpolate(torch.zeros(8, 3), 0.0, 1.0, torch.zeros(2, 3).double()), "positions is torch.float64"),
        (lambda: step_of(SQUARE, SQUARE[0], SQUARE, SQUARE), "gradient is torch.float32"),
        (lambda: step_of(SQUARE, SQUARE, SQUARE, SQUARE.double()), "second moment is torch.float64"),
    ],
)
def test_misfits_of_what_training_calls_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_distributed_tensors_are_refused_by_a_sentence():
    distributed.init_process_group("gloo", store=distributed.HashStore(), rank=0, world_size=1)
    try:
        image = distribute_tensor(torch.rand(12, 12, 3), init_device_mesh("cpu", (1,)))
        with pytest.raises(TypeError, match="a is a DTensor, which has no memory; pass a plain tensor"):
            ssim(image, image)
    finally:
        distributed.destroy_process_group()
