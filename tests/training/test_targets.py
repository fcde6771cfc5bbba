"""Training views, stacked so that a step can take one by a number on the device."""

import dataclasses

import numpy as np
import torch

from sehdr_warp.scene import codes_of
from sehdr_warp.training.targets import STORED, ViewStack, training_views

from .toy import EXPOSURE_TIME, toy_scene


def views_of(scene, device):
    return training_views(scene.train_views, EXPOSURE_TIME, device, truth=True)


def images(view):
    target = view.target
    return {name: getattr(target, name) for name in STORED} | {"photo": target.encoded}


def test_a_stacked_view_is_the_view(device):
    scene = toy_scene()
    masked = dataclasses.replace(scene.views[1], mask=np.tri(32, dtype=np.float32), exposure_time=0.5)
    scene = dataclasses.replace(scene, views=(scene.views[0], masked, *scene.views[2:]))
    views = views_of(scene, device)
    stack = ViewStack.of(views)
    assert len(stack) == len(views)
    for i, view in enumerate(views):
        for taken in (stack[i], stack.at(torch.tensor([i], device=device))):
            assert float(taken.exposure_time) == view.exposure_time
            assert torch.equal(taken.camera.world_to_camera, view.camera.world_to_camera)
            assert torch.equal(taken.camera.intrinsics, view.camera.intrinsics)
            assert torch.equal(taken.camera.position, view.camera.position)
            for name, image in images(taken).items():
                own = images(view)[name]
                if own is None and image is not None:
                    # A view without a mask counts everywhere; one without clipped or black pixels has none.
                    assert bool((image == (1 if name == "mask" else 0)).all())
                else:
                    assert (image is None) == (own is None) and (own is None or torch.equal(image, own))


def test_equal_times_stay_numbers_and_differing_sizes_do_not_stack(device):
    views = views_of(toy_scene(), device)
    assert ViewStack.of(views).times == EXPOSURE_TIME
    assert ViewStack.of(views + views_of(toy_scene(size=16), device)) is None


def test_photos_of_whole_codes_are_stacked_in_a_byte_each_and_come_back_exactly(device):
    every = (np.arange(32 * 32 * 3) % 256).reshape(32, 32, 3).astype(np.float32) / np.float32(255)
    scene = toy_scene()
    for values, dtype in ((every, torch.uint8), (every * np.float32(0.999), torch.float32)):
        views = views_of(
            dataclasses.replace(scene, views=(dataclasses.replace(scene.views[0], codes=codes_of(values)),)), device
        )
        stack = ViewStack.of(views)
        assert stack.images["photo"].dtype == dtype
        late = stack.at(torch.zeros(1, dtype=torch.int64, device=device))
        assert late.target.photo is stack.images["photo"]
        for taken in (stack[0], late):
            assert np.allclose(taken.target.encoded.cpu().numpy(), values, atol=1e-5)


def test_masks_of_codes_are_made_when_they_are_asked_for(device):
    values = np.zeros((32, 32, 3), np.float32)
    values[:16], values[16:, :8] = 1.0, np.float32(7 / 255)
    scene = toy_scene()
    whole = dataclasses.replace(scene.views[0], codes=codes_of(values))
    broken = dataclasses.replace(whole, codes=codes_of(values * np.float32(0.99)))
    alone, mixed = (
        ViewStack.of(views_of(dataclasses.replace(scene, views=views), device)) for views in ((whole,), (whole, broken))
    )
    assert alone.images["clipped"] is True and mixed.images["photo"].dtype == torch.float32
    for stack in (alone, mixed):
        target = stack[0].target
        assert np.array_equal(target.clipped.cpu().numpy(), values == 1)
        assert np.array_equal(target.black.cpu().numpy(), values == 0)
    assert not bool(mixed[1].target.clipped.any())


def test_bounds_are_noted_where_asked_for(device):
    scene = toy_scene()
    dark = dataclasses.replace(scene.views[0], codes=np.zeros((32, 32, 3), np.uint8))
    for bounds in (True, False):
        views = training_views((dark,), 1.0, device, truth=False, bounds=bounds)
        assert (views[0].target.black is not None) == bounds
