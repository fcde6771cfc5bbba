"""The rival methods: their presets train, HDR truth supervises where it is asked to, learned tone mappers are kept."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from sehdr_warp.errors import InputError
from sehdr_warp.model.color_models import make_color_model
from sehdr_warp.model.renders import PhotoRender
from sehdr_warp.rasterizer.losses.ssim import ssim
from sehdr_warp.response import ToneMapper, response_by_name
from sehdr_warp.runs.config import Config, LossConfig, ResponseConfig
from sehdr_warp.runs.config_files import load_config, override_config, preset_names
from sehdr_warp.training.hdr_truth import largest_hdr_truth
from sehdr_warp.training.initialization import response_for_training
from sehdr_warp.training.losses import anchor_loss, data_loss, hdr_loss
from sehdr_warp.training.targets import Target, code_scale
from sehdr_warp.training.train import train

from .recorded import train_on_gpu
from .toy import VARIANTS, make_trainer, quick, without_truth


def test_presets_are_what_their_methods_say():
    gs, truth, with_truth = (load_config(name) for name in ("hdr-gs", "truth", "hdr-gs-truth"))
    assert (gs.model.radiance, gs.model.tone_map, gs.response.name) == ("log", "gaussian", "learned")
    assert (gs.optimizer.response, gs.loss.form, gs.loss.ssim_weight, gs.loss.clipping) == (5e-4, "blend", 0.2, False)
    assert (gs.loss.ldr_weight, gs.loss.hdr_weight) == (1.0, 0.0) and not gs.loss.uses_hdr
    assert with_truth == override_config(gs, {"loss.hdr_weight": 0.6})
    assert load_config("gauss-hdr") == override_config(gs, {"model.tone_map": "pixel", "loss.anchor_weight": 0.5})
    assert (truth.loss.ldr_weight, truth.loss.hdr_weight) == (0.0, 1.0)
    assert load_config("paper-truth") == override_config(load_config("paper"), {"loss.hdr_truth": True})
    plans = {name for name in preset_names() if load_config(name).plan.enabled}
    assert plans == {"default", "fast", "demo"}


def images(seed):
    generator = torch.Generator().manual_seed(seed)
    return 4 * torch.rand((12, 14, 3), generator=generator)


def target_of(encoded, truth):
    codes = (255 * encoded).round().to(torch.uint8)
    return Target(codes, code_scale(255, None, "cpu", clipping=False), exposure_truth=truth)


def test_the_hdr_loss_compares_in_the_mu_law():
    exposure, truth = images(0), images(1)
    config = LossConfig(form="blend", hdr_weight=1.0)
    target = target_of(truth / 4, truth)
    loss = hdr_loss(PhotoRender(exposure, exposure, exposure, None), target, config, 4.0)
    a, b = ((1 + 5000 * x / 4).log() / math.log1p(5000) for x in (exposure, truth))
    assert float(loss) == pytest.approx(float(0.8 * (a - b).abs().mean() + 0.2 * (1 - ssim(a, b))), rel=1e-4)


def test_weights_mix_photos_and_truth(scene):
    photo = PhotoRender(images(0) / 4, images(1), images(1), None)
    target = target_of(images(2) / 4, images(3))
    field = make_trainer(scene, quick()).field

    def loss(**weights):
        return float(data_loss(field, photo, target, LossConfig(clipping=False, **weights), 4.0))

    ldr, hdr = loss(), loss(ldr_weight=0.0, hdr_weight=1.0)
    assert loss(ldr_weight=2.0, hdr_weight=0.6) == pytest.approx(2 * ldr + 0.6 * hdr, rel=1e-5)
    # A view without truth has its photo alone.
    target = dataclasses.replace(target, exposure_truth=None)
    assert loss(hdr_weight=0.6) == pytest.approx(ldr)


def test_photos_of_no_weight_teach_nothing(scene):
    views = tuple(dataclasses.replace(view, codes=view.codes[::-1].copy()) for view in scene.views)
    config = quick("truth", **{"model.initial_density": 0.0, "mcmc.seed_fraction": 0.0})
    trainers = [make_trainer(scene, config), make_trainer(dataclasses.replace(scene, views=views), config)]
    for trainer in trainers:
        for _ in range(5):
            trainer.step()
    first, second = (trainer.field.gaussians.tensors() for trainer in trainers)
    assert all(torch.equal(first[name], second[name]) for name in first)


@pytest.mark.parametrize("preset", ["truth", "hdr-gs-truth", "paper-truth"])
def test_a_scene_without_truth_is_refused_by_name_and_field(scene, tmp_path, preset, monkeypatch):
    for work in ("response_for_training", "estimate_compensation", "make_field"):
        monkeypatch.setattr(f"sehdr_warp.training.train.{work}", lambda *_: pytest.fail("worked for nothing"))
    field = "loss.hdr_truth = true" if preset == "paper-truth" else "loss.hdr_weight = "
    with pytest.raises(InputError, match=f"^toy: no training view has the HDR truth that {field}"):
        train(without_truth(scene), tmp_path / "run", quick(preset, **{"response.name": "srgb"}), device="cpu")
    assert not (tmp_path / "run").exists()


def test_truth_in_some_views_is_enough_where_photos_count(scene):
    some = without_truth(scene, "v_1")
    trainer = make_trainer(some, quick("hdr-gs-truth"))
    for _ in range(7):
        trainer.step()
    assert trainer.skipped_steps == 0
    with pytest.raises(InputError, match="view v_1 lacks the HDR truth"):
        make_trainer(some, quick("truth"))
    black = tuple(dataclasses.replace(view, hdr=np.zeros_like(view.hdr)) for view in scene.views)
    with pytest.raises(InputError, match="black in every training view"):
        make_trainer(dataclasses.replace(scene, views=black), quick("truth"))


def test_the_largest_truth_is_that_of_training_views_where_they_count(scene):
    loss = LossConfig(hdr_weight=1.0)
    bright = [np.where(np.arange(32)[:, None, None] < 4, 900.0, view.hdr).astype(np.float32) for view in scene.views]
    mask = np.repeat(np.arange(32)[:, None] >= 4, 32, axis=1).astype(np.float32)
    train_max = max(float(view.hdr[4:].max()) for view in scene.train_views)
    views = [
        dataclasses.replace(view, hdr=hdr, mask=mask if view.split == "train" else None)
        for view, hdr in zip(scene.views, bright, strict=True)
    ]
    assert largest_hdr_truth(dataclasses.replace(scene, views=tuple(views)), loss) == pytest.approx(train_max)
    assert largest_hdr_truth(scene, LossConfig()) == 1.0


def test_a_learned_tone_mapper_starts_as_hdr_gs_does(scene):
    config = Config(response=ResponseConfig(name="learned"), seed=5)
    mapper = response_for_training(scene, config)
    assert isinstance(mapper, ToneMapper) and mapper.width == 128
    assert torch.equal(mapper.weights[0], ToneMapper(seed=5).weights[0])
    encoded = np.array([[0.2, 0.5, 0.9]])
    assert np.allclose(make_color_model("log").start(encoded, mapper), encoded)
    assert np.allclose(make_color_model("linear").start(encoded, mapper), np.exp(encoded))
    assert not np.allclose(make_color_model("log").start(encoded, response_by_name("srgb")), encoded)


def test_the_anchor_holds_the_unit_exposure_of_a_learned_tone_mapper():
    mapper = ToneMapper(8, seed=1)
    loss = anchor_loss(mapper)
    expected = (mapper.encode(torch.ones(1, 3)) - 0.5).square().mean()
    assert loss.item() == pytest.approx(expected.item(), abs=1e-6)
    loss.backward()
    gradients = [parameter.grad for parameter in mapper.parameters() if parameter.grad is not None]
    assert all(torch.isfinite(gradient).all() for gradient in gradients)
    assert mapper.biases[-1].grad.abs().min() > 0


@pytest.mark.skipif(not torch.cuda.is_available(), reason="CUDA graphs need a GPU")
@pytest.mark.parametrize("name", ["hdr-gs-truth", "gauss-hdr", "truth"])
def test_rivals_are_recorded_on_a_gpu(scene, name):
    _, replays = train_on_gpu(scene, VARIANTS[name], iterations=90)
    assert replays > 50
