"""docs/architecture.md, held: which package may import which, and how large a file may be."""

import ast
import re
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "sehdr_warp"

# What each package may import of the others: training -> runs -> model -> response -> rasterizer -> kernels, and below
# them all what any package may use.
ANY = {
    "errors", "quiet", "arguments", "files", "own_files", "console", "sandbox", "parallel", "limits", "caches",
    "progress", "subsets", "json_values",
}  # fmt: skip
ALLOWED = {
    **{name: set() for name in ("kernels", "errors", "quiet", "limits", "progress", "caches", "json_values")},
    "sandbox": {"errors"},
    "parallel": {"limits"},
    "files": {"errors", "own_files", "json_values"},
    "own_files": {"errors"},
    "arguments": {"errors"},
    "splats": ANY,
    "rasterizer": ANY | {"kernels"},
    "compat": {"rasterizer"},
    "response": ANY | {"rasterizer"},
    "scene": ANY | {"response", "splats"},
    "prior": ANY,
    "model": ANY | {"scene", "response", "rasterizer", "splats"},
    "output": ANY
    | {"runs", "scene", "response", "splats", "kernels.constants"}
    | {"model.exposure", "model.baking", "model.lights", "model.color_models", "model.visibility"},
    "viewer": ANY | {"runs", "scene", "output", "splats", "model.lights"},
    "evaluation": ANY | {"runs", "scene", "rasterizer.losses.ssim", "output.images.ldr_files", "output.report.charts"},
    "runs": ANY | {"scene", "response", "prior", "model", "splats", "output.notebook"},
    "training": ANY
    | {"runs", "scene", "response", "model", "rasterizer", "splats"}
    | {"evaluation.metrics", "evaluation.protocols"},
    "blocks": ANY | {"training", "runs", "scene", "response", "model", "splats", "evaluation.metrics", "process"},
    "synth": ANY | {"scene", "response", "output.images.exr", "output.images.ldr_files", "model.exposure"},
    "check": ANY | {"kernels.constants", "rasterizer", "runs.device"},
}
# Packages that only some packages may import.
ONLY_IN = {"torch": ALLOWED.keys() - ANY - {"kernels", "splats", "scene", "synth"}, "warp": {"kernels", "rasterizer"}}
LARGEST_FILE = 400
NOT_FIRST = {"as", "how", "of", "that", "those", "what", "when", "where", "whether", "which", "who"}
"""Words that no docstring starts with."""


def package_of(path):
    """Name of a file's package; commands.py is a part of the command line, which may call any package."""
    if path.name == "commands.py":
        return "commands"
    return "kernels" if path.parent == ROOT / "kernels" else path.relative_to(PACKAGE).parts[0].removesuffix(".py")


PATHS = sorted([*PACKAGE.rglob("*.py"), *(ROOT / "kernels").glob("*.py")])
TREES = {path: ast.parse(path.read_text()) for path in PATHS}


def nodes(kind):
    """Each node of a kind in the sources, with `file:line`."""
    for path, tree in TREES.items():
        for node in ast.walk(tree):
            if isinstance(node, kind):
                yield node, f"{path.relative_to(ROOT)}:{node.lineno}"


def imports(path, *, for_types=True):
    """Dotted names that a file imports; those of the package start with `sehdr_warp.`. for_types: TYPE_CHECKING too."""
    parts = (
        ("sehdr_warp", *path.relative_to(PACKAGE).parts)
        if PACKAGE in path.parents
        else ("sehdr_warp", "kernels", path.name)
    )
    body = TREES[path].body
    if not for_types:
        body = [node for node in body if not (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test))]
    for node in ast.walk(ast.Module(body)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = [*parts[: len(parts) - node.level]] if node.level else []
            stem = ".".join([*base, *([node.module] if node.module else [])])
            yield from (f"{stem}.{alias.name}" for alias in node.names)


def test_imports_go_down_the_line():
    wrong = []
    for path in PATHS:
        if (package := package_of(path)) not in ALLOWED:
            continue
        for name in imports(path):
            top, *rest = name.split(".")
            if top == "sehdr_warp" and rest and rest[0] not in (package, "__version__"):
                if not any(".".join(rest).startswith(allowed) for allowed in ALLOWED[package]):
                    wrong.append((str(path), name))
            elif top in ONLY_IN and package not in ONLY_IN[top]:
                wrong.append((str(path), name))
    assert not wrong, f"these files may not import these modules: {wrong}"


def test_docstrings_start_with_a_verb_or_a_noun():
    documented = nodes(ast.FunctionDef | ast.ClassDef)
    wrong = [where for node, where in documented if (ast.get_docstring(node) or "-").split()[0].lower() in NOT_FIRST]
    assert not wrong, f"start with a verb, as Return or Write: {wrong}"


def test_no_call_unpacks_two_tuples():
    """Nobody can tell which argument is which; name one tuple of arguments, or write them one by one."""
    calls = nodes(ast.Call)
    wrong = [where for call, where in calls if sum(isinstance(each, ast.Starred) for each in call.args) > 1]
    assert not wrong, f"pass the arguments one by one, or as one list: {wrong}"


def test_the_page_names_files_and_functions_that_exist():
    section = (ROOT / "docs" / "architecture.md").read_text().partition("## Follow a command")[2].partition("## ")[0]
    named = {}
    for file, _, functions in re.findall(r"`([\w/]+\.py)`( \(((?:`\w[\w.]*`(?:, |: )?)+))?", section):
        named.setdefault(file, set()).update(re.findall(r"`([\w.]+)`", functions))
    assert len(named) > 15
    for file, functions in named.items():
        path = ROOT / file if file.startswith("kernels/") else PACKAGE / file
        assert path.is_file(), f"docs/architecture.md names {file}, which does not exist"
        names = {node.name for node in ast.walk(TREES[path]) if isinstance(node, ast.FunctionDef)}
        wrong = {function.rpartition(".")[2] for function in functions if not function.endswith(".py")} - names
        assert not wrong, f"docs/architecture.md names functions that {file} lacks: {wrong}"


def test_warp_internals_are_used_in_warp_launch_alone():
    """A minor release of Warp may change them; then one folder needs a look."""
    internals = {"adj", "hooks", "_shape_", "_wp_scalar_type_", "__ctype__"}
    launch = PACKAGE / "rasterizer" / "warp_launch"
    for path in PATHS:
        if package_of(path) not in ("rasterizer", "kernels") or path.parent == launch:
            continue
        tree = [*ast.walk(TREES[path])]
        names = {node.attr for node in tree if isinstance(node, ast.Attribute)}
        names |= {node.value for node in tree if isinstance(node, ast.Constant) and isinstance(node.value, str)}
        assert not names & internals, f"{path.name}: use internals of Warp in rasterizer/warp_launch"
        assert not any(name.startswith(("warp._", "warp.context", "warp.codegen")) for name in imports(path)), path


def test_no_files_import_each_other():
    """Nor by way of others, nor within functions; what a type checker alone imports is not run."""
    files = {}
    for path in PATHS:
        parts = path.relative_to(PACKAGE if PACKAGE in path.parents else ROOT).with_suffix("").parts
        files[".".join(["sehdr_warp", *parts]).removesuffix(".__init__")] = path

    def file_of(name):
        return name if name in files else file_of(name.rpartition(".")[0]) if name else None

    graph = {
        name: {file_of(imported) for imported in imports(path, for_types=False)} - {None, name}
        for name, path in files.items()
    }
    TopologicalSorter(graph).prepare()  # Else CycleError names them.


def test_kernels_import_warp_only():
    allowed = {"warp", "sehdr_warp.kernels"} | set(sys.stdlib_module_names)
    for path in sorted((ROOT / "kernels").glob("*.py")):
        for name in imports(path):
            assert any(name == top or name.startswith(top + ".") for top in allowed), f"{path.name} imports {name}"


def test_no_file_is_too_long_to_read_at_once():
    assert [str(path) for path in PATHS if len(path.read_text().splitlines()) > LARGEST_FILE] == []


def test_every_file_says_what_it_is():
    assert [str(path) for path, tree in TREES.items() if not ast.get_docstring(tree)] == []


@pytest.mark.parametrize("module", ["sehdr_warp", "sehdr_warp.cli", "sehdr_warp.scene", "sehdr_warp.runs.config_files"])
def test_light_modules_leave_torch_and_warp_alone(module):
    code = f"import sys, {module}; print([name for name in ('torch', 'warp') if name in sys.modules])"
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"
    )
