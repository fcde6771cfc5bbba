"""Photos in a nameless file: the same, out of memory, gone with the process, refused where there is no room."""

import gc
import sys
from collections import namedtuple

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.scene import load_scene
from sehdr_warp.scene.photo_storage import PhotoFile, open_shared
from tests.make_scenes import write_blender, write_ply


def test_arrays_are_kept_shared_and_gone(tmp_path):
    photos = PhotoFile(1 << 20, tmp_path)
    original = np.arange(30_000, dtype=np.uint16).reshape(100, 100, 3)
    stored = photos.keep(original)
    assert photos.keep(stored) is stored and photos.end < 2 * original.nbytes
    assert list(tmp_path.iterdir()) == [], "no name"
    if sys.platform == "linux":
        values = {"photo": stored, "mask": np.ones((80, 80), np.float32), "name": "a", "small": original[:1]}
        shared = photos.share(values)
        value = open_shared(shared)
        np.testing.assert_array_equal(value["photo"], original)
        assert value["mask"].sum() == 6400 and value["name"] == "a" and value["small"].shape == (1, 100, 3)
        assert photos.end < original.nbytes + 6400 * 4 + 4096, "what lies there is not copied"
    del photos
    gc.collect()
    np.testing.assert_array_equal(stored, original)
    if sys.platform == "linux":  # As long as an array lies in it.
        np.testing.assert_array_equal(open_shared(shared)["photo"], original)
        del stored, values
        gc.collect()
        with pytest.raises(OSError):
            open_shared(shared)


def test_too_large_for_the_disk_is_one_line(tmp_path, monkeypatch):
    write_blender(tmp_path, 6, ply_file_path="p.ply")
    write_ply(tmp_path / "p.ply", [(0, 0, 0)])
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr("shutil.disk_usage", lambda folder: usage(10, 10, 0))
    assert load_scene(tmp_path, response="srgb").notes is not None
    with pytest.raises(InputError, match="the photos take [0-9]+ KB; .* of this disk; use smaller photos"):
        load_scene(tmp_path, response="srgb", photo_storage="disk")
    monkeypatch.setattr("sehdr_warp.scene.photo_storage.available_memory", lambda: 0)
    with pytest.raises(InputError, match="of this disk"):
        load_scene(tmp_path, response="srgb")
    monkeypatch.undo()
    monkeypatch.setattr("sehdr_warp.scene.photo_storage.available_memory", lambda: 0)
    assert any("nameless file" in note for note in load_scene(tmp_path, response="srgb").notes)
