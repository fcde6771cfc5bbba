"""Simulated photos of the prior's training: what clips has its truth, and a seed gives the same photos."""

import numpy as np
import pytest
import torch

from priors.pack import curves
from priors.panoramas import Pack
from priors.photo_values import averaged
from priors.photos import Camera


def test_clipped_values_are_above_white_and_others_are_decoded(pack):
    photos = Camera(pack, "cpu", np.array([0]), rooms=False, seed=3).take(12, 64, plain=True)
    clipped = photos.clipped > 0
    assert clipped.flatten(1).any(1).all() and not clipped.flatten(1).all(1).any()
    assert (photos.truth[~clipped] == 0).all() and photos.truth[clipped].max() > 1
    # Half a code of white is all that a clipped value may lack.
    assert photos.exposure[clipped].min() > 0.98 and photos.exposure[~clipped].max() < 1


@pytest.mark.parametrize("plain", [False, True])
def test_a_seed_gives_the_same_photos_and_another_gives_others(pack, plain):
    first, again, other = (
        Camera(pack, "cpu", np.array([0, 1]), rooms=True, seed=seed).take(6, 64, plain=plain) for seed in (1, 1, 2)
    )
    for name in ("exposure", "clipped", "truth"):
        assert torch.equal(getattr(first, name), getattr(again, name))
    assert not torch.equal(first.exposure, other.exposure)


def lamp_and_window(tmp_path, brighter: str) -> Pack:
    """Return a pack of a dim panorama in which a lamp of 2 x 2 or a window of 40 x 60 pixels is brighter."""
    panoramas = np.float32(np.random.default_rng(0).uniform(0.1, 0.3, (1, 128, 256, 1))) * np.ones(3, np.float32)
    rows, columns = {"lamp": (slice(60, 62), slice(100, 102)), "window": (slice(40, 80), slice(100, 160))}[brighter]
    panoramas[:, rows, columns] = 40.0
    return Pack(
        panoramas, np.array([False]), ["a"], np.zeros((0, 1, 8, 8, 3), np.float32), curves(tmp_path / "none.mat")
    )


@pytest.mark.parametrize(("brighter", "raised"), [("lamp", True), ("window", False)])
def test_small_lights_alone_are_made_brighter(tmp_path, brighter, raised):
    pack = lamp_and_window(tmp_path, brighter)
    usual, stretched = (
        Camera(pack, "cpu", np.array([0]), rooms=False, seed=5, stretch_share=share).take(96, 64)
        for share in (0.0, 1.0)
    )
    lights = (usual.truth > 2) & (stretched.clipped > 0)
    stops = (stretched.truth - usual.truth)[lights]
    assert lights.sum() > 20
    if raised:
        # A page or a wall that clips around it makes it part of a large area.
        assert (stops > 0.01).float().mean() > 0.5 and stretched.truth.max() <= 2.2 * usual.truth.max()
    else:
        # Corners of a window have little light around them.
        assert (stops > 0.01).float().mean() < 0.1
    # Colored lamps clip in fewer channels, but nearly all of them clip.
    assert (stretched.clipped.amax(1) >= usual.clipped.amax(1)).float().mean() > 0.995


def test_overexposed_photos_clip_up_to_nearly_all(pack):
    shares = [
        Camera(pack, "cpu", np.array([0]), rooms=False, seed=5, overexposed_share=share)
        .take(64, 64)
        .clipped.amax(1)
        .mean((1, 2))
        for share in (0.0, 1.0)
    ]
    assert shares[0].quantile(0.9) < 0.55 < shares[1].quantile(0.8) and shares[1].min() > 0.05


def even_panorama(light, folder) -> Pack:
    """Return a pack of one panorama of the same light everywhere."""
    pictures = np.full((1, 64, 128, 3), light, np.float32)
    return Pack(pictures, np.array([False]), ["a"], np.zeros((0, 1, 8, 8, 3), np.float32), curves(folder / "none.mat"))


def test_lights_that_are_put_in_are_bright_and_light_what_is_around_them(tmp_path):
    grey = even_panorama(0.2, tmp_path)
    unlit, lit = (
        Camera(grey, "cpu", np.array([0]), rooms=False, seed=7, light_share=share).take(64, 64) for share in (0.0, 1.0)
    )
    # Without them noise and JPEG alone clip, by a white balance.
    assert unlit.truth.max() < 1.1 and lit.truth.max() > 4
    assert (lit.truth.flatten(1).max(1).values > 2).float().mean() > 0.25
    # Around lights the wall is brighter than elsewhere: values of a photo differ by more than noise and pages.
    deviation = [photos.exposure.clamp_min(1e-3).log2().flatten(1).std(1).median() for photos in (unlit, lit)]
    assert deviation[1] > 1.5 * deviation[0]


def test_printed_pages_are_put_in_and_are_no_lamps(tmp_path):
    dim = even_panorama(0.01, tmp_path)
    blank, printed = (
        Camera(dim, "cpu", np.array([0]), rooms=False, seed=2, page_share=share).take(200, 64) for share in (0.0, 1.0)
    )
    clipped, before = (photos.clipped.mean((1, 2, 3)) for photos in (printed, blank))
    assert (clipped > before + 0.02).float().mean() > 0.2
    # At most twice white, and somewhat more at one side, by grain and by waves.
    assert printed.truth.max() < 3
    # Letters are dark beside paper that clips: neighbours differ far more than those of an even scene.
    jumps = (printed.exposure.diff(dim=3).abs() > 0.3).float().mean((1, 2, 3))
    assert (jumps[clipped > 0.05] > 0.02).float().mean() > 0.3


def test_overexposed_photos_have_lights_put_in_by_a_share_of_their_own(pack):
    def brightest(**shares):
        camera = Camera(pack, "cpu", np.array([1]), rooms=False, seed=4, overexposed_share=1.0, **shares)
        return camera.take(60, 64).truth.amax((1, 2, 3)).mean()

    none = brightest(light_share=0.0, overexposed_light_share=0.0)
    assert brightest(light_share=1.0, overexposed_light_share=0.0) == none
    assert brightest(light_share=0.0, overexposed_light_share=1.0) > none + 0.5


def test_lamps_that_are_put_in_are_often_colored_and_clip_some_channels_alone(tmp_path):
    grey = even_panorama(0.2, tmp_path)
    photos = Camera(grey, "cpu", np.array([0]), rooms=False, seed=7, light_share=1.0).take(64, 64)
    number = photos.clipped.sum(1)
    assert 0.1 < float(((number > 0) & (number < 3)).sum() / (number > 0).sum()) < 0.9
    # Where all channels clip, those of some photos differ by stops.
    spread = torch.where(number == 3, photos.truth.amax(1) - photos.truth.amin(1), 0).flatten(1).amax(1)
    assert 0.05 < (spread > 2).float().mean() < 0.6


def test_photos_that_are_averaged_keep_the_light_that_clips(pack):
    photos = Camera(pack, "cpu", np.array([0]), rooms=False, seed=3, overexposed_share=0.5).take(8, 64)
    smaller = averaged(photos, 48)
    lights = [(p.clipped * torch.exp2(p.truth)).mean((1, 2, 3)) for p in (photos, smaller)]
    # Pixels of 4 / 3 cover others unevenly.
    torch.testing.assert_close(lights[0], lights[1], rtol=0.05, atol=1e-3)
    part = (smaller.clipped > 0) & (smaller.clipped < 1)
    assert part.any() and (smaller.exposure[smaller.clipped == 1] == 1).all()
    assert (smaller.truth[smaller.clipped == 0] == 0).all() and (smaller.truth >= 0).all()


def test_varied_panoramas_have_other_contrasts_and_orders_of_channels(pack):
    same, varied = (
        Camera(pack, "cpu", np.array([0]), rooms=False, seed=5, varied=value).take(12, 64, plain=True)
        for value in (False, True)
    )
    assert not torch.equal(same.exposure, varied.exposure) and (varied.truth >= 0).all()
    assert (varied.truth[varied.clipped == 0] == 0).all()
