"""Gaussians and files of them for tests, and what compares them."""

import json
import os
import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from sehdr_warp.splats import SUFFIXES, GaussianArrays, path_is_lossy

LOSSY_SUFFIXES = [suffix for suffix in SUFFIXES if path_is_lossy(f"a{suffix}")]


def gaussians(count=50, degree=3, color_model="log", seed=0) -> GaussianArrays:
    random = np.random.default_rng(seed)
    harmonics = 0.3 * random.normal(size=(count, (degree + 1) ** 2, 3))
    harmonics[:, 0] -= 2
    shapes = ((count, 3), (count, 3), (count, 4), (count,))
    arrays = (random.normal(size=shape).astype(np.float32) for shape in shapes)
    return GaussianArrays(*arrays, harmonics.astype(np.float32), color_model, 0.5)


def natural(count=600, degree=3, seed=0):
    """Gaussians as trainings make them: small higher harmonics, sizes over two decades."""
    random = np.random.default_rng(seed)
    harmonics = random.normal(0, 0.08, (count, (degree + 1) ** 2, 3))
    harmonics[:, 0] = random.uniform(-1.6, 1.6, (count, 3))
    return GaussianArrays(
        means=random.normal(0, 2, (count, 3)).astype(np.float32),
        log_scales=random.uniform(-6, -1, (count, 3)).astype(np.float32),
        quaternions=random.normal(size=(count, 4)).astype(np.float32),
        opacity_logits=random.normal(0, 2, count).astype(np.float32),
        harmonics=harmonics.astype(np.float32),
        color_model="display",
        base_time=0.25,
    )


def covariances(each):
    w, x, y, z = each.unit_quaternions.astype(np.float64).T
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    axes = np.stack(rows, 1).reshape(-1, 3, 3) * np.exp(each.log_scales)[:, None].astype(np.float64)
    return axes @ axes.swapaxes(1, 2)


def pairs(a, b):
    """The index of the Gaussian of b at the place of each of a."""
    return cKDTree(b.means).query(a.means)[1]


def assert_alike(original, read, *, harmonics=0.03):
    index = pairs(original, read)
    assert len(set(index.tolist())) == original.count == read.count
    np.testing.assert_allclose(read.means[index], original.means, atol=2e-2)
    np.testing.assert_allclose(read.opacities[index], original.opacities, atol=3e-3)
    a, b = covariances(original), covariances(read)[index]
    error = np.linalg.norm(a - b, axis=(1, 2)) / np.linalg.norm(a, axis=(1, 2))
    assert np.median(error) < 0.08 and np.percentile(error, 99) < 0.3
    np.testing.assert_allclose(read.harmonics[index][:, 0], original.harmonics[:, 0], atol=0.03)
    if original.degree:
        assert np.abs(read.harmonics[index][:, 1:] - original.harmonics[:, 1:]).mean() < harmonics


DEGREE_0_NAMES = [
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
]
"""Names of the properties of Gaussians without higher harmonics, in the order of the reference release."""


def write_ply(path, comments=(), **more):
    names = [*DEGREE_0_NAMES, *more]
    table = np.zeros(3, [(name, "<f4") for name in names])
    table["rot_0"], table["opacity"] = 1, 2
    table["scale_0"], table["scale_1"], table["scale_2"] = np.log([0.002, 0.02, 0.001])
    for name, value in more.items():
        table[name] = value
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments)]
    lines += ["element vertex 3", *(f"property float {name}" for name in names), "end_header", ""]
    path.write_bytes("\n".join(lines).encode("latin-1") + table.tobytes())
    return path


def rewrite(path, change, more=b""):
    """Change the description of a .glb, and put more behind its binary data."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    described, binary = json.loads(data[20 : 20 + length]), data[28 + length :] + more
    change(described)
    text = json.dumps(described).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<5I", 0x46546C67, 2, 28 + len(text) + len(binary), len(text), 0x4E4F534A)
    path.write_bytes(head + text + struct.pack("<2I", len(binary), 0x4E4942) + binary)
    return path


def package(name):
    """The folder of an npm package; skips where node or it is missing."""
    folders = [Path(folder) / name for folder in os.environ.get("NODE_PATH", "").split(os.pathsep) if folder]
    folder_of_package = next((folder for folder in folders if folder.is_dir()), None)
    if shutil.which("node") is None or folder_of_package is None:
        pytest.skip(f"{name} is not in NODE_PATH")
    return folder_of_package


def node(*words):
    return subprocess.run(["node", *map(str, words)], capture_output=True, text=True, timeout=60, check=True).stdout
