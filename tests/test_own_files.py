"""The list by which a user's files are known."""

import shutil

import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.own_files import LIST, is_as_listed, list_folder

from .test_files import listing, write


@pytest.mark.parametrize("change", ["never ours", "changed since", "another name", "no list"])
def test_what_this_program_did_not_write_is_never_replaced(tmp_path, change):
    target = tmp_path / "a.txt"
    write(tmp_path / "b.txt" if change == "another name" else target, "ours")
    if change == "another name":
        (tmp_path / "b.txt").rename(target)
    elif change == "no list":
        (tmp_path / LIST).unlink()
    else:
        target.write_text("theirs")
    if change == "never ours":
        (tmp_path / LIST).write_bytes(b"\xff\n" * 3)
    content = target.read_text()
    with pytest.raises(InputError, match="a.txt: was not written by sehdr-warp, or was changed since"):
        write(target, overwrite=True)
    assert target.read_text() == content and listing(tmp_path) == ["a.txt"]


def test_damage_to_a_listed_folder_is_found(tmp_path):
    def make_folder():
        folder = tmp_path / "set"
        shutil.rmtree(folder, ignore_errors=True)
        (folder / "deep").mkdir(parents=True)
        for name in ("a", "deep/b", "deep/\udcff\n"):
            (folder / name).write_text(name.encode("utf-8", "replace").decode())
        list_folder(folder)
        return folder

    changes = [
        lambda folder: (folder / "a").write_text("b"),
        lambda folder: (folder / "deep" / "b").unlink(),
        lambda folder: (folder / LIST).write_text(""),
        lambda folder: (folder / LIST).unlink(),
    ]
    assert is_as_listed(make_folder())
    for change in changes:
        folder = make_folder()
        change(folder)
        assert not is_as_listed(folder)
