"""Further shapes, places and radiance of splats, and poison in cameras, harmonics and images."""

import math
from collections.abc import Iterator
from functools import partial
from itertools import product

import torch

from sehdr_warp.check.case import UNIT, Case, Reading, as_float32, count, not_finite
from sehdr_warp.check.splat_cases import POISON, Splats, compare_splats, measure_of, overlap
from sehdr_warp.kernels.constants import NEAR_PLANE
from sehdr_warp.rasterizer import spherical_harmonics, ssim_map
from sehdr_warp.rasterizer.reference import rasterize_reference


def _far_away() -> Splats:
    splats = Splats(30)
    splats.means *= 1e6
    splats.log_scales += math.log(1e6)
    return splats


def _light_behind() -> Iterator[Splats]:
    """Place dim Gaussians, whose gradients must survive, before a bright one, and before a dim one."""
    for radiance, label in ((1e8, "{}"), (1e-8, "{}, dim alone")):
        splats = Splats(30, spread=0.8, label=label)
        splats.opacities *= 0.4
        splats.features[:] = 1e-8
        splats.features[splats.means[:, 2].argmax()] = radiance
        yield splats


def _on_borders() -> Splats:
    splats = Splats(16, width=33, height=17)
    focal_x, focal_y, cx, cy = splats.intrinsics
    x = torch.tensor([0.0, 33.0, 16.5, 16.5, 0.0, 33.0, 33.0, 0.0, -3.0, 36.0, 16.0, 16.0, -0.01, 33.01, 8.0, 25.0])
    y = torch.tensor([8.5, 8.5, 0.0, 17.0, 0.0, 17.0, 0.0, 17.0, 8.0, 8.0, -3.0, 20.0, 17.01, -0.01, 0.01, 16.99])
    splats.means[:, 0] = (x - cx) / focal_x * splats.means[:, 2]
    splats.means[:, 1] = (y - cy) / focal_y * splats.means[:, 2]
    return splats


def _near_plane(device):
    """Compare Gaussians around the near plane, and count those behind it that are drawn."""
    splats = Splats(16, spread=0.001)
    near = torch.tensor(NEAR_PLANE, dtype=torch.float32).item()
    # Float32's own roundings of a depth are 1e-9 here: nearer than 1e-6 there is no telling before from behind.
    steps = torch.tensor([-1e3, -1.0, -0.01, -1e-6, 1e-6, 1e-4, 1e-3, 1e-2], dtype=torch.float64)
    splats.means[:8, 2], splats.means[8:, 2] = near + steps, 3.0
    splats.means[:8, :2] = 0.0
    splats.log_scales[:8] = math.log(1e-3)
    splats.ties = True
    yield from compare_splats(splats, device)
    splats.means[0, 2] = near
    behind = splats.means[:, 2].float() <= near
    yield count("drawn behind the near plane", (splats.render(*splats.float32(device)).visible.cpu() & behind).sum())


def _quaternions(device):
    """Compare quaternions with lengths from 1e-12 to 1e15, and zero with the identity."""
    splats = Splats(20)
    for length in (1e-12, 1e-6, 1e6, 1e15):
        splats.quaternions *= length / splats.quaternions.norm(dim=1, keepdim=True)
        splats.label = f"{{}} at {length:g}"
        yield from compare_splats(splats, device)
    splats.quaternions[:] = 0.0
    zero = splats.render(*splats.float32(device)).image
    splats.quaternions[:, 0] = 1.0
    wrong = (zero != splats.render(*splats.float32(device)).image).sum()
    yield count("numbers in which zero differs from the identity", wrong)


def _far(distance: float, device):
    """Compare centers, in pixels, of a scene far from the origin before a rotated camera."""
    splats = Splats(30)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64))[0]
    turn = turn * torch.linalg.det(turn)
    offset = torch.tensor([distance, -0.7 * distance, 0.4 * distance], dtype=torch.float64)
    splats.means = ((splats.means + offset) @ turn).float().double()
    splats.world_to_camera[:3, :3], splats.world_to_camera[:3, 3] = turn.float().double(), -offset.float().double()
    rendering = splats.render(*splats.float32(device))
    exact = as_float32(splats.tensors.values())
    truth = rasterize_reference(*exact, width=splats.width, height=splats.height)
    both = rendering.visible.cpu() & truth.visible
    error = (rendering.means2d.cpu().double() - truth.means2d)[both].norm(dim=1).max()
    nearest, focal = float(truth.depths[both].min()), float(splats.intrinsics[0])
    # Each coordinate before the camera is a sum of four numbers as large as the distance.
    bound = 4 * math.sqrt(3) * UNIT * 1.3 * distance * focal / nearest
    yield Reading("centers, pixels", float(error), bound)
    yield count("not finite", not_finite(rendering.image))


def _poisoned_camera(device):
    """Poison one number of the camera at a time: it is refused, or nothing is shown if it is not finite."""
    wrong = 0
    for which, value, place in product((5, 6), POISON, range(4)):
        splats = Splats(12, 20, 18)
        tensors = splats.float32(device)
        tensors[which].view(-1)[place] = value
        try:
            rendering = splats.render(*tensors)
        except ValueError:  # Refused on the CPU, which can look at the camera without waiting for a GPU.
            continue
        wrong += not_finite(rendering.image, rendering.alpha)
        wrong += 0 if math.isfinite(value) else int(rendering.image.count_nonzero())
    yield count("pixels shown or not finite", wrong)


def _poisoned_others(device):
    """Poison one number of harmonics or images, and count effects outside of its row or window."""
    generator = torch.Generator().manual_seed(0)
    coefficients = torch.randn(8, 16, 3, generator=generator).to(device)
    means = torch.randn(8, 3, generator=generator).to(device)
    rows = pixels = 0
    for value in POISON:
        for poisoned in (0, 1):
            arguments = [coefficients.clone(), means.clone()]
            arguments[poisoned][3].view(-1)[0] = value
            result = spherical_harmonics(3, *arguments, camera_position=torch.zeros(3, device=device))
            rows += not_finite(torch.cat([result[:3], result[4:]]))
        image = torch.rand(30, 30, 3, generator=generator).to(device)
        spoiled = image.clone()
        spoiled[4, 4, 0] = value
        similarity = ssim_map(spoiled, image)
        pixels += not_finite(similarity[10:], similarity[:, 10:], similarity[..., 1:])  # the window reaches five pixels
    yield count("other rows of harmonics not finite", rows)
    yield count("similarity not finite beyond the window", pixels)


SPLAT_CASES = (
    Case("scale-tiny", "standard deviations from 1e-7", measure_of(lambda: Splats(24, scales=(1e-7, 2e-7, 5e-7)))),
    Case("scale-huge", "standard deviations from 1e4: each covers the image",
         measure_of(lambda: Splats(24, scales=(1e4, 2e4, 5e4))),
         note="a Gaussian wider than about 4e9 pixels overflows the determinant and is culled"),
    Case("disc", "discs, 1e6 times wider than thick", measure_of(lambda: Splats(24, scales=(1e1, 1e1, 1e-5)))),
    Case("near-plane", "at, before and behind the near plane", _near_plane),
    Case("border", "centers on and beyond the image's borders", measure_of(_on_borders)),
    Case("subpixel", "a thousandth of a pixel wide", measure_of(lambda: Splats(24, scales=(1e-4, 2e-5, 5e-5)))),
    Case("overlap-100k", "10^5 Gaussians in one tile, all counted",
         measure_of(lambda: overlap(100_000, 5e-5, 1e-6)), quick=False),
    Case("radiance-dark", "radiance from 1e-12 to 1e-8", measure_of(lambda: Splats(50, radiance=(-12, -8)))),
    Case("radiance-bright", "radiance from 1e5 to 1e9", measure_of(lambda: Splats(50, radiance=(5, 9)))),
    Case("decades", "16 decades of radiance within a pixel", measure_of(_light_behind)),
    Case("quaternions", "unnormalized, zero and huge quaternions", _quaternions),
    Case("far-1e3", "scene and camera 1e3 units from the origin", partial(_far, 1e3)),
    Case("far-1e6", "scene and camera 1e6 units from the origin", partial(_far, 1e6),
         note="float32 places are 0.06 units apart there: move the scene to the origin before training"),
    Case("far-away", "1e6 units before the camera, and as large", measure_of(_far_away)),
    Case("poison-camera", "NaN, infinite, huge and denormal numbers in the camera", _poisoned_camera, "poison"),
    Case("poison-others", "the same in harmonics and similarity", _poisoned_others, "poison"),
)  # fmt: skip
