"""Files and requests that were made to do harm, by somebody who has not written what they are refused by.

Each case is a command line on something spoiled: one line, or the right result, and nothing else of the user's changes.
"""

import gzip
import io
import json
import os
import re
import resource
import shutil
import signal
import struct
import subprocess
import sys
import zipfile
import zlib
from functools import partial
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.own_files import LIST
from tests.make_scenes import pattern
from tests.scene.clips import pan, write_clip
from tests.scene.dng_files import area, gain_map, longs, opcodes, shorts, write_tagged_dng
from tests.scene.gain_map_files import iso_metadata, write_heif_pair, write_jpeg_pair, xmp_segment
from tests.scene.test_color_encoding import icc_profile

from .harness import COMMANDS, LATEST, TRAIN, call, files_in

pytestmark = pytest.mark.trial
MARKUP = '"><script>PWNED</script><img src=x onerror=PWNED>'
MOST_MEMORY = 2500
"""MiB of any command here; the largest picture that is sent has a few thousand pixels."""
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


# --- links


def link(place: str, target: str):
    def make(space: Path) -> None:
        path = space / place
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.symlink_to(target)

    return make


RUN_LINKS = {
    "checkpoint folder": ("run/checkpoints/iteration_00000024", "../../precious"),
    "checkpoint values": ("run/checkpoints/iteration_00000024/checkpoint.json", "../../../precious/a.json"),
    "second checkpoint": ("run/checkpoints/iteration_00000099", "../../precious"),
    "link to itself": ("run/scene.json", "scene.json"),
    "link to a device": ("run/metrics.jsonl", "/dev/zero"),
    "link to a process": ("run/plan.json", "/proc/self/environ"),
    "link to passwords": ("run/summary.json", "/etc/passwd"),
    "link in .new": ("run/.new/config.json", "../../precious/a.json"),
    "link in .ready": ("run/.ready/checkpoints", "../../precious"),
    "folder of events": ("run/tensorboard", "/"),
    "orientation": ("run/orientation.json", "../precious/a.json"),
    "extension": ("run/extension.json", "../precious/a.json"),
}


@pytest.mark.parametrize("line", ["render run --out seen --device cpu", "train --resume --out run --device cpu -q"])
@pytest.mark.parametrize("name", RUN_LINKS)
def test_further_links_in_a_run(space, name, line):
    (space / "precious").mkdir()
    (space / "precious" / "a.json").write_text("{}")
    link(*RUN_LINKS[name])(space)
    ended = tried(space, line, codes=(1,))
    assert "is a link" in ended.err.splitlines()[-1]


SET_LINKS = {
    "a photo that leads out": ("photos/images/r_2.png", "../../secret.png"),
    "a photo that leads to itself": ("photos/images/r_2.png", "r_2.png"),
    "photos that lead out": ("photos/images", "../elsewhere"),
    "a mask that leads out": ("photos/masks/r_2.png", "../../secret.png"),
    "masks that lead out": ("photos/masks", "../elsewhere"),
    "times that lead out": ("photos/exposures.json", "../secret.json"),
    "cameras that lead out": ("photos/transforms.json", "../secret.json"),
}


@pytest.mark.parametrize("name", SET_LINKS)
def test_links_in_a_set(space, name):
    """What leads out of a data set is not read: neither shown nor named by its content."""
    (space / "elsewhere").mkdir()
    for path in (space / "secret.png", space / "elsewhere" / "r_2.png"):
        Image.fromarray(np.full((16, 24, 3), 201, np.uint8)).save(path)
    (space / "secret.json").write_text('{"SECRET": 1}')
    link(*SET_LINKS[name])(space)
    ended = tried(space, SHORT)
    assert "SECRET" not in ended.err + ended.out


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


# --- what a run says of itself

REGION = {"photo": "r_0", "pixels": 1, "row": 1.0, "column": 1.0, "stops": 1.0, "box": [1, 2, 3, 4]}
SHAPES = {
    "summary.json": [
        "null",
        "[]",
        '""',
        "{}",
        "{",
        "",
        "\ufeff{}",
        "NaN",
        "[" * 100_000,
        '{"iteration": 1e400}',
        '{"format": 99}',
        '{"iteration": -1}',
        '{"train_seconds": NaN}',
        '{"device": "' + "x" * 100_000 + '"}',
        '{"iteration": ' + "9" * 5000 + "}",
        '{"a": 1, "a": 2}',
        '{"unexplained": {"regions": 1e9}}',
        json.dumps({"unexplained": {"regions": 1, "photos": 1, "worst": [REGION] * 5000}}),
        json.dumps({"unexplained": {"regions": 1, "photos": 1, "worst": [REGION | {"photo": "../../x"}]}}),
        json.dumps({"unexplained": {"regions": 1, "photos": 1, "worst": [REGION | {"row": -5, "column": 1e12}]}}),
        json.dumps({"unexplained": {"regions": 1, "photos": 1, "worst": [REGION | {"box": [9, 9, 1, 1]}]}}),
    ],
    "plan.json": [
        "null",
        "[1]",
        '{"decisions": null}',
        '{"decisions": {}}',
        '{"decisions": [[]]}',
        '{"decisions": [{"name": 1}]}',
        json.dumps({"decisions": [{"name": MARKUP, "choice": MARKUP, "reason": MARKUP, "fields": {MARKUP: MARKUP}}]}),
        json.dumps(
            {"decisions": [{"name": "x", "choice": "y", "reason": "z", "fields": {"a": {"b": [1] * 9999}}}] * 99}
        ),
    ],
    "metrics.jsonl": [
        "null\n",
        "[]\n",
        '{"iteration": "1"}\n',
        '{"iteration": 1, "psnr_ldr": 1e400}\n',
        '{"iteration": 1}\n' * 50_000,
        '{"iteration": -1, "seconds": -1}\n',
        "\0" * 1000,
        '{"iteration": 1, "psnr_ldr": null, "x": "' + MARKUP + '"}\n',
    ],
}
CASES = [(name, number) for name, shapes in SHAPES.items() for number in range(len(shapes))]


class _Sent(HTMLParser):
    """What of a page was sent and could do something."""

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


@pytest.mark.parametrize("name, number", CASES)
def test_shapes_of_summary_plan_and_metrics(space, name, number):
    (space / "run" / name).write_text(SHAPES[name][number])
    tried(space, "report run --out seen --device cpu")
    for page in (space / "seen").glob("*.html"):
        assert scripts_of(page.read_text()) == []
    tried(space, "compare run")


# --- text that reaches pages and terminals

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
    """Of photos that are not there."""
    (space / "photos" / "exposures.json").write_text(json.dumps({NAMED[name]: 1, "r_0.png": 0.5}))
    tried(space, SHORT.replace(" -q", ""))


# --- films

FILM = "render run --cameras all --device cpu --video"
FILM_CASES = {
    "a folder": ("d", 1),
    "in a folder that is a file": ("photos/transforms.json/a.mp4", 1),
    "no name": ("", 2),
    "in a device": ("/dev/null/a.mp4", 1),
    "long": ("n" * 300 + ".mp4", 1),
    "null frames": ("seen.mp4 --fps 0", 1),
    "slow": ("seen.mp4 --fps 1e-9", 1),
    "fast": ("seen.mp4 --fps 1e9", 1),
    "hlg": ("seen.mp4 --transfer hlg", 0),
    "hdr10": ("seen.mov --transfer hdr10", 0),
    "log": ("seen.mov --transfer logc3", 0),
    "log in mp4": ("seen.mp4 --transfer slog3", 1),
    "ramp": ("seen.mp4 --ev-ramp=-3:3", 0),
    "ramp of many": ("seen.mp4 --ev-ramp=1:2:3", 1),
    "bright": ("seen.mp4 --ev-ramp=0:1e9", 1),
    "one pixel": ("seen.mp4 --size 1x1", 0),
    "wide": ("seen.mp4 --size 70000x2", 1),
    "matroska": ("seen.mkv", 0),
    "a link": ("l.mp4 --overwrite", 1),
    "a pipe": ("p.mp4 --overwrite", 1),
    "somebody's": ("own.mp4 --overwrite", 1),
}


@pytest.mark.parametrize("name", FILM_CASES)
def test_films_that_cannot_be(space, name):
    pytest.importorskip("av")
    (space / "d").mkdir()
    (space / "own.mp4").write_text("mine")
    (space / "l.mp4").symlink_to("own.mp4")
    words, code = FILM_CASES[name]
    if name == "a pipe":
        os.mkfifo(space / "p.mp4")
    ended = tried(space, f"{FILM} {words}", codes=(0,) if code == 0 else (1, 2))
    assert ended.code or any(space.glob("seen.*"))


# --- LUTs

LUT_3D = "LUT_3D_SIZE 2\n" + "0 0 0\n" * 8
LAUGHS = '<?xml version="1.0"?><!DOCTYPE l [<!ENTITY a0 "ha">{}]>'
LAUGHS += '<ProcessList id="x"><Description>&a20;</Description></ProcessList>'
LAUGHS = LAUGHS.format("".join(f'<!ENTITY a{n} "{f"&a{n - 1};" * 10}">' for n in range(1, 21)))
LUT_FILES = {
    "cube of a million": ("a.cube", "LUT_3D_SIZE 1000000\n0 0 0\n"),
    "cube of minus one": ("a.cube", "LUT_3D_SIZE -1\n0 0 0\n"),
    "long line": ("a.cube", "LUT_1D_SIZE 1000000000\n0 0 0\n"),
    "numbers that are none": ("a.cube", LUT_3D.replace("0 0 0", "nan inf x")),
    "spi1d of 2^40": ("a.spi1d", "Version 1\nFrom 0 1\nLength 1099511627776\nComponents 1\n{\n0\n}\n"),
    "spi3d of 2^31": ("a.spi3d", "SPILUT 1.0\n3 3\n2147483647 2147483647 2147483647\n0 0 0 0 0 0\n"),
    "3dl": ("a.3dl", "3DMESH\nMesh 30 30\n0 1 2\n"),
    "csp": ("a.csp", "CSPLUTV100\n3D\n\n999999999\n0 1\n0 1\n"),
    "xml that grows": ("a.clf", LAUGHS),
    "ctf that grows": ("a.ctf", LAUGHS),
    "cdl that grows": ("a.cdl", LAUGHS),
    "xml of another file": (
        "a.clf",
        '<?xml version="1.0"?><!DOCTYPE l [<!ENTITY x SYSTEM "file:///etc/passwd">]><ProcessList id="&x;"/>',
    ),
    "hdl": ("a.lut", "Version 1\nFormat any\nType 3D\nFrom 0 1\nTo 0 1\nBlack 0\nWhite 1\nLength 9999999\nLUT:\n"),
    "zeros": ("a.cube", "\0" * 100_000),
    "icc": ("a.icc", "acsp" * 100),
}
CONFIG = """ocio_profile_version: 2
search_path: {search}
roles: {{default: raw, scene_linear: raw, aces_interchange: raw, cie_xyz_d65_interchange: raw}}
file_rules:
  - !<Rule> {{name: Default, colorspace: default}}
displays:
  D:
    - !<View> {{name: V, colorspace: out}}
colorspaces:
  - !<ColorSpace>
    name: raw
  - !<ColorSpace>
    name: out
    from_scene_reference: !<FileTransform> {{src: {source}}}
"""
VIEW_LINE = "render run --out seen --ocio own.ocio --view V --device cpu"


@pytest.mark.parametrize("name", LUT_FILES)
def test_luts_that_were_made(space, name):
    pytest.importorskip("PyOpenColorIO")
    file, text = LUT_FILES[name]
    (space / file).write_text(text)
    (space / "own.ocio").write_text(CONFIG.format(search=".", source=file))
    ended = tried(space, VIEW_LINE)
    assert "root:" not in ended.err


CONFIGS = {
    "environment in a path": CONFIG.format(search="$HOME:$PATH:.", source="$SECRET/a.cube"),
    "up and up": CONFIG.format(search="../../..:/", source="etc/passwd"),
    "url": CONFIG.format(search=".", source="http://127.0.0.1:9/a.cube"),
    "version 99": CONFIG.format(search=".", source="a.cube").replace("version: 2", "version: 99"),
    "yaml that grows": "a: &a [x, x, x]\n"
    + "".join(f"{chr(98 + n)}: &{chr(98 + n)} [{', '.join([f'*{chr(97 + n)}'] * 9)}]\n" for n in range(12)),
    "deep": "{a: " * 3000 + "1" + "}" * 3000,
    "python": "!!python/object/apply:os.system ['touch PWNED']",
    "empty": " ",
    "zeros": "\0" * 5000,
}


@pytest.mark.parametrize("name", CONFIGS)
def test_configs_that_were_made(space, name):
    pytest.importorskip("PyOpenColorIO")
    (space / "own.ocio").write_text(CONFIGS[name])
    ended = tried(space, VIEW_LINE, codes=(1,))
    assert "root:" not in ended.err


@pytest.mark.parametrize("name", ["no archive", "up", "bomb", "nothing in it"])
def test_archives_of_configs(space, name):
    pytest.importorskip("PyOpenColorIO")
    place = space / "own.ocioz"
    if name == "no archive":
        place.write_bytes(b"PK\3\4" + bytes(500))
    else:
        with zipfile.ZipFile(place, "w", zipfile.ZIP_DEFLATED) as archive:
            if name != "nothing in it":
                archive.writestr(
                    "config.ocio", CONFIG.format(search=".", source="../a.cube" if name == "up" else "a.cube")
                )
            archive.writestr(
                "../a.cube" if name == "up" else "a.cube", "0 0 0\n" * (60_000_000 if name == "bomb" else 1)
            )
    tried(space, VIEW_LINE.replace("own.ocio", "own.ocioz"), codes=(1,))


# --- splats

PLY_HEAD = "ply\nformat binary_little_endian 1.0\n"
SH = "".join(
    f"property float {name}\n"
    for name in (
        "x",
        "y",
        "z",
        "f_dc_0",
        "f_dc_1",
        "f_dc_2",
        "opacity",
        "scale_0",
        "scale_1",
        "scale_2",
        "rot_0",
        "rot_1",
        "rot_2",
        "rot_3",
    )
)


def ply(head: str, body: bytes = bytes(14 * 4 * 3)):
    return lambda files: (PLY_HEAD + head + "end_header\n").encode() + body


def zipped(
    change=lambda meta: None, drop: str = "", extra: dict[str, bytes] | None = None, method=zipfile.ZIP_DEFLATED
):
    """A .sog with a changed description, without a part, or with further ones."""

    def make(files: Path) -> bytes:
        packed = io.BytesIO()
        with zipfile.ZipFile(files / "a.sog") as whole, zipfile.ZipFile(packed, "w", method) as archive:
            for name in whole.namelist():
                data = whole.read(name)
                if name == "meta.json":
                    meta = json.loads(data)
                    change(meta)
                    data = json.dumps(meta).encode()
                if name != drop and name not in (extra or {}):
                    archive.writestr(name, data)
            for name, data in (extra or {}).items():
                archive.writestr(name, data() if callable(data) else data)
        return packed.getvalue()

    return make


def webp(width: int, height: int) -> bytes:
    buffer = io.BytesIO()
    Image.new("RGBA", (width, height)).save(buffer, "WEBP", lossless=True)
    return buffer.getvalue()


def spz(count=3, version=3, degree=0, fraction=12, body=None, pack=True):
    def make(files: Path) -> bytes:
        head = struct.pack("<IIIBBBB", 0x5053474E, version, count, degree, fraction, 0, 0)
        data = head + (bytes(20 * 3) if body is None else body() if callable(body) else body)
        return gzip.compress(data) if pack else data

    return make


def described(change):
    """A .glb whose description was changed."""

    def make(files: Path) -> bytes:
        data = (files / "a.glb").read_bytes()
        length = struct.unpack_from("<I", data, 12)[0]
        tree, binary = json.loads(data[20 : 20 + length]), data[28 + length :]
        text = change(tree)
        text = json.dumps(tree).encode() if text is None else text
        text += b" " * (-len(text) % 4)
        head = struct.pack("<5I", 0x46546C67, 2, 28 + len(text) + len(binary), len(text), 0x4E4F534A)
        return head + text + struct.pack("<2I", len(binary), 0x4E4942) + binary

    return make


def usd(body: str):
    return lambda files: f'#usda 1.0\n(defaultPrim = "a" upAxis = "Y")\n{body}\n'.encode()


def set_in(*path, value):
    def change(tree):
        for key in path[:-1]:
            tree = tree[key]
        tree[path[-1]] = value

    return change


SPLATS = {
    "count of 10^12.ply": ply(f"element vertex {10**12}\n{SH}"),
    "count below 0.ply": ply(f"element vertex -3\n{SH}"),
    "no end.ply": lambda files: (PLY_HEAD + f"element vertex 3\n{SH}").encode() * 200,
    "list.ply": ply("element vertex 3\nproperty list uint int x\n" + SH, b"\xff" * 200),
    "header of 100 MB.ply": lambda files: PLY_HEAD.encode() + b"comment x\n" * 10_000_000,
    "same property twice.ply": ply(f"element vertex 3\n{SH}property float x\n"),
    "two elements.ply": ply(f"element a 4000000000\nproperty double q\nelement vertex 3\n{SH}"),
    "type of another.ply": ply(f"element vertex 3\n{SH}".replace("float x", "float128 x")),
    "text.ply": lambda files: (
        b"ply\nformat ascii 1.0\nelement vertex 3\n" + SH.encode() + b"end_header\n" + b"1 " * 1000
    ),
    "nan.ply": ply(f"element vertex 3\n{SH}", b"\xff" * 14 * 4 * 3),
    "huge.ply": ply(f"element vertex 3\n{SH}", struct.pack("<f", 3e38) * 42),
    "count of none.sog": zipped(set_in("count", value=0)),
    "count of many.sog": zipped(set_in("count", value=2**31)),
    "count of a text.sog": zipped(set_in("count", value="9" * 5000)),
    "codebook of nan.sog": zipped(set_in("scales", "codebook", value=[float("nan")] * 256)),
    "codebook of text.sog": zipped(set_in("sh0", "codebook", value="x" * 256)),
    "files above.sog": zipped(set_in("means", "files", value=["../../etc/passwd", "/etc/passwd"])),
    "version 1.sog": zipped(set_in("version", value=1)),
    "bands of 9.sog": zipped(
        set_in("shN", value={"bands": 9, "count": 1, "codebook": [0] * 256, "files": ["sh0.webp"] * 2})
    ),
    "no picture.sog": zipped(drop="quats.webp"),
    "no description.sog": zipped(drop="meta.json"),
    "picture of 16000.sog": zipped(extra={"quats.webp": lambda: webp(16000, 16000)}),
    "bomb.sog": zipped(extra={"zeros": lambda: bytes(200_000_000)}),
    "description of 60 MB.sog": zipped(extra={"meta.json": lambda: b" " * 60_000_000}),
    "deep.sog": zipped(extra={"meta.json": b"[" * 100_000}),
    "names above.sog": zipped(extra={"../PWNED": b"x", "/tmp/PWNED": b"x"}),
    "not zip.sog": lambda files: b"PK\5\6" + bytes(18),
    "a zip in front.sog": lambda files: (files / "a.sog").read_bytes() * 2,
    "world of nan.sog": zipped(set_in("sehdr", "world_matrix", value=[[float("nan")] * 4] * 4)),
    "count of many.spz": spz(count=49_999_999),
    "count of 2^32.spz": spz(count=2**32 - 1, pack=False),
    "degree 9.spz": spz(degree=9),
    "fraction 200.spz": spz(fraction=200),
    "version 9.spz": spz(version=9),
    "bomb.spz": spz(count=3, body=lambda: bytes(200_000_000)),
    "bomb that is asked for.spz": spz(count=20_000_000, body=lambda: bytes(300_000_000)),
    "cut.spz": lambda files: spz()(files)[:-9],
    "not packed.spz": spz(pack=False, body=b"\xff" * 60),
    "outside file.glb": described(set_in("buffers", value=[{"byteLength": 9, "uri": "../../../etc/passwd"}])),
    "url.glb": described(set_in("buffers", value=[{"byteLength": 9, "uri": "http://127.0.0.1:9/a"}])),
    "data of a gigabyte.glb": described(set_in("buffers", value=[{"byteLength": 1 << 30, "uri": "data:;base64,AAAA"}])),
    "no meshes.glb": described(set_in("meshes", value=[])),
    "nodes in a circle.glb": described(set_in("nodes", value=[{"children": [0], "mesh": 0}])),
    "nodes of a million.glb": described(
        set_in("nodes", value=[{"children": [n + 1]} for n in range(100_000)] + [{"mesh": 0}])
    ),
    "matrix of text.glb": described(set_in("nodes", value=[{"mesh": 0, "matrix": ["x"] * 16}])),
    "deep.glb": described(lambda tree: b"[" * 100_000),
    "accessors above.glb": described(set_in("accessors", value=[])),
    "chunk of 4 GiB.glb": lambda files: (
        (files / "a.glb").read_bytes()[:12] + b"\xff" * 4 + (files / "a.glb").read_bytes()[16:]
    ),
    "json alone.glb": lambda files: b'{"asset": {"version": "2.0"}}',
    "empty.glb": lambda files: b"",
    "reference outside.usda": usd('def "a" (references = @/etc/passwd@) {}'),
    "payload of a url.usda": usd('def "a" (payload = @http://127.0.0.1:9/a.usda@) {}'),
    "sublayer above.usda": lambda files: b"#usda 1.0\n(subLayers = [@../../../secret.usda@])\n",
    "itself.usda": usd('def "a" (references = @./b.usda@</a>) {}'),
    "clips.usda": usd('def "a" (clips = {dictionary default = {asset[] assetPaths = [@/etc/passwd@]}}) {}'),
    "deep.usda": usd('def "a" {' * 5000 + "}" * 5000),
    "array of many.usda": usd(f'def "a" {{ point3f[] positions = [{"(0,0,0)," * 100_000}] }}'),
    "names.usda": usd(f'def "a" {{ custom string x = "{MARKUP[2:]}" }}'),
    "variants.usda": usd(
        'def "a" (variants = {string v = "x"} prepend variantSets = "v") { variantSet "v" = { "x" '
        '{ def "b" (references = @/etc/passwd@) {} } } }'
    ),
    "header of others.compressed.ply": lambda files: (
        (files / "a.compressed.ply").read_bytes().replace(b"element vertex ", b"element vertex 9999999")
    ),
    "chunks of none.compressed.ply": lambda files: (
        (files / "a.compressed.ply").read_bytes().replace(b"element chunk 1", b"element chunk 0")
    ),
}


@pytest.mark.parametrize("name", SPLATS)
def test_splats_that_were_made(space, name):
    suffix = name[name.index(".") :] if name.endswith(".compressed.ply") else Path(name).suffix
    (space / f"b{suffix}").write_bytes(SPLATS[name](space / "files"))
    shutil.rmtree(space / "files")
    ended = tried(space, f"convert b{suffix} seen.ply")
    assert ended.code or "root:" not in (space / "seen.ply").read_text(errors="replace")


# --- locks


def locked(kind: str, space: Path) -> None:
    lock = space / "run" / ".lock"
    lock.unlink(missing_ok=True)
    {
        "folder": lambda: lock.mkdir(),
        "full folder": lambda: (lock / "a").mkdir(parents=True),
        "pipe": lambda: os.mkfifo(lock),
        "link": lambda: lock.symlink_to("../precious"),
        "dangling": lambda: lock.symlink_to("nowhere"),
        "text": lambda: lock.write_text("4294967295\n" * 1000),
        "sparse": lambda: (lock.touch(), os.truncate(lock, 1 << 26)),
    }[kind]()


@pytest.mark.parametrize("line", ["train --resume --out run --device cpu -q", " ".join([*TRAIN, "--overwrite", "-q"])])
@pytest.mark.parametrize("kind", ["folder", "full folder", "pipe", "link", "dangling", "text", "sparse"])
def test_locks_that_are_no_locks(space, kind, line):
    (space / "precious").write_text("mine")
    locked(kind, space)
    ended = tried(space, line, made=("run",))
    assert (ended.code == 0) == (kind in ("text", "sparse", "pipe"))


# --- changes below a resumed training


def change_set(kind: str, photos: Path) -> None:
    first = min((photos / "images").glob("*.png"))
    description = json.loads((photos / "transforms.json").read_text())
    frames = description["frames"]
    if kind == "pixels":
        Image.open(first).convert("RGB").point(lambda value: 255 - value).save(first)
    elif kind == "one pixel":
        image = Image.open(first).convert("RGB")
        image.putpixel((3, 3), tuple(255 - value for value in image.getpixel((3, 3))))
        image.save(first)
    elif kind == "swapped":
        second = sorted((photos / "images").glob("*.png"))[1]
        data = first.read_bytes()
        first.write_bytes(second.read_bytes())
        second.write_bytes(data)
    elif kind == "smaller":
        image = Image.open(first)
        image.resize((image.width // 2, image.height // 2)).save(first)
    elif kind == "removed":
        first.unlink()
    elif kind == "renamed":
        first.rename(first.with_name("other.png"))
        frames[0]["file_path"] = "images/other.png"
    elif kind == "camera":
        frames[0]["transform_matrix"][0][3] += 0.25
    elif kind == "fewer":
        frames.pop()
    elif kind == "mask":
        (photos / "masks").mkdir()
        Image.new("L", (24, 16), 0).save(photos / "masks" / first.name)
    elif kind == "times":
        names = [path.name for path in sorted((photos / "images").glob("*.png"))]
        (photos / "exposures.json").write_text(json.dumps(dict.fromkeys(names, 1.0) | {first.name: 9.0}))
    elif kind == "date":
        os.utime(first, (1, 1))
    elif kind == "saved again":
        Image.open(first).save(first, compress_level=0)
    (photos / "transforms.json").write_text(json.dumps(description))


SAME = ("date", "saved again")
CHANGES = ("pixels", "one pixel", "swapped", "smaller", "removed", "renamed", "camera", "fewer", "mask", "times", *SAME)


@pytest.mark.parametrize("kind", CHANGES)
def test_sets_that_changed_below_a_training(space, kind):
    change_set(kind, space / "photos")
    before = files_in(space / "run")
    line = "train photos --resume --out run --iterations 26 --device cpu -q"
    ended = tried(space, line, codes=(0,) if kind in SAME else (0, 1), made=("run",))
    assert (ended.code == 0) == (kind in SAME), f"{kind}: went on without a word"
    assert ended.code == 0 or files_in(space / "run") == before


# --- disks that are full

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


# --- locales

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
    told = done.stderr.decode(errors="replace")
    assert done.returncode == 0 and "Traceback" not in told and (space / "Süden.ply").is_file(), told


# --- photos of new kinds


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


def pair(path: Path, segment, size=(24, 16), gain=(12, 8)) -> None:
    write_jpeg_pair(path, pattern(*size), pattern(*gain)[..., 0], [segment])


def iso(**options):
    return 0xFFE2, b"urn:iso:std:iso:ts:21496:-1\0" + iso_metadata(options.pop("maximum", 2.5), **options)


def hdrgm(**fields):
    return xmp_segment({"Version": "1.0", "GainMapMax": "2.5", "HDRCapacityMax": "2.5"} | fields)


def heif_pair(path: Path, **options) -> None:
    files = heic(path.with_name("b.heic")), heic(path.with_name("g.heic"), pattern(12, 8))
    write_heif_pair(path, *files, **options)
    for file in files:
        file.unlink()


def gif_named(path: Path) -> None:
    Image.fromarray(pattern(24, 16)).save(path, "GIF")


PHOTOS = {
    "size of 2^32.heic": lambda path: patched(heic(path), b"ispe", b"\xff" * 8, 8),
    "size of none.heic": lambda path: patched(heic(path), b"ispe", bytes(8), 8),
    "cut.heic": lambda path: path.write_bytes(heic(path).read_bytes()[:300]),
    "zeros.heic": lambda path: path.write_bytes(b"\0\0\0\x18ftypheic" + bytes(5000)),
    "brand alone.heic": lambda path: path.write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic"),
    "a gif.heic": gif_named,
    "primary of none.heic": lambda path: patched(heic(path), b"pitm", b"\xff\xff", 8),
    "items of many.heic": lambda path: patched(heic(path), b"iloc", b"\xff\xff", 10),
    "meta of 4 GiB.heic": lambda path: patched(heic(path), b"meta", b"\xff\xff\xff\xff", -4),
    "a text.heic": lambda path: path.write_text("heic " * 100),
    "avif named heic.heic": lambda path: Image.fromarray(pattern(24, 16)).save(path, "AVIF"),
    "bright.jpg": partial(pair, segment=iso(maximum=400)),
    "gain of a bomb.jpg": partial(pair, segment=iso(), gain=(3000, 2000)),
    "no channels.jpg": partial(pair, segment=(0xFFE2, b"urn:iso:std:iso:ts:21496:-1\0" + bytes(9))),
    "fractions by 0.jpg": partial(
        pair, segment=(0xFFE2, b"urn:iso:std:iso:ts:21496:-1\0" + struct.pack(">HHB", 0, 0, 0) + bytes(80))
    ),
    "nan.jpg": partial(pair, segment=hdrgm(GainMapMax="nan")),
    "markup.jpg": partial(pair, segment=hdrgm(GainMapMax="&lt;script&gt;", Gamma="\x1b[2J")),
    "metadata that repeat.jpg": lambda path: pair(
        path, (0xFFE1, b"http://ns.adobe.com/xap/1.0/\0" + b"<hdrgm:Gamma>" * 4900)
    ),
    "apple without a note.jpg": partial(pair, segment=xmp_segment({"HDRGainMapVersion": "1"}, "HDRGainMap", "x")),
    "headroom of 1e308.jpg": partial(pair, segment=xmp_segment({"HDRGainMapHeadroom": "1e308"}, "HDRGainMap", "x")),
    "map of itself.heic": lambda path: (
        heif_pair(path, iso=iso_metadata(2.5)),
        patched(path, b"dimg", struct.pack(">4H", 3, 2, 1, 3), 4),
    ),
    "map of nothing.heic": lambda path: (
        heif_pair(path, iso=iso_metadata(2.5)),
        patched(path, b"dimg", struct.pack(">4H", 3, 2, 1, 99), 4),
    ),
    "metadata of 0.heic": partial(heif_pair, iso=b""),
    "apple of nothing.heic": partial(heif_pair, apple_xmp=b""),
    "xmp that repeats.heic": partial(heif_pair, apple_xmp=b"HDRGainMap:HDRGainMapHeadroom=" * 100_000),
}
PROFILES = {
    "nothing": b"",
    "zeros": bytes(5000),
    "cut": icc_profile("Display P3")[:200],
    "tags of many": icc_profile("Display P3")[:128] + b"\xff" * 4 + bytes(400),
    "curve of 2^32": icc_profile("sRGB", curve=b"curv\0\0\0\0\xff\xff\xff\xff\0\0"),
    "gamma 65535": icc_profile("sRGB", gamma=32767.0),
    "falling": icc_profile("sRGB", curve=b"curv\0\0\0\0\0\0\0\2\xff\xff\0\0"),
    "markup": icc_profile("Display P3", name=MARKUP),
    "escape": icc_profile("Display P3", name="\x1b[2J\nsehdr-warp: done"),
    "long name": icc_profile("Display P3", name="n" * 60_000),
    "place outside": icc_profile("Display P3").replace(b"rXYZ\0\0", b"rXYZ\xff\xff"),
    "no primaries": icc_profile("Display P3").replace(b"rXYZ", b"xxxx"),
}


def profiled(path: Path, profile: bytes) -> None:
    Image.fromarray(pattern(24, 16)).save(path, icc_profile=profile)


PHOTOS |= {f"profile: {name}.png": partial(profiled, profile=profile) for name, profile in PROFILES.items()}


def png(path: Path, *chunks: tuple[bytes, bytes], size=(24, 16)) -> None:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = zlib.compress((b"\0" + bytes(24 * 3)) * 16)
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", *size, 8, 2, 0, 0, 0))
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + head
        + b"".join(chunk(*each) for each in chunks)
        + chunk(b"IDAT", rows)
        + chunk(b"IEND", b"")
    )


PHOTOS |= {
    "size of 2^31.png": partial(png, size=(2**31 - 1, 2**31 - 1)),
    "size of a line.png": partial(png, size=(2**31 - 1, 1)),
    "cicp of none.png": lambda path: png(path, (b"cICP", b"\xff\xff\0\1")),
    "gamma 0.png": lambda path: png(path, (b"gAMA", bytes(4))),
    "text that grows.png": lambda path: png(path, (b"zTXt", b"x\0\0" + zlib.compress(bytes(100_000_000)))),
    "profile that grows.png": lambda path: png(path, (b"iCCP", b"x\0\0" + zlib.compress(bytes(200_000_000)))),
    "exif of itself.png": lambda path: png(
        path, (b"eXIf", b"MM\0*\0\0\0\x08\0\1\x87\x69\0\4\0\0\0\1\0\0\0\x08\0\0\0\0")
    ),
}


@pytest.mark.parametrize("name", PHOTOS)
def test_photos_that_were_made(space, name):
    """A photo that is not good is left out and named, or refused; its colors count as sRGB."""
    path = photo(space, Path(name).suffix)
    PHOTOS[name](path)
    tried(space, SHORT.replace(" -q", ""))
    if (space / "new" / "run.json").exists():
        tried(space, "report new --out seen --device cpu", codes=(0,))
        assert all(scripts_of(page.read_text()) == [] for page in (space / "seen").glob("*.html"))


SIZE = (16, 24)
ROWS = struct.pack(">I", 16) + np.ones(16, ">f4").tobytes()
OPCODES = {
    "list of 2^32": {51009: (7, 4, b"\xff" * 4)},
    "list that ends": {51009: (7, 12, struct.pack(">3I", 1, 9, 0))},
    "length of 2^32": {51009: (7, 20, struct.pack(">5I", 1, 9, 0, 0, 2**32 - 1))},
    "map of 2^31 rows": {51009: opcodes((9, area(SIZE) + struct.pack(">2I", 2**31, 2**31) + bytes(40)))},
    "map of none": {51009: opcodes((9, area(SIZE) + struct.pack(">2I", 0, 0) + bytes(40)))},
    "area outside": {51009: opcodes(gain_map(np.ones((3, 3)), (9999, 9999), 500, 500))},
    "pitch 0": {51009: opcodes(gain_map(np.ones((3, 3)), SIZE, pitch=0))},
    "gains of nan": {51009: opcodes(gain_map(np.full((3, 3), np.nan), SIZE))},
    "rows of others": {51009: opcodes((12, area(SIZE) + struct.pack(">I", 9) + bytes(36)))},
    "polynomial of 99": {51009: opcodes((8, area(SIZE) + struct.pack(">I", 99) + bytes(800)))},
    "table of 2^32": {51009: opcodes((7, area(SIZE) + b"\xff" * 4))},
    "pixels of 2^32": {51008: opcodes((5, struct.pack(">3I", 0, 2**32 - 1, 2**32 - 1)))},
    "pixels outside": {51008: opcodes((5, struct.pack(">3I", 0, 1, 0) + struct.pack(">2I", 2**31, 2**31)))},
    "lens of nan": {51022: opcodes((1, struct.pack(">I8d", 1, *[float("nan")] * 8)))},
    "lens of 1e300": {51022: opcodes((1, struct.pack(">I8d", 1, 1e300, 1e300, 0, 0, 0, 0, 0.5, 0.5)))},
    "planes of 2^32": {51022: opcodes((1, b"\xff" * 4 + bytes(64)))},
    "a thousand maps": {51009: opcodes(*[gain_map(np.ones((3, 3)), SIZE)] * 1000)},
    "number 65535": {51009: opcodes((65535, b""))},
    "active area": {50829: longs(0, 0, 2**31, 2**31)},
    "white below black": {50714: longs(9), 50717: longs(3)},
    "orientation 99": {274: shorts(99)},
    "strips outside": {273: longs(2**31), 279: longs(2**31)},
    "crop of none": {50720: longs(0, 0)},
}


@pytest.mark.parametrize("name", OPCODES)
def test_opcodes_of_dng(space, name):
    pytest.importorskip("rawpy")
    path = photo(space, ".dng")
    write_tagged_dng(path, np.full(SIZE, 9000, np.uint16), OPCODES[name])
    tried(space, "train photos --out new --preset demo --iterations 2 --device cpu")
    tried(space, "train photos --out new --preset demo --response linear --iterations 2 --device cpu --overwrite")


def clip(path: Path, **options) -> Path:
    write_clip(path, pan(8), codec="libx264", pixels="yuv420p", **options)
    return path


def tables(path: Path, **changes: int) -> None:
    data = bytearray(clip(path).read_bytes())
    for kind, value in changes.items():
        at, place = {
            "stsz": (8, ">II"),
            "stsc": (16, ">I"),
            "stts": (12, ">I"),
            "stco": (12, ">I"),
            "tkhd": (80, ">I"),
            "mvhd": (16, ">I"),
        }[kind]
        start = data.index(kind.encode())
        values = (1, value) if kind == "stsz" else (value,)
        data[start + at : start + at + struct.calcsize(place)] = struct.pack(place, *values)
    path.write_bytes(data)


CLIPS = {
    "concat.mp4": lambda path: path.write_text("ffconcat version 1.0\nfile photos/images/r_0.png\n"),
    "playlist.mp4": lambda path: path.write_text("#EXTM3U\n#EXTINF:9,\n/etc/passwd\n#EXT-X-ENDLIST\n"),
    "playlist of a url.mov": lambda path: path.write_text("#EXTM3U\n#EXTINF:9,\nhttp://127.0.0.1:9/a.ts\n"),
    "sdp.mp4": lambda path: path.write_text(
        "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 96\n"
    ),
    "text.avi": lambda path: path.write_text("RIFF" + "x" * 1000),
    "zeros.mkv": lambda path: path.write_bytes(bytes(5000)),
    "samples of 50 million.mp4": partial(tables, stsz=50_000_000, stsc=50_000_000),
    "samples of 2^32.mp4": partial(tables, stsz=2**32 - 1),
    "chunks of 2^32.mp4": partial(tables, stsc=2**32 - 1),
    "times of 2^32.mp4": partial(tables, stts=2**32 - 1),
    "chunks outside.mp4": partial(tables, stco=2**32 - 1),
    "duration of 2^32.mp4": partial(tables, mvhd=2**32 - 1),
    "cut.mp4": lambda path: path.write_bytes(clip(path).read_bytes()[:3000]),
    "cut.mkv": lambda path: path.write_bytes(clip(path).read_bytes()[:2000]),
    "half.mts": lambda path: path.write_bytes(clip(path).read_bytes()[::2]),
    "still.mp4": lambda path: write_clip(path, [next(iter(pan(1)))] * 9, codec="libx264", pixels="yuv420p"),
    "one frame.mp4": lambda path: write_clip(path, pan(1), codec="libx264", pixels="yuv420p"),
    "sound alone.mp4": lambda path: path.write_bytes(clip(path).read_bytes().replace(b"vide", b"soun")),
    "log of no space.mp4": lambda path: clip(path, metadata={"comment": MARKUP + "S-Log3" + "x" * 5000}),
    "turned by 33.mp4": lambda path: clip(path, rotation=33),
    "a photo.mp4": lambda path: Image.fromarray(pattern(24, 16)).save(path, "PNG"),
}


@pytest.mark.parametrize("name", CLIPS)
def test_clips_that_were_made(space, name):
    pytest.importorskip("av")
    CLIPS[name](space / f"c{Path(name).suffix}")
    ended = tried(space, f"train c{Path(name).suffix} --out new --iterations 2 --device cpu")
    assert "root:" not in ended.err


# --- masks, times and cameras


def mask(save):
    def make(photos: Path) -> None:
        (photos / "masks").mkdir()
        save(photos / "masks" / "r_2.png")

    return make


MASKS = {
    "of another size": mask(lambda path: Image.new("L", (5, 5), 255).save(path)),
    "of nothing": mask(lambda path: Image.new("L", (24, 16), 0).save(path)),
    "of 2^31": mask(partial(png, size=(2**31 - 1, 2**31 - 1))),
    "a text": mask(lambda path: path.write_text("mask")),
    "empty": mask(lambda path: path.touch()),
    "a folder": mask(lambda path: path.mkdir()),
    "a pipe": mask(lambda path: os.mkfifo(path)),
    "a gif": mask(gif_named),
    "an animation": mask(
        lambda path: Image.new("L", (24, 16)).save(path, save_all=True, append_images=[Image.new("L", (24, 16), 9)])
    ),
    "of ten thousand names": lambda photos: (
        (photos / "masks").mkdir(),
        [(photos / "masks" / f"{n}.png").touch() for n in range(10_000)],
    ),
    "in a circle": lambda photos: ((photos / "masks").mkdir(), (photos / "masks" / "a").symlink_to(".")),
    "stated above": lambda photos: patched(
        photos / "transforms.json", b'"file_path"', b'"mask_path": "../../secret.png", "file_path"'
    ),
}
TIMES = {
    name: json.dumps({"r_2.png": value})
    for name, value in {
        "0": 0,
        "below 0": -1,
        "1e308": 1e308,
        "1e-320": 1e-320,
        "text": "soon",
        "fraction": "1/0",
        "fractions": "1/1/1",
        "list": [1],
        "true": True,
        "none": None,
        "huge": 10**400,
    }.items()
} | {
    "nan": '{"r_2.png": NaN}',
    "twice": '{"r_2.png": 1, "r_2.png": 2}',
    "deep": "[" * 100_000,
    "no table": "[1, 2]",
    "entries": '[{"file": {}, "exposure_time": 1}]',
    "text alone": '"x"',
    "empty": "",
    "utf-16": "\ufeff{}",
    "above": '{"../../secret.png": 1}',
    "name of 100 KB": json.dumps({"n" * 100_000: 1}),
    "null in a name": '{"a\\u0000b": 1}',
    "a surrogate": '{"\\ud800": 1}',
    "a million": json.dumps({str(n): 1 for n in range(300_000)}),
}


@pytest.mark.parametrize("name", MASKS)
def test_masks_that_were_made(space, name):
    MASKS[name](space / "photos")
    tried(space, SHORT.replace(" -q", ""))


@pytest.mark.parametrize("name", TIMES)
def test_times_that_were_made(space, name):
    (space / "photos" / "exposures.json").write_text(TIMES[name], errors="surrogatepass")
    tried(space, SHORT.replace(" -q", ""))


POSE = {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "position": [0, 0, -3]}
INRIA = {"id": 0, "img_name": "a", "width": 24, "height": 16, "fx": 20, "fy": 20} | POSE
CHAN = "1 0 0 3 0 0 0 45\n"
CAMERAS = {
    "view of 0.chan": CHAN.replace("45", "0"),
    "view of nan.chan": CHAN.replace("45", "nan"),
    "frame of 1e300.chan": CHAN.replace("1 0", "1e300 0"),
    "far.chan": CHAN.replace("3 0", "1e300 0"),
    "few.chan": "1 2 3\n",
    "text.chan": "a b c\n",
    "many.chan": CHAN * 5000,
    "zeros.chan": "\0" * 500,
    "name above.json": json.dumps([INRIA | {"img_name": "../../x"}]),
    "name of markup.json": json.dumps([INRIA | {"img_name": MARKUP}]),
    "name of a device.json": json.dumps([INRIA | {"img_name": "/dev/null"}]),
    "two of a name.json": json.dumps([INRIA, INRIA]),
    "size of 2^31.json": json.dumps([INRIA | {"width": 2**31}]),
    "size of text.json": json.dumps([INRIA | {"width": "x" * 9999}]),
    "mirrored.json": json.dumps([INRIA | {"rotation": [[-1, 0, 0], [0, 1, 0], [0, 0, 1]]}]),
    "focal 1e-300.json": json.dumps([INRIA | {"fx": 1e-300}]),
    "none.json": "[]",
    "list of lists.json": "[[]]",
    "path.json": json.dumps({"camera_path": [{"camera_to_world": [1] * 15}], "render_width": 8, "render_height": 8}),
    "path of many.json": json.dumps({"camera_path": [{}] * 100_000, "render_width": 8, "render_height": 8}),
    "field of view.json": json.dumps(
        {
            "camera_path": [{"camera_to_world": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 3, 0, 0, 0, 1], "fov": 1e9}],
            "render_width": 8,
            "render_height": 8,
        }
    ),
    "reference.usda": '#usda 1.0\ndef Camera "a" (references = @/etc/passwd@) {}\n',
    "frames of 10^9.usda": "#usda 1.0\n(startTimeCode = 0 endTimeCode = 1000000000)\n"
    'def Camera "a" { float focalLength.timeSamples = {0: 20, 1: 30} }\n',
    "lens of 0.usda": '#usda 1.0\ndef Camera "a" { float focalLength = 0 }\n',
    "meters of 0.usda": '#usda 1.0\n(metersPerUnit = 0)\ndef Camera "a" {}\n',
    "no camera.usda": "#usda 1.0\n",
}


@pytest.mark.parametrize("name", CAMERAS)
def test_cameras_that_were_made(space, name):
    file = f"own{Path(name).suffix}"
    (space / file).write_text(CAMERAS[name])
    if file.endswith(".usda"):
        pytest.importorskip("pxr")
    line = f"render run --out seen --cameras {file} --size 24x16 --device cpu"
    ended = tried(space, line if "many" not in name else line.replace("render", "render", 1) + " --camera nobody")
    assert "root:" not in ended.err


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
    """Of a user's files those that are named, or belong to what is named; the folder above is a user's."""
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
