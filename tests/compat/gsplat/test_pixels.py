"""gsplat's rasterize_to_pixels(): against its formula in float64, rasterization(), and what torch promises."""

import math
from typing import NamedTuple

import pytest
import torch

from sehdr_warp.compat.gsplat import (
    isect_offset_encode,
    isect_tiles,
    rasterization,
    rasterize_to_indices_in_range,
    rasterize_to_pixels,
)

from .scenes import HEIGHT, WIDTH, scene

NAMES = "means2d", "conics", "colors", "opacities"


class Lists(NamedTuple):
    """The images' size, and a list of Gaussians for each of their tiles."""

    image_width: int
    image_height: int
    tile_size: int
    isect_offsets: torch.Tensor
    flatten_ids: torch.Tensor

    def to(self, device):
        return self._replace(isect_offsets=self.isect_offsets.to(device), flatten_ids=self.flatten_ids.to(device))


def pixels(leaves, lists, **options):
    """Images and alphas of means2d, conics, colors and opacities by rasterize_to_pixels()."""
    return rasterize_to_pixels(*leaves[:4], **lists._asdict(), **options)


def formula(gaussians, lists, backgrounds=None, masks=None):
    """The images and alphas of flattened Gaussians, tile by tile, as the sum of 3DGS is written."""
    means2d, conics, colors, opacities = gaussians
    width, height, size, offsets, ids = lists
    *axes, rows, columns = offsets.shape
    begins = [*offsets.flatten().tolist(), len(ids)]
    images, alphas = [], []
    for image in range(math.prod(axes)):
        image_colors = means2d.new_zeros(height, width, colors.shape[-1])
        image_alphas = means2d.new_zeros(height, width)
        for tile in range(rows * columns):
            index = image * rows * columns + tile
            y0, x0 = tile // columns * size, tile % columns * size
            if x0 >= width or y0 >= height or (masks is not None and not masks.flatten()[index]):
                continue
            y, x = torch.meshgrid(
                torch.arange(y0, min(y0 + size, height)), torch.arange(x0, min(x0 + size, width)), indexing="ij"
            )
            left, color = torch.ones(y.shape, dtype=means2d.dtype), 0.0
            done = torch.zeros(y.shape, dtype=torch.bool)
            for row in ids[begins[index] : begins[index + 1]].tolist():
                dx, dy = means2d[row, 0] - x - 0.5, means2d[row, 1] - y - 0.5
                a, b, c = conics[row]
                alpha = (opacities[row] * torch.exp(-(a * dx * dx + c * dy * dy) / 2 - b * dx * dy)).clamp_max(0.999)
                counts = (alpha >= 1 / 255) & ~done
                done = done | (counts & (left * (1 - alpha) <= 1e-4))
                alpha = torch.where(counts & ~done, alpha, 0.0)
                color = color + (left * alpha)[..., None] * colors[row]
                left = left * (1 - alpha)
            image_colors = image_colors.index_put((y, x), color + torch.zeros_like(image_colors[y, x]))
            image_alphas = image_alphas.index_put((y, x), 1 - left)
        if backgrounds is not None:
            image_colors = (
                image_colors + (1 - image_alphas)[..., None] * backgrounds.reshape(-1, colors.shape[-1])[image]
            )
        images.append(image_colors)
        alphas.append(image_alphas[..., None])
    return (torch.stack(parts).reshape([*axes, height, width, -1]) for parts in (images, alphas))


def random_lists(axes, count, size, packed, channels=3, width=37, height=26, seed=0):
    """Gaussians in float64, and for each tile a random list in random order, which leaves some out."""
    generator = torch.Generator().manual_seed(seed)

    def random(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    shape = (count,) if packed else (*axes, count)
    spread = 12.0 * random(*shape, 2, 2) - 6.0
    matrices = torch.linalg.inv(spread @ spread.mT + 20.0 * torch.eye(2))
    conics = torch.stack([matrices[..., 0, 0], matrices[..., 0, 1], matrices[..., 1, 1]], -1)
    means2d = random(*shape, 2) * torch.tensor([width, height])
    tensors = means2d, conics, random(*shape, channels) - 0.3, random(*shape) * 1.2
    tiles = *axes, -(-height // size), -(-width // size)
    lengths = torch.randint(0, 9, (math.prod(tiles),), generator=generator)
    offsets = (lengths.cumsum(0) - lengths).int().reshape(tiles)
    last = count if packed else math.prod(axes) * count
    ids = torch.cat([torch.randperm(last - 2, generator=generator)[:length] for length in lengths]).int()
    backgrounds, masks = random(*axes, channels), random(*tiles) > 0.2
    return tensors, Lists(width, height, size, offsets, ids), backgrounds, masks


@pytest.mark.parametrize(
    ("axes", "packed", "size", "channels"),
    [((2,), False, 16, 3), ((), False, 16, 1), ((2, 1), True, 8, 5), ((1, 2), False, 20, 2), ((3,), True, 32, 3)],
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_any_lists_give_what_the_formula_gives(axes, packed, size, channels, dtype, device):
    tensors, lists, backgrounds, masks = random_lists(axes, 12, size, packed, channels)
    lists.flatten_ids[1:8:3] = lists.flatten_ids[:7:3]  # Some twice in one list
    leaves = [tensor.requires_grad_() for tensor in (*tensors, backgrounds)]
    flat = [tensor.reshape(-1, *tensor.shape[len(tensors[3].shape) :]) for tensor in tensors]
    colors, alphas = formula(flat, lists, backgrounds=leaves[4], masks=masks)
    weights, by_alpha = torch.rand_like(colors), torch.rand_like(alphas)
    true = torch.autograd.grad((colors * weights).sum() + (alphas * by_alpha).sum(), leaves)
    own = [leaf.detach().to(device, dtype).requires_grad_() for leaf in leaves]
    masks = masks.to(device)
    mine, my_alphas = pixels(own, lists.to(device), backgrounds=own[4], masks=masks, packed=packed, absgrad=True)
    assert mine.shape == colors.shape and my_alphas.shape == alphas.shape
    tolerance = {"rtol": 1e-5, "atol": 1e-5 if dtype == torch.float32 else 1e-9}
    torch.testing.assert_close(mine.detach().cpu().double(), colors.detach(), **tolerance)
    torch.testing.assert_close(my_alphas.detach().cpu().double(), alphas.detach(), **tolerance)
    energy = (mine * weights.to(mine)).sum() + (my_alphas * by_alpha.to(mine)).sum()
    for one, two in zip(torch.autograd.grad(energy, own), true, strict=True):
        assert float((one.cpu().double() - two).norm() / two.norm()) < (1e-5 if dtype == torch.float32 else 1e-9)
    assert own[0].absgrad.shape == own[0].shape


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("size", [16, 8])
def test_it_is_what_rasterization_renders(packed, size, device):
    """Images, gradients and absolute gradients of the stages in one call, and of each by itself."""
    leaves, place = scene(device)
    behind = torch.rand(2, 3, generator=torch.Generator().manual_seed(1)).to(device)
    colors, alphas, info = rasterization(
        *leaves, **place._asdict(), packed=packed, tile_size=size, backgrounds=behind, absgrad=True
    )
    means2d, weights = info["means2d"], torch.rand_like(colors)
    means2d.retain_grad()
    ((colors * weights).sum() + alphas.sum()).backward(retain_graph=True)
    true = [*(leaf.grad for leaf in leaves), means2d.grad, means2d.absgrad]
    for tensor in (*leaves, means2d):
        tensor.grad = None
    own = leaves[4][info["gaussian_ids"]] if packed else leaves[4].expand(2, -1, -1)
    options = {"packed": True, "image_ids": info["camera_ids"]} if packed else {}
    _, isect_ids, flatten_ids = isect_tiles(
        means2d, info["radii"], info["depths"], size, info["tile_width"], info["tile_height"], **options
    )
    offsets = isect_offset_encode(isect_ids, 2, info["tile_width"], info["tile_height"])
    splats, lists = (means2d, info["conics"], own, info["opacities"]), Lists(WIDTH, HEIGHT, size, offsets, flatten_ids)
    mine, my_alphas = pixels(splats, lists, backgrounds=behind, packed=packed, absgrad=True)
    torch.testing.assert_close(mine, colors, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(my_alphas, alphas, rtol=1e-5, atol=1e-5)
    ((mine * weights).sum() + my_alphas.sum()).backward()
    for one, two in zip([*(leaf.grad for leaf in leaves), means2d.grad, means2d.absgrad], true, strict=True):
        assert float((one - two).norm() / two.norm()) < 1e-5


def test_absolute_gradients_are_sums_over_pixels(device):
    tensors, lists, _, _ = random_lists((2,), 5, 8, False, width=14, height=10)
    leaves = [tensor.to(device).requires_grad_() for tensor in tensors]
    means2d = leaves[0]
    colors, _ = pixels(leaves, lists.to(device), absgrad=True)
    colors.mul_(0.5)
    energy = (colors * torch.randn(colors.shape, generator=torch.Generator().manual_seed(2)).to(colors)).sum(-1)
    sums = sum(torch.autograd.grad(each, means2d, retain_graph=True)[0].abs() for each in energy.flatten())
    for _ in range(2):
        energy.sum().backward(retain_graph=True)
        torch.testing.assert_close(means2d.absgrad, sums, rtol=1e-6, atol=1e-9)
    assert (sums > 0).any()


@pytest.mark.parametrize("size", [16, 2])
def test_what_pixels_show_in_ranges_makes_the_image(size, device):
    """Blended pixel by pixel, what two ranges of batches name is the image; the second begins where the first ends."""
    tensors, lists, _, _ = random_lists((2,), 12, size, False)
    means2d, conics, colors, opacities = (tensor.to(device) for tensor in tensors)
    opacities, second = opacities.clamp_min(0.6), int(lists.isect_offsets[1, 0, 0])
    lists.flatten_ids[:second] %= 12  # Each image has its own 12 Gaussians.
    lists.flatten_ids[second:] = lists.flatten_ids[second:] % 12 + 12
    lists = lists.to(device)
    true, _ = pixels((means2d, conics, colors, opacities), lists)
    width, height = lists[:2]
    image, left = torch.zeros_like(true), means2d.new_ones(2, height, width)
    count = 0
    for first, last in ((0, 1), (1, 10**10)):
        found = rasterize_to_indices_in_range(first, last, left.clone(), means2d, conics, opacities, **lists._asdict())
        keys = found[2] * width * height + found[1]
        assert (keys.diff() >= 0).all() and all(each.dtype == torch.int64 for each in found)
        count += len(keys)
        for gaussian, pixel, index in zip(*(each.tolist() for each in found), strict=True):
            y, x = divmod(pixel, width)
            dx, dy = means2d[index, gaussian] - means2d.new_tensor([x + 0.5, y + 0.5])
            a, b, c = conics[index, gaussian]
            alpha = (opacities[index, gaussian] * torch.exp(-(a * dx * dx + c * dy * dy) / 2 - b * dx * dy)).clamp_max(
                0.999
            )
            image[index, y, x] += left[index, y, x] * alpha * colors[index, gaussian]
            left[index, y, x] *= 1 - alpha
    torch.testing.assert_close(image, true)
    assert count > 500


def test_what_cannot_be_drawn_is_left_out(device):
    """Gaussians that are not finite, that are no ellipse, too faint or far away: no image changes, gradients are 0."""
    tensors, lists, _, _ = random_lists((1,), 12, 16, False)
    lists, leaves = lists.to(device), [tensor.to(device) for tensor in tensors]
    with torch.no_grad():
        leaves[0][0, 0], leaves[0][0, 1] = math.nan, torch.tensor([1e30, -1e30])
        leaves[1][0, 2], leaves[1][0, 3] = math.inf, torch.tensor([1.0, 2.0, 1.0])
        leaves[2][0, 4], leaves[3][0, 5], leaves[3][0, 6], leaves[3][0, 7] = math.nan, math.nan, 1 / 256, math.inf
    leaves = [leaf.requires_grad_() for leaf in leaves]
    colors, alphas = pixels(leaves, lists)
    used = torch.isin(lists.flatten_ids, torch.arange(8, device=device), invert=True)
    before = torch.cat([used.new_zeros(1, dtype=torch.int64), used.cumsum(0)])
    shorter = lists._replace(isect_offsets=before[lists.isect_offsets.long()], flatten_ids=lists.flatten_ids[used])
    fine = [leaf.detach().nan_to_num(0.0, 0.5, 0.5) for leaf in leaves]
    true, true_alphas = pixels(fine, shorter)
    assert torch.equal(colors, true) and torch.equal(alphas, true_alphas) and 0 < int(used.sum()) < len(used)
    (colors.sum() + alphas.sum()).backward()
    for leaf in leaves:
        assert (leaf.grad[0, :8] == 0).all() and (leaf.grad[0, 8:] != 0).any()


def test_needles_are_drawn_whole(device):
    """Draw a Gaussian 1000 times as long as wide, of whose determinant float32 leaves little."""
    turn, spread = torch.tensor([[0.8, -0.6], [0.6, 0.8]]).double(), torch.tensor([1e3, 1.0]).double()
    conic = torch.linalg.inv(turn * spread.square() @ turn.T).float().to(device)
    conics = torch.stack([conic[0, 0], conic[0, 1], conic[1, 1]])[None, None]
    center, color = torch.tensor([[[20.0, 15.0]]], device=device), torch.ones(1, 1, 1, device=device)
    splat = center, conics, color, torch.full((1, 1), 0.5, device=device)
    offsets = torch.arange(6, dtype=torch.int32).view(1, 2, 3)
    lists = Lists(WIDTH, HEIGHT, 16, offsets, torch.zeros(6, dtype=torch.int64))
    colors, _ = pixels(splat, lists.to(device))
    true, _ = formula([tensor[0].double().cpu() for tensor in splat], lists)
    torch.testing.assert_close(colors.cpu(), true.float(), rtol=1e-4, atol=1e-3)
    assert (colors > 0.4).sum() > 30


def test_gradients_are_derivatives():
    tensors, lists, backgrounds, masks = random_lists((2,), 5, 16, False, channels=2, width=18, height=10)
    spread = tensors[1] * 0.05  # Wide: no pixel is near the threshold, where the image is not continuous.
    leaves = [
        each.clone().requires_grad_() for each in (tensors[0], spread, tensors[2], tensors[3] * 0.5 + 0.1, backgrounds)
    ]
    assert torch.autograd.gradcheck(lambda *t: pixels(t, lists, backgrounds=t[4], masks=masks), leaves, atol=1e-6)


def test_torchs_contract():
    tensors, lists, _, _ = random_lists((1,), 9, 16, False)
    leaves = [tensor.float().requires_grad_() for tensor in tensors]
    colors, _ = pixels(leaves, lists)
    once = torch.autograd.grad(colors.sum(), leaves, retain_graph=True)
    twice = torch.autograd.grad(colors.sum(), leaves)
    assert all(map(torch.equal, once, twice))
    with pytest.raises(RuntimeError, match="second time"):
        torch.autograd.grad(colors.sum(), leaves)
    first = torch.autograd.grad(pixels(leaves, lists)[0].sum(), leaves[0], create_graph=True)[0]
    with pytest.raises(RuntimeError, match="differentiable once"):
        first.sum().backward()
    changed = leaves[2].clone()
    image, _ = pixels((*leaves[:2], changed, leaves[3]), lists)
    changed.mul_(2.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        image.sum().backward()
    compiled = torch.compile(lambda *t: pixels(t, lists)[0] * 2.0, backend="eager")
    torch.testing.assert_close(compiled(*leaves), colors * 2.0)
    with torch.autocast("cpu", torch.bfloat16):
        half = pixels((*leaves[:2], leaves[2].bfloat16(), leaves[3]), lists)[0]
    assert half.dtype == torch.float32 and bool(((half - colors).abs() < 0.01).all())


def test_nothing_to_draw_is_the_background(device):
    empty = [torch.zeros(1, 0, *shape, device=device) for shape in ((2,), (3,), (3,), ())]
    offsets, ids = (torch.zeros(*shape, dtype=torch.int32, device=device) for shape in ((1, 1, 2), (0,)))
    behind = torch.tensor([0.2, 0.4, 0.6], device=device, requires_grad=True)
    colors, alphas = rasterize_to_pixels(*empty, 20, 9, 16, offsets, ids, backgrounds=behind)
    assert torch.equal(colors, behind.expand(1, 9, 20, 3)) and not alphas.any()
    colors.sum().backward()
    assert behind.grad.tolist() == [180.0] * 3


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"conics": torch.zeros(1, 9, 2)}, ValueError, r"conics has shape \[1, 9, 2\], expected \[1, N, 3\]"),
        ({"opacities": torch.zeros(1, 9, 1)}, ValueError, r"opacities has shape \[1, 9, 1\], expected \[1, N\]"),
        ({"colors": torch.zeros(1, 9, 3).double()}, ValueError, "colors is torch.float64 on cpu, but means2d is"),
        ({"colors": torch.zeros(1, 9, 0)}, ValueError, r"colors has shape \[1, 9, 0\], which has no channel"),
        ({"means2d": [1.0]}, TypeError, "means2d is a list, expected a torch tensor"),
        ({"backgrounds": torch.zeros(2, 3)}, ValueError, r"backgrounds has shape \[2, 3\], expected \[1, D\]"),
        ({"masks": torch.ones(1, 2, 2)}, ValueError, r"masks has shape \[1, 2, 2\], expected \[1, 2, 3\]"),
        ({"masks": torch.ones(1, 2, 3)}, ValueError, "masks is torch.float32, expected torch.bool"),
        ({"isect_offsets": torch.zeros(2, 2, 3).int()}, ValueError, r"isect_offsets has shape .* expected \[1, tile_h"),
        ({"isect_offsets": torch.zeros(1, 2, 3)}, ValueError, "isect_offsets is torch.float32, expected torch.int32"),
        ({"isect_offsets": None}, TypeError, "isect_offsets is a NoneType"),
        ({"isect_offsets": torch.zeros(1, 1, 3).int()}, ValueError, "3 x 1 tiles of tile_size 16, which do not cover"),
        ({"isect_offsets": torch.arange(6, 0, -1).int().view(1, 2, 3)}, ValueError, "isect_offsets has numbers that"),
        ({"flatten_ids": torch.zeros(2, 2).int()}, ValueError, r"flatten_ids has shape \[2, 2\], expected \[4\]"),
        ({"flatten_ids": [0]}, TypeError, r"flatten_ids is a list, expected a tensor \[M\]"),
        ({"flatten_ids": torch.full((99,), 9).int()}, ValueError, "flatten_ids has numbers from 9 to 9, .* below 9"),
        ({"tile_size": 0}, ValueError, r"tile_size 0 is not in 1\.\."),
        ({"image_width": 2.5}, TypeError, r"image_width is 2\.5, expected a whole number"),
    ],
)  # fmt: skip
def test_errors_name_the_argument(change, error, message):
    tensors, lists, _, _ = random_lists((1,), 9, 16, False)
    arguments = dict(zip(NAMES, (tensor.float() for tensor in tensors), strict=True)) | lists._asdict()
    with pytest.raises(error, match=message):
        rasterize_to_pixels(**(arguments | change))
