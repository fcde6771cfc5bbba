"""Our files read by npm packages in NODE_PATH: Khronos's glTF validator and SuperSplat's parser."""

import csv
import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from sehdr_warp.splats import read_gaussians, write_gaussians

from .test_splat_files import gaussians

VALIDATE = """
const validator = require('gltf-validator'), file = require('fs').readFileSync(process.argv[1]);
validator.validateBytes(new Uint8Array(file)).then(report => console.log(JSON.stringify(report)));
"""


def package(name):
    """The folder of an npm package; skips where node or it is missing."""
    folders = [Path(folder) / name for folder in os.environ.get("NODE_PATH", "").split(os.pathsep) if folder]
    folder_of_package = next((folder for folder in folders if folder.is_dir()), None)
    if shutil.which("node") is None or folder_of_package is None:
        pytest.skip(f"{name} is not in NODE_PATH")
    return folder_of_package


def node(*words):
    return subprocess.run(["node", *map(str, words)], capture_output=True, text=True, timeout=60, check=True).stdout


@pytest.mark.parametrize("degree", [0, 3])
def test_the_khronos_validator_knows_everything_but_the_extension(tmp_path, degree):
    package("gltf-validator")
    write_gaussians(tmp_path / "a.glb", gaussians(degree=degree, color_model="display"))
    report = json.loads(node("-e", VALIDATE, tmp_path / "a.glb"))
    assert report["info"]["totalVertexCount"] == 50
    messages = report["issues"]["messages"]
    # It is older than the extension, whose attributes it takes for names that are none.
    own = [m for m in messages if "KHR_gaussian_splatting:" in m["pointer"] and m["code"].endswith("INVALID_ATTRIBUTE")]
    assert [m["code"] for m in messages if m not in own] == ["UNSUPPORTED_EXTENSION"]
    assert len(own) == 3 + (degree + 1) ** 2


def test_supersplats_parser_reads_what_was_written(tmp_path):
    tool = package("@playcanvas/splat-transform") / "bin" / "cli.mjs"
    written = gaussians(color_model="display")
    write_gaussians(tmp_path / "a.ply", written)
    node(tool, tmp_path / "a.ply", tmp_path / "a.csv")
    with open(tmp_path / "a.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    for field, names in (
        ("means", "xyz"),
        ("log_scales", [f"scale_{i}" for i in range(3)]),
        ("quaternions", [f"rot_{i}" for i in range(4)]),
    ):
        read = np.array([[float(row[name]) for name in names] for row in rows])
        np.testing.assert_allclose(read, getattr(written, field), atol=1e-6)
    rest = np.array([[float(row[f"f_rest_{i}"]) for i in range(45)] for row in rows]).reshape(-1, 3, 15)
    np.testing.assert_allclose(rest.swapaxes(1, 2), written.harmonics[:, 1:], atol=1e-6)
    # And what it writes is read here.
    node(tool, tmp_path / "a.ply", tmp_path / "b.ply")
    again = read_gaussians(tmp_path / "b.ply")
    np.testing.assert_allclose(again.opacity_logits, written.opacity_logits, atol=1e-6)
    np.testing.assert_allclose(again.harmonics, written.harmonics, atol=1e-6)
