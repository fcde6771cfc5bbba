"""Clips that the test encodes: what their streams state, and which of their frames are used."""

import resource
import struct
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.config import Config
from sehdr_warp.scene import Camera, load_scene, look_at
from sehdr_warp.scene.images.ldr_files import read_ldr
from sehdr_warp.scene.video.decode import codes, decode, is_video, open_clip
from sehdr_warp.scene.video.frames import choose_frames, read_video
from sehdr_warp.training.initialization import response_for_training

from ..panorama_room import light, walls
from .clips import pan, still, write_clip

pytest.importorskip("av")


@pytest.mark.parametrize(
    "matrix, turn",
    [
        ((-1, 0, 0, 1), lambda a: a[:, ::-1]),
        ((0, 1, 1, 0), lambda a: a.swapaxes(0, 1)),
        ((0, 1, -1, 0), lambda a: np.rot90(a, -1)),
        ((0, 0, 0, 0), lambda a: a),
    ],
)
def test_frames_are_turned_and_mirrored_as_the_stream_states(tmp_path, matrix, turn):
    """A front camera's display matrix mirrors, and a scene of mirrored frames would be a mirrored scene."""
    file = tmp_path / "a.mp4"
    write_clip(file, still(), rotation=180)
    data = bytearray(file.read_bytes())
    start = data.index(struct.pack(">9i", -1 << 16, 0, 0, 0, -1 << 16, 0, 0, 0, 1 << 30))
    a, b, c, d = (value << 16 for value in matrix)
    data[start : start + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    file.write_bytes(data)
    clip = open_clip(file)
    frame_pixels = codes(next(decode(clip))[1], clip.color) / 65535
    assert frame_pixels.shape[1::-1] == clip.size
    assert np.abs(frame_pixels - turn(still()[0])).mean() < 0.01


@pytest.mark.parametrize("aspect, rotation, size", [("4/3", 0, (171, 96)), ("1/2", 0, (128, 192)),
                                                    ("4/3", 90, (96, 171))])  # fmt: skip
def test_anamorphic_pixels_become_square(tmp_path, aspect, rotation, size):
    write_clip(
        tmp_path / "a.mp4", pan(30), codec="libx264", pixels="yuv420p", aspect=Fraction(aspect), rotation=rotation
    )
    assert open_clip(tmp_path / "a.mp4").size == size
    dataset = read_video(tmp_path / "a.mp4", tmp_path / "cache")
    assert f"its pixels are not square: frames are resampled to {size[0]} x {size[1]} square" in " ".join(dataset.notes)
    assert read_ldr(dataset.records[0].image).pixels.shape == (size[1], size[0], 3)


def test_clips_that_cannot_be_used(tmp_path):
    def refused(match, data=None):
        if data is not None:
            (tmp_path / "a.mp4").write_bytes(data)
        with pytest.raises(InputError, match=match):
            choose_frames(open_clip(tmp_path / "a.mp4"))

    refused(r"cannot be read as video \(cannot be opened", b"\0\0\0\x18ftypisom" + bytes(500))
    write_clip(tmp_path / "a.mp4", [next(iter(pan(1)))] * 30, codec="libx264", pixels="yuv420p")
    refused("its camera hardly moves .* that shows no depth; walk with the camera")
    write_clip(tmp_path / "a.mp4", pan(2), codec="libx264", pixels="yuv420p")
    refused("holds 2 frames")
    write_clip(tmp_path / "a.mp4", pan(4), codec="libx264", pixels="yuv420p", aspect=Fraction(9))
    refused("states pixels 9 times as wide as high; correct its sample aspect ratio")


@pytest.mark.parametrize("text", ["ffconcat version 1.0\nfile other.mp4\n", "#EXTM3U\n#EXTINF:10,\nother.mp4\n"])
def test_a_clip_that_names_other_files_is_refused(tmp_path, text):
    write_clip(tmp_path / "other.mp4", pan(4), codec="libx264", pixels="yuv420p")
    (tmp_path / "clip.mp4").write_text(text)
    with pytest.raises(InputError, match="cannot be opened"):
        open_clip(tmp_path / "clip.mp4")


def test_a_name_with_a_colon_is_a_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_clip(tmp_path / "12:30.mp4", pan(4), codec="libx264", pixels="yuv420p")
    assert open_clip(Path("12:30.mp4")).size == (128, 96)


def test_counts_beyond_the_file_take_no_memory(tmp_path):
    """A table of 50 million samples, for which FFmpeg would take 3 GB."""
    file = tmp_path / "a.mp4"
    write_clip(file, pan(8), codec="libx264", pixels="yuv420p")
    data = bytearray(file.read_bytes())
    sizes, chunks = data.index(b"stsz"), data.index(b"stsc")
    data[sizes + 8 : sizes + 16] = struct.pack(">II", 1, 50_000_000)
    data[chunks + 16 : chunks + 20] = struct.pack(">I", 50_000_000)
    file.write_bytes(data)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match="cannot be read as video"):
        open_clip(file)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200 << 10


def test_a_clip_that_ends_early_gives_what_it_has(tmp_path):
    write_clip(tmp_path / "a.mkv", pan(60), codec="libx264", pixels="yuv420p")
    data = (tmp_path / "a.mkv").read_bytes()
    (tmp_path / "b.mkv").write_bytes(data[: len(data) * 6 // 10])
    choice = choose_frames(open_clip(tmp_path / "b.mkv"))
    assert 20 < choice.total < 60 and choice.movement < 1.5


def test_a_variable_frame_rate(tmp_path):
    times = np.cumsum(np.random.default_rng(0).integers(1, 9, 40)).tolist()
    write_clip(tmp_path / "a.mp4", pan(40), times=times, codec="libx264", pixels="yuv420p")
    choice = choose_frames(open_clip(tmp_path / "a.mp4"))
    assert choice.total == 40 and choice.movement == pytest.approx(39 * 4 / 128, rel=0.05)


def test_an_hlg_clip_of_a_room_becomes_a_scene(tmp_path):
    """The scene has cameras from structure from motion, the encoded light, and Rec.709 by the stream's primaries."""
    pytest.importorskip("pycolmap")
    response, painted, frames = response_by_name("colour:ITU-R BT.2100 HLG"), walls(), []
    for i in range(12):
        camera = Camera(256, 192, 200, 200, 128, 96, look_at((-0.6 + 0.1 * i, -0.5, 0.1), (0.1, 1, 0)))
        frames.append(response.encode(0.5 * light(camera, painted)))
    write_clip(tmp_path / "clip.mov", frames, tags=(18, 9, 9), pixels="yuv420p10le")
    scene = load_scene(tmp_path / "clip.mov", cache=tmp_path / "cache", max_size=128)
    assert scene.format == "video" and scene.name == "clip.mov" and scene.response.name == response.name
    assert response_for_training(scene, Config()) is scene.response, "the stated curve is not guessed again"
    assert any(
        note.startswith("video: the sharpest ") and "of 12 frames" in note and "it states HLG: " in note
        for note in scene.notes
    ), scene.notes
    assert 8 <= len(scene.views) <= 12 and len(scene.points) > 100
    np.testing.assert_allclose(scene.color_matrix.sum(1), 1, atol=1e-3)
    for view in scene.views[::3]:
        number = int(view.name.removeprefix("frame_"))
        expected = response.decode(frames[number]).mean((0, 1))
        frame_pixels = response.decode(view.codes / 65535)
        np.testing.assert_allclose(np.asarray(frame_pixels).mean((0, 1)), expected, rtol=0.05)
    # The camera went along x.
    places = np.stack([view.camera.position for view in scene.views])
    steps = np.diff(places, axis=0)
    along = np.linalg.svd(places - places.mean(0))[2][0]
    assert np.abs(steps @ along).sum() > 20 * np.abs(steps - np.outer(steps @ along, along)).sum(0).max()


@pytest.mark.parametrize("pixels", ["gbrp10le", "gbrp16le", "yuv444p16le"])
def test_clips_without_loss_keep_their_light(tmp_path, pixels):
    """RGB and luma with chroma: the light of an HLG clip of 10 bits is right to its last code."""
    av = pytest.importorskip("av")
    response, rgb = response_by_name("colour:ITU-R BT.2100 HLG"), 0.8 * still()[0]
    if pixels.startswith("gbrp"):
        with av.open(str(tmp_path / "a.mkv"), "w") as container:
            stream = container.add_stream("ffv1", rate=30)
            stream.height, stream.width, stream.pix_fmt = *rgb.shape[:2], pixels
            stored = np.rint(rgb * 65535).astype(np.uint16)
            frame = av.VideoFrame.from_ndarray(stored, format="rgb48le").reformat(format=pixels)
            for packet in [*stream.encode(frame), *stream.encode()]:
                container.mux(packet)
    else:
        write_clip(tmp_path / "a.mkv", [rgb], tags=(18, 9, 9), codec="ffv1", pixels=pixels)
    clip = open_clip(tmp_path / "a.mkv")
    decoded = codes(next(decode(clip))[1], clip.color) / 65535
    assert np.abs(decoded - rgb).max() < (1.1 / 1023 if "10" in pixels else 2 / 65535)
    light = response.decode(decoded) - response.decode(rgb)
    assert np.abs(light).max() < 0.01


@pytest.mark.parametrize("place", [0, 1, 2])
def test_chroma_lies_where_the_stream_states_it(tmp_path, place):
    """Left (0), in the center (1), or top left (2) of its luma samples: a ramp of chroma comes out straight."""
    av = pytest.importorskip("av")
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = container.add_stream("libx265", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p10le"
        stream.options = {"x265-params": f"log-level=none:lossless=1:chromaloc={place}"}
        frame = av.VideoFrame(64, 64, "yuv420p10le")
        frame.pts = 0
        for index, plane in enumerate(frame.planes):
            rows, columns = np.mgrid[: plane.height, : plane.line_size // 2]
            values = np.full(rows.shape, 502) if index == 0 else 400 + 6 * (columns if index == 1 else rows)
            plane.update(values.astype(np.uint16).tobytes())
        for packet in [*stream.encode(frame), *stream.encode()]:
            container.mux(packet)
    clip = open_clip(tmp_path / "a.mkv")
    rgb = codes(next(decode(clip))[1], clip.color) / 65535
    kr, kb = clip.color.matrix
    luma = kr * rgb[..., 0] + (1 - kr - kb) * rgb[..., 1] + kb * rgb[..., 2]
    blue = (rgb[..., 2] - luma) / (2 * (1 - kb)) * 896 + 512
    red = (rgb[..., 0] - luma) / (2 * (1 - kr)) * 896 + 512
    at = np.arange(20, 44)
    np.testing.assert_allclose(blue[30, at], 400 + 3 * (at - (0.5 if place == 1 else 0)), atol=0.6)
    np.testing.assert_allclose(red[at, 30], 400 + 3 * (at - (0 if place == 2 else 0.5)), atol=0.6)


@pytest.mark.parametrize("name, codec", [("a.MPG", "mpeg2video"), ("a.3gp", "libx264")])
def test_clips_of_older_cameras(tmp_path, name, codec):
    write_clip(tmp_path / name.lower(), pan(8), codec=codec, pixels="yuv420p")
    (tmp_path / name.lower()).rename(tmp_path / name)
    assert is_video(tmp_path / name) and sum(1 for _ in decode(open_clip(tmp_path / name))) == 8


def encode(path, streams, **metadata):
    """Write a clip of (codec, pixel format, frames [H, W, 3] uint8) streams at 30 frames a second, with metadata."""
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        opened = []
        for codec, layout, frames in streams:
            stream = container.add_stream(codec, rate=30)
            stream.height, stream.width, stream.pix_fmt = *frames[0].shape[:2], layout
            stream.metadata.update(metadata)
            if codec == "mpeg2video":
                stream.options = {"flags": "+ilme+ildct", "qscale": "2"}
            opened.append((stream, layout, frames))
        for stream, layout, frames in opened:
            for i, pixels in enumerate(frames):
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24").reformat(format=layout)
                frame.pts = i
                for packet in stream.encode(frame):
                    container.mux(packet)
        for stream, _, _ in opened:
            for packet in stream.encode():
                container.mux(packet)
    return path


def bytes_of(count, **options):
    return [np.rint(frame * 255).astype(np.uint8) for frame in pan(count, **options)]


@pytest.mark.parametrize("layout", ["gray10le", "ya8", "yuv410p", "yuva420p", "yuv422p10le", "bgr0"])
def test_every_layout_of_samples(tmp_path, layout, caplog):
    """Grey, a quarter of chroma, half of its height, transparency, RGB."""
    frames = bytes_of(1)
    clip = open_clip(encode(tmp_path / "a.mkv", [("ffv1", layout, frames)]))
    decoded = codes(next(decode(clip))[1], clip.color)
    luma = np.array([0.299, 0.587, 0.114])
    assert decoded.shape == frames[0].shape
    error = decoded / float(np.iinfo(decoded.dtype).max) @ luma - frames[0] / 255 @ luma
    assert np.abs(error).mean() < 0.01
    assert ("its transparency is ignored" in caplog.text) == (layout in ("ya8", "yuva420p"))


@pytest.mark.parametrize("thumbnail_first", [False, True])
def test_a_thumbnail_in_a_stream_of_its_own_is_not_the_clip(tmp_path, thumbnail_first):
    streams = [("libx264", "yuv420p", bytes_of(8)), ("mjpeg", "yuvj420p", [bytes_of(1)[0][::2, ::2]])]
    clip = open_clip(encode(tmp_path / "a.mp4", streams[::-1] if thumbnail_first else streams))
    assert clip.size == (128, 96) and sum(1 for _ in decode(clip)) == 8


def test_interlaced_and_tiny_clips(tmp_path):
    assert open_clip(encode(tmp_path / "a.mpg", [("mpeg2video", "yuv420p", bytes_of(4))])).interlaced
    assert not open_clip(encode(tmp_path / "b.mp4", [("libx264", "yuv420p", bytes_of(4))])).interlaced
    encode(tmp_path / "c.mkv", [("ffv1", "yuv420p", [frame[:2, :4] for frame in bytes_of(4)])])
    with pytest.raises(InputError, match="its frames have 4 x 2 pixels; give 16 and more a side"):
        open_clip(tmp_path / "c.mkv")


def test_clips_of_two_lenses_are_named(tmp_path):
    (tmp_path / "a.insv").write_bytes(b"x")
    with pytest.raises(InputError, match="holds the pictures of two lenses; export it as one equirectangular MP4"):
        load_scene(tmp_path / "a.insv")
    encode(tmp_path / "a.mkv", [("libx264", "yuv420p", bytes_of(2))], stereo_mode="left_right")
    with pytest.raises(InputError, match="frames hold the pictures of two lenses"):
        open_clip(tmp_path / "a.mkv")


def test_frames_of_another_size_are_left_out(tmp_path, caplog):
    """Recordings that were joined."""
    large, small = bytes_of(30), [frame[:64, :96] for frame in bytes_of(10)]
    parts = [encode(tmp_path / f"{i}.mts", [("libx264", "yuv420p", frames)]) for i, frames in enumerate([large, small])]
    (tmp_path / "a.mts").write_bytes(b"".join(part.read_bytes() for part in parts))
    assert choose_frames(open_clip(tmp_path / "a.mts")).total == 30
    assert "frames of another size from frame 30 on are left out" in caplog.text
