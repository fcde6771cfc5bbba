"""Evidence of photos for lights: darker photos that clip or measure them, deviations, and lower bounds."""

import numpy as np
import pytest
import torch

from sehdr_warp.model.confidence import gather_evidence
from sehdr_warp.model.light_evidence import Candidates, deviation_of_light, is_surface
from sehdr_warp.model.lights import find_lights
from sehdr_warp.output.lighting.lights import uncertain_lights
from sehdr_warp.scene import Camera, View, codes_of, look_at

from .test_lights import RADIANCE, ball, field, map_light, panel, views


@pytest.mark.parametrize(
    "darker, direction, stops", [(64, 1, 0.25), (8, 1, 1.6), (64, -1, 1.6)], ids=["clear", "still clipped", "elsewhere"]
)
def test_a_light_is_sure_if_a_darker_photo_shows_it_unclipped(darker, direction, stops):
    scene = field(panel(), RADIANCE, 0.03)
    scene.clipped_stops = torch.full((scene.gaussians.count,), 1.2)
    (camera, time), *others = views()
    turned = look_at(camera.position, np.add(camera.position, (0, 0, direction)), up=(0, -1, 0))
    dark = (Camera(256, 192, 240.0, 240.0, 128.0, 96.0, turned), time / darker)
    (light,) = find_lights(scene, torch.full((scene.gaussians.count,), 0.75), [*others, dark])
    assert light.deviation == pytest.approx(stops, rel=0.01) and light.measured == (stops < 1)


def test_a_darker_photo_of_most_of_a_light_leaves_the_doubt_to_the_rest():
    """The part that it cuts off is what makes the light uncertain: the scene does not contradict the photo."""
    scene = field(panel(), RADIANCE, 0.03)
    scene.clipped_stops = torch.full((scene.gaussians.count,), 1.5)
    (camera, time), *others = views()
    ahead = look_at(camera.position, np.add(camera.position, (0, 0, 1)), up=(0, -1, 0))
    dark = (Camera(256, 192, 240.0, 240.0, 211.0, 96.0, ahead), time / 64)
    (light,) = find_lights(scene, torch.full((scene.gaussians.count,), 5 / 6), [*others, dark])
    assert 0.6 < light.deviation < 1.0 and light.measured < 0.5


def test_a_darker_photo_measures_gaussians_that_are_brighter_than_its_white():
    """Bright Gaussians among dark ones, which blend to pixels below the white of the dark photo."""
    places = panel()
    radiance = np.where(np.arange(len(places))[:, None] % 4 == 0, 4 * RADIANCE, 0.01)
    scene = field(places, radiance, 0.06)
    scene.gaussians.opacity_logits.data[:] = -1
    scene.clipped_stops = torch.full((scene.gaussians.count,), 1.2)
    *others, (camera, time) = views()
    limit = float(scene.render(camera).hdr.max())
    assert radiance.max() > 1.5 * limit
    for white, clipped, stops in ((1.1 * limit, 5 / 6, 0.25), (limit / 4, 1.0, 1.2)):
        shares = torch.full((scene.gaussians.count,), clipped)
        (light,) = find_lights(scene, shares, [*others, (camera, time / white)])
        assert light.deviation == pytest.approx(stops, rel=0.01)


@pytest.mark.parametrize("bright", [5, 60])
def test_what_the_darker_photo_clips_is_not_measured_though_the_scene_is_darker(bright):
    """A panel of which the darkest photo shows three fifths unclipped and clips the rest, which the scene misses."""
    scene = field(panel(), RADIANCE, 0.03)
    scene.clipped_stops = torch.full((scene.gaussians.count,), 3.0)
    (camera, time), *others = views()
    shots = [*(others * (bright // 5)), (camera, time / 64)]
    unclipped = scene.gaussians.means[:, 0] < scene.gaussians.means[:, 0].quantile(0.6)
    shares = 1 - unclipped.float() / len(shots)
    (light,) = find_lights(scene, shares, shots)
    assert 1.3 < light.deviation < 1.5 and light.measured < 0.2
    (sentence,) = uncertain_lights({"light_0": light})
    assert "three photos" in sentence


def photograph(scene, views, truth=None):
    """Measure a scene on photos of itself, or of another scene; return the clipped shares."""
    photos = []
    for camera, time in views:
        image = scene.response.encode((truth or scene).render(camera).hdr * time).clamp(0, 1).numpy()
        photos.append(View(f"v{len(photos)}", codes_of(image, 8), camera, time, "train"))
    evidence = gather_evidence(scene, photos)
    scene.clipped_stops, scene.confidence = evidence.clipped_stops, evidence.confidence()
    return evidence.clipped


def small_views(targets=((0, 0, 4.0), (0.3, 0.3, 4.0))):
    return [(camera.resized(85, 64), time) for target in targets for camera, time in views(target)]


LAMPS = {
    "apart": ([panel(0.3, 0.3, at=(-0.7, 0.2, 4)), panel(0.2, 0.2, at=(0.7, -0.2, 4))], 2),
    "touching": ([panel(0.2, 0.2, at=(0, 0, 4)), panel(0.2, 0.2, at=(0.2, 0, 4))], 1),
    "at the border": ([panel(0.3, 0.3, at=(2.4, 0, 4)), panel(0.3, 0.3, at=(-0.5, 0, 4))], 2),
}


@pytest.mark.parametrize(
    "lamps, dark", [*(("apart", dark) for dark in (0, 1, 6, 8)), ("touching", 8), ("at the border", 11)]
)
def test_lights_are_listed_with_their_energy_however_many_photos_are_dark(lamps, dark):
    """Lamps before a grey wall, in twelve photos of which some are six stops darker than the others."""
    places, count = LAMPS[lamps]
    wall = panel(6, 4, 0.12, at=(0, 0, 5.0))
    radiance = np.concatenate([np.full((len(wall), 3), 0.3), np.tile(RADIANCE, (sum(map(len, places)), 1))])
    scene = field(np.concatenate([wall, *places]), radiance, np.where(radiance[:, :1] < 1, 0.08, 0.03))
    times = np.ones(12)
    times[np.linspace(0, 11, dark).astype(int)] = 1 / 64
    shots = [(camera, time) for (camera, _), time in zip(small_views(), times, strict=True)]
    lights = find_lights(scene, photograph(scene, shots), shots)
    assert len(lights) == count
    middle = np.mean([camera.position for camera, _ in shots], axis=0)
    total, lost, brightest = map_light(scene, middle, 80.0, [light.members for light in lights])
    assert brightest < 1
    energy = sum(light.radiance.mean() * light.shape.solid_angle(middle) for light in lights)
    assert energy == pytest.approx(lost, rel=0.1) and sum(x.share for x in lights) == pytest.approx(
        lost / total, rel=0.1
    )
    assert [light.deviation for light in lights] == pytest.approx([0.25 if dark else 1.0] * count, abs=0.01)


@pytest.mark.parametrize("darker, bound", [(1, (1, 1, 1)), (8, (8, 8, 8)), (25, (25, 25, 1))])
def test_a_darker_photo_that_clips_raises_the_lower_bound(darker, bound):
    scene = field(panel(), RADIANCE, 0.03)
    shots = [(camera, 1.0 if index % 2 else 1 / darker) for index, (camera, _) in enumerate(small_views())]
    (light,) = find_lights(scene, photograph(scene, shots), shots)
    assert light.lower_bound == pytest.approx(bound, rel=0.15)  # Pixels at its edge clip in fewer photos.
    # A scene that is twice as bright as the photos, of which the darker ones then clip nothing
    bright = field(panel(), 2 * RADIANCE, 0.03)
    (light,) = find_lights(bright, photograph(bright, shots, field(panel(), (7, 7, 7), 0.03)), shots)
    assert light.lower_bound == pytest.approx((1, 1, 1), rel=0.05)


def test_one_dark_photo_of_many_raises_the_lower_bound_only_if_it_clips():
    shots = [(camera, 1.0) for camera, _ in 2 * small_views()]
    shots[0] = (shots[0][0], 1 / 16)
    scene, truth = (field(panel(), (radiance,) * 3, 0.03) for radiance in (24, 9.6))
    (measured,) = find_lights(scene, photograph(scene, shots), shots)
    assert measured.lower_bound.min() > 10
    (light,) = find_lights(scene, photograph(scene, shots, truth), shots)
    assert light.lower_bound.max() < 9.6


def test_a_channel_that_dark_photos_do_not_clip_keeps_a_bound_below_its_light():
    shots = [(camera, 1.0) for camera, _ in 4 * small_views()]
    shots[:3] = [(camera, 1 / 16) for camera, _ in shots[:3]]
    scene, truth = field(panel(), (24.0, 24.0, 24.0), 0.03), field(panel(), (24.0, 24.0, 8.0), 0.03)
    (light,) = find_lights(scene, photograph(scene, shots, truth), shots)
    assert light.lower_bound[2] < 8


def test_errors_of_unclipped_values_count_if_these_measure_a_light():
    """The scene has a quarter of the light that six dark photos show. Six others clip it."""
    scene, truth = field(panel(), RADIANCE / 8, 0.03), field(panel(), RADIANCE / 2, 0.03)
    shots = [(camera, 1.0 if index % 2 else 1 / 64) for index, (camera, _) in enumerate(small_views())]
    for photos, deviation in ((truth, 1.0), (scene, 0.25)):
        clipped = photograph(scene, shots, photos)
        (light,) = find_lights(scene, clipped, shots)
        assert light.deviation == pytest.approx(deviation, abs=0.05)


def group_of(radiance, unclipped, **values):
    """Gaussians that each photo sees under one steradian, of a radiance [V, K] in their brightest channel.

    `unclipped` [V, K] is where photos of half the exposure or less do not clip them. Clipped values deviate by 2 stops.
    """
    radiance, unclipped = np.array(radiance, float), np.array(unclipped, bool)
    count = radiance.shape[1]
    fields = {"index": torch.arange(count), "positions": np.zeros((count, 3)), "axes": np.zeros((count, 3, 3))}
    fields |= {"weights": radiance.mean(0), "brightness": radiance.max(0), "too_bright": np.ones(count, bool)}
    fields |= {"measured": unclipped.any(0), "unclipped": unclipped, "clipped": np.full(count, 0.8)}
    fields |= {"stops": np.full(count, 1.6), "doubt": np.full(count, 1.6), "angles": np.ones_like(radiance)}
    fields |= {"pixel_brightness": np.ones((count, 2))}
    return Candidates(**fields | {"light": radiance[..., None] * [0.5, 1.0, 0.2]} | values)


@pytest.mark.parametrize(
    "radiance, unclipped, values, expected",
    [
        ([[1.3, 1.3], [9, 9]], [[1, 1], [0, 0]], {}, True),
        ([[1.8, 1.8], [9, 9]], [[1, 1], [0, 0]], {}, False),
        ([[1.3, 1.3], [9, 9]], [[1, 1], [0, 0]], {"doubt": np.full(2, 1.8)}, False),
        ([[1.2] * 19 + [8.0]], [[1] * 20], {}, False),
        ([[1.3, 1.3], [9, 9]], [[1, 0], [0, 0]], {"weights": np.array([2.0, 3.0])}, False),
        ([[1.3, 1.3], [9, 9]], [[1, 0], [0, 0]], {"weights": np.array([3.0, 2.0])}, True),
        ([[1.2, 1.2, 9]], [[1, 1, 1]], {"measured": np.array([True, True, False]), "weights": np.ones(3)}, True),
        ([[0, 0], [9, 9]], [[1, 1], [0, 0]], {}, False),
        ([[1.3, 1.3]], [[1, 1]], {"stops": None}, False),
    ],
    ids=[
        "page",
        "lamp",
        "contradiction",
        "small-lamp",
        "less-than-half",
        "most",
        "unmeasured",
        "dark",
        "not-estimated",
    ],
)
def test_a_surface_is_what_photos_that_do_not_clip_it_measure_below_twice_white(radiance, unclipped, values, expected):
    assert is_surface(group_of(radiance, unclipped, **values), 1.0) is expected


@pytest.mark.parametrize(
    "dark, bright, expected", [(8, 8, 0.25), (8, 16, 1.0), (16, 8, 1.0), (8, 80, 2.0), (0, 8, 0.25), (8, 0, 0.25)]
)
def test_a_light_deviates_by_what_it_differs_towards_photos_that_clip_it(dark, bright, expected):
    """The deviation is at most that without the darker photo."""
    group = group_of([[dark, dark], [bright, bright]], [[1, 1], [0, 0]])
    assert deviation_of_light(group) == pytest.approx((expected, 1.0))


@pytest.mark.parametrize("radiance, dark, listed", [(1.3, 3, False), (1.3, 0, True), (3.0, 3, True), (20.0, 3, True)])
@pytest.mark.parametrize("shape", [panel(0.4, 0.3), ball((0, 0, 4), 0.2)], ids=["page", "head"])
def test_what_dark_photos_measure_as_bright_as_a_white_surface_is_no_light(shape, radiance, dark, listed):
    """A page and a statue's head before a grey wall, a little above white, in photos of which three are darker."""
    wall = panel(6, 4, 0.12, at=(0, 0, 5.0))
    light = np.repeat([[0.3] * 3, [radiance] * 3], [len(wall), len(shape)], axis=0)
    scene = field(np.concatenate([wall, shape]), light, np.where(light[:, :1] < 1, 0.08, 0.03))
    shots = [(camera, time / (16 if index < dark else 1)) for index, (camera, time) in enumerate(small_views())]
    assert len(find_lights(scene, photograph(scene, shots), shots)) == listed


def test_a_small_lamp_stays_although_a_lit_wall_around_it_is_measured():
    wall, lamp = panel(0.8, 0.8), panel(0.12, 0.12, 0.03, at=(0, 0, 3.95))
    light = np.repeat([[1.3] * 3, [40.0] * 3], [len(wall), len(lamp)], axis=0)
    scene = field(np.concatenate([wall, lamp]), light, 0.03)
    shots = [(camera, time / (64 if index < 3 else 1)) for index, (camera, time) in enumerate(small_views())]
    (result,) = find_lights(scene, photograph(scene, shots), shots)
    assert len(result.members) >= len(lamp)


def test_a_scene_that_is_darker_towards_photos_that_clip_is_not_sure():
    """Left photos are dark and measure 15, which the scene has towards them alone: harmonics hide the rest."""
    scene = field(panel(), (10.0,) * 3, 0.03, slope=68.0)
    scene.clipped_stops = torch.full((scene.gaussians.count,), 2.0)
    shots = [(camera, 1 / 64 if camera.position[0] < -0.5 else 1.0) for camera, _ in views()]
    (light,) = find_lights(scene, torch.full((scene.gaussians.count,), 0.8), shots)
    assert light.deviation == pytest.approx(1.0, abs=0.15) and light.measured > 0.9


def test_bright_places_that_darker_photos_alone_show_are_no_lights():
    """Build a walk from a room into the sun, where the camera shortens its exposure."""
    scene = field(np.concatenate([panel(6, 4, 0.12), panel(6, 4, 0.12, at=(0, 0, -4.0))]), (0.3, 0.3, 0.3), 0.08)
    outside = scene.gaussians.means[:, 2] < 0
    scene.gaussians.harmonics_dc.data[outside] *= 64
    inside_views = [(camera, 1.0) for camera, _ in small_views(((0, 0, 4.0),))]
    outside_views = [(camera, 1 / 64) for camera, _ in small_views(((0, 0, -4.0),))]
    shots = inside_views + outside_views
    clipped = photograph(scene, shots)
    assert not clipped.any() and find_lights(scene, clipped, shots) == []
