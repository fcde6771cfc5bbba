"""Every format of splat files: what is written is read, other programs read it, and bad files are refused in a line."""

import struct
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.splats import check_suffix, read_gaussians, write_gaussians
from tests.splats.samples import LOSSY_SUFFIXES, assert_alike, gaussians, natural, package

ARRAYS = ("means", "log_scales", "opacity_logits", "harmonics", "unit_quaternions")


@pytest.mark.parametrize(
    "suffix, color_model, degree, tolerance",
    [
        (".ply", "log", 0, 0), (".ply", "linear", 1, 0), (".ply", "display", 2, 0),
        (".usda", "linear", 3, 1e-5), (".usdc", "linear", 1, 1e-5), (".usdz", "linear", 0, 1e-5),
        (".glb", "display", 3, 1e-5), (".glb", "display", 0, 1e-5),
    ],
)  # fmt: skip
def test_round_trip(tmp_path, suffix, color_model, degree, tolerance):
    if suffix.startswith(".usd"):
        pytest.importorskip("pxr")
    written, file = gaussians(degree=degree, color_model=color_model), tmp_path / f"a{suffix}"
    write_gaussians(file, written)
    read = read_gaussians(file)
    for name in ARRAYS:
        np.testing.assert_allclose(getattr(read, name), getattr(written, name), atol=tolerance, rtol=tolerance)
    assert (read.color_model, read.base_time, read.degree) == (color_model, 0.5, degree)
    assert [path.name for path in tmp_path.glob("[!.]*")] == [file.name]
    with pytest.raises(InputError, match="exists already"):
        write_gaussians(file, written)
    broken = replace(written, opacity_logits=np.where(np.arange(50) == 7, np.nan, 0).astype(np.float32))
    with pytest.raises(InputError, match="opacity_logits of 1 Gaussians are not finite, the first at 7"):
        write_gaussians(tmp_path / f"b{suffix}", broken)
    assert [path.name for path in tmp_path.glob("[!.]*")] == [file.name]


@pytest.mark.parametrize("suffix", LOSSY_SUFFIXES)
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_what_is_written_is_read(tmp_path, suffix, degree):
    original = natural(degree=degree)
    path = tmp_path / f"a{suffix}"
    write_gaussians(path, original)
    read = read_gaussians(path)
    assert (read.degree, read.color_model) == (degree, "display")
    # The palette of SOG is small beside so few and so random Gaussians.
    assert_alike(original, read, harmonics=0.06 if suffix == ".sog" else 0.03)
    if suffix != ".spz":
        assert read.base_time == 0.25
    with pytest.raises(InputError, match="exists already"):
        write_gaussians(path, original)
    first = path.read_bytes()
    write_gaussians(path, original, overwrite=True)
    assert path.read_bytes() == first


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".sog", ".glb"])
def test_transform_and_base_time_are_stored(tmp_path, suffix):
    matrix = np.diag([2.0, 2.0, 2.0, 1.0])
    written = replace(natural(50).transformed(matrix), base_time=np.float32(0.5))
    write_gaussians(tmp_path / f"a{suffix}", written)
    read = read_gaussians(tmp_path / f"a{suffix}")
    np.testing.assert_allclose(read.world_matrix, matrix)
    assert read.base_time == 0.5


def test_files_hold_one_color_model(tmp_path):
    for suffix in (*LOSSY_SUFFIXES, ".glb"):
        assert check_suffix(f"x{suffix.upper()}") == suffix
        with pytest.raises(InputError, match="holds display colors, and these are linear"):
            write_gaussians(tmp_path / f"a{suffix}", gaussians(color_model="linear"))


@pytest.mark.parametrize("suffix", LOSSY_SUFFIXES)
def test_splat_transform_reads_them(tmp_path, suffix):
    tool = package("@playcanvas/splat-transform") / "bin" / "cli.mjs"
    original = natural()
    write_gaussians(tmp_path / f"a{suffix}", original)
    subprocess.run(["node", tool, tmp_path / f"a{suffix}", tmp_path / "b.ply"], check=True, capture_output=True)
    assert_alike(original, read_gaussians(tmp_path / "b.ply"), harmonics=0.06)


def ply(header: str, body: bytes = b"") -> bytes:
    return f"ply\nformat binary_little_endian 1.0\n{header}end_header\n".encode() + body


COLUMNS = "x y z scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3 f_dc_0 f_dc_1 f_dc_2"
NUMBERS = "".join(f"property float {name}\n" for name in COLUMNS.split())
BAD = {
    "a.ply": (ply("element vertex 2147483648\nproperty float x\n"), "claims 2147483648 elements"),
    "b.ply": (b"ply\nformat ascii 1.0\nelement vertex 99999999999\nproperty float x\nend_header\n1\n", "claims"),
    "c.ply": (b"no ply", "is not a PLY file"),
    "d.ply": (ply("element vertex 1\nproperty float x\nproperty uchar red\n", bytes(5)), "point cloud"),
    "e.ply": (ply("element vertex 3\nproperty float x\n", bytes(9)), "cannot be read as PLY"),
    "f.ply": (ply(f"element vertex 1\n{NUMBERS}property uchar opacity\n", bytes(53)), "opacity is of whole numbers"),
    "a.glb": (b"glTF" + bytes(40), "is not binary glTF"),
    "b.glb": (struct.pack("<5I", 0x46546C67, 2, 22, 2, 0x4E4F534A) + b"{}", "is damaged glTF"),
    "a.spz": (b"x", "is damaged SPZ"),
    "a.splat": (b"x", ".splat is not read or written here"),
    "a.txt": (b"x", "a.txt: is not a splat file; use one of .ply"),
    "a.usda": (b"#usda 1.0\ndef Sphere \"a\" {}\n", "has 0 prims of ParticleField3DGaussianSplat"),
    "b.usda": (b"#usda 1.0\ndef {", "cannot be read as USD"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_in_one_line(tmp_path, name):
    if name.endswith(".usda"):
        pytest.importorskip("pxr")
    data, words = BAD[name]
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=words):
        read_gaussians(tmp_path / name)


@pytest.mark.parametrize("suffix", LOSSY_SUFFIXES)
@pytest.mark.parametrize("part", [0, 3, 40, 0.5, -30])
def test_cut_files_are_refused_in_one_line(tmp_path, suffix, part):
    path = tmp_path / f"a{suffix}"
    write_gaussians(path, natural(64))
    data = path.read_bytes()
    path.write_bytes(data[: int(part * len(data)) if part == 0.5 else part])
    with pytest.raises(InputError) as refusal:
        read_gaussians(path)
    assert len(str(refusal.value).splitlines()) == 1
