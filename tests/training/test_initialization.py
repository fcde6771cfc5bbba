"""Start of a training: focus, random points, colors, and the choice of a response."""

import dataclasses

import numpy as np
import pytest

from sehdr_warp.errors import SehdrError
from sehdr_warp.model.baking import field_of
from sehdr_warp.model.color_models import make_color_model
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.splats import write_gaussians
from sehdr_warp.training.initialization import (
    base_time,
    colors_in_views,
    focus_distance,
    make_field,
    random_points,
    response_for_training,
)

from ..splats.test_splat_files import gaussians
from .toy import orbit_camera, toy_scene

RADIUS = np.hypot(4.0, 0.8)


def test_focus_of_an_orbit_and_of_cameras_at_one_place(scene):
    assert focus_distance(scene.train_views) == pytest.approx(RADIUS, rel=1e-3)
    still = tuple(dataclasses.replace(view, camera=scene.views[0].camera) for view in scene.views)
    assert focus_distance(still) > 0


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
        expected = expected * written.base_time / base_time(scene)
    rendered = field.render(camera).hdr
    assert float(expected.max()) > 0.01
    assert float((rendered - expected).abs().mean()) < 0.02 * float(expected.mean())
    few = load_config("default", config | {"densification.cap_max": 50})
    assert make_field(scene, few, response, "cpu").gaussians.count == 50


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


def test_cameras_back_to_back_share_nothing():
    scene = toy_scene(with_points=False)
    away = []
    for view in scene.views:
        pose = view.camera.world_to_camera.copy()
        pose[[0, 2]] *= -1  # turned by half a circle about its own vertical axis
        away.append(dataclasses.replace(view, camera=dataclasses.replace(view.camera, world_to_camera=pose)))
    two = tuple(view for view in away if view.name in ("v_0", "v_4"))
    with pytest.raises(SehdrError, match="no two training cameras"):
        random_points(dataclasses.replace(scene, views=two), 500, np.random.default_rng(0))


@pytest.mark.parametrize("radiance", ["log", "linear", "display"])
def test_start_colors_invert_the_colour_model(radiance):
    srgb, encoded = response_by_name("srgb"), np.array([[0.2, 0.5, 0.9]])
    value = make_color_model(radiance).start(encoded, srgb)
    cases = {
        "log": lambda: srgb.encode(np.exp(value)),
        "linear": lambda: srgb.encode(value),
        "display": lambda: value + 0.5,
    }
    np.testing.assert_allclose(cases[radiance](), encoded, atol=1e-6)
    # Black and white say a bound only; their start values are finite and inside it.
    for extreme in (0.0, 1.0):
        assert np.isfinite(
            make_color_model(radiance).start(np.full((1, 3), extreme), response_by_name("hdr-nerf"))
        ).all()


def test_base_time_is_the_median_of_training(scene):
    times = [0.1, 0.2, 0.4, 8.0]
    views = tuple(dataclasses.replace(v, exposure_time=t) for v, t in zip(scene.train_views, times, strict=False))
    assert base_time(dataclasses.replace(scene, views=views)) == pytest.approx(0.3)


@pytest.mark.parametrize("method", ["posterior", "paper"])
def test_auto_chooses_from_the_candidates(method, tmp_path):
    scene = toy_scene(view_count=4, size=64)
    (tmp_path / "mine.csv").write_text("".join(f"{x / 20},{(x / 20) ** 0.4}\n" for x in range(21)))
    candidates = ["gamma-2.2", str(tmp_path / "mine.csv")]
    options = {"response.name": "auto", "response.method": method, "response.candidates": candidates}
    assert response_for_training(scene, load_config("default", options)).name in (
        "gamma-2.2",
        "mine",
        str(tmp_path / "mine.csv"),
    )
    assert response_for_training(scene, load_config("default", {"response.name": "rec709"})).name == "rec709"


def test_posterior_takes_a_cameras_curve_for_a_cameras_files(tmp_path):
    from PIL import Image

    tags = Image.Exif()
    tags.get_ifd(0x8769)[0x829A] = 0.01
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / "photo.jpg", exif=tags)
    toy = toy_scene()
    config = load_config("default", {"response.name": "auto", "response.method": "posterior"})
    views = tuple(dataclasses.replace(view, source=tmp_path / "photo.jpg") for view in toy.views)
    assert response_for_training(dataclasses.replace(toy, views=views), config).name == "camera"
