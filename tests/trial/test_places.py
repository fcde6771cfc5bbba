"""Links in sets and in a user's folders, hostile names, full disks, locales, and the files that commands open."""

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from sehdr_warp.own_files import LIST

from .harness import COMMANDS, LATEST, TRAIN, call, files_in
from .hostile import MARKUP, SHORT, scripts_of, tried

pytestmark = pytest.mark.trial


@pytest.mark.parametrize("name", ["run", "link to run", "output folder", "output file", "list", "cache"])
def test_links_that_a_user_made(space, name):
    (space / "kept").mkdir()
    (space / "kept" / "notes.txt").write_text("mine")
    line = "render run --out seen --device cpu"
    if name == "link to run":
        (space / "other").symlink_to("run")
        assert tried(space, line.replace("run", "other", 1), codes=(0,)).code == 0
    elif name == "run":
        tried(space, line, codes=(0,))
    elif name == "output folder":
        (space / "seen").symlink_to("kept")
        tried(space, line, made=("kept",))
    elif name == "output file":
        (space / "seen.ply").symlink_to("kept/notes.txt")
        tried(space, "export run --out seen.ply --overwrite", codes=(1,))
    elif name == "list":
        shutil.copytree(space / "made", space / "again")
        (space / "again" / LIST).unlink()
        (space / "again" / LIST).symlink_to("../kept/notes.txt")
        tried(space, "export run --out again/new.ply --kind hdr", made=("again",))
    else:
        (space / "cache").symlink_to("kept")
        tried(space, SHORT, codes=(0,), made=("new", "seen", "kept"))
    assert (space / "kept" / "notes.txt").read_text() == "mine"


NAMED = {
    "markup": MARKUP.replace("/", "\u2215"),
    "quote": "'\"><svg onload=PWNED>",
    "entity": "&lt;script&gt;PWNED",
    "escape": "a\x1b[2Jb",
    "newline": "a\nsehdr-warp: all is well",
    "right to left": "a\u202egpj",
    "formula": "=1+1",
    "percent": "%s%n{0}$(id)`id`",
}


@pytest.mark.parametrize("name", NAMED)
def test_names_of_photos_on_pages_and_terminals(space, name):
    photos = space / "photos"
    description = json.loads((photos / "transforms.json").read_text())
    for number, frame in enumerate(description["frames"]):
        old = photos / f"{frame['file_path'].removesuffix('.png')}.png"
        new = f"images/{number}{NAMED[name]}.png"
        old.rename(photos / new)
        frame["file_path"] = new
    (photos / "transforms.json").write_text(json.dumps(description))
    tried(space, SHORT.replace(" -q", ""), codes=(0,))
    tried(space, "report new --out seen --device cpu", codes=(0,))
    tried(space, "export new --out seen.html", codes=(0,))
    pages = [*(space / "seen").glob("*.html"), space / "seen.html"]
    assert len(pages) == 2
    for page in pages:
        assert scripts_of(page.read_text()) == []


@pytest.mark.parametrize("name", NAMED)
def test_names_in_lists_on_terminals(space, name):
    """List photos that are not there."""
    (space / "photos" / "exposures.json").write_text(json.dumps({NAMED[name]: 1, "r_0.png": 0.5}))
    tried(space, SHORT.replace(" -q", ""))


WRITES = {name: " ".join(words) for name, words in COMMANDS.items()} | {
    "train": " ".join(TRAIN).replace("--out run", "--out made/run"),
    "export html": "export run --out made/scene.html",
    "export glb": "export run --out made/scene.glb",
    "export sog": "export run --out made/scene.sog",
    "export usdz": "export run --out made/scene.usdz",
    "aovs": "render run --out made/aovs --aovs all --device cpu",
}


@pytest.mark.parametrize("most", [1200, 8000])
@pytest.mark.parametrize("name", WRITES)
def test_full_disks(space, name, most):
    """A limit on the size of files stands in: writes past it fail, whoever makes them, and what was there stays."""

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        # The child's own output is such a file as well.
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))

    shutil.copytree(space / "made", space / "before")
    (space / "run" / "confidence.safetensors").unlink(missing_ok=True)
    ended = call(*WRITES[name].split(), folder=space, prepare=limit)
    if ended.code:
        left = [path.name for path in space.rglob(".*") if path.name not in (LIST, ".lock")]
        assert files_in(space / "made") == files_in(space / "before") and left == []


LOCALES = {
    "latin": {"LC_ALL": "de_DE.ISO-8859-1"},
    "none": {"LC_ALL": "xx_YY.nothing"},
    "C": {"LC_ALL": "C", "PYTHONUTF8": "0"},
    "strict": {"LC_ALL": "C", "PYTHONIOENCODING": "ascii:strict", "PYTHONCOERCECLOCALE": "0"},
    "utf16": {"PYTHONIOENCODING": "utf-16"},
    "turkish": {"LC_ALL": "tr_TR.UTF-8", "LANG": "tr_TR.UTF-8"},
}


@pytest.mark.parametrize("name", LOCALES)
def test_locales(space, name):
    """A name with letters of many scripts, and one that is no UTF-8, each in words and files."""
    (space / "run").rename(space / "Größe_İı_写真")
    environment = {**os.environ, **LOCALES[name], "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-m", "sehdr_warp", "export", "Größe_İı_写真", "--out", "Süden.ply"]
    done = subprocess.run(command, cwd=space, env=environment, capture_output=True, timeout=LATEST, check=False)
    errors = done.stderr.decode(errors="replace")
    assert done.returncode == 0 and "Traceback" not in errors and (space / "Süden.ply").is_file(), errors


OPENED = {
    "train": SHORT,
    "render": "render run --out seen --device cpu",
    "report": "report run --out seen --device cpu",
    "export": "export run --out seen.ply",
    "eval": "eval run --device cpu",
    "convert": "convert files/a.glb seen.ply",
}
USES = {"train": ("photos",), "report": ("run", "photos"), "eval": ("run", "photos"), "convert": ("files",)}


@pytest.mark.parametrize("name", OPENED)
def test_what_commands_open(space, name):
    """Commands open only files that are named, or belong to what is named; the folder above is a user's."""
    places = [space / place for place in (*USES.get(name, ("run",)), "new", "seen", "cache", ".out", ".err", ".count")]

    def watch(event, arguments):
        if event == "open" and isinstance(arguments[0], str | bytes):
            path = Path(os.path.abspath(os.fsdecode(arguments[0])))
            inside = path.is_relative_to(space) and path != space and path.name != LIST and path.exists()
            if inside and not any(
                path.is_relative_to(each) or path.name.startswith((".seen", "seen")) for each in places
            ):
                os.write(2, f"STARTED to open {path}, mode {arguments[1]}\n".encode())

    tried(space, OPENED[name], codes=(0,), prepare=lambda: sys.addaudithook(watch))
