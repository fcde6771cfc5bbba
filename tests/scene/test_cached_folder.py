"""Folders of results: computed once, and again if they are damaged."""

import pytest

from sehdr_warp.own_files import LIST
from sehdr_warp.scene.cached_folder import cached_folder


@pytest.mark.parametrize("damage", ["empty", "cut", "pickle", "missing", "no list"])
def test_a_damaged_result_is_made_again(tmp_path, caplog, damage):
    caplog.set_level("INFO")
    count = 0

    def fill(folder):
        nonlocal count
        count += 1
        (folder / "cameras.bin").write_bytes(b"cameras")
        (folder / "sizes.json").write_text("[]")

    for _ in range(2):
        place = cached_folder(tmp_path, "sfm-key", "cameras", fill)
        assert count == 1
    assert "cameras: using the cached result" in caplog.text
    file = place / ("cameras.bin" if damage != "no list" else LIST)
    if damage in ("missing", "no list"):
        file.unlink()
    else:
        file.write_bytes({"empty": b"", "cut": b"cam", "pickle": b"\x80\x04."}[damage])
    for _ in range(2):
        assert (cached_folder(tmp_path, "sfm-key", "cameras", fill) / "cameras.bin").read_bytes() == b"cameras"
        assert count == 2
    assert caplog.text.count("is damaged and is made again") == 1


def test_a_cache_that_cannot_be_written_is_replaced_by_a_temporary_folder(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("SEHDR_CACHE", str(tmp_path / "file" / "cache"))
    place = cached_folder(None, "key", "letters", lambda folder: (folder / "a").write_text("b"))
    assert (place / "a").read_text() == "b" and tmp_path not in place.parents
