"""Clips, masks, exposure times and cameras that were made to do harm."""

import json
import os
import struct
from functools import partial
from pathlib import Path

import pytest
from PIL import Image

from tests.make_scenes import pattern
from tests.scene.clips import pan, write_clip

from .hostile import MARKUP, SHORT, gif_named, patched, png, tried

pytestmark = pytest.mark.trial


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
