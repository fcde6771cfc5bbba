"""The third result of gsplat's rasterization(): packed rows, intersections, and copies of it."""

import copy
import pickle

import pytest
import torch

from sehdr_warp.compat.gsplat import rasterization

from .scenes import COUNT, WIDTH, gradients, scene


@pytest.mark.parametrize("options", [{}, {"render_mode": "RGB+ED"}, {"sh_degree": 1}, {"absgrad": True}])
def test_packed_results_are_the_visible_of_the_others(options, device):
    leaves, place = scene(device, coefficients=4 if "sh_degree" in options else 0)
    with torch.no_grad():
        leaves[0][:20, 2] -= 100.0
    results = []
    for packed in (True, False):
        colors, alphas, info = rasterization(*leaves, **place._asdict(), packed=packed, **options)
        info["means2d"].retain_grad()
        results.append((colors, alphas, info, gradients(colors, leaves)))
    (colors, alphas, info, grads), (other_colors, other_alphas, other, expected) = results
    torch.testing.assert_close(colors, other_colors)
    torch.testing.assert_close(alphas, other_alphas)
    for one, two in zip(grads, expected, strict=True):
        torch.testing.assert_close(one, two, rtol=1e-3, atol=1e-4)
    rows = info["camera_ids"], info["gaussian_ids"]
    assert (info["batch_ids"] == 0).all() and 0 < len(rows[0]) < 2 * COUNT - 40
    assert torch.equal((other["radii"] > 0).all(-1).nonzero(), torch.stack(rows, 1))
    for name in ("radii", "means2d", "depths", "conics", "opacities"):
        torch.testing.assert_close(info[name], other[name][rows])
    torch.testing.assert_close(info["means2d"].grad, other["means2d"].grad[rows], rtol=1e-3, atol=1e-4)
    if "absgrad" in options:
        torch.testing.assert_close(info["means2d"].absgrad, other["means2d"].absgrad[rows], rtol=1e-3, atol=1e-4)


def test_intersections_are_made_when_they_are_read(device):
    leaves, place = scene(device)
    _, _, info = rasterization(*leaves, **place._asdict(), packed=False)
    assert {"isect_ids", "flatten_ids", "isect_offsets", "tiles_per_gauss"} <= set(info)
    counts, offsets, ids = info["tiles_per_gauss"], info["isect_offsets"], info["isect_ids"]
    assert counts.shape == (2, COUNT) and int(counts.sum()) == len(ids) == len(info["flatten_ids"])
    assert (
        offsets.shape == (2, 2, 3) and (ids.diff() >= 0).all() and (info["tile_width"], info["tile_height"]) == (3, 2)
    )
    assert torch.equal((counts > 0), (info["radii"] > 0).all(-1))
    # The second camera's last tile: those whose rectangle reaches there.
    last = info["flatten_ids"][int(offsets[1, 1, 2]) :].long() - COUNT
    corner = info["means2d"][1] + info["radii"][1]
    inside = (corner > torch.tensor([32.0, 16.0], device=device)).all(1) & (counts[1] > 0)
    assert set(last.tolist()) == set(inside.nonzero()[:, 0].tolist())
    assert pickle.loads(pickle.dumps({k: v for k, v in info.items() if k != "means2d"}))["width"] == WIDTH


@pytest.mark.parametrize(
    "read",
    [dict, lambda info: {**info}, lambda info: info.copy(), copy.copy, lambda info: info | {}, lambda info: {} | info],
    ids=["dict", "unpacked", "method", "copy", "or", "or of another"],
)
def test_copies_of_meta_hold_values(read):
    leaves, place = scene()
    _, _, info = rasterization(*leaves, **place._asdict())
    copied = read(info)
    assert type(copied) is dict and list(copied) == list(info)
    assert not any(callable(dict.get(copied, key)) for key in copied)
    assert torch.equal(info.pop("isect_ids"), copied["isect_ids"]) and "isect_ids" not in info
    with pytest.raises(KeyError):
        info.pop("isect_ids")
