"""Lights found in Gaussians: place, size and radiance of shapes whose light is known."""

import numpy as np
import pytest
import torch

from sehdr_warp.model.baking import field_of
from sehdr_warp.model.lights import find_lights
from sehdr_warp.output.lighting.environment_map import latlong
from sehdr_warp.scene import Camera, look_at
from sehdr_warp.splats import GaussianArrays

RADIANCE = np.array([40.0, 30.0, 20.0])


def field(places, radiance, width, slope=0.0):
    """Opaque round Gaussians at places [N, 3] of a radiance, [3] or [N, 3], and a width, one or [N, 1].

    `slope` is their harmonic along x.
    """
    count = len(places)
    harmonics = np.zeros((count, 4 if slope else 1, 3), np.float32)
    harmonics[:, 0] = np.float32(radiance) / 0.28209479
    harmonics[:, 3:] = -slope
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


def test_a_light_of_faint_gaussians_is_as_bright_as_its_pixels():
    """Each is ten times as bright as any pixel, whatever lies behind it."""
    places = np.concatenate([panel(), panel(3, 3, at=(0, 0, 4.2))])
    radiance = np.where(places[:, 2:] < 4.1, 400, 0.03) * np.ones(3)
    scene = field(places, radiance, 0.03)
    lamp = torch.from_numpy(places[:, 2] < 4.1)
    scene.gaussians.opacity_logits.data[lamp] = -4
    cameras = views()
    (light,) = find_lights(scene, lamp.float(), cameras)
    brightest = max(float(scene.render(camera).hdr.max()) for camera, _ in cameras)
    assert brightest < 100 and light.radiance.mean() == pytest.approx(brightest, rel=0.2)
    assert light.radiance * light.shape.solid_angle(np.zeros(3)) == pytest.approx(received(scene), rel=0.1)
