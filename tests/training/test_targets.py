"""Training views, stacked so that a step can take one by a number on the device."""

import dataclasses

import numpy as np
import torch

from sehdr_warp.model.response import response_by_name
from sehdr_warp.training.targets import ViewStack, training_views

from .toy import EXPOSURE_TIME, toy_scene


def views_of(scene, device, level=0):
    return training_views(scene.train_views, level, response_by_name("srgb"), EXPOSURE_TIME, device, truth=True)


def images(view):
    return {field.name: getattr(view.target, field.name) for field in dataclasses.fields(view.target)}


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
