"""The command line: what scripts may rely on."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from sehdr_warp import __version__, cli
from sehdr_warp.response import response_names
from sehdr_warp.runs.config_files import config_fields, load_config, preset_names
from sehdr_warp.runs.config_flags import flag_of
from sehdr_warp.training.commands import next_commands

from .refusals import call


@pytest.fixture
def run(embedded_run):
    return embedded_run


@pytest.mark.parametrize("command", [["responses"], ["train", "--help"], ["--help"], ["presets"]])
def test_output_that_nobody_reads_ends_quietly(command):
    process = subprocess.Popen(
        [sys.executable, "-m", "sehdr_warp", *command], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    process.stdout.close()
    assert process.stderr.read() == b"" and process.wait() == 141
    process.stderr.close()


def test_version_and_help(capsys, monkeypatch):
    assert call("--version") == 0
    assert capsys.readouterr().out == f"sehdr-warp {__version__}\n"
    monkeypatch.setenv("COLUMNS", "80")
    for words in ([], ["--help"], ["-h"]):
        assert call(*words) == 0
        text = capsys.readouterr().out
        for group in cli.COMMANDS.values():
            assert all(f"\n  {name} " in text for name in group)
        assert len(text.splitlines()) <= 48 and all(len(line) <= 80 for line in text.splitlines())


def test_every_field_of_the_config_is_a_flag_with_help(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    assert call("train", "--help-all") == 0
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    for path, item in config_fields():
        assert f"{flag_of(path)} " in text
        assert path == "seed" or " ".join(item.description.split())[:40] in text


def test_help_is_a_word_too(capsys):
    assert call("help") == 0
    assert capsys.readouterr().out.startswith("usage: sehdr-warp COMMAND")
    assert call("help", "export") == 0
    assert "sehdr-warp export" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("train prak --out runs/x", "prak: not found; did you mean park?"),
        ("train elsewhere --out runs/x", "elsewhere: not found; give a folder of photos, or 'embedded'"),
        ("train broken --out runs/x", "broken: is a link to gone, which is not there; correct the link"),
        ("render runs/caslte --out views", "runs/caslte: no such file or folder; did you mean runs/castle?"),
        ("render runs/castle --out x --colorspace srgb", "color space 'srgb' is an encoding"),
        ("envmap runs/castle --out x.exr --at 0,0", "point '0,0' is neither x,y,z"),
        ("view prk", "prk: no such file or folder; did you mean park?"),
        ("train --resume --out runs/y", "runs/y: holds no run to resume; give SCENE, a folder of photos, to begin one"),
    ],
)
def test_what_needs_no_scene_is_refused_before_one_is_opened(line, message, tmp_path, monkeypatch, capsys):
    for name in ("park", "runs/castle"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "broken").symlink_to("gone")
    monkeypatch.chdir(tmp_path)
    assert call(*line.split()) == 1
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("line", ["train gone --out x", "render gone --out x --colorspace rec708"])
def test_a_missing_folder_or_wrong_color_space_is_named_without_loading_what_takes_long(line, tmp_path):
    code = "import sys\nfrom sehdr_warp.cli import main\ntry: main(sys.argv[1:])\n"
    code += "finally: print({'torch', 'scipy'} & {*sys.modules})"
    words = [sys.executable, "-c", code, *line.split()]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and done.stdout == "set()\n", done.stderr


@pytest.mark.parametrize("name", [name for group in cli.COMMANDS.values() for name in group])
def test_every_command_explains_itself(name, capsys):
    assert call(name, "--help") == 0
    text = capsys.readouterr().out
    assert f"sehdr-warp {name}" in text and "None" not in text


HEAVY = ("torch", "warp", "scipy", "matplotlib", "colour", "pycolmap", "OpenEXR")
"""Modules that take from a tenth of a second to seconds to import."""


@pytest.mark.parametrize(
    "words, most", [("train --help", 800), ("--help", 200), ("completion bash", 800), ("responses", 700)]
)
def test_help_is_quick_and_needs_no_torch(words, most):
    """Check what is imported, because seconds depend on the machine: it takes some 0.7, 0.1, 1.3 and 0.4."""
    code = f"import sys; from sehdr_warp import cli\ntry: cli.main({words.split()})\n"
    code += f"except SystemExit: print(len(sys.modules), *({{*{HEAVY}}} & {{*sys.modules}}))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    count, *heavy = out.splitlines()[-1].split()
    assert not heavy and int(count) < most


@pytest.mark.parametrize("line", ["report run --out", "eval pictures --truth embedded --json"])
def test_what_cannot_be_written_is_said_before_the_work(line, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    assert call(*line.split(), "file/out") == 1
    assert ": file: is a file, not a folder; choose another place\n" in capsys.readouterr().err


@pytest.mark.parametrize(
    "line,message",
    [
        ("trian", "no command trian, did you mean train?"),
        ("fly", "no command fly; sehdr-warp --help"),
        ("--out x", "no command --out"),
        ("train", "train needs SCENE"),
        ("train --out y", "train needs SCENE"),
        ("--versoin", "no command --versoin, did you mean --version?"),
        ("train x y --out z", "y: unexpected argument"),
        ("train x --out", "--out needs a value"),
        ("eval --run x", "eval takes RUN|PICTURES without --run"),
        ("eval --pictures x", "eval takes RUN|PICTURES without --pictures"),
        ("train --data x --out y", "train takes SCENE without --data"),
        ("train --scene x --out y", "train takes SCENE without --scene"),
        ("view --runs x", "view takes RUN without --runs"),
        ("train x --max-steps 9", "train has no --max-steps, did you mean --iterations?"),
        ("train x --output_dir y", "train has no --output-dir, did you mean --out?"),
        ("convert x --out y", "convert takes OUT without --out"),
        ("train x --otu y", "train has no --otu, did you mean --out?"),
        ("train x --los.clipping false", "did you mean --loss.clipping?"),
        ("train x --clipping=false", "did you mean --loss.clipping?"),
        ("train x --out y --seed one", "--seed one: not a whole number"),
        ("train x --out y --loss.clipped-lift 3", "--loss.clipped-lift is gone: it gained nothing"),
        ("train embedded --out y --resume --overwrite", "leave one out"),
        ("render x", "render needs --out, a folder"),
        ("render x --out y --pixel byte", "--pixel byte: not one of 'float', 'half'"),
        ("bench step", "no command bench: it left the installed program; in a checkout, run python -m benchmarks"),
        ("orbit runs/x", "no command orbit: sehdr-warp render RUN --cameras orbit --video orbit.mp4 writes a film"),
        ("share runs/x", "no command share: sehdr-warp export RUN --out scene.html writes a page to share"),
        ("brackets runs/x", "no command brackets: sehdr-warp render RUN --out DIR --evs=-4,-2,0,2,4 writes brackets"),
        ("score x --truth y", "no command score: the command is sehdr-warp eval FOLDER --truth SET"),
        ("eval x --max-size 9", "--max-size needs --truth"),
        ("eval x --truth y --data z", "--data belongs to runs"),
        ("completion tsch", "shell tsch: not one of 'bash', 'fish', 'tcsh', 'zsh'"),
    ],
)
def test_wrong_usage_is_one_line_with_the_nearest_right_word(line, message, capsys):
    assert call(*line.split()) == 2
    error = capsys.readouterr().err
    assert error.startswith("sehdr-warp: ") and message in error
    assert error.count("\n") == 1


def test_existing_run_is_refused_and_resume_continues(run, capsys):
    arguments = ("train", "embedded", "--out", run, "--device", "cpu")
    assert call(*arguments) == 1
    error = capsys.readouterr().err
    assert "--resume or --overwrite" in error and str(run) in error
    # The scene and its size are the run's.
    assert call("train", "--resume", "--out", run, "--device", "cpu", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["iteration"] == 30 and result["finished"] and result["metrics"][-1]["iteration"] == 30
    assert call("train", "--resume", "--out", run, "--device", "cpu", "--seed", "4") == 1
    assert "seed = 3, but 4" in capsys.readouterr().err
    assert call("train", "--resume", "--out", run, "--device", "cpu", "--max-size", "40") == 1
    assert "cameras differ" in capsys.readouterr().err


def test_train_with_a_run_in_place_of_photos_suggests_resume(run, tmp_path, capsys):
    for words in (("--resume",), ("--out", tmp_path / "other", "--iterations", "60")):
        assert call("train", run, *words) == 2
        steps = " --iterations 60" if "60" in words else ""
        assert (
            f"is a run, not photos; sehdr-warp train --resume --out {run}{steps} continues it"
            in capsys.readouterr().err
        )
    for word, hint in (("demo", "train embedded"), ("continue", "train --resume"), ("resume", "train --resume")):
        assert call(word, run) == 2
        assert hint in capsys.readouterr().err


@pytest.mark.parametrize("words", [("photos", "--out", "run"), ("embedded", "--out", "photos/run")])
def test_a_folder_without_rights_is_named_itself(tmp_path, words):
    """The error must not blame a file that a run would have there. Root reads all unless it gives up that right."""
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos").chmod(0)
    if os.access(tmp_path / "photos", os.R_OK) and shutil.which("setpriv") is None:
        pytest.skip("setpriv, to run without root's rights, is not installed")
    drop = ["setpriv", "--bounding-set=-dac_override,-dac_read_search"] if os.geteuid() == 0 else []
    command = [*drop, sys.executable, "-m", "sehdr_warp", "train", *words]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120)
    (tmp_path / "photos").chmod(0o700)
    place = {"photos": tmp_path / "photos", "embedded": "photos/run"}[words[0]]
    assert done.returncode == 1
    assert re.search(rf"^sehdr-warp: {place}: cannot be \w+ \(Permission denied\); check", done.stderr, re.MULTILINE)


def test_a_training_ends_by_saying_what_to_type_next(run, capsys):
    assert call("train", "--resume", "--out", run, "--device", "cpu") == 0
    message = capsys.readouterr()
    assert "all 30 iterations are done: nothing is left to train" in message.err
    lines = message.out.splitlines()
    assert lines[0].startswith(f"{run}: 30 iterations, ")
    assert re.search(r", held-out photos [\d.]+ dB, HDR [\d.]+ dB \(mu-law\), [\d.]+ s on cpu", lines[0])
    assert len(lines) >= 4 and all(
        f"sehdr-warp {word} {run}" in "".join(lines) for word in ("view", "render", "lights", "report", "export")
    )


def test_commands_to_type_next_stand_a_folder_with_spaces():
    run = Path("runs/my castle")
    summary = {"metrics": [], "iteration": 30, "gaussians": 5, "train_seconds": 1.0, "device": "cpu"}
    typed = [line.split(":", 1)[1] for line in next_commands(run, summary).splitlines()[1:]]
    for command in "; ".join(typed).split(";"):
        words = shlex.split(command)
        assert words[0] == "sehdr-warp" and words[2] == str(run)
    assert "--cameras train --evs" in next_commands(run, summary)  # Without held-out views render has none by default.


def test_fields_named_on_the_command_line_override_the_preset_and_stay(capsys):
    line = "train embedded --plan-only --json --max-size 40 --iterations 5000 --response srgb"
    assert call(*line.split(), "--loss.ssim_weight=0.3") == 0
    plan = json.loads(capsys.readouterr().out)
    fields = {path: value for decision in plan["decisions"] for path, value in decision["fields"].items()}
    assert "schedule.iterations" not in fields and plan["kept"]["schedule.iterations"] == 5000


@pytest.mark.parametrize(
    "arguments,words",
    [
        ("train nowhere --out r", "nowhere"),
        ("train embedded --out r --preset defualt", "did you mean default?"),
        ("train embedded --out r --iterations 0", "--iterations: schedule.iterations = 0"),
        ("train embedded --out r --loss.ssim-weight 3", "--loss.ssim-weight: loss.ssim_weight = 3"),
        ("train embedded --out r --loss.clipping maybe", "--loss.clipping: loss.clipping = 'maybe'"),
        ("train embedded --out r --loss.linear-weight 1", "--loss.linear-weight: loss.linear_weight = 1"),
        ("train embedded --out r --response kodak", "kodak"),
        ("train embedded --out r --response hdr-nerv", "did you mean hdr-nerf?"),
        ("train embedded:rom --out r", "did you mean room?"),
        ("train embedded --out r --device cuda:77", "cuda:77"),
        ("train embedded --out r --device mps", "device mps: is neither"),
        ("config defualt", "did you mean default?"),
        ("render nowhere --out r", "nowhere"),
        ("compare nowhere --plot chart.pdf", "chart.pdf: the chart is a PNG file; name it chart.png"),
        ("eval nowhere", "nowhere"),
    ],
)
def test_errors_are_one_line_and_status_1(arguments, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert call(*arguments.split()) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and error.startswith("sehdr-warp: ") and words in error
    assert "default.toml" not in error
    assert list(tmp_path.iterdir()) == []


def test_what_there_is_to_choose_from_can_be_asked_for(capsys):
    for command, least in (("presets", preset_names()), ("responses", response_names()), ("scenes", ["embedded:room"])):
        assert call(command, "--json") == 0
        assert set(least) <= set(json.loads(capsys.readouterr().out))
        assert call(command) == 0
        text = capsys.readouterr().out
        assert all(name in text for name in least) and all(len(line) <= 115 for line in text.splitlines())


def test_config_prints_what_train_takes(run, tmp_path, capsys):
    assert call("config", "paper", "--diff") == 0
    (tmp_path / "own.toml").write_text(capsys.readouterr().out)
    assert load_config(tmp_path / "own.toml") == load_config("paper")
    assert call("config", run) == 0
    text = capsys.readouterr().out
    assert "iterations = 30  # default: 30000" in text
    assert all(f"\n{path.rpartition('.')[2]} = " in f"\n{text}" for path, _ in config_fields())
    assert call("config", run, "--json") == 0
    assert json.loads(capsys.readouterr().out) == json.loads((run / "config.json").read_text())


def test_debug_shows_where_an_error_comes_from(tmp_path, capsys):
    assert call("eval", tmp_path / "nowhere", "--debug") == 1
    assert "Traceback" in capsys.readouterr().err


def test_defects_are_not_hidden(monkeypatch):
    def broken(_):
        raise ZeroDivisionError

    monkeypatch.setattr("sehdr_warp.evaluation.commands.run_evaluate", broken)
    with pytest.raises(ZeroDivisionError):
        cli.main(["eval", "x"])


def test_interrupt_is_130(monkeypatch, capsys):
    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setattr("sehdr_warp.evaluation.commands.run_evaluate", interrupted)
    assert call("eval", "x") == 130
    assert capsys.readouterr().err == "sehdr-warp: interrupted\n"


def test_an_interrupt_while_modules_load_is_130(tmp_path):
    (tmp_path / "difflib.py").write_text("raise KeyboardInterrupt")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    command = [sys.executable, "-m", "sehdr_warp", "presets"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert (ended.returncode, ended.stderr) == (130, "sehdr-warp: interrupted\n")
