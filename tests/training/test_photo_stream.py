"""Photos that come to the device one by one are those that stay there."""

import dataclasses

import numpy as np
import pytest
import torch

from sehdr_warp.runs.config_files import override_config
from sehdr_warp.runs.run_folder import RunFolder
from sehdr_warp.scene.photo_file import PhotoKeeper
from sehdr_warp.training.initialization import make_field, response_for_training
from sehdr_warp.training.photo_stream import PhotoStream
from sehdr_warp.training.targets import PhotoSource
from sehdr_warp.training.train import train
from sehdr_warp.training.trainer import Trainer
from sehdr_warp.training.training_state import state_of

from .toy import EXPOSURE_TIME, VARIANTS, toy_scene


@pytest.mark.parametrize("truth", [False, True])
def test_what_is_brought_is_the_view(device, truth):
    views = list(toy_scene().train_views)
    views[1] = dataclasses.replace(views[1], mask=np.tri(32, dtype=np.float32), exposure_time=0.5)
    views[2] = dataclasses.replace(views[2], codes=views[2].codes.astype(np.uint16) * 200)
    source = PhotoSource(views, EXPOSURE_TIME, device, truth=truth)
    stream, order = PhotoStream(source), [0, 1, 2, 2, 5, 3, 4, 0, 1, 5, 2, 0]
    assert len(stream) == len(source) == len(views)
    for index, following in zip(order, [*order[1:], None], strict=True):
        stream.bring(index)
        streamed, whole = stream.at(torch.tensor([index], device=device)), source[index]
        encoded, mask = streamed.target.encoded, streamed.target.mask
        stream.release(following)
        assert torch.equal(encoded, whole.target.encoded) and float(streamed.exposure_time) == whole.exposure_time
        assert torch.equal(streamed.camera.world_to_camera, whole.camera.world_to_camera)
        assert torch.equal(mask, torch.ones_like(mask) if whole.target.mask is None else whole.target.mask)
        assert (streamed.target.exposure_truth is None) == (not truth)
        if truth:
            assert torch.equal(streamed.target.exposure_truth, whole.target.exposure_truth)


def test_photos_of_several_sizes_have_no_common_place(device):
    views = toy_scene().train_views + toy_scene(size=16).train_views
    with pytest.raises(ValueError, match="photos differ in size"):
        PhotoStream(PhotoSource(views, EXPOSURE_TIME, device, truth=False))


def test_a_training_on_a_file_is_the_same_bits(scene, trained, tmp_path):
    keeper = PhotoKeeper("disk", len(scene.views), len(scene.views) * 32 * 32)
    stored = dataclasses.replace(scene, views=tuple(keeper.store(view) for view in scene.views))
    assert "read from a nameless file" in keeper.note
    train(stored, tmp_path / "disk", VARIANTS["default"], device="cpu")
    first, second = (RunFolder(run).newest_checkpoint().tensors for run in (trained("default"), tmp_path / "disk"))
    for name, value in first.items():
        assert torch.equal(value, second[name]), name


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_streamed_steps_are_recorded_and_the_same_on_a_gpu(scene):
    config, states = override_config(VARIANTS["default"], {"deterministic": True}), []
    for photos in ("device", "memory"):
        chosen = override_config(config, {"schedule.photo_cache": photos})
        trainer = Trainer(scene, chosen, make_field(scene, chosen, response_for_training(scene, chosen), "cuda:0"))
        for _ in range(60):
            trainer.step()
        assert (
            isinstance(trainer.views.source(60), PhotoStream) == (photos == "memory")
            and trainer.graphs.captured is not None
        )
        states.append(state_of(trainer).tensors)
    for name, value in states[0].items():
        assert torch.equal(value, states[1][name]), name
