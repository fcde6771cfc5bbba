"""A process of a second node, which reads photos itself: they must be those of rank 0, in its world."""

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from sehdr_warp.errors import InputError
from sehdr_warp.runs.open import PhotoRequest
from sehdr_warp.runs.run_folder import CameraEntry
from sehdr_warp.scene import Scene
from sehdr_warp.training.launch import RankInfo
from sehdr_warp.training.workers import send_training, train_as_worker

from .toy import make_trainer, quick, toy_scene


@dataclass(frozen=True)
class Photos:
    """A request for photos that are a scene already."""

    scene: Scene
    data: dict

    def load(self):
        return self.scene


class TwoNodes:
    """The ranks of a training, as rank 0 and then the second node see them, until that one hands its photos on."""

    info, device = RankInfo(1, 2, 0, 1, 1, 2), torch.device("cpu")

    def __init__(self):
        self.request = self.message = self.arrays = self.photos = None

    def requested_photos(self):
        return self.request

    def broadcast_object(self, message=None):
        self.message = message or self.message
        return self.message

    def broadcast_arrays(self, arrays):
        self.arrays = self.arrays or arrays
        for mine, sent in zip(arrays, self.arrays, strict=True):
            mine.copy_(sent)

    def share_photos(self, scene, size):
        self.photos = scene
        if self.request is not None:
            raise InterruptedError


def photos_of_second_node(scene, request):
    """The scene that the second node of a training of `scene` trains on."""
    ranks, trainer = TwoNodes(), make_trainer(scene, quick())
    field = trainer.field
    info = {"normalization": field.normalization.to_dict(), "base_time": field.base_time}
    send_training(ranks, trainer, info | {"response": field.response.to_dict()})
    ranks.request = request
    with suppress(InterruptedError):
        train_as_worker(ranks)
    return ranks.photos


@pytest.mark.parametrize("black", [False, True])
def test_nodes_know_whether_transparent_parts_count_as_black(black):
    scene = replace(toy_scene(6), black_background=black)
    assert photos_of_second_node(scene, Photos(scene, {})).black_background == black


def test_nodes_must_have_the_same_photos():
    scene = toy_scene(6)
    photos = photos_of_second_node(scene, Photos(scene, {}))
    assert [view.name for view in photos.views] == [view.name for view in scene.train_views]
    first = replace(scene.views[0], codes=scene.views[0].codes // 2)
    with pytest.raises(InputError, match=r"rank 1 of 2 on node 1 \(.*\) reads other photos than rank 0: v_0 differ"):
        photos_of_second_node(scene, Photos(replace(scene, views=(first, *scene.views[1:])), {}))
    with pytest.raises(InputError, match="views differ"):
        photos_of_second_node(scene, Photos(replace(scene, views=scene.views[:-1]), {}))


def test_other_nodes_hold_out_what_a_resumed_run_does(photos):
    where, options = {"path": str(photos)}, {"response": "srgb"}
    scene = PhotoRequest(where, options).load()
    saved = tuple(CameraEntry(view.name, "train", view.camera, 1.0) for view in scene.views)
    resumed = replace(scene, views=tuple(replace(view, split="train") for view in scene.views))
    loaded = photos_of_second_node(resumed, PhotoRequest(where, options, saved))
    assert len(loaded.views) == len(scene.views) > len(scene.train_views)


def test_nodes_train_bare_photos_in_the_world_of_rank_0():
    """Structure from motion on another node may move and scale the world; its views get rank 0's poses."""
    scene, views = replace(toy_scene(6), format="photos"), []
    for view in scene.views:
        pose = view.camera.world_to_camera.copy()
        pose[:3, 3] = 2 * pose[:3, 3] - pose[:3, :3] @ [1, 2, 3]
        views.append(replace(view, camera=replace(view.camera, world_to_camera=pose)))
    own_world = replace(scene, views=tuple(views), points=2 * scene.points + [1, 2, 3])
    np.testing.assert_allclose(photos_of_second_node(scene, Photos(own_world, {})).points, scene.points, atol=1e-12)
