"""Films that cannot be written, and OCIO configs and LUTs that were made to do harm."""

import os
import zipfile

import pytest

from sehdr_warp.own_files import LIST
from tests.ocio_config import ocio_config

from .harness import call, files_in
from .hostile import tried

pytestmark = pytest.mark.trial


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


def lut_config(file, search_path="."):
    """The text of a config whose view is a LUT."""
    return ocio_config(f"!<FileTransform> {{src: {file}}}", search_path)


VIEW_LINE = "render run --out seen --ocio own.ocio --view V --device cpu"


@pytest.mark.parametrize("name", LUT_FILES)
def test_luts_that_were_made(space, name):
    pytest.importorskip("PyOpenColorIO")
    file, text = LUT_FILES[name]
    (space / file).write_text(text)
    (space / "own.ocio").write_text(lut_config(file))
    ended = tried(space, VIEW_LINE)
    assert "root:" not in ended.err


CONFIGS = {
    "environment in a path": lut_config("$SECRET/a.cube", "$HOME:$PATH:."),
    "up and up": lut_config("etc/passwd", "../../..:/"),
    "url": lut_config("http://127.0.0.1:9/a.cube"),
    "version 99": lut_config("a.cube").replace("version: 2", "version: 99"),
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
                archive.writestr("config.ocio", lut_config("../a.cube" if name == "up" else "a.cube"))
            archive.writestr(
                "../a.cube" if name == "up" else "a.cube", "0 0 0\n" * (60_000_000 if name == "bomb" else 1)
            )
    tried(space, VIEW_LINE.replace("own.ocio", "own.ocioz"), codes=(1,))


FILMS = {
    **dict.fromkeys(
        ("film.mp4", "film.mov", "film.MP4", "tour-12:30.mp4", "a b.mp4", "ü%03d.mp4", "-y.mp4", "film.mkv"), 0),
    **dict.fromkeys(
        ("film.mpd", "film.m3u8", "film.ism", "film.gif", "film%d.png", "film.sdp", "film.ffmeta", "film", "film.mp4.",
         ".mp4", "film.tee", "pipe:1", "http://127.0.0.1:9/film.mp4", "rtmp://127.0.0.1/film.mp4",
         "file:///tmp/film.mp4", "concat:a|b.mp4/x", "/dev/null", "/dev/stdout", "/proc/film.mp4"), 1),
}  # fmt: skip


@pytest.mark.parametrize("name", FILMS)
def test_films(space, name):
    pytest.importorskip("av")
    (space / "d").mkdir()
    for own in ("init-stream0.m4s", "chunk-stream0-00001.m4s", "film0.ts", "film.mp4.txt"):
        (space / "d" / own).write_text("the user's own")
    before = files_in(space)
    place = name if "/" in name or name.startswith("pipe:") else f"d/{name}"
    ended = call("render", "run", "--video", place, "--cameras", "all", "--device", "cpu", folder=space)
    created = {path: files_in(space)[path] for path in files_in(space) if path not in before and LIST not in path}
    assert ended.code == FILMS[name], ended.err
    assert list(created) == ([f"d/{name}"] if ended.code == 0 else [])
    assert {path: text for path, text in files_in(space).items() if path in before} == before
