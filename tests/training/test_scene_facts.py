"""Figures of a scene that are measured before its training."""

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.scene import View, codes_of
from sehdr_warp.training.scene_facts import measure_scene


def with_codes(view: View, codes: np.ndarray) -> View:
    """The view with other codes, perhaps of another size."""
    height, width, _ = codes.shape
    return replace(view, codes=codes, camera=view.camera.resized(width, height), hdr=None)


def test_facts_are_those_of_the_scene(scene, facts):
    assert (facts.photos, facts.truths) == (6, 6)
    assert facts.pixels == 6 * 32 * 32 and facts.points == len(scene.points) == 60
    # Cameras on a full circle see most of a cloud in its middle.
    assert facts.overlap > 0.5 and facts.visibility > 4
    clipped = [(view.image >= 254.5 / 255).any(2).mean() for view in scene.train_views]
    assert facts.clipped == pytest.approx(float(np.mean(clipped)))


def test_brackets_clip_as_much_as_their_darkest_photos(scene):
    views = [
        replace(view, exposure_time=time, codes=codes_of(np.clip(time * view.image, 0, 1)))
        for view, time in zip(scene.views, [0.25, 1.0, 9.0] * len(scene.views), strict=False)
    ]
    facts = measure_scene(replace(scene, views=tuple(views)))
    assert facts.clipped_when_dark < 0.01 < facts.clipped
    assert measure_scene(scene).clipped_when_dark == measure_scene(scene).clipped


def test_facts_count_what_masks_keep(scene):
    """A subject before a white wall: only the wall clips, and only outside the masks."""
    wall = np.arange(32)[None, :] < 12
    views = [
        replace(
            view,
            codes=codes_of(np.where(wall[..., None], 1.0, 0.1 + 0.5 * view.image)),
            mask=(~wall * np.ones((32, 1)) if masked else np.zeros((32, 32))).astype(np.float32),
        )
        for view, masked in zip(scene.views, [True] * (len(scene.views) - 1) + [False], strict=True)
    ]
    before = measure_scene(replace(scene, views=tuple(replace(view, mask=None) for view in views)))
    facts = measure_scene(replace(scene, views=tuple(views)))
    assert before.clipped == before.clipped_when_dark == 12 / 32
    assert facts.clipped == facts.clipped_when_dark == facts.plateau == 0
    assert 0 < facts.contrast < before.contrast


@pytest.mark.parametrize(
    ("white", "quality", "plateau"), [(240, 95, 240), (228, 85, 228), (240, None, 240), (255, 95, 0), (190, 95, 0)]
)
def test_a_white_below_255_is_found_in_jpegs_that_ring(scene, white, quality, plateau):
    """Noisy rooms with a window, whose edge JPEG makes brighter than the window in some pixels."""
    rng, views = np.random.default_rng(0), []
    for view in scene.views:
        light = np.clip(rng.normal(0.5, 0.08, (96, 128, 1)), 0, 1) * [1.0, 0.9, 0.8]
        light[20:70, 30:90] = 1
        codes = np.rint(white * light).astype(np.uint8)
        if quality:
            file = io.BytesIO()
            Image.fromarray(codes).save(file, "JPEG", quality=quality)
            codes = np.asarray(Image.open(file))
            assert white == 255 or codes.max() > white + 2
        views.append(with_codes(view, codes))
    assert measure_scene(replace(scene, views=tuple(views))).plateau == plateau


@pytest.mark.parametrize("lamp", [False, True], ids=["shaded wall", "even page beside a lamp"])
def test_a_bright_surface_is_no_white_below_255(scene, lamp):
    codes = np.random.default_rng(0).normal(225, 6, (96, 128, 1)).clip(0, 254).repeat(3, 2)
    if lamp:
        codes[10:50, 10:60], codes[60:70, 60:70] = 225, 255
    codes = np.rint(codes).astype(np.uint8)
    views = [with_codes(view, codes) for view in scene.views]
    assert measure_scene(replace(scene, views=tuple(views))).plateau == 0
