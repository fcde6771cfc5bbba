"""Places of tests: in folders named after the packages, named after the modules that they test."""

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
