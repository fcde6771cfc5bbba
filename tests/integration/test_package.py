"""The package as installed: public names, version, data, and how fast it is there."""

import ast
import inspect
import json
import re
import subprocess
import sys
import tomllib
from dataclasses import fields, is_dataclass
from importlib import resources
from pathlib import Path
from types import SimpleNamespace

import pytest

import sehdr_warp

ROOT = Path(__file__).resolve().parents[2]


def test_stub_and_lazy_names_agree():
    """The stub, which editors read, names each public object where the package loads it from."""
    stub = ast.parse((ROOT / "sehdr_warp" / "__init__.pyi").read_text())
    homes = {alias.name: node.module for node in stub.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    (declared,) = (node.value for node in stub.body if isinstance(node, ast.Assign) and node.targets[0].id == "__all__")
    assert homes == sehdr_warp._HOME_OF
    assert sorted(ast.literal_eval(declared)) == sehdr_warp.__all__ == sorted(homes)


@pytest.mark.parametrize("name", sehdr_warp.__all__)
def test_public_names_load_and_are_documented(name):
    assert getattr(sehdr_warp, name).__doc__
    assert name in dir(sehdr_warp)


@pytest.mark.parametrize("name", sehdr_warp.__all__)
def test_docstrings_name_every_argument_and_field_in_googles_form(name):
    """The site of the pages would otherwise show their descriptions as plain text."""
    public_object = getattr(sehdr_warp, name)
    if inspect.isclass(public_object):
        section, names = (
            "Attributes",
            [each.name for each in fields(public_object)] if is_dataclass(public_object) else [],
        )
    else:
        section, names = "Args", list(inspect.signature(public_object).parameters)
    match = re.search(rf"^{section}:\n((?: {{4}}.*\n)+)", inspect.getdoc(public_object) + "\n", re.MULTILINE)
    assert not names or {*re.findall(r"^ {4}(\w+): ", match[1], re.MULTILINE)} == {*names}


@pytest.mark.parametrize("name", sehdr_warp.__all__)
def test_a_path_in_place_of_a_run_or_scene_names_what_reads_it(name):
    function = getattr(sehdr_warp, name)
    parameters = {} if inspect.isclass(function) else inspect.signature(function).parameters
    needed = {each.name for each in parameters.values() if each.default is each.empty and each.kind <= 1}
    loaders = {"run": "run", "runs": "run", "scene": "scene", "truth": "scene"}
    both = SimpleNamespace(train_views=(), render=None, train_seconds=0.0)  # A run and a scene as far as is looked at
    for parameter in loaders.keys() & parameters.keys():
        with pytest.raises(TypeError, match=rf"'a/path' is a path.*load_{loaders[parameter]}\(\)"):
            function(**{name: both if name in loaders else None for name in needed} | {parameter: "a/path"})


def test_type_checkers_see_every_public_name():
    from sehdr_warp import rasterizer
    from sehdr_warp.compat import gsplat

    text = (ROOT / "tests" / "public_types.py").read_text()
    names = {*sehdr_warp.__all__, *rasterizer.__all__, *gsplat.__all__}
    assert not {name for name in names if not re.search(rf"\b{name}\b", text)}


def test_kernels_presets_and_types_are_inside_the_package():
    assert (resources.files("sehdr_warp.configs") / "default.toml").is_file()
    assert resources.files("sehdr_warp.kernels").joinpath("tiles.py").is_file()
    assert resources.files("sehdr_warp").joinpath("py.typed").is_file()


def test_every_subpackage_is_listed_for_installation():
    setup = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    folders = {path.parent for path in (ROOT / "sehdr_warp").rglob("__init__.py")}
    names = {".".join(path.relative_to(ROOT).parts) for path in folders} | {"sehdr_warp.kernels", "sehdr_warp.configs"}
    assert names == set(setup["packages"])


def test_import_loads_nothing_but_the_standard_library():
    """Only then is it quick, on any machine."""
    code = "import sys; before = set(sys.modules); import sehdr_warp; print(*sorted(set(sys.modules) - before))"
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    loaded = {name.partition(".")[0] for name in output.split()}
    assert loaded <= sys.stdlib_module_names | {"sehdr_warp"}, "import it where it is used, as cli.py does"
    assert len(output.split()) < 30


def test_pins_with_advisories_are_listed(tmp_path):
    """Versions from the first with the hole to before the first without; another package's do not count."""
    folder = tmp_path / "vulns" / "pillow"
    folder.mkdir(parents=True)
    for name, fixed in (("open", "999"), ("mended", "1.0")):
        events = [{"introduced": "0"}, {"fixed": fixed}]
        affected = {"package": {"name": "Pillow"}, "ranges": [{"type": "ECOSYSTEM", "events": events}]}
        text = json.dumps({"id": name, "modified": "2026-01-02T00:00:00Z", "affected": [affected]})
        (folder / f"{name}.yaml").write_text(text)
    completed = subprocess.run(
        [sys.executable, ROOT / ".ci" / "audit.py", tmp_path], capture_output=True, text=True, check=False
    )
    assert completed.returncode == 1 and completed.stdout.startswith("pillow==") and "open" in completed.stdout
    assert completed.stdout.endswith("2 advisories about them, the newest of 2026-01-02: 1 holes\n")


def test_pins_are_compared_with_ranges_of_safety_db(tmp_path):
    (tmp_path / "data").mkdir()
    listed = {"$meta": {"timestamp": 1775023247}, "Pillow": ["<1.0", ">=9,<10000"], "numpy": ["<1.22"], "other": [">0"]}
    (tmp_path / "data" / "insecure.json").write_text(json.dumps(listed))
    audit = [sys.executable, ROOT / ".ci" / "audit.py", tmp_path]
    completed = subprocess.run(audit, capture_output=True, text=True, check=False)
    assert completed.returncode == 1 and re.match(r"pillow==\S+: >=9,<10000\n", completed.stdout)
    assert "numpy==" not in completed.stdout and completed.stdout.endswith(
        "ranges about them, of 2026-04-01: 1 holes\n"
    )
