"""Clips that were made to do harm."""

import struct
from functools import partial
from pathlib import Path

import pytest
from PIL import Image

from tests.make_scenes import pattern
from tests.scene.video.clips import pan, write_clip

from .hostile import MARKUP, tried

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
