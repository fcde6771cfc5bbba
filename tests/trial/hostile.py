"""Command lines on a folder, and files to spoil, for trials of files that are damaged or were made to do harm.

A case says what it expects: a refusal in one line, or, under EITHER, that line or the right result.
"""

import json
import os
import re
import shutil
import struct
import zlib
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from sehdr_warp.own_files import LIST
from tests.make_scenes import pattern, png_of

from .harness import call, files_in

MARKUP = '"><script>PWNED</script><img src=x onerror=PWNED>'
MOST_MEMORY = 2500  # MiB of any command here; the largest picture that is sent has a few thousand pixels
SHORT = "train photos --out new --preset demo --response srgb --iterations 2 --device cpu -q"


def tried(space: Path, line: str, codes=(0, 1), made=("new", "seen", "cache"), **options):
    """Runs a command line; what it does not make by name stays as it is, and a refusal is short."""
    before = files_in(space)
    os.environ["SEHDR_CACHE"] = str(space / "cache")
    ended = call(*line.split(), folder=space, **options)
    assert ended.code in codes, ended.err[-600:]
    assert ended.memory < MOST_MEMORY, f"{ended.memory} MiB"
    after = files_in(space)
    changed = {path for path in after.keys() | before.keys() if after.get(path) != before.get(path)}
    theirs = {path for path in changed - {LIST} if Path(path).parts[0].partition(".")[0] not in made}
    assert not theirs, theirs
    assert all(len(text) < 2000 and not re.search(r"[\x00-\x08\x0b-\x1f\x7f]", text) for text in ended.err.splitlines())
    return ended


def link(place: str, target: str):
    def make(space: Path) -> None:
        path = space / place
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.symlink_to(target)

    return make


class _Sent(HTMLParser):
    """Parts of a page that were sent and could do something."""

    def __init__(self, page: str):
        super().__init__()
        self.found, self.within = [], ""
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        self.within = tag
        self.found += [(tag, name) for name, value in attributes if "PWNED" in (value or "") and name.startswith("on")]
        self.found += [
            (tag, name) for name, value in attributes if "PWNED" in (value or "") and name in ("href", "src")
        ]

    def handle_endtag(self, tag):
        self.within = ""

    def handle_data(self, data):
        # Our own scripts hold the names as JSON in which no tag can end.
        if self.within == "script" and "PWNED" in data and ("<" in data.split("PWNED")[0][-20:] or data == "PWNED"):
            self.found.append((self.within, data[:80]))


def scripts_of(page: str) -> list:
    return _Sent(page).found


def photo(space: Path, suffix: str) -> Path:
    """The place of a photo of the set, whose description names it by this suffix."""
    photos = space / "photos"
    description = json.loads((photos / "transforms.json").read_text())
    for frame in description["frames"]:
        if frame["file_path"].removesuffix(".png").endswith("r_2"):
            frame["file_path"] = f"images/r_2{suffix}"
    (photos / "images" / "r_2.png").unlink()
    (photos / "transforms.json").write_text(json.dumps(description))
    return photos / "images" / f"r_2{suffix}"


def heic(path: Path, pixels=None, **options) -> Path:
    pillow_heif = pytest.importorskip("pillow_heif")
    pillow_heif.from_pillow(Image.fromarray(pattern(24, 16) if pixels is None else pixels)).save(
        path, quality=90, **options
    )
    return path


def patched(path: Path, old: bytes, new: bytes, at: int = 0) -> None:
    data = bytearray(path.read_bytes())
    start = data.index(old) + at
    data[start : start + len(new)] = new
    path.write_bytes(data)


def gif_named(path: Path) -> None:
    Image.fromarray(pattern(24, 16)).save(path, "GIF")


def png(path: Path, *chunks: tuple[bytes, bytes], size=(24, 16)) -> None:
    rows = zlib.compress((b"\0" + bytes(24 * 3)) * 16)
    head = struct.pack(">IIBBBBB", *size, 8, 2, 0, 0, 0)
    path.write_bytes(png_of((b"IHDR", head), *chunks, (b"IDAT", rows), (b"IEND", b"")))


REFUSED, EITHER = (1, 2), (0, 1)
NAN, FAR = float("nan"), 1e300
RENDER = "render run --out new --cameras test --size 8x8 --device cpu"
STATE = "checkpoints/iteration_00000024/state.safetensors"
DEEP = "[" * 100_000
IDENTITY = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]
CAMERA = {"name": "c", "width": 8, "height": 8, "fx": 9, "fy": 9, "cx": 4, "cy": 4, "world_to_camera": IDENTITY}


def case(name: str, *values: Any, codes: tuple[int, ...] = REFUSED):
    return pytest.param(*values, codes, id=name[:60])


def put(path: Path, content: Any) -> None:
    """Write bytes, text or JSON to a file, or make one of another kind: `fifo`, `zero`, `folder`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    kinds = {"fifo": os.mkfifo, "zero": lambda place: place.symlink_to("/dev/zero"), "folder": os.mkdir}
    if isinstance(content, str) and content in kinds:
        kinds[content](path)
    elif isinstance(content, bytes):
        path.write_bytes(content)
    else:
        text = content if isinstance(content, str) else json.dumps(content)
        path.write_bytes(text.encode("utf-8", "surrogatepass"))
