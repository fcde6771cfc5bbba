"""Lights found in Gaussians: place, size and radiance of shapes whose light is known."""

import numpy as np
import pytest
import torch

from sehdr_warp.model.baking import field_of
from sehdr_warp.model.confidence import gather_evidence
from sehdr_warp.model.lights import find_lights
from sehdr_warp.output.lighting.environment_map import latlong
from sehdr_warp.output.lighting.lights import uncertain_lights
from sehdr_warp.scene import Camera, View, codes_of, look_at
from sehdr_warp.splats import GaussianArrays

RADIANCE = np.array([40.0, 30.0, 20.0])


def field(places, radiance, width):
    """Opaque round Gaussians at places [N, 3] of a radiance, [3] or [N, 3], and a width, one or [N, 1]."""
    count = len(places)
    harmonics = np.broadcast_to(np.float32(radiance) / 0.28209479, (count, 3))[:, None].astype(np.float32)
    quaternions = np.tile(np.float32([1, 0, 0, 0]), (count, 1))
    scales = np.broadcast_to(np.float32(np.log(width)), (count, 3)).copy()
    opacity = np.full(count, 6, np.float32)
    return field_of(GaussianArrays(np.float32(places), scales, quaternions, opacity, harmonics, "linear", 1.0))


def panel(width=1.2, height=0.6, step=0.04, at=(0.0, 0.0, 4.0)):
    x, y = np.meshgrid(np.arange(-width / 2, width / 2, step), np.arange(-height / 2, height / 2, step))
    return np.stack([x + at[0], y + at[1], np.full_like(x, at[2])], 2).reshape(-1, 3)


def views(target=(0, 0, 4.0)):
    """Cameras in front of the light, all of which see it whole, as finely as received()."""
    positions = [(x, y, 0) for x in (-0.6, 0, 0.6) for y in (-0.3, 0.3)]
    orientations = [look_at(position, target, up=(0, -1, 0)) for position in positions]
    return [(Camera(256, 192, 240.0, 240.0, 128.0, 96.0, pose), 1.0) for pose in orientations]


def received(scene):
    """Light [3] that a camera at the origin receives: radiance times the solid angle of its pixels."""
    camera = Camera(256, 256, 240.0, 240.0, 128.0, 128.0, look_at((0, 0, 0), (0, 0, 4), up=(0, -1, 0)))
    x = (np.arange(256) + 0.5 - 128) / 240
    angle = (1 + x**2 + x[:, None] ** 2) ** -1.5 / 240**2
    return (scene.render(camera).hdr.numpy() * angle[..., None]).sum((0, 1))


def map_light(scene, middle, focal_length, members):
    """Light that the map of a camera in the middle has, and what it lacks without lights; the brightest of the rest."""
    directions = torch.tensor(latlong(512), dtype=torch.float32)
    options = {"focal_length": focal_length, "pixel_angle": 2 * np.pi / 512}
    whole, rest = (
        scene.render_directions(middle, directions, without=without, **options).hdr.mean(2).numpy()
        for without in ((), members)
    )
    angles = np.cos(np.arcsin(latlong(512)[..., 1])) * (2 * np.pi / 512) ** 2
    total, lost = (float((image * angles).sum()) for image in (whole, whole - rest))
    return total, lost, rest.max()


def test_a_panel_is_found_with_its_place_size_direction_and_light():
    scene = field(panel(), RADIANCE, 0.03)
    (light,) = find_lights(scene, torch.ones(scene.gaussians.count), views())
    assert light.shape.kind == "rect" and light.shape.position == pytest.approx([0, 0, 4], abs=0.03)
    assert light.shape.size == pytest.approx((1.25, 0.65), rel=0.1)  # Gaussians reach beyond their centers
    assert light.shape.axes[2] == pytest.approx([0, 0, -1], abs=0.02)
    # What counts is the light that a surface gets: radiance times solid angle.
    assert light.radiance * light.shape.solid_angle(np.zeros(3)) == pytest.approx(received(scene), rel=0.06)
    assert light.radiance == pytest.approx(RADIANCE, rel=0.05)
    assert light.share == pytest.approx(1, abs=0.15) and len(light.members) == scene.gaussians.count
    assert light.deviation is None and light.lower_bound == pytest.approx(np.ones(3), rel=0.01)


def ball(at, radius=0.3):
    turns = np.random.default_rng(0).normal(size=(900, 3))
    return radius * turns / np.linalg.norm(turns, axis=1, keepdims=True) + at


def test_a_ball_is_a_sphere():
    scene = field(ball((0.5, 0, 4)), RADIANCE, 0.03)
    (light,) = find_lights(scene, torch.ones(900), views((0.5, 0, 4)))
    assert light.shape.kind == "sphere" and light.shape.position == pytest.approx([0.5, 0, 3.9], abs=0.15)
    irradiance = light.radiance * light.shape.solid_angle(np.zeros(3))
    assert irradiance == pytest.approx(received(scene), rel=0.1)


@pytest.mark.parametrize("radius, width", [(0.02, 0.015), (0.02, 0.03), (0.05, 0.02)])
def test_a_tube_keeps_its_length_and_faces_the_photos(radius, width):
    """A slanting tube, half of which cameras see."""
    angle, along = np.random.default_rng(0).uniform([0, -0.5], [np.pi, 0.5], (400, 2)).T
    axis, across = np.array([0.8, 0.6, 0]), np.array([-0.6, 0.8, 0])
    places = np.outer(along, axis) + radius * np.outer(np.cos(angle), across)
    places[:, 2] = 4 - radius * np.sin(angle)
    scene = field(places, RADIANCE, width)
    (light,) = find_lights(scene, torch.ones(400), views())
    assert light.shape.kind == "rect" and light.shape.size[0] == pytest.approx(1.0, abs=0.1)
    assert light.shape.size[1] < 0.2 and abs(light.shape.axes[0] @ axis) == pytest.approx(1, abs=0.01)
    assert light.shape.axes[2] == pytest.approx([0, 0, -1], abs=0.1)
    assert light.radiance == pytest.approx(RADIANCE, rel=0.05)
    assert light.radiance * light.shape.solid_angle(np.zeros(3)) == pytest.approx(received(scene), rel=0.06)


def test_a_strip_of_few_long_gaussians_is_one_light():
    """Gaussians as long as these reach each other, however small most others are."""
    x = np.concatenate([np.linspace(-0.6, -0.385, 40), np.arange(-0.3, 0.5, 0.17)])
    places = np.stack([x, np.zeros_like(x), np.full_like(x, 4)], 1)
    scene = field(places, RADIANCE, np.where(x[:, None] < -0.38, 0.01, [0.15, 0.01, 0.01]))
    (light,) = find_lights(scene, torch.ones(len(x)), views())
    assert light.shape.kind == "rect" and light.shape.size[0] > 0.9 and light.shape.size[1] < 0.06


def test_the_wall_behind_a_colored_tube_does_not_widen_it():
    """The tube clips in all channels, and the wall in one."""
    tube, wall = panel(1, 0.04, 0.02), panel(1, 0.6, 0.04, at=(0, 0, 4.05))
    radiance = np.concatenate([np.tile(RADIANCE, (len(tube), 1)), np.tile([1.0, 0.1, 0.1], (len(wall), 1))])
    scene = field(np.concatenate([tube, wall]), radiance, np.where(radiance[:, 1:2] > 1, 0.01, 0.03))
    (light,) = find_lights(scene, torch.from_numpy(np.where(radiance[:, 1] > 1, 1.0, 0.34)).float(), views())
    assert light.shape.size[0] == pytest.approx(1, abs=0.1) and light.shape.size[1] < 0.1
    assert light.radiance * light.shape.solid_angle(np.zeros(3)) == pytest.approx(received(scene), rel=0.1)


def test_a_panel_of_which_one_half_clips_less_is_one_light():
    """One half clips in all channels, the other half in one, although it is nearly as bright."""
    scene = field(panel(), RADIANCE, 0.03)
    left = scene.gaussians.means[:, 0] < 0
    scene.gaussians.harmonics_dc.data[left] *= 0.7
    (light,) = find_lights(scene, torch.where(left, 0.34, 1.0), views())
    assert light.shape.size == pytest.approx((1.25, 0.65), rel=0.1)
    assert light.radiance == pytest.approx(0.85 * RADIANCE, rel=0.1)


@pytest.mark.parametrize("angle", [0, 0.1])
def test_a_long_gaussian_that_points_at_the_photos_takes_no_light_away(angle):
    places = np.concatenate([panel(0.4, 0.4), [[0, 0, 4]]])
    widths = np.full((len(places), 3), 0.03)
    widths[-1, 2] = 2
    scene = field(places, RADIANCE, widths)
    scene.gaussians.quaternions.data[-1, [0, 2]] = torch.tensor([np.cos(angle), np.sin(angle)]).float()
    (light,) = find_lights(scene, torch.ones(len(places)), views())
    assert light.radiance * light.shape.solid_angle(np.zeros(3)) == pytest.approx(received(scene), rel=0.25)


def test_equally_long_gaussians_reach_no_further_along_their_axes():
    """Rows of them end to end are two lights, as rows side by side at this distance are."""
    row = np.arange(0, 0.4, 0.02)
    for along in (0, 1):
        places = np.full((40, 3), [0, 0, 4.0])
        places[:, along] = np.concatenate([row - 0.46, row + 0.06])
        scene = field(places, RADIANCE, [0.04, 0.01, 0.01])
        assert len(find_lights(scene, torch.ones(40), views())) == 2


@pytest.mark.parametrize("offset", [(0.15, 0, 0), (0, 0.15, 0), (0, 0, 0.15)])
def test_few_gaussians_are_a_light_whatever_plane_they_span(offset):
    places = np.array([[0, 0, 4], np.add(offset, (0, 0, 4)), [-0.01, -0.02, 4.01]])
    scene = field(places, RADIANCE, 0.1)
    (light,) = find_lights(scene, torch.ones(3), views())
    assert light.radiance * light.shape.solid_angle(np.zeros(3)) == pytest.approx(received(scene), rel=0.1)


def test_lights_apart_are_two_and_what_is_dark_or_did_not_clip_is_none():
    places = np.concatenate([panel(0.4, 0.4, at=(-0.7, 0, 4)), panel(0.4, 0.4, at=(0.7, 0, 4))])
    scene, half = field(places, RADIANCE, 0.03), len(places) // 2
    lights = find_lights(scene, torch.ones(len(places)), views())
    assert sorted(light.shape.position[0] for light in lights) == pytest.approx([-0.7, 0.7], abs=0.03)
    clipped = torch.cat([torch.ones(half), torch.zeros(half)])
    assert len(find_lights(scene, clipped, views())) == 1
    assert find_lights(field(places, [0.2, 0.2, 0.2], 0.03), torch.ones(len(places)), views()) == []
    assert find_lights(scene, torch.ones(len(places)), []) == []


@pytest.mark.parametrize("target", [(-2.3, 0, 4.0), (2.3, 0, 4.0), (0, -1.75, 4.0)])
def test_a_light_that_every_photo_cuts_off_has_what_a_map_without_it_loses(target):
    """Large Gaussians at the border of all photos reach beyond it, and a map of the rest lacks all of their light."""
    scene = field(panel(step=0.3), RADIANCE, 0.15)
    (light,) = find_lights(scene, torch.ones(scene.gaussians.count), views(target))
    alphas = [float(scene.render(camera).alpha.sum()) for camera, _ in views(target)]
    assert max(alphas) < 0.9 * float(scene.render(views()[0][0]).alpha.sum())
    middle = np.zeros(3)
    total, lost, _ = map_light(scene, middle, 240.0, [light.members])
    assert light.radiance.mean() * light.shape.solid_angle(middle) == pytest.approx(lost, rel=0.08)
    assert light.share == pytest.approx(lost / total, rel=0.08)


def test_a_walk_s_shares_are_of_the_light_around_what_it_looks_at():
    """A statue as bright as white stands between the cameras, and a panel of four times that behind them."""
    statue, wall = ball((0, 0, 0)) / 2, panel()
    radiance = np.repeat([[1.0] * 3, [4.0] * 3], [len(statue), len(wall)], axis=0)
    scene = field(np.concatenate([statue, wall]), radiance, 0.03)
    turns = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    poses = [look_at((2 * np.sin(t), 0.2, 2 * np.cos(t)), (0, 0, 0), up=(0, -1, 0)) for t in turns]
    photos = [(Camera(256, 192, 120.0, 120.0, 128.0, 96.0, pose), 1.0) for pose in poses]
    lights = {light.shape.kind: light for light in find_lights(scene, torch.ones(scene.gaussians.count), photos)}
    assert lights["rect"].share == pytest.approx(1) and lights["sphere"].share == 0


@pytest.mark.parametrize("target", [(0, 0, 4.0), (4.0, 0, 0), (0, 0, -4.0), (0.5, -3.5, 0)])
def test_panoramas_show_lights_in_all_directions(target):
    scene, clipped = field(ball(target), RADIANCE, 0.03), torch.ones(900)
    places = [(x, y, 0.0) for x in (-0.5, 0, 0.5) for y in (-0.3, 0.3)]
    up = (0, -1, 0) if target[2] or target[1] > -1 else (0, 0, 1)
    poses = [look_at(place, np.add(place, (0, 0, 1)), up=(0, -1, 0)) for place in places]
    wide = [(Camera(256, 128, 40.7, 40.7, 128.0, 64.0, pose, "equirectangular"), 1.0) for pose in poses]
    # As fine as the panoramas: pixels blur small lights.
    plain = [(Camera(64, 64, 40.7, 40.7, 32.0, 32.0, look_at(place, target, up=up)), 1.0) for place in places]
    (irradiance,), (reference,) = find_lights(scene, clipped, wide), find_lights(scene, clipped, plain)
    assert irradiance.shape.size == pytest.approx(reference.shape.size, rel=0.1)
    assert irradiance.radiance == pytest.approx(reference.radiance, rel=0.1)
    assert irradiance.share == pytest.approx(reference.share, rel=0.2)


def test_a_fisheye_lens_shows_a_light_beside_it():
    """At 100 degrees from the axis, where no pinhole shows anything."""
    target = 4 * np.array([np.sin(np.radians(100)), 0, np.cos(np.radians(100))])
    scene, clipped = field(ball(target), RADIANCE, 0.03), torch.ones(900)
    poses = [look_at((0, y, 0), (0, y, 1), up=(0, -1, 0)) for y in (-0.3, 0, 0.3)]
    lens = [(Camera(256, 256, 55.0, 55.0, 128.0, 128.0, pose, "OPENCV_FISHEYE", (0.0,) * 4), 1.0) for pose in poses]
    (light,) = find_lights(scene, clipped, lens)
    poses = [look_at(camera.position, target, up=(0, -1, 0)) for camera, _ in lens]
    plain = [(Camera(128, 96, 120.0, 120.0, 64.0, 48.0, pose), 1.0) for pose in poses]
    (reference,) = find_lights(scene, clipped, plain)
    assert light.shape.size == pytest.approx(reference.shape.size, rel=0.1)
    assert light.radiance == pytest.approx(reference.radiance, rel=0.1)


def test_photos_so_dark_that_lights_do_not_clip_take_none_off_the_list():
    scene = field(panel(), RADIANCE, 0.03)
    clipped = torch.full((scene.gaussians.count,), 0.25)
    assert find_lights(scene, clipped, views()) == []
    two_dark = [(camera, time / (64 if i < 2 else 1)) for i, (camera, time) in enumerate(views())]
    (light,) = find_lights(scene, clipped, two_dark)
    assert len(light.members) == scene.gaussians.count


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
