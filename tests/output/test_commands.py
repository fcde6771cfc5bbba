"""Commands that render: refusals before work, old names, and what they print."""

import pytest

from sehdr_warp.cli import parse_command
from sehdr_warp.errors import InputError, SehdrError, UsageError
from sehdr_warp.output.cameras.selection import select_cameras
from sehdr_warp.output.commands import (
    EnvironmentMap,
    FilmOptions,
    Render,
    ViewFileOptions,
    run_environment_map,
    run_render,
)
from sehdr_warp.output.film import write_film

from .helpers import smooth_run


def test_a_film_says_how_long_it_is(tmp_path, monkeypatch, capsys, caplog):
    run = smooth_run()[0]
    monkeypatch.setattr("sehdr_warp.output.commands.open_scene", lambda *_: run)
    run_render(Render(run=tmp_path, video=tmp_path / "a.mkv", cameras="orbit", count=12))
    assert capsys.readouterr().out == f"{tmp_path / 'a.mkv'}: 12 frames, 0.5 s\n"
    assert not caplog.records  # Nor has the library a word about options of other containers.
    run.cameras = run.cameras[2:4]
    run_render(Render(run=tmp_path, video=tmp_path / "b.mp4"))
    assert capsys.readouterr().out == f"{tmp_path / 'b.mp4'}: 1 frame, 0.0417 s\n"
    assert "'test' is one camera, so one frame; --cameras orbit is a path" in caplog.text
    run_render(Render(run=tmp_path, video=tmp_path / "c.mp4", camera=run.cameras[0].name))
    assert f"'{run.cameras[0].name}' is one camera" in caplog.text
    caplog.clear()
    run_render(Render(run=tmp_path, video=tmp_path / "still.mp4", cameras="orbit", count=1))
    assert not caplog.records, "one frame was asked for"
    for name, ramp, expected in (("d.mp4", "-1", (-1, -1)), ("e.mp4", "-4:4", (-4, 4))):
        options = FilmOptions(ev_ramp=ramp, fps=8)
        run_render(Render(run=tmp_path, video=tmp_path / name, cameras="interpolate", count=3, film=options))
        path = [camera for _, camera in select_cameras(run, "interpolate", count=3)]
        again = write_film(run, tmp_path / f"again_{name}", path, fps=8, ev_ramp=expected)
        assert again.read_bytes() == (tmp_path / name).read_bytes()


def test_words_that_people_type_find_what_they_mean(tmp_path):
    with pytest.raises(UsageError, match="no command resume: sehdr-warp train --resume --out RUN"):
        parse_command(["resume", str(tmp_path)])
    with pytest.raises(SehdrError, match="cameras 'orbt' are neither .*, did you mean orbit"):
        run_render(Render(run=tmp_path, out=tmp_path / "out", cameras="orbt", count=1))


def test_old_flags_name_the_new_ones(tmp_path):
    old = ("render", "--passes", "--aovs"), ("render", "--by", "--group-by"), ("envmap", "--fill", "--inpaint")
    for command, flag, new in old:
        with pytest.raises(UsageError, match=f"{flag} is gone: the option is {new}"):
            parse_command([command, str(tmp_path), "--out", "x", flag, "1"])
    with pytest.raises(UsageError, match="no command panorama: the command is sehdr-warp envmap"):
        parse_command(["panorama", str(tmp_path)])


def test_values_that_cannot_be_are_refused_before_a_scene_is_opened(tmp_path):
    options = {"run": tmp_path / "run", "out": tmp_path / "out"}
    with pytest.raises(SehdrError, match="did you mean depth"):
        run_render(Render(**options, pictures=ViewFileOptions(aovs="depht")))
    with pytest.raises(SehdrError, match="such as 1920x1080"):
        run_render(Render(**options, size="64"))
    with pytest.raises(SehdrError, match="choose a suffix"):
        run_environment_map(EnvironmentMap(run=tmp_path / "run", out=tmp_path / "map.png"))


def test_options_that_nothing_uses_and_ramps_that_cannot_be_are_refused(tmp_path):
    options = {"run": tmp_path, "out": tmp_path}
    still, ramp = Render(**options, film=FilmOptions(fps=25)), Render(**options, film=FilmOptions(ev_ramp="1:2"))
    photos = Render(**options, cameras=str(tmp_path), film=FilmOptions(fps=25))  # A COLMAP model's folder
    for args in (Render(run=tmp_path), still, ramp, photos):
        with pytest.raises(UsageError, match="--video"):
            run_render(args)

    alone = {"run": tmp_path, "video": tmp_path / "new.mp4"}
    with pytest.raises(UsageError, match="--evs, --ldr-brackets: set for pictures, which only --out writes"):
        run_render(Render(**alone, pictures=ViewFileOptions(evs="-4,4", ldr_brackets="jpeg")))
    with pytest.raises(UsageError, match="--count 240: set for an orbit or interpolation"):
        run_render(Render(**alone, count=240))
    for bad in ("", "a:b", "1:2:3", "99:0", "nan:1"):
        with pytest.raises(InputError, match="--ev-ramp"):
            run_render(Render(**alone, film=FilmOptions(ev_ramp=bad)))
