import json
import os
import signal
import subprocess
import sys

import pytest

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.files import atomic_folder, atomic_path, has_file, read_bytes, read_json, read_lines, write_json
from sehdr_warp.own_files import LIST
from sehdr_warp.splats import read_gaussians

from .full_disk import full_disk


def listing(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.name != LIST)


def write(path, text="x", **how):
    with atomic_path(path, **how) as temporary:
        temporary.write_text(text)


def test_file_appears_when_the_block_ends(tmp_path):
    target = tmp_path / "new" / "deep" / "a.txt"
    with atomic_path(target) as temporary:
        assert temporary.parent == target.parent and temporary.suffix == ".txt"
        temporary.write_text("whole")
        assert not target.exists()
    assert target.read_text() == "whole"
    assert listing(tmp_path) == ["new", "new/deep", "new/deep/a.txt"]


def test_existing_file_is_kept_unless_asked(tmp_path):
    target = tmp_path / "a.txt"
    write(target, "old")
    with pytest.raises(InputError, match="a.txt: exists already;") as caught, atomic_path(target):
        pytest.fail("the block must not run")
    assert "\n" not in str(caught.value)
    write(target, "new", overwrite=True)
    assert target.read_text() == "new"


def test_links_devices_and_pipes_are_never_replaced(tmp_path):
    write(tmp_path / "a.txt", "whole")
    (tmp_path / "link.txt").symlink_to("a.txt")
    (tmp_path / "dangling.txt").symlink_to("nowhere")
    (tmp_path / "set").symlink_to(".")
    os.mkfifo(tmp_path / "pipe")
    for name, kind in (("link.txt", "link"), ("dangling.txt", "link"), ("pipe", "a pipe"), ("/dev/null", "a device")):
        with pytest.raises(InputError, match=kind):
            write(tmp_path / name, overwrite=True)
    with pytest.raises(InputError, match="link"), atomic_folder(tmp_path / "set", overwrite=True):
        pass
    (tmp_path / LIST).unlink()
    (tmp_path / LIST).symlink_to("a.txt")
    for make in (lambda: None, lambda: os.mkfifo(tmp_path / LIST), (tmp_path / LIST).mkdir):
        make()
        with pytest.raises(InputError, match="not the list of this folder"):
            write(tmp_path / "b.txt")
        if (tmp_path / LIST).is_dir():
            (tmp_path / LIST).rmdir()
        else:
            (tmp_path / LIST).unlink()
    assert (tmp_path / "a.txt").read_text() == "whole"


def test_what_has_the_name_of_a_file_is_not_taken_for_a_missing_one(tmp_path):
    write(tmp_path / "file", "whole")
    assert has_file(tmp_path / "file") and not has_file(tmp_path / "none")
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to("nowhere")
    os.mkfifo(tmp_path / "pipe")
    for name in ("folder", "link", "pipe"):
        with pytest.raises(InputError, match="not a file; remove it"):
            has_file(tmp_path / name)


def test_file_that_appears_meanwhile_is_kept(tmp_path):
    target = tmp_path / "a.txt"
    with pytest.raises(InputError), atomic_path(target) as temporary:
        temporary.write_text("mine")
        target.write_text("theirs")
    assert target.read_text() == "theirs"
    assert listing(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_failure_leaves_nothing_new_and_keeps_the_old(tmp_path, error):
    write(tmp_path / "old.txt", "old")
    with pytest.raises(error), atomic_path(tmp_path / "old.txt", overwrite=True) as temporary:
        temporary.write_text("half")
        raise error
    with pytest.raises(error), atomic_path(tmp_path / "x" / "y" / "new.txt") as temporary:
        temporary.write_text("half")
        raise error
    assert listing(tmp_path) == ["old.txt"]
    assert (tmp_path / "old.txt").read_text() == "old"


def test_full_disk_is_one_line(tmp_path):
    line = r"big.bin: cannot be written \(.*\); free space"
    with pytest.raises(SehdrError, match=line) as caught, full_disk(), atomic_path(tmp_path / "big.bin") as temporary:
        temporary.write_bytes(bytes(1 << 20))
    assert "\n" not in str(caught.value)
    assert listing(tmp_path) == []


def test_what_is_in_the_way_is_one_line(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a folder"), atomic_path(tmp_path / "folder", overwrite=True):
        pass
    with pytest.raises(SehdrError, match="is a file"), atomic_path(tmp_path / "file" / "a.txt"):
        pass


def test_long_names_fit_the_file_system(tmp_path):
    name = "n" * 250 + ".txt"
    with atomic_path(tmp_path / name) as temporary:
        temporary.write_text("x")
    assert (tmp_path / name).exists()


def test_folder_replaces_whole_or_not_at_all(tmp_path):
    target = tmp_path / "set"
    with atomic_folder(target) as folder:
        (folder / "old").write_text("old")
    (target / "theirs").write_text("theirs")
    with pytest.raises(InputError, match="theirs: was not written"), atomic_folder(target, overwrite=True):
        pass
    (target / "theirs").unlink()
    with pytest.raises(InputError, match="exists already"), atomic_folder(target):
        pass
    with pytest.raises(RuntimeError), atomic_folder(target, overwrite=True) as folder:
        (folder / "new").write_text("new")
        raise RuntimeError
    assert listing(tmp_path) == ["set", "set/old"]
    with atomic_folder(target, overwrite=True) as folder:
        (folder / "new").write_text("new")
    assert listing(tmp_path) == ["set", "set/new"]


def test_json_has_no_nan(tmp_path):
    write_json(tmp_path / "a.json", {"a": float("nan"), "b": [1.5, float("inf")], "c": "ä"})
    assert json.loads((tmp_path / "a.json").read_text(encoding="utf-8")) == {"a": None, "b": [1.5, None], "c": "ä"}
    write_json(tmp_path / "a.json", {"name": "\udcff"}, overwrite=True)
    assert read_json(tmp_path / "a.json") == {"name": "\udcff"}
    (tmp_path / "twice.json").write_text('{"a": {"b": 1, "b": 2}}')
    with pytest.raises(InputError, match="'b' stands twice"):
        read_json(tmp_path / "twice.json")
    (tmp_path / "twice.json").unlink()
    with pytest.raises(TypeError):
        write_json(tmp_path / "b.json", {"a": object()})
    assert listing(tmp_path) == ["a.json"]


HEAD = "import os, signal; from pathlib import Path; from sehdr_warp import files\n"
DIE = "def die(*_, **__): os.kill(os.getpid(), signal.SIGKILL)\n"


def killed(code, folder):
    """Runs code in a process that is killed where it says so; the names it left."""
    result = subprocess.run([sys.executable, "-c", HEAD + DIE + code], cwd=folder, timeout=60, check=False)
    assert result.returncode == -signal.SIGKILL
    return sorted(name for name in os.listdir(folder) if name != LIST)


def test_what_a_killed_process_left_goes_with_the_next_write(tmp_path):
    code = """
with files.atomic_folder(Path("set")) as folder, files.atomic_path(Path("a.txt")) as file:
    (folder / "half").write_text("1")
    file.write_text("half")
    die()
"""
    left = killed(code, tmp_path)
    assert len(left) == 2 and all(name.startswith(".") for name in left)
    (tmp_path / ".a.12345678.tmp.txt").write_text("not ours")
    with atomic_path(tmp_path / "a.txt") as temporary:
        temporary.write_text("whole")
    assert listing(tmp_path) == [".a.12345678.tmp.txt", "a.txt"]


@pytest.mark.parametrize(
    "hook, left, content",
    [
        ("rename = os.rename\nos.rename = lambda a, b: (rename(a, b), die())", 2, "set/old"),
        ("files.shutil.rmtree = die", 1, "set/new"),
    ],
)
def test_a_folder_that_was_being_replaced_by_a_killed_process_is_never_lost(tmp_path, hook, left, content):
    """Killed between the two renames, or before what was set aside is removed."""
    with atomic_folder(tmp_path / "set") as folder:
        (folder / "old").write_text("1")
    code = """
with files.atomic_folder(Path("set"), overwrite=True) as folder:
    (folder / "new").write_text("1")
"""
    assert len([name for name in killed(hook + code, tmp_path) if name.startswith(".set.")]) == left
    with pytest.raises(InputError, match="exists already"), atomic_folder(tmp_path / "set"):
        pass
    assert listing(tmp_path) == ["set", content]


def test_a_long_sequence_does_not_list_its_folder_for_each_file(tmp_path, monkeypatch):
    listed, real = [], os.listdir
    monkeypatch.setattr(os, "listdir", lambda path: listed.append(path) or real(path))
    with atomic_folder(tmp_path / "pictures") as folder:
        for index in range(5):
            with atomic_path(folder / f"{index}.txt") as temporary:
                temporary.write_text("x")
    assert len(listed) == 1 and len(list((tmp_path / "pictures").glob("*.txt"))) == 5


def test_what_another_process_is_writing_is_left_alone(tmp_path):
    code = """
with files.atomic_path(Path("a.txt"), overwrite=True) as file:
    file.write_text("theirs")
    print(flush=True)
    input()
"""
    with subprocess.Popen(
        [sys.executable, "-c", HEAD + code], cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        other.stdout.readline()
        write(tmp_path / "a.txt", "ours")
        assert (tmp_path / "a.txt").read_text() == "ours"
        other.communicate(b"\n")
    assert other.returncode == 0 and (tmp_path / "a.txt").read_text() == "theirs"
    assert listing(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("read", [read_bytes, lambda path: list(read_lines(path)), read_gaussians])
def test_devices_and_pipes_are_not_read(tmp_path, read):
    """Such as a pipe that nobody writes to, or /dev/zero; /dev/null would end at once."""
    path = tmp_path / "a.ply"
    path.symlink_to(os.devnull)
    with pytest.raises(InputError, match="is a folder, a pipe or a device"):
        read(path)


@pytest.mark.parametrize("read", [read_json, lambda path: list(read_lines(path)), read_gaussians])
def test_a_pointer_of_git_lfs_is_named(tmp_path, read):
    """A clone without LFS has pointers in place of large files."""
    (tmp_path / "a.ply").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:9970\nsize 772721\n")
    with pytest.raises(InputError, match="is a Git LFS pointer, not the file itself; fetch it with `git lfs pull`"):
        read(tmp_path / "a.ply")
