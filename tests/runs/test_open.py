"""Photos of a run are found again where the run says that they are: a folder, or the file of a video."""

from types import SimpleNamespace

import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.runs import open as opening
from sehdr_warp.runs.config import Config
from sehdr_warp.runs.run import load_run


@pytest.mark.parametrize("name", ["photos", "clip.mp4"])
def test_photos_of_a_folder_and_of_a_video_are_loaded_again(monkeypatch, tmp_path, name):
    place = tmp_path / name
    run = SimpleNamespace(data={"path": str(place)}, path=tmp_path / "run", config=Config(), response=None)
    with pytest.raises(InputError, match="no longer there|no longer here"):
        opening.load_run_scene(run, None)
    if name == "clip.mp4":
        place.write_bytes(b"")
    else:
        place.mkdir()
    monkeypatch.setattr(opening, "load_scene_and_log_notes", lambda data, **_: data["path"])
    assert opening.load_run_scene(run, None) == str(place)


@pytest.mark.parametrize("name", ["gpu", "mps", "cuda:99"])
def test_devices_that_torch_cannot_use_are_named(embedded_run, name):
    with pytest.raises(InputError, match=f"device {name}: (is neither a CPU nor|cannot be used)"):
        load_run(embedded_run, device=name)
