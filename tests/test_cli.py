"""The command line: what scripts may rely on."""

import json
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from sehdr_warp import __version__, cli
from sehdr_warp.response import response_by_name
from sehdr_warp.scene.images import read_hdr, read_ldr
from sehdr_warp.training.config import ResponseConfig

from .refusals import call


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A very short training of the embedded scene, made through the command line."""
    out = tmp_path_factory.mktemp("cli") / "run"
    arguments = ["train", "embedded", "--out", str(out), "--preset", "demo", "--iterations", "30", "--max-size", "48"]
    assert call(*arguments, "--response", "hdr-nerf", "--device", "cpu", "--seed", "3") == 0
    return out


def test_output_that_nobody_reads_ends_quietly():
    command = [sys.executable, "-m", "sehdr_warp", "check", "--cases", "needle"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    assert process.stderr.read() == b"" and process.wait() == 141
    process.stderr.close()


def test_version_and_help(capsys):
    assert call("--version") == 0
    assert capsys.readouterr().out == f"sehdr-warp {__version__}\n"
    assert call("--help") == 0
    text = capsys.readouterr().out
    for command in ("train", "render", "eval", "export", "report"):
        assert command in text


@pytest.mark.parametrize(
    "command,flags",
    [
        (
            "train",
            [
                "--out",
                "--preset",
                "--device",
                "--exposure-index",
                "--response",
                "--iterations",
                "--max-size",
                "--seed",
                "--resume",
                "--json",
            ],
        ),
        (
            "render",
            ["--out", "--cameras", "--evs", "--exposures", "--multipart", "--colorspace", "--pixel", "--overwrite"],
        ),
        ("eval", ["--json"]),
    ],
)
def test_documented_flags_exist(command, flags, capsys):
    assert call(command, "--help") == 0
    text = capsys.readouterr().out
    assert [flag for flag in flags if flag not in text] == []


def test_help_is_quick_and_needs_no_torch():
    """Under a second of processor time: how long that takes is a matter of what else runs."""
    call = "try: cli.main(['train', '--help'])\nexcept SystemExit: print('torch' in sys.modules, time.process_time())"
    code = f"import sys, time; from sehdr_warp import cli\n{call}"
    times = []
    for _ in range(3):
        out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
        torch, seconds = out.split()[-2:]
        assert torch == "False"
        times.append(float(seconds))
    assert min(times) < 1.0


def test_module_is_the_command():
    out = subprocess.run(
        [sys.executable, "-m", "sehdr_warp", "--version"], capture_output=True, text=True, check=True
    ).stdout
    assert out == f"sehdr-warp {__version__}\n"


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["train"],
        ["fly"],
        ["train", "x", "--out", "y", "--seed", "one"],
        ["render", "x", "--out", "y", "--pixel", "byte"],
    ],
)
def test_wrong_usage_is_2(arguments, capsys):
    assert call(*arguments) == 2


def test_a_training_needs_a_folder(capsys):
    assert call("train", "embedded") == 1
    assert capsys.readouterr().err.startswith("sehdr-warp: train needs a folder for the run: give --out")


def test_training_leaves_a_run_that_says_how_it_was_made(run):
    config = json.loads((run / "config.json").read_text())
    assert (config["seed"], config["schedule"]["iterations"], config["response"]["name"]) == (3, 30, "hdr-nerf")
    assert json.loads((run / "run.json").read_text())["data"] == {
        "path": "embedded",
        "exposure_index": None,
        "max_size": 48,
    }
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert lines[-1]["iteration"] == 30 and {"seconds", "psnr_ldr", "psnr_mu", "gaussians", "split"} <= lines[-1].keys()


def test_existing_run_is_refused_and_resume_continues(run, capsys):
    arguments = ("train", "embedded", "--out", run, "--max-size", "48", "--device", "cpu")
    assert call(*arguments) == 1
    error = capsys.readouterr().err
    assert "--resume or --overwrite" in error and str(run) in error
    assert call(*arguments, "--resume", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["iteration"] == 30 and result["finished"] and result["metrics"][-1]["iteration"] == 30
    assert call(*arguments, "--resume", "--seed", "4") == 1
    assert "seed = 3, but 4" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments,words",
    [
        (["train", "nowhere", "--out", "r"], "nowhere"),
        (["train", "embedded", "--out", "r", "--preset", "defualt"], "defualt"),
        (["train", "embedded", "--out", "r", "--iterations", "0"], "schedule.iterations = 0"),
        (["train", "embedded", "--out", "r", "--response", "kodak"], "kodak"),
        (["train", "embedded", "--out", "r", "--device", "cuda:77"], "cuda:77"),
        (["render", "nowhere", "--out", "r"], "nowhere"),
        (["eval", "nowhere"], "nowhere"),
    ],
)
def test_errors_are_one_line_and_status_1(arguments, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert call(*arguments) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and error.startswith("sehdr-warp: ") and words in error
    assert list(tmp_path.iterdir()) == []


def test_debug_shows_where_an_error_comes_from(tmp_path, capsys):
    assert call("eval", tmp_path / "nowhere", "--debug") == 1
    assert "Traceback" in capsys.readouterr().err


def test_defects_are_not_hidden(monkeypatch):
    def broken(_):
        raise ZeroDivisionError

    monkeypatch.setitem(cli._COMMANDS, cli.Evaluate, broken)
    with pytest.raises(ZeroDivisionError):
        cli.main(["eval", "x"])


def test_interrupt_is_130(monkeypatch, capsys):
    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setitem(cli._COMMANDS, cli.Evaluate, interrupted)
    assert call("eval", "x") == 130
    assert capsys.readouterr().err == "sehdr-warp: interrupted\n"


def test_render_writes_hdr_previews_and_brackets(run, tmp_path, capsys):
    out = tmp_path / "renders"
    assert call("render", run, "--out", out, "--evs=-2,0,2", "--device", "cpu", "--json") == 0
    files = json.loads(capsys.readouterr().out)["files"]
    assert files and all((tmp_path / name).exists() for name in files)
    views = sorted(path.stem for path in (out / "hdr").glob("*.exr"))
    assert views and views == sorted(path.stem for path in (out / "preview").glob("*.png"))
    for view in views:
        names = sorted(path.name for path in (out / "brackets" / view).iterdir())
        assert names == [f"{view}_b0_ev-2.0.exr", f"{view}_b1_ev+0.0.exr", f"{view}_b2_ev+2.0.exr"]
    manifest = json.loads((out / "brackets.json").read_text())
    assert [view["view"] for view in manifest["views"]] and all(
        (out / exposure["file"]).is_file() for view in manifest["views"] for exposure in view["exposures"]
    )
    assert call("render", run, "--out", out, "--device", "cpu") == 1, "nothing is replaced without --overwrite"


@pytest.mark.parametrize("kind, tolerance", [("png", 0.005), ("png16", 1e-4)])
def test_simulated_photos_merge_back_to_the_rendered_radiance(run, tmp_path, kind, tolerance, capsys):
    """From a trained run to photos and, by Debevec and Malik 1997, Eq. 6, back to its HDR views: RMS error."""
    out = tmp_path / "renders"
    evs = ",".join(str(ev) for ev in range(-8, 9, 2))
    flags = ("--device", "cpu", "--pixel", "float", "--ldr-brackets", kind)
    assert call("render", run, "--out", out, f"--evs={evs}", *flags) == 0
    manifest = json.loads((out / "brackets.json").read_text())
    decode = response_by_name(manifest["response"]).decode
    for view in manifest["views"]:
        total = weights = 0.0
        for exposure in view["exposures"]:
            photo = read_ldr(out / exposure["ldr_file"])
            value = photo.pixels / photo.levels
            weight = np.where((value > 0.02) & (value < 0.98), np.minimum(value, 1 - value), 0)
            total += weight * np.log(np.maximum(decode(value), 1e-12) / exposure["exposure_time"])
            weights += weight
        radiance = read_hdr(out / "hdr" / f"{view['view']}.exr")
        seen = weights > 0
        assert seen[radiance > 1e-3].mean() > 0.99
        error = np.exp(total[seen] / weights[seen]) / radiance[seen] - 1
        assert np.sqrt(np.mean(error**2)) < tolerance


@pytest.mark.parametrize(
    "flags,words",
    [(["--evs=1,x"], "--evs"), (["--evs=0", "--exposures", "1"], "both were"), (["--colorspace", "cmyk"], "cmyk")],
)
def test_render_refuses_what_it_cannot_use(run, tmp_path, flags, words, capsys):
    assert call("render", run, "--out", tmp_path / "r", "--device", "cpu", *flags) == 1
    assert words in capsys.readouterr().err
    assert not (tmp_path / "r").exists()


def test_eval_writes_json_and_prints_a_table(run, tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("SEHDR_LPIPS", raising=False)
    file = tmp_path / "figures.json"
    assert call("eval", run, "--json", file, "--device", "cpu") == 0
    result = json.loads(file.read_text())
    assert result["protocol"]["gt-max"]["psnr_mu"] > 10 and result["ldr"]["psnr"] > 10 and result["train_seconds"] > 0
    assert "gt-max" in capsys.readouterr().out
    assert result["ldr"]["lpips"] is None and "SEHDR_LPIPS" in result["ldr"]["lpips_reason"]
    assert result["protocol"]["gt-max"]["lpips_mu"] is None and "lpips_reason" in result["protocol"]["gt-max"]
    assert call("eval", run, "--json", file, "--device", "cpu") == 1


def test_a_run_is_judged_by_photos_scaled_as_those_it_was_trained_on():
    def curves(options, response):
        return cli._curves_of(SimpleNamespace(config=SimpleNamespace(response=options), response=response))

    srgb = response_by_name("srgb")
    # Chosen after the photos were read, so they were scaled by load_scene's own curve.
    assert curves(ResponseConfig(name="auto"), srgb) == {}
    assert curves(ResponseConfig(name="srgb"), srgb) == {"decode": srgb.decode, "encode": srgb.encode}


@pytest.mark.parametrize("kind", ["hdr", "ldr"])
def test_export_writes_ply(run, tmp_path, kind, capsys):
    file = tmp_path / "scene.ply"
    assert call("export", run, "--out", file, "--kind", kind) == 0
    assert file.read_bytes().startswith(b"ply\n") and str(file) in capsys.readouterr().out


def test_report_writes_pictures(run, tmp_path, capsys):
    assert call("report", run, "--out", tmp_path / "report", "--device", "cpu") == 0
    assert len(list((tmp_path / "report").iterdir())) >= 2


def test_libraries_are_silent_when_python_ends():
    """OpenImageIO lists what Python still held of it, tens of lines."""
    pytest.importorskip("OpenImageIO")
    hold = "import ctypes, sys, OpenImageIO; "
    hold += "ctypes.pythonapi.Py_IncRef(ctypes.py_object(OpenImageIO.TypeDesc('float'))); "
    code = hold + "from sehdr_warp.cli import main; main(['--version'])"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout == f"sehdr-warp {__version__}\n" and ended.stderr == ""
    code = hold + "from sehdr_warp.quiet import silence_exit; silence_exit(); sys.exit('what the program says last')"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ended.stderr == "what the program says last\n"
