"""Films read back by FFmpeg: frames, tags, and the light in their codes."""

import ctypes
import os
import subprocess
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.output.commands import FilmOptions, Render, run_render
from sehdr_warp.output.film import encode, write_film
from sehdr_warp.output.images.display import display_gain
from sehdr_warp.output.render_views import shared_tone_map
from sehdr_warp.own_files import LIST

from .helpers import AnalyticRun, smooth_run

av = pytest.importorskip("av")


def frames(path):
    """Frames as [H, W, 3] in [0, 1], and the codec."""
    with av.open(str(path)) as container:
        context = container.streams.video[0].codec_context
        pictures = [frame.to_ndarray(format="rgb48le") / 65535 for frame in container.decode(video=0)]
        return np.stack(pictures), context


@pytest.mark.parametrize(
    "transfer, codec, tags",
    [
        ("sdr", "h264", (1, 1, 1)),
        ("hlg", "hevc", (9, 18, 9)),
        ("hdr10", "hevc", (9, 16, 9)),
        ("logc3", "prores", (2, 2, 1)),
    ],
)
def test_a_film_holds_the_light_and_says_how(tmp_path, transfer, codec, tags):
    run, cameras = smooth_run()
    decoded, context = frames(write_film(run, tmp_path / "f.mov", cameras, transfer=transfer, fps=24000 / 1001))
    assert decoded.shape == (5, 64, 96, 3) and context.name == codec
    assert (context.color_primaries, context.color_trc, context.colorspace) == tags
    gain, tone_map = run.base_time * display_gain(run.response), shared_tone_map(run, cameras)
    for picture, camera in zip(decoded, cameras, strict=True):
        light = run.render(camera.resized(96, 64)).hdr.numpy()
        expected = tone_map(light) if transfer == "sdr" else encode(light * gain, transfer)
        assert np.abs(picture - expected).mean() < 0.02
    if transfer == "hdr10":  # Clipped where SDR clips it is not: codes of white, and of the light above.
        assert encode(np.ones(3), "hdr10") == pytest.approx(0.581, abs=2e-3) and decoded.max() > 0.65


def test_hdr10_states_the_brightest_pixel_and_no_mean_that_it_does_not_know(tmp_path):
    run, cameras = smooth_run()
    write_film(run, tmp_path / "f.mp4", cameras[:1], transfer="hdr10", ev_ramp=(6, 6))
    with av.open(str(tmp_path / "f.mp4")) as container:
        stated = {each.type.name: bytes(each) for each in next(container.decode(video=0)).side_data}
    assert np.frombuffer(stated["CONTENT_LIGHT_LEVEL"], "<u4").tolist() == [1000, 0]


@pytest.mark.parametrize("name, transfer", [("f.mp4", "sdr"), ("f.mov", "logc3")])
def test_a_film_states_the_shape_of_its_pixels_and_rates_of_television(tmp_path, name, transfer):
    """Anamorphic cameras have pixels twice as wide as high; 23.976 stands for 24000 frames in 1001 seconds."""
    run, cameras = smooth_run()
    wide = [replace(camera, fx=camera.fy / 2) for camera in cameras]
    write_film(run, tmp_path / name, wide, transfer=transfer, fps=23.976)
    square = [replace(camera, fx=1.001 * camera.fy) for camera in cameras]
    write_film(run, tmp_path / f"square-{name}", square, transfer=transfer, fps=12.5)
    for file, aspect, rate in ((name, 2, Fraction(24000, 1001)), (f"square-{name}", None, Fraction(25, 2))):
        with av.open(str(tmp_path / file)) as container:
            stream = container.streams.video[0]
            assert (stream.sample_aspect_ratio, stream.average_rate) == (aspect, rate)


def test_cameras_of_other_sizes_and_shapes_keep_the_proportions_of_what_they_show(tmp_path, monkeypatch, caplog):
    run, cameras = smooth_run()
    first, render, calls = cameras[0].resized(96, 64), run.render, []
    smaller, upright = first.resized(72, 48), replace(first, width=40, height=60, fx=30.0, fy=30.0, cx=20.0, cy=30.0)
    monkeypatch.setattr(run, "render", lambda camera: calls.append(camera) or render(camera))
    film = {"transfer": "logc3", "overwrite": True}
    write_film(run, tmp_path / "f.mov", [first, smaller], **film)
    assert calls[0].to_dict() == calls[1].to_dict() == first.to_dict() and not caplog.messages
    write_film(run, tmp_path / "f.mov", [first, smaller, upright], **film)
    problem = "1 of 3 cameras are not of the shape of the first, 96 x 64: their frames show more or less at the sides"
    assert caplog.messages == [f"{tmp_path / 'f.mov'}: {problem}"]
    wider = {"width": 96, "height": 64, "fx": 32.0, "fy": 32.0, "cx": 48.0, "cy": 32.0}
    assert calls[-1].to_dict() == upright.to_dict() | wider and len(frames(tmp_path / "f.mov")[0]) == 3
    panorama = replace(first, width=64, height=32, projection="equirectangular")
    with pytest.raises(SehdrError, match="size 96x64 would distort a panorama"):
        write_film(run, tmp_path / "g.mov", [first, panorama], **film)


def test_references_of_the_curves():
    # ITU-R BT.2408: diffuse white of 203 cd/m2 is 58 % PQ and 75 % HLG; 1000 cd/m2 is 75 % PQ and 100 % HLG.
    assert encode(np.full(3, 1.0), "hlg") == pytest.approx(0.75, abs=3e-3)
    assert encode(np.full(3, 1e3), "hlg") == pytest.approx(1, abs=1e-3)
    assert encode(np.full(3, 1e3), "hdr10") == pytest.approx(0.7518, abs=1e-3)
    # ARRI (2017), Sony (2016) and S-2016-001: 18 % grey at 400, 420 and 423 of 1023.
    for transfer, code in (("logc3", 400), ("slog3", 420), ("acescct", 423)):
        np.testing.assert_allclose(encode(np.full(3, 0.18), transfer) * 1023, code, atol=0.6)
        assert encode(np.full(3, 30.0), transfer).max() < 1 and (encode(np.zeros(3), transfer) >= 0).all()
    assert all(encode(np.zeros(3), transfer) == pytest.approx(0, abs=1e-5) for transfer in ("hlg", "hdr10"))


def test_a_ramp_runs_through_the_stops(tmp_path):
    run, cameras = smooth_run()
    still = [cameras[0]] * 5
    decoded, _ = frames(write_film(run, tmp_path / "f.mp4", still, ev_ramp=(-4, 0)))
    light = run.render(cameras[0].resized(96, 64)).hdr.numpy() * run.base_time * display_gain(run.response)
    for stops, picture in zip(range(-4, 1), decoded, strict=True):
        assert picture.mean() == pytest.approx(encode(light * 2.0**stops, "sdr").mean(), abs=0.01)


@pytest.mark.parametrize(
    "name", ["f.mpd", "f.m3u8", "f.gif", "f.webm", "f.png", "f", "f.mp4.txt", "f%d.jpg", "f.ffconcat", "f.sdp", "f.tee"]
)
def test_formats_of_several_files_and_none_are_refused_before_the_work(tmp_path, name):
    run = AnalyticRun()
    (tmp_path / "init-stream0.m4s").write_text("the user's own")
    with pytest.raises(InputError, match="is not the suffix of a film; use one of .mp4"):
        write_film(run, tmp_path / name, [run.cameras[0].camera])
    assert run.rendered == 0 and [each.name for each in tmp_path.iterdir()] == ["init-stream0.m4s"]


@pytest.mark.parametrize(
    "name", ["http://127.0.0.1:9/f.mp4", "rtmp://host/f.mp4", "file:///tmp/f.mp4", "concat:/f.mp4"]
)
def test_urls_are_refused(name):
    for out in (name, Path(name)):
        with pytest.raises(InputError, match="is a URL; name a file"):
            write_film(AnalyticRun(), out, [AnalyticRun().cameras[0].camera])


@pytest.mark.parametrize("name", ["tour-12:30.mp4", "data:x.mkv", "crypto:f.mov", "-y.mp4", "a|b.mkv", "f%03d.avi"])
def test_names_that_ffmpeg_takes_for_more_are_names(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    write_film(AnalyticRun(), name, [entry.camera.resized(1, 1) for entry in AnalyticRun().cameras[:2]])
    assert [each.name for each in tmp_path.iterdir() if each.name != LIST] == [name]
    assert len(frames(f"file:{name}")[0]) == 2


@pytest.mark.parametrize("fps", [1e300, 1e4, 1e-3, 0.0, -24.0, float("nan"), float("inf")])
def test_rates_that_no_film_has_are_refused(tmp_path, fps):
    with pytest.raises(SehdrError, match="frames a second are not between"):
        write_film(AnalyticRun(), tmp_path / "f.mp4", [AnalyticRun().cameras[0].camera], fps=fps)
    for films in ({}, {"video": tmp_path / "f.mp4"}):  # Before the scene, which is not there, is opened.
        with pytest.raises(SehdrError, match="frames a second are not between"):
            run_render(Render(run=tmp_path, out=tmp_path / "o", cameras="orbit", film=FilmOptions(fps=fps), **films))


@pytest.mark.parametrize("fps", ["24", None, [24.0]])
def test_a_rate_that_is_no_number_is_named(tmp_path, fps):
    with pytest.raises(TypeError, match="fps is .*, expected a number"):
        write_film(AnalyticRun(), tmp_path / "f.mp4", [AnalyticRun().cameras[0].camera], fps=fps)


@pytest.mark.parametrize("count", [1, 2])
def test_hevc_films_of_one_or_two_frames_need_no_clean_memory(tmp_path, count):
    """Write in a process whose new memory is not zero: x265 takes decoding times of so few frames from it."""
    code = f"""
from tests.output.helpers import AnalyticRun
from sehdr_warp.output.film import write_film
cameras = [entry.camera.resized(96, 64) for entry in AnalyticRun().cameras]
write_film(AnalyticRun(), {str(tmp_path / "f.mkv")!r}, cameras[:{count}], transfer="hdr10")
"""
    environment = {**os.environ, "MALLOC_PERTURB_": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr[-300:]
    assert len(frames(tmp_path / "f.mkv")[0]) == count


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"cameras": []}, "cameras: none; a film has a list of Cameras"),
        ({"cameras": AnalyticRun().cameras[0].camera}, r"cameras: Camera\(32 x 24.*; a film has a list of Cameras"),
        ({"cameras": AnalyticRun().cameras}, "camera is a Entry, expected a Camera"),
        ({"cameras": [("orbit_0", AnalyticRun().cameras[0].camera)]}, "camera is a tuple, expected a Camera"),
        ({"transfer": "hdr"}, "transfer 'hdr' is not one of sdr, hlg, .*, did you mean hdr10?"),
        ({"ev_ramp": (0.0, float("nan"))}, r"ev_ramp \(0.0, nan\) is not two numbers of stops"),
        ({"ev_ramp": (1.0,)}, "is not two numbers of stops"),
        ({"ev_ramp": 1.0}, "ev_ramp 1.0 is not two numbers of stops"),
        ({"cameras": iter(())}, "cameras: <tuple_iterator .*; a film has a list of Cameras"),
    ],
)
def test_what_is_no_film_is_named(tmp_path, changes, message):
    arguments = {"cameras": [AnalyticRun().cameras[0].camera]} | changes
    with pytest.raises((SehdrError, TypeError), match=message):
        write_film(AnalyticRun(), tmp_path / "f.mp4", **arguments)
    assert not list(tmp_path.iterdir())


def test_small_hevc_films_leave_memory_whole(tmp_path):
    """Write in a process whose allocator checks each block when it is freed."""
    checker = "libc_malloc_debug.so.0"
    try:
        ctypes.CDLL(checker)
    except OSError:
        pytest.skip("this C library has no checking allocator")
    code = f"""
from tests.output.helpers import AnalyticRun
from sehdr_warp.output.film import write_film
run = AnalyticRun()
cameras = [entry.camera.resized(34, 24) for entry in run.cameras] * 3
write_film(run, {str(tmp_path / "f.mp4")!r}, cameras, transfer="hlg")
"""
    environment = {**os.environ, "LD_PRELOAD": checker, "MALLOC_CHECK_": "3", "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr[-300:]


def test_refusals(tmp_path, monkeypatch):
    run, cameras = smooth_run()
    (tmp_path / "mine.mp4").write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        write_film(run, tmp_path / "mine.mp4", cameras)
    with pytest.raises(SehdrError, match="cannot be written as a film .* choose .mov"):
        write_film(run, tmp_path / "film.mp4", cameras, transfer="logc3")
    assert [file.name for file in tmp_path.iterdir()] == ["mine.mp4"]
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(SehdrError, match="films need PyAV; run `pip install"):
        write_film(run, tmp_path / "new.mp4", cameras)
