"""What the pages say, held: examples run, command lines parse, links lead somewhere, versions agree."""

import dataclasses
import inspect
import os
import re
import runpy
import shlex
import shutil
import subprocess
import tomllib
import typing
from pathlib import Path

import pytest
import tyro
from packaging.requirements import Requirement

import sehdr_warp
from sehdr_warp import cli
from sehdr_warp.training import commands
from sehdr_warp.training.config import Config
from sehdr_warp.training.config_files import preset_names

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def blocks(page, language):
    """Code blocks of a page, without their fences."""
    return re.findall(rf"^```{language}\n(.*?)^```$", (ROOT / page).read_text(), re.DOTALL | re.MULTILINE)


def run_block(code, folder):
    """Runs code as a file, since Warp reads the source of its kernels; returns its variables."""
    file = folder / "example.py"
    file.write_text(code)
    return runpy.run_path(str(file))


def command_lines():
    """Every sehdr-warp command line in a shell block of a page."""
    for page in PAGES:
        for block in blocks(page.relative_to(ROOT), "(?:sh)?"):
            for line in block.replace("\\\n", " ").splitlines():
                line = line.strip().removeprefix("$ ").partition("  #")[0]
                if line.startswith("sehdr-warp ") and "[" not in line:
                    yield pytest.param(line, id=f"{page.name}: {line}")


def test_rasterize_in_a_training_loop(tmp_path):
    found = run_block(blocks("docs/splatting.md", "python")[0], tmp_path)
    losses, grows = found["losses"], found["grows"]
    assert losses[-1] < 0.5 * losses[0]
    assert 0 < int(grows.sum()) < len(grows)
    _, depth, rendering = found["render"](found["scene"].test_views[0].camera)
    assert 1.0 < (depth[rendering.alpha > 0.9] / rendering.alpha[rendering.alpha > 0.9]).median() < 20.0, "metres"


def test_another_kernel_in_the_same_graph(tmp_path):
    import torch

    found = run_block(blocks("docs/splatting.md", "python")[1], tmp_path)
    assert abs(found["density"].item() - 0.35) < 0.005
    inputs = [found["radiance"][:50], found["means"][:50].norm(dim=1), torch.tensor([0.2])]
    ours, plain = ([tensor.clone().requires_grad_() for tensor in inputs] for _ in range(2))
    upstream = torch.randn(50, 3, generator=torch.Generator().manual_seed(1))
    found["attenuate"](*ours).backward(upstream)
    radiance, distance, density = plain
    ((-density * distance).exp()[:, None] * radiance).backward(upstream)
    for a, b in zip(ours, plain):
        torch.testing.assert_close(a.grad, b.grad, rtol=1e-4, atol=1e-5)


def test_the_python_quick_start_runs(tmp_path, monkeypatch):
    (code,) = blocks("README.md", "python")
    short = code.replace('"photos"', '"embedded", max_size=48').replace('load_config("fast"', 'load_config("demo"')
    assert short != code and "overrides" not in code
    short = short.replace('load_config("demo"', 'load_config("demo", {"schedule.iterations": 20, "seed": 1}')
    monkeypatch.chdir(tmp_path)
    found = run_block(short, tmp_path)
    assert found["run"].iterations == 20
    assert sorted((tmp_path / "views" / "brackets").iterdir()) and list((tmp_path / "views" / "hdr").glob("*.exr"))


def parse(line):
    arguments = shlex.split(line)[1:]
    tyro.cli(cli.Command, args=arguments, config=(tyro.conf.FlagCreatePairsOff, tyro.conf.OmitArgPrefixes))


@pytest.mark.parametrize("line", list(command_lines()))
def test_documented_command_lines_parse(line):
    parse(line)


def flags_of(kind):
    """Flags of a command and of all below it."""
    for part in typing.get_args(kind):
        yield from flags_of(part)
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        for field in dataclasses.fields(kind):
            yield "--" + field.name.replace("_", "-")
            yield from flags_of(field.type)


def fields_of(config, prefix=""):
    """Dotted names of all choices of a training."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        nested = dataclasses.is_dataclass(value)
        yield from fields_of(value, f"{prefix}{field.name}.") if nested else [prefix + field.name]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_flags_and_fields_on_the_pages_exist(page):
    text = page.read_text()
    others = {"--version", "--help", "--debug", "--index-url", "--clock-control"}  # the last two of pip and Nsight
    assert set(re.findall(r"(?<![\w-])(--[a-z][a-z-]*)", text)) <= {*flags_of(cli.Command), *others}
    fields = set(fields_of(Config()))
    parts = "|".join({field.split(".")[0] for field in fields if "." in field})
    named = set(re.findall(rf"`((?:{parts})\.[a-z_]+)", text)) - {"plan.json", "model.response"}  # a file, a module
    assert named <= fields


def test_the_help_names_every_preset():
    (doc,) = re.findall(r'preset: str \| None = None\n    """(.*?)"""', inspect.getsource(commands.Train), re.DOTALL)
    assert {name for name in preset_names() if re.search(rf"(?<![\w-]){name}(?![\w-])", doc)} == set(preset_names())


def test_the_pages_hold_command_lines():
    assert {line.values[0].split()[1] for line in command_lines()} >= {"train", "render", "eval", "export", "report"}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r'(?:src|href)="([^"]+)"', text):
        path, _, anchor = target.partition("#")
        if path.startswith(("http://", "https://")):
            continue
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{page.name} points at {target}"
        if anchor:
            titles = re.findall(r"^#+ (.+)$", file.read_text(), re.MULTILINE)
            assert anchor in {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}, target


def test_the_index_lists_every_page():
    index = (ROOT / "docs" / "README.md").read_text()
    for page in (ROOT / "docs").glob("*.md"):
        assert page.name == "README.md" or f"]({page.name})" in index, page.name


def test_pictures_are_small():
    """Pictures make most of a clone, and every changed one stays in it: 200 kB a picture, 700 kB in all."""
    sizes = {path.name: path.stat().st_size for path in (ROOT / "docs" / "images").iterdir()}
    assert max(sizes.values()) <= 200_000, sizes
    assert sum(sizes.values()) <= 700_000, sizes


def test_changelog_and_citation_state_the_version():
    versions = re.findall(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert versions[0] == "Unreleased" and versions[1:2] in ([], [sehdr_warp.__version__])
    assert f"\nversion: {sehdr_warp.__version__}\n" in (ROOT / "CITATION.cff").read_text()


def test_constraints_pin_what_the_package_needs():
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = dict(line.split("==") for line in lines if line and not line.startswith("#"))
    for need in map(Requirement, sum(PROJECT["optional-dependencies"].values(), PROJECT["dependencies"])):
        name = need.name.lower().replace("_", "-")
        assert name == PROJECT["name"] or (name in pins and need.specifier.contains(pins[name])), (
            f"{need} against {pins.get(name)}"
        )


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not here")
def test_make_calls_documented_commands(tmp_path):
    recipe = {
        goal: subprocess.run(
            ["make", "-n", "--no-print-directory", goal, f"VENV={tmp_path}/venv"],
            cwd=ROOT,
            env={name: value for name, value in os.environ.items() if "MAKE" not in name},
            capture_output=True,
            text=True,
            check=True,
        ).stdout.splitlines()
        for goal in ("demo", "test")
    }
    commands = [line for line in recipe["demo"] if line.startswith(f"{tmp_path}/venv/bin/sehdr-warp ")]
    assert [line.split()[1] for line in commands] == ["train", "eval", "render", "report"]
    for line in commands:
        parse(line)
    assert recipe["test"][-1].startswith(f"{tmp_path}/venv/bin/python -m pytest")
    assert (ROOT / ".ci" / "run").stat().st_mode & 0o111
