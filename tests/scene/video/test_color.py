"""Colors that a stream states, and light beyond Rec.709."""

from dataclasses import replace

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.response import response_by_name
from sehdr_warp.scene import load_scene
from sehdr_warp.scene.lens import Lens
from sehdr_warp.scene.video.color import VideoColor, codes_in_rec709
from sehdr_warp.scene.video.decode import codes, decode, open_clip

from ..video.clips import still
from .clips import pan, write_clip

pytest.importorskip("av")


@pytest.mark.parametrize("full, tags, metadata, curve, response", [
    (False, (18, 9, 9), {}, "HLG", "colour:ITU-R BT.2100 HLG"),
    (True, (16, 9, 9), {}, "PQ", "colour:ST 2084"),
    (False, (2, 9, 9), {"com.apple.quicktime.make": "Apple"}, "Apple Log Profile", "colour:Apple Log Profile"),
    (True, (2, 9, 9), {"comment": "Apple Log"}, "Apple Log Profile", "colour:Apple Log Profile"),
    (False, (1, 1, 1), {"comment": "S-Log3"}, "S-Log3", "colour:S-Log3"),
    (True, (1, 1, 1), {}, "Rec.709", None),
    (True, (2, 1, 1), {}, "no curve", None),
])  # fmt: skip
def test_ten_bits_and_the_curve_that_a_stream_states(tmp_path, tags, metadata, curve, response, full):
    file, frames = tmp_path / "a.mov", still()
    write_clip(file, frames, tags=tags, metadata=metadata, full=full)
    clip = open_clip(file)
    assert (clip.color.curve, clip.color.response, clip.color.bits) == (curve, response, 10)
    frame_pixels = codes(next(decode(clip))[1], clip.color) / 65535
    inside = np.s_[4:20, 4:-4], np.s_[28:44, 4:12], np.s_[28:44, 20:28]
    for part in inside:
        assert np.abs(frame_pixels[part] - frames[0][part]).max() < 0.01
        assert np.abs(frame_pixels[part] - frames[0][part]).mean() < 1.5 / 1023
    if response is not None:
        light = response_by_name(response).decode(frames[0][10, 4:-4])
        np.testing.assert_allclose(
            response_by_name(response).decode(frame_pixels[10, 4:-4]), light, rtol=0.08, atol=2e-3
        )


@pytest.mark.parametrize("layout, bits, shift", [
    ("yuvj420p", 8, 0), ("yuvj422p", 8, 0), ("yuvj444p", 8, 0), ("nv12", 8, 0), ("yuv411p", 8, 0), ("gray", 8, 0),
    ("yuv420p10le", 10, 0), ("yuv444p10le", 10, 0), ("p010le", 10, 6), ("yuv420p12le", 12, 0),
])  # fmt: skip
def test_greys_of_full_range_keep_their_codes(layout, bits, shift):
    """FFmpeg widens the samples of some layouts so that white is 65535, and shifts those of others."""
    import av

    frame, kind = av.VideoFrame(256, 64, layout), np.dtype("u1" if bits == 8 else "<u2")
    top = 2**bits - 1
    values = np.rint(np.linspace(0, top, 256)).astype(int)
    for number, plane in enumerate(frame.planes):
        samples = np.full((plane.height, plane.line_size // kind.itemsize), 1 << (bits - 1 + shift), kind)
        if number == 0:
            samples[:, :256] = values << shift
        plane.update(samples.tobytes())
    frame_pixels = codes(frame, VideoColor("Rec.709", None, None, (0.2126, 0.0722), True, bits))[32]
    expected = values if bits == 8 else np.rint(values / top * 65535)
    assert np.abs(frame_pixels - expected[:, None]).max() <= (0 if bits == 8 else 1)


@pytest.mark.parametrize(
    "matrix, name", [(8, "YCgCo"), (10, "constant-luminance BT.2020"), (14, "ICtCp"), (15, "IPT-C2")]
)
def test_samples_that_are_no_luma_are_named(tmp_path, matrix, name):
    """PyAV issue 2149: such frames would come out in other colors, or not at all."""
    write_clip(tmp_path / "a.mp4", still(), tags=(16, 9, matrix))
    with pytest.raises(InputError, match=f"its frames are stored as {name}, which is not read; convert the clip"):
        open_clip(tmp_path / "a.mp4")


def test_dolby_vision_without_another_layer_is_named(tmp_path):
    write_clip(tmp_path / "a.mp4", still(), tags=(2, 2, 2))
    data = (tmp_path / "a.mp4").read_bytes()
    (tmp_path / "a.mp4").write_bytes(data.replace(b"hev1", b"dvhe"))
    with pytest.raises(InputError, match="is Dolby Vision of profile 5, whose colors only Dolby's decoder knows"):
        open_clip(tmp_path / "a.mp4")
    write_clip(tmp_path / "b.mp4", still(), tags=(18, 9, 9))
    data = (tmp_path / "b.mp4").read_bytes()
    (tmp_path / "b.mp4").write_bytes(data.replace(b"hev1", b"dvhe"))
    assert open_clip(tmp_path / "b.mp4").color.curve == "HLG"


@pytest.mark.parametrize("saturated", [False, True])
def test_a_clip_within_rec709_is_converted_and_another_keeps_its_primaries(tmp_path, monkeypatch, saturated):
    def place(dataset, _):
        lens = Lens("SIMPLE_PINHOLE", 128, 96, (100.0, 64.0, 48.0), dataset.folder)
        return replace(dataset, records=tuple(replace(record, lens=lens) for record in dataset.records)), []

    monkeypatch.setattr("sehdr_warp.scene.load.place_photos", place)
    response = response_by_name("colour:ITU-R BT.2100 HLG")
    to_rec709 = np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]])
    lights, frames = [], []
    for pixels in pan(30):
        light = 0.6 * (0.7 * pixels.mean(2, keepdims=True) + 0.3 * pixels)
        wide = light @ np.linalg.inv(to_rec709).T
        if saturated:
            wide[:20, :30] = [0.02, 0.4, 0.02]
        frames.append(response.encode(wide))
        lights.append(wide @ to_rec709.T)
    write_clip(tmp_path / "a.mov", frames, tags=(18, 9, 9), lossless=True)
    scene = load_scene(tmp_path / "a.mov", cache=tmp_path / "cache", max_size=64)
    assert (scene.color_matrix is None) is not saturated and scene.light_known
    assert any("colors: the clip's lie within Rec.709" in note for note in scene.notes) is not saturated
    for view in scene.views[::6]:
        decoded = response.decode(view.codes / 65535) @ (np.eye(3) if scene.color_matrix is None else to_rec709).T
        expected = lights[int(view.name.removeprefix("frame_"))].reshape(48, 2, 64, 2, 3).mean((1, 3))
        np.testing.assert_allclose(decoded, expected, rtol=0.03, atol=2e-3)
        assert (decoded.min() < -0.1) is np.bool_(saturated)
    by_another = load_scene(tmp_path / "a.mov", cache=tmp_path / "cache", max_size=64, response="camera")
    assert by_another.color_matrix is not None and not by_another.light_known


def test_clipped_channels_stay_clipped_in_rec709():
    response, matrix = response_by_name("linear"), np.array([[1.5, -0.4, -0.1], [-0.1, 1.1, 0.0], [0.0, -0.1, 1.1]])
    codes = np.array([[[65535, 65535, 65535], [65535, 20000, 20000], [30000, 30000, 30000]]], np.uint16)
    converted = codes_in_rec709(codes, response, matrix)
    assert (converted[0, 0] == 65535).all() and converted[0, 1, 0] == 65535
    assert (converted[0, 1, 1:] < 40000).all() and np.abs(converted[0, 2].astype(int) - 30000).max() <= 1
