"""Places of tests: in folders named after the packages, named after the modules that they test."""

from fnmatch import fnmatch
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
ROOT = TESTS.parent
NOT_PACKAGES = {"integration", "fuzz", "trial", "scenes_generator"}
TOPICS = {
    "compat/gsplat": {"against_gsplat", "simple_trainer"},
    "kernels": {"cuda_compilation"},
    "output": {"blender"},
    "rasterizer": {"culling", "properties"},
    "training": {
        "bad_input", "confidence", "deterministic", "fields", "nodes", "out_of_memory", "reserved_rows", "resume",
        "units",
    },
}  # fmt: skip
"""Tests of what several modules of a package do together. Prefer a module's name."""
ELSEWHERE = {
    "with their kernels, in tests/kernels": [
        "rasterizer/absolute_gradient", "rasterizer/blending*", "rasterizer/losses/*", "rasterizer/ops/*",
    ],
    "with kernels that compute the same, or what launches them": [
        "kernels/blend_cuda_backward", "kernels/caller_memory", "kernels/plane_sweep_cpu", "kernels/shared_ranges",
        "kernels/ssim_cuda",
    ],
    "with what calls them, in other tests of their folder": [
        "blocks/seams", "check/*", "prior/network", "rasterizer/caller_lists",
        "rasterizer/cuda_graphs/render_graph", "rasterizer/warp_launch/loading", "rasterizer/warp_launch/packing",
        "scene/exposure/matched_points",
    ],
    "on the command line": ["evaluation/commands", "runs/commands", "scene/commands", "training/commands"],
    "as what tests compare with": ["rasterizer/reference"],
    "through what uses them: a few lines, names or types": [
        "caches", "kernels/constants", "model/renders", "rasterizer/render_options", "response/names", "runs/field",
        "scene/images/xmp", "training/training_progress",
    ],
}  # fmt: skip
"""Modules without a test of their name, by how they are tested."""


def home(package: str) -> Path:
    """Return the folder of a package's modules."""
    return ROOT / package if package in ("kernels", "benchmarks", "priors") else ROOT / "sehdr_warp" / package


def test_a_test_has_the_name_of_its_module():
    for test in sorted(TESTS.rglob("test_*.py")):
        *package, _ = test.relative_to(TESTS).parts
        name = test.stem.removeprefix("test_")
        if (package and package[0] in NOT_PACKAGES) or name in TOPICS.get("/".join(package), ()):
            continue
        folder = home("/".join(package))
        remedy = f"name it after a module, move it to tests/integration, or add {name!r} to TOPICS here"
        assert (folder / f"{name}.py").is_file() or (folder / name).is_dir(), f"{folder} has no {name}.py: {remedy}"


def test_a_module_has_a_test_of_its_name_or_is_listed_here():
    folders = (ROOT, "kernels"), (ROOT / "sehdr_warp", "")
    files = {path.relative_to(root) for root, folder in folders for path in (root / folder).rglob("[!_]*.py")}
    modules = {
        file.with_suffix("").as_posix() for file in files if not (TESTS / file.parent / f"test_{file.name}").is_file()
    }
    patterns = [pattern for group in ELSEWHERE.values() for pattern in group]
    missing = [module for module in sorted(modules) if not any(fnmatch(module, pattern) for pattern in patterns)]
    remedy = "write tests/PACKAGE/test_MODULE.py, or add it to ELSEWHERE here, under where it is tested"
    assert not missing, f"{missing} have no test of their name: {remedy}"
    needless = [pattern for pattern in patterns if not any(fnmatch(module, pattern) for module in modules)]
    assert not needless, f"{needless} are gone or have a test of their name: take them out of ELSEWHERE here"
