"""Renders of another resolution than the photos give the same light."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.linalg import null_space
from scipy.spatial.transform import Rotation

from sehdr_warp import Camera, load_run
from sehdr_warp.kernels.constants import EPS2D
from sehdr_warp.model import pixel_filter
from sehdr_warp.model.gaussians import Gaussians
from sehdr_warp.model.lights import received_light
from sehdr_warp.model.pixel_filter import (
    ROUNDING,
    FocalRange,
    keep_light,
    options_at_place,
    photo_filters,
    samples_across_pixel,
)
from sehdr_warp.model.radiance_field import RadianceField
from sehdr_warp.model.renders import CameraTensors
from sehdr_warp.output.lighting.environment_map import latlong, solid_angles
from sehdr_warp.rasterizer.reference import project_reference
from sehdr_warp.response import response_by_name
from sehdr_warp.scene.wide_camera import pixel_directions, pixels_of_directions

from ..refusals import call

PHOTO = Camera(48, 36, 40.0, 40.0, 24.0, 18.0, np.eye(4))
FISHEYE = Camera(48, 36, 40.0, 40.0, 24.0, 18.0, np.eye(4), projection="OPENCV_FISHEYE", distortion=(0.0,) * 4)
FOCALS = FocalRange(40.0, 40.0)


def lamps(focals=FOCALS, **options):
    """Bright Gaussians of a fifth of a pixel."""
    places = torch.tensor([[-0.5, -0.3, 2.0], [0.1, 0.2, 3.0], [0.6, 0.4, 2.5]])
    gaussians = Gaussians.from_points(places, torch.full((3, 3), math.log(1000.0)), 0, opacity=0.6)
    gaussians.overwrite({"log_scales": torch.full((3, 3), math.log(0.01)) + torch.tensor([0.0, 0.5, 0.0])})
    response = response_by_name("srgb")
    return RadianceField(gaussians, response, base_time=1.0, photo_focals=focals, **options)


def mean_light(field, camera, scale):
    return float(field.render(camera.resized(round(48 * scale), round(36 * scale))).hdr.mean())


def lamp(cameras, **options):
    """One of these lamps, two units in front of the photo."""
    field = lamps(**options)
    means, logits = torch.tensor([[0.0, 0.0, 2.0]]).expand(3, 3), torch.tensor([0.4, -20.0, -20.0])
    field.gaussians.overwrite({"means": means, "opacity_logits": logits})
    field.photo_cameras = cameras
    return field


def received_on_map(field, place, rows=512):
    """Light that a map of a place has, in pixels as fine as the photo's or finer."""
    directions = torch.tensor(latlong(2 * rows), dtype=torch.float32)
    light = field.render_directions(place, directions, focal_length=PHOTO.fx, pixel_angle=np.pi / rows).hdr.mean(2)
    return float((light.numpy() * solid_angles(2 * rows, "latlong")).sum() * (np.pi / rows) ** 2)


@pytest.mark.parametrize("distance", [0.5, 1.0, 4.0])
def test_a_place_nearer_to_a_lamp_than_the_photos_receives_more_of_its_light(distance):
    place, photo = np.array([0.0, 0.0, 2.0 - distance]), np.zeros(3)
    field, without = lamp([PHOTO]), lamp([])
    as_in_photo = received_on_map(without, photo)
    assert received_on_map(field, photo) == pytest.approx(as_in_photo, rel=0.03)
    expected = as_in_photo * (2 / distance) ** 2
    assert received_on_map(field, place) == pytest.approx(expected, rel=0.05)
    assert received_light(field, place, PHOTO.fx).light.mean(1).sum() == pytest.approx(expected, rel=0.1)
    assert not 0.7 < received_on_map(without, place) / expected < 1.4, "what happens without"


@pytest.mark.parametrize("pixel_angle", [1e-4, 0.2])
def test_turned_flat_gaussians_keep_their_light_in_pixels_of_any_size(pixel_angle):
    """Opacity times the area across the line of sight, in float64, is that of sizes with the photos' filter."""
    field, place = lamps(), np.array([0.7, -0.4, 1.0])
    turns = Rotation.random(3, random_state=0)
    scales = np.array([[0.001, 0.01, 0.05], [0.02, 0.002, 0.002], [0.3, 0.1, 0.01]])
    quaternions = 3 * np.roll(turns.as_quat(), 1, axis=1)  # Of any length
    field.gaussians.overwrite({"log_scales": torch.tensor(scales).log(), "quaternions": torch.tensor(quaternions)})
    field.photo_cameras = [PHOTO]
    opacities = field.gaussians.opacities().detach()
    options = options_at_place(field, torch.tensor(place, dtype=torch.float32), opacities, PHOTO.fx, pixel_angle)

    def areas(variances):
        covariances = turns.as_matrix() * variances[:, None] @ turns.as_matrix().transpose(0, 2, 1)
        sights = field.gaussians.means.detach().numpy() - place
        sights /= np.linalg.norm(sights, axis=1, keepdims=True)
        across = [null_space(sight[None]) for sight in sights]
        return [np.sqrt(np.linalg.det(a.T @ each @ a)) for a, each in zip(across, covariances, strict=True)]

    expected = opacities.numpy() * areas(scales**2 + field.filters.mean.numpy()[:, None] ** 2)
    light = options.opacities.numpy() * areas(np.exp(2 * options.log_scales.double().numpy()))
    np.testing.assert_allclose(light, expected, rtol=1e-5)
    if pixel_angle < 0.1:
        assert torch.equal(options.opacities, opacities)


def test_a_map_has_gaussians_whose_squared_areas_overflow():
    light = []
    for cameras in ([PHOTO], []):
        field = lamp(cameras)
        field.gaussians.overwrite({"log_scales": torch.full((3, 3), math.log(1e13))})
        light.append(received_on_map(field, np.zeros(3), rows=32))
    assert light[0] == pytest.approx(light[1]) and light[0] > 1000


def test_a_map_hides_what_photos_hide():
    """A lamp is behind a white Gaussian by depth, and in front of it by distance."""
    field, rays = lamps(), torch.tensor([[[0.3, 0.0, 1.0]]]) / math.hypot(0.3, 1.0)
    means = torch.tensor([[0.4, 0.0, 2.01], [0.6, 0.0, 2.0], [0.0, 9.0, 1.0]])
    sizes, colors = torch.tensor([0.2, 0.2, 0.001]).log()[:, None], torch.tensor([1000.0, 1.0, 1.0]).log()
    field.gaussians.overwrite(
        {"means": means, "log_scales": sizes.expand(3, 3), "opacity_logits": torch.full((3,), 9.0)}
    )
    field.gaussians.harmonics_dc.data = colors[:, None, None].expand(3, 1, 3) / 0.28209479
    light = []
    for cameras in ([PHOTO], [], [PHOTO, FISHEYE, *[PHOTO] * 40]):
        vars(field).pop("filters", None)
        field.photo_cameras = cameras
        light.append(float(field.render_directions(np.zeros(3), rays, focal_length=40.0, pixel_angle=0.01).hdr.mean()))
    assert light[0] < 10 and field.render(PHOTO).hdr[18, 36].mean() < 10
    assert min(light[1:]) > 100, "by distance without photos, and if some are wide"


def test_a_place_needs_no_filter_where_opacities_make_up_for_it():
    assert lamp([PHOTO], antialiased=True).filters is None and lamp([]).filters is None
    stated = lamp([PHOTO])
    stated.photo_filters = np.full(3, 0.25, np.float32)  # As a file states them
    assert torch.equal(stated.filters.mean, torch.full((3,), 0.25))


@pytest.mark.parametrize("camera", [PHOTO, FISHEYE], ids=["pinhole", "fisheye"])
@pytest.mark.parametrize(("distance", "scale"), [(1.0, 1.0), (0.5, 1.0), (0.5, 2.0), (1.0, 0.5)])
def test_views_that_are_nearer_to_a_lamp_than_the_photos_have_all_its_light(camera, distance, scale):
    field, without = lamp([camera]), lamp([])
    near = replace(camera, world_to_camera=pose_at(distance - 2.0))
    expected = mean_light(without, camera, 1.0) * (2 / distance) ** 2
    assert mean_light(field, near, scale) == pytest.approx(expected, rel=0.05)
    assert mean_light(without, near, scale) < 0.7 * expected, "what happens without"


def test_views_from_where_photos_are_or_farther_stay():
    far = replace(PHOTO, world_to_camera=pose_at(3.0))
    for photos in ([PHOTO], [far, PHOTO], [PHOTO, far]):
        for view in (PHOTO, far):
            assert torch.equal(lamp(photos).render(view).hdr, lamp([]).render(view).hdr)
    behind = replace(PHOTO, world_to_camera=np.diag([-1.0, 1, -1, 1]))
    near = replace(PHOTO, world_to_camera=pose_at(-1.5))
    assert torch.equal(lamp([behind]).render(near).hdr, lamp([]).render(near).hdr), "no photo shows it"
    compensated = lamp([PHOTO], antialiased=True), lamp([], antialiased=True)
    assert torch.equal(*(field.render(near).hdr for field in compensated))


@pytest.mark.parametrize(("camera", "aside"), [(PHOTO, 0.64), (FISHEYE, 0.72)], ids=["pinhole", "fisheye"])
def test_photos_that_show_a_gaussian_at_their_border_stay(camera, aside):
    """Its center is outside of the near photo, and inside of the far one."""
    near, light = replace(camera, world_to_camera=pose_at(-1.0)), []
    for photos in ([camera, near], [camera], []):
        field = lamp(photos)
        places, sizes = torch.tensor([[aside, 0.0, 2.0]]).expand(3, 3), torch.full((3, 3), math.log(0.03))
        field.gaussians.overwrite({"means": places, "log_scales": sizes})
        light.append(field.render(near).hdr)
    assert torch.equal(light[0], light[2]) and light[0].max() > 1
    assert not torch.equal(light[1], light[2]), "what happens without the near photo"


@pytest.mark.parametrize("antialiased", [False, True])
def test_the_middle_of_a_wide_view_is_that_of_the_photo(antialiased):
    """A Gaussian beside the photo's field of view does not reach into it."""
    wide, light = replace(PHOTO, width=48 + 384, cx=24.0 + 192), []
    for photos in ([PHOTO], [wide, PHOTO], []):
        field = lamp(photos, antialiased=antialiased)
        places, sizes = torch.tensor([[1.0, 0.0, 0.3]]).expand(3, 3), torch.full((3, 3), math.log(0.1))
        field.gaussians.overwrite({"means": places, "log_scales": sizes})
        light.append(field.render(wide).hdr)
        assert not field.render(PHOTO).hdr.any()
    assert not light[0][:, 192:240].any() and light[0].max() > 1
    assert torch.equal(light[1], light[2]), "it is as wide as a photo"
    assert light[2][:, 192:240].max() > 1, "what happens without"


@pytest.mark.parametrize("photos", [[], [PHOTO], [PHOTO, FISHEYE], [PHOTO, FISHEYE, FISHEYE], [FISHEYE]], ids=str)
def test_pinholes_are_drawn_along_their_rays_if_most_photos_are_wide(photos):
    """A large Gaussian is nearer than another, and behind it by depth; its own depth stays that along the axis."""
    field = lamp(photos)
    places, sizes = torch.tensor([[0.9, 0.0, 1.6], [0.45, 0.0, 1.7], [0.0, 9.0, 1.0]]), torch.tensor([0.1, 0.3, 0.1])
    shapes = {"means": places, "log_scales": sizes.log()[:, None].expand(3, 3)}
    field.gaussians.overwrite(shapes | {"opacity_logits": torch.tensor([-9.0, 1.0, -9.0])})
    view = field.render(PHOTO)
    torch.testing.assert_close(
        view.depth[view.alpha > 0.01], torch.full((1,), 1.7).expand(int((view.alpha > 0.01).sum()))
    )
    field.gaussians.overwrite({"opacity_logits": torch.tensor([1.0, 1.0, -9.0])})
    field.gaussians.harmonics_dc.data[1] = 0
    rays = torch.tensor(pixel_directions(PHOTO), dtype=torch.float32)
    on_sphere = field.render_directions(np.zeros(3), rays, focal_length=40.0, pixel_angle=1 / 40).hdr
    along_rays = torch.allclose(field.render(PHOTO).hdr, on_sphere, rtol=0.02, atol=0.1)
    assert along_rays == (sum(camera is FISHEYE for camera in photos) > len(photos) / 2)


def test_filters_that_a_render_under_autocast_leaves_are_precise():
    places = torch.tensor([[-0.5, -0.3, 2.0], [0.1, 0.2, 3.0], [9.0, 0.4, 2.5]])
    moved = [replace(PHOTO, world_to_camera=pose_at(0.1234))]
    with torch.autocast("cpu", dtype=torch.bfloat16):
        filters = photo_filters(places, moved)
    assert all(map(torch.equal, filters, photo_filters(places, moved)))


def test_all_photos_count_if_gaussians_are_few(monkeypatch):
    far, near = (replace(PHOTO, world_to_camera=pose_at(depth)) for depth in (8.0, 2.0))
    photos, places = [far, near, *[far] * 200], np.zeros((3, 3))
    pixel = (1 - ROUNDING) * math.sqrt(EPS2D) / 40
    np.testing.assert_allclose(filters_at(places, photos).least, 2 * pixel, rtol=1e-6)
    monkeypatch.setattr(pixel_filter, "MOST_PROJECTIONS", 300)
    np.testing.assert_allclose(filters_at(places, photos).least, 8 * pixel, rtol=1e-6)


@pytest.mark.parametrize("scale", [0.5, 2.0, 4.0])
@pytest.mark.parametrize("camera", [PHOTO, FISHEYE], ids=["pinhole", "fisheye"])
def test_small_lamps_keep_their_light_at_other_sizes(camera, scale):
    as_photo = mean_light(lamps(), camera, 1.0)
    assert mean_light(lamps(), camera, scale) == pytest.approx(as_photo, rel=0.05)
    assert not 0.7 < mean_light(lamps(focals=None), camera, scale) / as_photo < 1.4, "what happens without"


def test_photos_of_several_focal_lengths_are_rendered_as_in_training():
    field, plain = lamps(FocalRange(20.0, 80.0)), lamps(focals=None)
    for scale in (0.5, 1.0, 2.0):
        camera = PHOTO.resized(round(48 * scale), round(36 * scale))
        assert torch.equal(field.render(camera).hdr, plain.render(camera).hdr)


def test_a_side_that_is_rounded_to_pixels_is_no_other_resolution():
    focals = FocalRange(700.0, 700.0)
    assert focals.variance(700.0 * 1.0009) == focals.variance(700.0 * 0.9991) == EPS2D
    for focal, samples in ((690.0, 1), (600.0, 2), (200.0, 4)):
        assert samples_across_pixel(lamps(focals), replace(PHOTO, fx=focal)) == samples


def test_opacity_times_area_stays():
    """Compare with the reference's projection in float64."""
    generator = torch.Generator().manual_seed(0)
    means = torch.randn(50, 3, generator=generator, dtype=torch.float64) * 0.1 + torch.tensor([0, 0, 3.0])
    log_scales = torch.randn(50, 3, generator=generator, dtype=torch.float64) - 4
    quaternions = torch.randn(50, 4, generator=generator, dtype=torch.float64)
    opacities = torch.full((50,), 0.5, dtype=torch.float64)
    pose, intrinsics = torch.eye(4, dtype=torch.float64), torch.tensor([20.0, 22.0, 12.0, 9.0], dtype=torch.float64)
    camera = CameraTensors(24, 18, pose, intrinsics, torch.zeros(3, dtype=torch.float64))

    def area(variance):
        arguments = means, log_scales, quaternions, opacities, pose, intrinsics, 24, 18, 0.01, variance, 1e-9, False
        a, b, c = project_reference(*arguments)[1].unbind(1)
        return 1 / (a * c - b * b).sqrt()

    new_opacities = keep_light(opacities, means, log_scales, quaternions, camera, 0.05)
    torch.testing.assert_close(new_opacities * area(EPS2D), opacities * area(0.05), rtol=1e-9, atol=0)


def test_the_filter_of_photos_is_the_mean_of_cameras_that_show_a_place_or_of_the_nearest():
    near, far = (replace(PHOTO, world_to_camera=pose_at(depth)) for depth in (2.0, 8.0))
    pixel = math.sqrt(EPS2D) / 40
    middle, behind = np.array([0.0, 0, 0]), np.array([0.0, 0, -9.0])
    aside = replace(near, cx=500.0)
    for place, cameras, mean, least in (
        (middle, [far], 8, 8),
        (middle, [far, near], 4, 2),
        (middle, [far, aside], 8, 8),
        (behind, [far, near], 1, 0),
        (middle, [replace(FISHEYE, world_to_camera=pose_at(3.0))], 3, 3),
    ):
        filters = filters_at(place[None], cameras)
        np.testing.assert_allclose(filters.mean, mean * pixel, rtol=1e-6)
        np.testing.assert_allclose(filters.least, (1 - ROUNDING) * least * pixel, rtol=1e-6)


def filters_at(places, cameras):
    return photo_filters(torch.from_numpy(places), cameras)


@pytest.mark.parametrize("distortion", [(0.0, 0.0), (-0.1, 0.0)], ids=["to 180 degrees", "to 105 degrees"])
def test_fisheye_photos_have_no_part_in_filters_of_what_is_behind_them(distortion):
    pixel, place = math.sqrt(EPS2D) / 40, np.array([[0.0, 0, 0]])
    ahead = replace(FISHEYE, projection="RADIAL_FISHEYE", distortion=distortion, world_to_camera=pose_at(2.0))
    behind = replace(ahead, world_to_camera=pose_at(-8.0))
    np.testing.assert_allclose(filters_at(place, [ahead, behind]).mean, 2 * pixel, rtol=1e-6)


def test_filters_are_computed_a_part_at_a_time(monkeypatch):
    places = np.random.default_rng(0).uniform(-1, 1, (20, 3)) + np.array([0, 0, 1.5])
    whole, sizes = filters_at(places, [PHOTO, FISHEYE]), []

    def project(directions, camera):
        sizes.append(len(directions))
        return pixels_of_directions(directions, camera)

    monkeypatch.setattr(pixel_filter, "ROWS", 8)
    monkeypatch.setattr(pixel_filter, "pixels_of_directions", project)
    for one, other in zip(whole, filters_at(places, [PHOTO, FISHEYE]), strict=True):
        torch.testing.assert_close(one, other)
    assert sizes == [8, 8, 4]


def pose_at(depth):
    """A camera that far in front of the origin."""
    pose = np.eye(4)
    pose[2, 3] = depth
    return pose


def test_a_round_gaussian_covers_the_area_of_the_filter_anywhere_in_a_photo():
    places = np.array([[0.0, 0, 2], [1.1, 0.8, 2], [-1.1, 0.1, 2]])
    filters = filters_at(places, [PHOTO]).mean.double()
    pose, intrinsics = torch.eye(4, dtype=torch.float64), torch.from_numpy(PHOTO.intrinsics)
    quaternions, opacities = torch.tensor([[1.0, 0, 0, 0]] * 3).double(), torch.full((3,), 0.5).double()
    sizes = filters.log()[:, None].expand(3, 3)
    arguments = (
        torch.from_numpy(places),
        sizes,
        quaternions,
        opacities,
        pose,
        intrinsics,
        48,
        36,
        0.01,
        0.0,
        1e-9,
        False,
    )
    a, b, c = project_reference(*arguments)[1].unbind(1)
    torch.testing.assert_close(1 / (a * c - b * b).sqrt(), torch.full((3,), EPS2D).double(), rtol=1e-4, atol=0)


def test_pictures_of_half_the_size_are_means_of_the_photos_pixels(embedded_run):
    run = load_run(embedded_run)
    camera = run.cameras[0].camera
    even = camera.resized(camera.width // 2 * 2, camera.height // 2 * 2)
    full, half = run.render(even), run.render(even.resized(even.width // 2, even.height // 2))
    means = full.hdr.unfold(0, 2, 2).unfold(1, 2, 2).mean((-1, -2))
    torch.testing.assert_close(half.hdr, means, rtol=1e-4, atol=1e-5)
    once = run.render(even.resized(even.width // 2, even.height // 2), supersample=False)
    assert float((once.hdr - half.hdr).abs().max()) > 0.01
    assert half.depth.shape == half.alpha.shape == half.hdr.shape[:2]


@pytest.mark.parametrize(
    ("camera", "antialiased", "samples"),
    [
        (PHOTO.resized(12, 9), False, 4),
        (PHOTO.resized(12, 9), True, 1),
        (FISHEYE.resized(12, 9), False, 1),
        (replace(PHOTO, width=2400, height=1800, fx=1.0, fy=1.0), False, 1),
    ],
    ids=["coarse", "antialiased", "fisheye", "very wide"],
)
def test_pixels_are_finer_where_that_is_needed_and_fits_into_memory(camera, antialiased, samples):
    assert samples_across_pixel(lamps(antialiased=antialiased), camera) == samples


def test_rendered_files_of_any_size_hold_the_same_light(embedded_run, tmp_path):
    import OpenEXR

    light = []
    for side in (24, 48, 96):
        out = tmp_path / str(side)
        assert (
            call("render", embedded_run, "--out", out, "--evs=0", "--size", f"{side}x{side}", "--cameras", "test") == 0
        )
        with OpenEXR.File(str(next(out.rglob("*.exr"))), separate_channels=True) as file:
            light.append(float(file.channels()["G"].pixels.astype(np.float32).mean()))
    assert light == pytest.approx([light[1]] * 3, rel=0.02)
