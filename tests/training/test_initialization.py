"""Start of a training: focus, random points, colors, and the choice of a response."""

import dataclasses
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from PIL import Image

from sehdr_warp.errors import SehdrError
from sehdr_warp.model.baking import field_of
from sehdr_warp.model.color_models import make_color_model
from sehdr_warp.response import ToneMapper, response_by_name
from sehdr_warp.runs.config import Config, ResponseConfig
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.scene.normalization import normalization_of
from sehdr_warp.splats import write_gaussians
from sehdr_warp.training.initialization import (
    MAX_START_ANGLE,
    base_time_of,
    colors_in_views,
    focus_distance,
    make_field,
    make_matcher,
    random_points,
    response_for_training,
    start_count,
    start_points,
)
from sehdr_warp.training.train import train
from tests.splats.samples import gaussians

from .toy import orbit_camera, toy_scene
from .wall_and_lamp import wall_and_lamp

LINEAR = response_by_name("linear")

RADIUS = np.hypot(4.0, 0.8)


def test_focus_of_an_orbit_and_of_cameras_at_one_place(scene):
    cameras = [view.camera for view in scene.train_views]
    assert focus_distance(cameras) == pytest.approx(RADIUS, rel=1e-3)
    assert focus_distance(cameras[:1] * 6) > 0


def test_a_point_far_from_all_others_starts_as_no_veil_before_cameras(scene):
    points, config = np.r_[scene.points, [[0.0, 0.0, 60.0]]], load_config("default", {"model.initial_density": 0.0})
    scene = dataclasses.replace(scene, points=points, point_colors=np.full_like(points, 0.5, np.float32))
    gaussians = make_field(scene, config, LINEAR, "cpu").gaussians
    views = normalization_of(scene).scene(scene).train_views
    cameras = torch.tensor(np.stack([view.camera.position for view in views]))
    angles = gaussians.log_scales.exp()[:, 0].detach() / torch.cdist(gaussians.means.double(), cameras).amin(1)
    # The others are about as far away from it as the cameras are.
    assert angles[-1].item() == pytest.approx(MAX_START_ANGLE, rel=1e-4)
    assert angles.amax() < 1.0001 * MAX_START_ANGLE and angles.amin() < 0.8 * MAX_START_ANGLE
    as_3dgs = load_config("default", {"model.initial_density": 0.0, "densification.strategy": "adc"})
    assert make_field(scene, as_3dgs, LINEAR, "cpu").gaussians.log_scales[-1].exp().amin() > 0.5


@pytest.mark.parametrize("radiance, degree", [("log", 1), ("linear", 3), ("display", 1)])
def test_a_training_starts_from_a_file_of_gaussians(scene, tmp_path, radiance, degree):
    file = tmp_path / "start.ply"
    written = gaussians(200, degree=1, color_model="display" if radiance == "display" else "log")
    write_gaussians(file, written)
    config = {"model.init_file": str(file), "model.radiance": radiance, "model.sh_degree": degree}
    response = response_by_name("srgb")
    field = make_field(scene, load_config("default", config), response, "cpu")
    assert field.gaussians.count == 200 and field.gaussians.degree == degree
    camera = scene.views[0].camera
    expected = field_of(written).render(camera).hdr
    if radiance == "display":  # Colors of the scene's own photos.
        expected = expected * written.base_time / base_time_of(scene)
    rendered = field.render(camera).hdr
    assert float(expected.max()) > 0.01
    assert float((rendered - expected).abs().mean()) < 0.02 * float(expected.mean())
    few = load_config("default", config | {"densification.cap_max": 50})
    assert make_field(scene, few, response, "cpu").gaussians.count == 50


def test_photos_that_do_not_belong_to_their_cameras_are_named(logged):
    scene, rng = replace(toy_scene(), points=np.zeros((0, 3)), point_colors=np.zeros((0, 3))), np.random.default_rng(0)
    make_field(scene, load_config("default"), LINEAR, "cpu")
    assert not any("other photos" in line for line in logged)
    noise = (replace(view, codes=rng.integers(0, 256, view.codes.shape, np.uint8)) for view in scene.views)
    make_field(replace(scene, views=tuple(noise)), load_config("default"), LINEAR, "cpu")
    assert any("cameras were wrong or belonged to other photos" in line for line in logged)


def test_drawn_points_are_seen_and_repeat(scene):
    points, colors = random_points(scene, 500, np.random.default_rng(0))
    again, _ = random_points(scene, 500, np.random.default_rng(0))
    view_counts, mean = colors_in_views(points, scene.train_views)
    assert len(points) == len(colors) == 500 and (view_counts >= 2).all() and np.array_equal(points, again)
    np.testing.assert_allclose(mean, colors)


def test_colors_are_those_at_the_projections(scene):
    view = scene.views[0]
    camera = orbit_camera(0.0)
    point = camera.camera_to_world @ [0.5 / camera.fx * 4, 0.5 / camera.fy * 4, 4.0, 1.0]
    behind = camera.camera_to_world @ [0.0, 0.0, -4.0, 1.0]
    view_counts, mean = colors_in_views(np.stack([point[:3], behind[:3]]), (view,))
    assert view_counts.tolist() == [1, 0]
    np.testing.assert_allclose(mean[0], view.image[16, 16], rtol=1e-6)


def test_base_time_is_that_of_a_photo_in_the_middle(scene):
    times = [0.1, 0.2, 0.4, 8.0]
    views = tuple(dataclasses.replace(v, exposure_time=t) for v, t in zip(scene.train_views, times, strict=False))
    assert base_time_of(dataclasses.replace(scene, views=views)) == 0.2


@pytest.mark.parametrize("method", ["posterior", "paper"])
def test_auto_chooses_from_the_candidates(method, tmp_path):
    scene = toy_scene(view_count=4, size=64)
    (tmp_path / "mine.csv").write_text("".join(f"{x / 20},{(x / 20) ** 0.4}\n" for x in range(21)))
    candidates = ["gamma-2.2", str(tmp_path / "mine.csv")]
    options = {"response.name": "auto", "response.method": method, "response.candidates": candidates}
    assert response_for_training(scene, load_config("default", options)).name in ("gamma-2.2", "mine.csv")
    assert response_for_training(scene, load_config("default", {"response.name": "rec709"})).name == "rec709"


def test_posterior_takes_a_cameras_curve_for_a_cameras_files(tmp_path):
    tags = Image.Exif()
    tags.get_ifd(0x8769)[0x829A] = 0.01
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / "photo.jpg", exif=tags)
    toy = toy_scene()
    config = load_config("default", {"response.name": "auto", "response.method": "posterior"})
    views = tuple(dataclasses.replace(view, source=tmp_path / "photo.jpg") for view in toy.views)
    assert response_for_training(dataclasses.replace(toy, views=views), config).name == "camera"


def test_a_learned_tone_mapper_starts_as_hdr_gs_does(scene):
    config = Config(response=ResponseConfig(name="learned"), seed=5)
    mapper = response_for_training(scene, config)
    assert isinstance(mapper, ToneMapper) and mapper.width == 128
    assert torch.equal(mapper.weights[0], ToneMapper(seed=5).weights[0])
    encoded = np.array([[0.2, 0.5, 0.9]])
    assert np.allclose(make_color_model("log").start(encoded, mapper), encoded)
    assert np.allclose(make_color_model("linear").start(encoded, mapper), np.exp(encoded))
    assert not np.allclose(make_color_model("log").start(encoded, response_by_name("srgb")), encoded)


def never():
    raise AssertionError("nothing is to be matched")


def test_start_points_are_the_scenes_and_matched_ones():
    scene, config = wall_and_lamp(), load_config("default", {"model.initial_density": 4.0})
    assert start_count(config, 9 * 64 * 64) == 768
    own = np.array([[0.0, 0.0, 3.0]] * 300)
    inputs = replace(scene, points=own, point_colors=np.full((300, 3), 0.5, np.float32))
    points, colors = start_points(
        inputs, config, partial(make_matcher, inputs, LINEAR, "cpu"), np.random.default_rng(0)
    )
    assert 300 < len(points) == len(colors) <= 800 and np.array_equal(points[:300], own)
    none = load_config("default", {"model.initial_density": 0.0})
    assert len(start_points(inputs, none, never, np.random.default_rng(0))[0]) == 300
    # Without any, they are drawn where cameras look.
    assert len(start_points(scene, none, never, np.random.default_rng(0))[0]) == 5000


def test_a_scene_of_two_photos_or_of_none_that_match_still_starts(tmp_path):
    scene = wall_and_lamp()
    two = replace(scene, views=scene.views[:2])
    config = load_config("default", {"schedule.iterations": 3, "plan.enabled": False, "response.name": "linear"})
    assert train(two, tmp_path / "two", config, device="cpu").summary()["iteration"] == 3
    rng = np.random.default_rng(0)
    noise = tuple(replace(v, codes=rng.integers(0, 256, v.codes.shape, dtype=np.uint8)) for v in scene.views)
    assert train(replace(scene, views=noise), tmp_path / "noise", config, device="cpu").summary()["iteration"] == 3


def test_back_to_back_photos_are_refused(tmp_path):
    scene = wall_and_lamp()
    turned = scene.views[1].camera.world_to_camera.copy()
    turned[[0, 2]] *= -1
    other = replace(scene.views[1], camera=replace(scene.views[1].camera, world_to_camera=turned))
    two = replace(scene, views=(scene.views[0], other))
    config = load_config("default", {"plan.enabled": False, "response.name": "linear"})
    with pytest.raises(SehdrError, match="no two training cameras"):
        train(two, tmp_path / "run", config, device="cpu")
