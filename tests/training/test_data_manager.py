"""Training views: the order of photos, panoramas, and photos that come to the device one by one."""

import dataclasses

import numpy as np
import pytest
import torch

from sehdr_warp.errors import InputError
from sehdr_warp.evaluation.evaluate import evaluate
from sehdr_warp.model.renders import CameraTensors
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.config_files import load_config, override_config
from sehdr_warp.runs.run_folder import RunFolder
from sehdr_warp.scene import Scene, View, codes_of
from sehdr_warp.scene.lens import Lens
from sehdr_warp.scene.photo_storage import PhotoKeeper
from sehdr_warp.scene.wide_camera import pixel_directions, solid_angles
from sehdr_warp.training.data_manager import PhotoSampler, PhotoStream
from sehdr_warp.training.initialization import make_field
from sehdr_warp.training.train import train
from sehdr_warp.training.training_state import state_of
from sehdr_warp.training.training_views import ViewDataset, ViewStack

from .recorded import captured
from .toy import EXPOSURE_TIME, VARIANTS, make_trainer, toy_scene
from .wall_and_lamp import wall_and_lamp


def test_every_photo_comes_once_before_any_comes_again():
    order = PhotoSampler(5, seed=0)
    rounds = [[order.next() for _ in range(5)] for _ in range(3)]
    assert [sorted(photos) for photos in rounds] == [list(range(5))] * 3
    assert rounds[0] != rounds[1] or rounds[1] != rounds[2]
    other = PhotoSampler(5, seed=1)
    assert [[other.next() for _ in range(5)] for _ in range(3)] != rounds


def test_ranks_share_one_order():
    alone, ranks = PhotoSampler(7, seed=3), [PhotoSampler(7, 3, rank, 2) for rank in range(2)]
    for _ in range(10):
        assert [rank.next() for rank in ranks] == [alone.next(), alone.next()]


def test_the_next_photo_is_known_when_one_is_sampled():
    order = PhotoSampler(3, seed=0)
    assert order.peek() is None
    for _ in range(7):
        order.next()
        upcoming = order.peek()
        state = order.state()
        assert upcoming in (None, order.next())
        order.load_state(*state)


def test_an_order_goes_on_from_its_state():
    order, resumed = PhotoSampler(6, seed=2), PhotoSampler(6, seed=9)
    for _ in range(4):
        order.next()
    resumed.load_state(*order.state())
    assert [resumed.next() for _ in range(14)] == [order.next() for _ in range(14)]


@pytest.mark.parametrize("left", [[6], [-1]])
def test_photos_that_there_are_not_are_refused(left):
    order = PhotoSampler(6, seed=2)
    with pytest.raises(ValueError, match="names others than the 6 there are"):
        order.load_state(order.state()[0], left)


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
    overrides = {"schedule.iterations": 40, "model.sh_degree": 1, "model.exposure_compensation": "never"}
    run = train(scene, tmp_path / "run", load_config("fast", overrides), device="cpu")
    scores = evaluate(run, scene)
    assert scores["split"] == "test"
    assert scores["ldr"]["psnr"] > 27, scores["ldr"]
    assert run.render(scene.test_views[0].camera).hdr.shape == (HEIGHT, WIDTH, 3)


def test_gradients_of_a_panorama_reach_all_parameters():
    scene = panoramas(4)
    config = load_config("fast", {"model.sh_degree": 0})
    field = make_field(scene, config, response_by_name("srgb"), "cpu")
    camera = field.camera_tensors(scene.train_views[0].camera)
    assert isinstance(camera, CameraTensors) and camera.directions.shape == (HEIGHT, WIDTH, 3)
    photo = field.render_photo(camera, 1.0)
    photo.photo_exposure.square().mean().backward()
    for name in ("means", "log_scales", "opacity_logits", "harmonics_dc"):
        assert getattr(field.gaussians, name).grad.abs().sum() > 0, name


def test_a_densification_by_projected_centers_is_refused():
    config = load_config("default", {"densification.strategy": "adc", "response.name": "srgb"})
    with pytest.raises(InputError, match=r"p0 is equirectangular.*use densification.strategy=mcmc"):
        make_trainer(panoramas(3), config)


def unlike_photos(scene):
    """The scene with a training photo that has a mask, one of 16 bits, and one of another exposure time."""
    views = list(scene.views)
    views[0] = dataclasses.replace(views[0], mask=np.tri(32, dtype=np.float32))
    views[1] = dataclasses.replace(views[1], codes=views[1].codes.astype(np.uint16) * 257)
    views[2] = dataclasses.replace(views[2], exposure_time=0.7 * EXPOSURE_TIME)
    return dataclasses.replace(scene, views=tuple(views))


@pytest.mark.parametrize("truth", [False, True])
def test_what_is_brought_is_the_view(device, truth):
    views = list(toy_scene().train_views)
    views[1] = dataclasses.replace(views[1], mask=np.tri(32, dtype=np.float32), exposure_time=0.5)
    views[2] = dataclasses.replace(views[2], codes=views[2].codes.astype(np.uint16) * 200)
    source = ViewDataset(views, EXPOSURE_TIME, device, truth=truth)
    stream, order = PhotoStream(source), [0, 1, 2, 2, 5, 3, 4, 0, 1, 5, 2, 0]
    assert len(stream) == len(source) == len(views)
    for index, following in zip(order, [*order[1:], None], strict=True):
        stream.stage(index)
        streamed, whole = stream.at(torch.tensor([index], device=device)), source[index]
        encoded, mask = streamed.target.encoded, streamed.target.mask
        stream.release(following)
        assert torch.equal(encoded, whole.target.encoded) and float(streamed.exposure_time) == whole.exposure_time
        assert torch.equal(streamed.camera.world_to_camera, whole.camera.world_to_camera)
        assert torch.equal(mask, torch.ones_like(mask) if whole.target.mask is None else whole.target.mask)
        assert (streamed.target.exposure_truth is None) == (not truth)
        if truth:
            assert torch.equal(streamed.target.exposure_truth, whole.target.exposure_truth)


@pytest.mark.parametrize("uploaded", [False, True])
def test_views_have_the_estimates_that_replace_others(device, uploaded):
    config = load_config("default", {"response.name": "srgb"})
    manager = make_trainer(wall_and_lamp(response="srgb"), config, device).data_manager
    assert manager.estimates is not None and not manager.has_measured
    if uploaded:
        manager.views = list(manager.views)
    others = [torch.full_like(estimate, 2.0) for estimate in manager.estimates]
    manager.replace_estimates(others)
    assert manager.has_measured and all(torch.equal(*pair) for pair in zip(manager.estimates, others, strict=True))
    for view in manager.views:
        assert view.target.estimates.device == view.target.encoded.device and (view.target.estimates == 2).all()


def test_a_stream_reads_views_again_that_it_forgot(device):
    views = toy_scene().train_views
    source = ViewDataset(views, EXPOSURE_TIME, device, truth=False, estimates=[torch.ones(8, 8, 6).half()] * len(views))
    stream = PhotoStream(source)
    for value in (1.0, 2.0):
        if value == 2:
            source.estimates = [torch.full((8, 8, 6), value).half()] * len(views)
            stream.forget()
        for index, following in ((0, 1), (1, 2), (2, None)):
            stream.stage(index)
            assert (stream.at(torch.tensor([index], device=device)).target.estimates == value).all()
            stream.release(following)


@pytest.mark.parametrize("change", [lambda scene: scene, unlike_photos])
def test_steps_without_a_graph_read_the_same_from_a_stack_and_a_stream(scene, device, change):
    source = ViewDataset(change(scene).train_views, EXPOSURE_TIME, device, truth=True)
    stack = ViewStack.of(list(source))
    assert stack is not None
    for view, other in zip(stack, PhotoStream(source), strict=True):
        assert view.exposure_time == other.exposure_time
        for part in ("camera", "target"):
            for field in dataclasses.fields(getattr(view, part)):
                value, other_value = (getattr(getattr(each, part), field.name) for each in (view, other))
                both = isinstance(value, torch.Tensor) and isinstance(other_value, torch.Tensor)
                assert torch.equal(value, other_value) if both else value == other_value, field.name


def test_photos_of_several_sizes_have_no_common_place(device):
    views = toy_scene().train_views + toy_scene(size=16).train_views
    with pytest.raises(ValueError, match="photos differ in size"):
        PhotoStream(ViewDataset(views, EXPOSURE_TIME, device, truth=False))


def test_a_training_on_a_file_is_the_same_bits(scene, trained, tmp_path):
    keeper = PhotoKeeper("disk", len(scene.views), len(scene.views) * 32 * 32)
    stored = dataclasses.replace(scene, views=tuple(keeper.store(view) for view in scene.views))
    assert "read from a nameless file" in keeper.note
    train(stored, tmp_path / "disk", VARIANTS["default"], device="cpu")
    first, second = (RunFolder(run).newest_checkpoint().tensors for run in (trained("default"), tmp_path / "disk"))
    for name, value in first.items():
        assert torch.equal(value, second[name]), name


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("change", [lambda scene: scene, unlike_photos])
def test_streamed_steps_are_recorded_and_the_same_on_a_gpu(scene, change):
    config, states = override_config(VARIANTS["default"], {"deterministic": True}), []
    scene = change(scene)
    for photos in ("device", "memory"):
        chosen = override_config(config, {"schedule.photo_cache": photos})
        trainer = make_trainer(scene, chosen, "cuda:0")
        for _ in range(60):
            trainer.step()
        assert isinstance(trainer.data_manager.views, PhotoStream) == (photos == "memory")
        assert captured(trainer) is not None
        states.append(state_of(trainer).tensors)
    for name, value in states[0].items():
        assert torch.equal(value, states[1][name]), name


def test_clipped_light_is_estimated_on_one_thread(monkeypatch):
    """Its sums depend on the number of threads, and a resumed training, whose steps use one, estimates it again."""
    manager, before = make_trainer(toy_scene(), VARIANTS["default"]).data_manager, torch.get_num_threads()
    monkeypatch.setattr("sehdr_warp.training.data_manager.light_estimates", lambda *_: torch.get_num_threads())
    torch.set_num_threads(3)
    try:
        assert manager.light_estimates == 1 and torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
