"""HDR truth that losses need: refused where it is missing, and its largest radiance."""

import dataclasses

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.runs.config import LossConfig
from sehdr_warp.training.hdr_truth import largest_hdr_truth
from sehdr_warp.training.train import train

from .toy import make_trainer, quick, without_truth


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
