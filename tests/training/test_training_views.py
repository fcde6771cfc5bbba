"""Training views, stacked so that a step can take one by a number on the device."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from sehdr_warp.response import response_by_name
from sehdr_warp.training.training_views import ViewDataset, ViewStack

from .toy import EXPOSURE_TIME, toy_scene


def views_of(views, device, **options):
    return list(ViewDataset(views, EXPOSURE_TIME, device, truth=True, **options))


def test_a_stacked_view_is_the_view(device):
    views = list(toy_scene().train_views)
    views[1] = dataclasses.replace(views[1], mask=np.tri(32, dtype=np.float32), exposure_time=0.5)
    alone = views_of(views, device)
    stack = ViewStack.of(alone)
    assert len(stack) == len(alone)
    for i, view in enumerate(alone):
        late = stack.at(torch.tensor([i], device=device))
        assert late.target.codes is stack.targets.codes
        for each in (stack[i], late):
            assert float(each.exposure_time) == view.exposure_time
            for name in ("world_to_camera", "intrinsics", "position"):
                assert torch.equal(getattr(each.camera, name), getattr(view.camera, name))
            assert torch.equal(each.target.encoded, view.target.encoded)
            assert torch.equal(each.target.exposure_truth, view.target.exposure_truth)
            # One without a mask counts everywhere.
            whole = torch.ones_like(each.target.mask)
            assert torch.equal(each.target.mask, whole if view.target.mask is None else view.target.mask)


def test_equal_times_stay_numbers_and_differing_sizes_do_not_stack(device):
    views = views_of(toy_scene().train_views, device)
    assert ViewStack.of(views).times == EXPOSURE_TIME
    assert ViewStack.of(views).targets.mask is None
    assert ViewStack.of(views + views_of(toy_scene(size=16).train_views, device)) is None


def test_codes_stay_codes_and_come_back_exactly(device):
    view = toy_scene().views[0]
    bytes_ = (np.arange(32 * 32 * 3) % 256).reshape(32, 32, 3).astype(np.uint8)
    words = np.random.default_rng(0).integers(0, 65536, (32, 32, 3)).astype(np.uint16)
    plain, deep = (dataclasses.replace(view, codes=codes) for codes in (bytes_, words))
    for views, dtype in (((plain,), torch.uint8), ((plain, deep), torch.int16)):
        stacked = views_of(views, device)
        assert {one.target.codes.dtype for one in stacked} == {dtype}
        for one, original in zip(stacked, views, strict=True):
            np.testing.assert_array_equal(one.target.encoded.cpu().numpy(), original.image)


@pytest.mark.parametrize("deep", [False, True])
def test_a_scale_has_black_at_0_and_white_at_1(device, deep):
    view = toy_scene().views[0]
    view = dataclasses.replace(view, codes=view.codes.astype(np.uint16)) if deep else view
    for light in (None, response_by_name("srgb")):
        scale = views_of((view,), device, response=light)[0].target.scale
        for wide in (False, light is not None and not deep):
            worth, least, most = scale.table.unbind(1)
            assert len(worth) == (65536 if deep else 256)
            assert worth[0] == 0 and worth[-1].item() == pytest.approx(1, abs=2e-3)
            assert bool((worth.diff() > 0).all()) and least[0] == -math.inf and most[-1] == math.inf
            assert bool((least <= worth).all() and (worth <= most).all()) and most[0] > 0 and least[-1] < worth[-1]
            # Codes of the dark stand for more light than others, and not for that of the next.
            assert bool((least < most)[1:20].any()) == wide and bool((least < most)[1:20].all()) == wide
            assert bool((most[1:-2] < least[2:-1]).all())
            scale.use_intervals()
    worth, least, most = views_of((view,), device, clipping=False)[0].target.scale.table.unbind(1)
    assert torch.equal(least, worth) and torch.equal(most, worth)
