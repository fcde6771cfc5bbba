"""A run that is trained meanwhile."""

import os
import shutil

from sehdr_warp.runs.open import open_scene
from sehdr_warp.training.train import train
from sehdr_warp.viewer.watching import Watch

from ..output.helpers import camera
from ..training.toy import toy_scene


def test_what_a_training_writes_meanwhile_is_shown(tmp_path, logged):
    options = {"plan.enabled": False, "schedule.iterations": 2}
    paths = [tmp_path / "run", tmp_path / "other"]
    for path in paths:
        train(toy_scene(), path, options, device="cpu")
    watch = Watch(paths, lambda path: open_scene(path, "cpu"))
    watch.look()
    scene_shown = watch.scenes[0]
    assert [run.version for run in watch.scenes] == [0, 0] and scene_shown.facts()["iterations"] == 2
    train(toy_scene(), paths[0], options | {"schedule.iterations": 4}, device="cpu", overwrite=True)
    watch.look()
    assert [run.version for run in watch.scenes] == [1, 0] and scene_shown.facts()["iterations"] == 4
    assert scene_shown.clipped is not None
    for damage in (lambda: (paths[0] / "scene.json").unlink(), lambda: shutil.rmtree(paths[0])):
        damage()
        for file in paths[0].glob("checkpoints/*/checkpoint.json"):
            os.utime(file, (1, 1))
        watch.look()
        assert "keeps what it has read" in logged[-1] and scene_shown.version == 1
    assert [*scene_shown.frame_parts(camera(8, 8))][-1].nbytes == 8 * 8 * 5 * 2
