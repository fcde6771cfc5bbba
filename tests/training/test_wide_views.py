"""A training on panoramas: of Gaussians whose light the test knows."""

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.evaluation.evaluate import evaluate
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.config_files import load_config
from sehdr_warp.scene import Scene, View, codes_of
from sehdr_warp.scene.lens import Lens
from sehdr_warp.scene.wide_camera import pixel_directions, solid_angles
from sehdr_warp.training.train import train
from sehdr_warp.training.wide_views import has_wide_views

WIDTH, HEIGHT = 64, 32


def room(directions, position):
    """[H, W, 3] light of the walls of a box around the origin, 2 wide, in stripes of three decades of light."""
    with np.errstate(divide="ignore"):
        reach = np.where(directions > 0, 1 - position, -1 - position) / directions
    place = position + directions * np.nanmin(np.where(np.isfinite(reach), reach, np.inf), axis=2, keepdims=True)
    level = np.sin(3 * place[..., :1] + 1) * np.sin(3 * place[..., 1:2]) + np.sin(3 * place[..., 2:])
    return 0.2 * 2 ** (1.5 * level) * (0.6 + 0.4 * np.sin(place * 2))


def panoramas(count=8):
    random, views, response = np.random.default_rng(0), [], response_by_name("srgb")
    for i in range(count):
        pose = np.eye(4)
        pose[:3, 3] = random.uniform(-0.4, 0.4, 3)
        camera = Lens("EQUIRECTANGULAR", WIDTH, HEIGHT, (WIDTH, HEIGHT), "test").camera(pose)
        light = room(pixel_directions(camera) @ pose[:3, :3], camera.position).astype(np.float32)
        codes = codes_of(response.encode(light), 16)
        split = "test" if i in (3, 6) else "train"
        views.append(View(f"p{i}", codes, camera, 1.0, split, solid_angles(camera), light))
    points = random.uniform(-1, 1, (800, 3))
    points /= np.abs(points).max(1, keepdims=True)
    return Scene("box", "test", tuple(views), points, np.full((800, 3), 0.5, np.float32), response=response)


def test_held_out_panoramas_of_a_training_on_panoramas(tmp_path):
    scene = panoramas()
    overrides = {"schedule.iterations": 250, "model.sh_degree": 1, "model.exposure_compensation": "never"}
    run = train(scene, tmp_path / "run", load_config("fast", overrides), device="cpu")
    scores = evaluate(run, scene)
    assert scores["split"] == "test"
    assert scores["ldr"]["psnr"] > 24, scores["ldr"]
    assert run.render(scene.test_views[0].camera).hdr.shape == (HEIGHT, WIDTH, 3)


def test_gradients_of_a_panorama_reach_all_parameters():
    from sehdr_warp.model.camera_tensors import CameraTensors
    from sehdr_warp.training.initialization import make_field

    scene = panoramas(4)
    config = load_config("fast", {"model.sh_degree": 0})
    field = make_field(scene, config, response_by_name("srgb"), "cpu")
    camera = field.camera_tensors(scene.train_views[0].camera)
    assert isinstance(camera, CameraTensors) and camera.directions.shape == (HEIGHT, WIDTH, 3)
    photo = field.render_train_view(camera, 1.0)
    photo.photo_exposure.square().mean().backward()
    for name in ("means", "log_scales", "opacity_logits", "harmonics_dc"):
        assert getattr(field.gaussians, name).grad.abs().sum() > 0, name


def test_a_densification_by_projected_centers_is_refused():
    config = load_config("default", {"densification.strategy": "adc"})
    with pytest.raises(InputError, match=r"p0 is equirectangular.*use densification.strategy=mcmc"):
        has_wide_views(panoramas(3), config)
