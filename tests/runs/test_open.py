"""Photos of a run are found again where the run says that they are: a folder, or the file of a video."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.runs import open as opening
from sehdr_warp.runs.config import Config
from sehdr_warp.runs.run import load_run
from sehdr_warp.runs.run_folder import CameraEntry
from tests.training.toy import toy_scene


@pytest.mark.parametrize("name", ["photos", "clip.mp4"])
def test_photos_of_a_folder_and_of_a_video_are_loaded_again(monkeypatch, tmp_path, name):
    place = tmp_path / name
    scene = toy_scene(2, 8)
    cameras = [CameraEntry(view.name, "test", view.camera, 0.25) for view in scene.views[:1]]
    run = SimpleNamespace(
        data={"path": str(place)}, path=tmp_path / "run", config=Config(), response=None, cameras=cameras
    )
    with pytest.raises(InputError, match="no longer there|no longer here"):
        opening.load_run_scene(run, None)
    if name == "clip.mp4":
        place.write_bytes(b"")
    else:
        place.mkdir()
    monkeypatch.setattr(opening, "load_scene_and_log_notes", lambda data, **_: replace(scene, name=data["path"]))
    loaded = opening.load_run_scene(run, None)
    assert loaded.name == str(place)
    # As the run was trained, however photos are held out and timed today.
    first, second = scene.views[:2]
    assert [view.name for view in loaded.test_views] == [first.name] and loaded.views[0].exposure_time == 0.25
    assert loaded.views[1].exposure_time == second.exposure_time and loaded.views[1].split == second.split


@pytest.mark.parametrize("name", ["gpu", "mps", "cuda:99"])
def test_devices_that_torch_cannot_use_are_named(embedded_run, name):
    with pytest.raises(InputError, match=f"device {name}: (is neither a CPU nor|cannot be used)"):
        load_run(embedded_run, device=name)
