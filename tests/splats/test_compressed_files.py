import gzip
import itertools
import json
import os
import struct
import subprocess
import sys
import warnings
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.splats import GaussianArrays, check_suffix, read_gaussians, write_gaussians

from .test_npm_parsers import package
from .test_splat_files import LOSSY_SUFFIXES, gaussians

SHARED = Path(os.environ.get("SEHDR_SHARED", "../shared")) / "data" / "splats"


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


@pytest.mark.parametrize("suffix", [".sog", ".compressed.ply"])
def test_the_transform_is_stored(tmp_path, suffix):
    matrix = np.diag([2.0, 2.0, 2.0, 1.0])
    write_gaussians(tmp_path / f"a{suffix}", natural().transformed(matrix))
    np.testing.assert_allclose(read_gaussians(tmp_path / f"a{suffix}").world_matrix, matrix)


def test_harmonics_beyond_the_square_root_of_float32_do_not_end_the_program(tmp_path):
    original = natural()
    harmonics = original.harmonics.copy()
    harmonics[3:6, 1:] = 1e20, -3e38, 1e30
    write_gaussians(tmp_path / "a.sog", replace(original, harmonics=harmonics))
    read = read_gaussians(tmp_path / "a.sog")
    assert read.count == original.count and (np.abs(read.harmonics[:, 1:]).max(axis=(1, 2)) > 1e14).sum() == 3


@pytest.mark.parametrize("suffix", LOSSY_SUFFIXES)
def test_splat_transform_reads_them(tmp_path, suffix):
    tool = package("@playcanvas/splat-transform") / "bin" / "cli.mjs"
    original = natural()
    write_gaussians(tmp_path / f"a{suffix}", original)
    subprocess.run(["node", tool, tmp_path / f"a{suffix}", tmp_path / "b.ply"], check=True, capture_output=True)
    assert_alike(original, read_gaussians(tmp_path / "b.ply"), harmonics=0.06)


def test_files_of_other_programs():
    if not SHARED.is_dir():
        pytest.skip("no shared data")
    plain = read_gaussians(SHARED / "plush_dog_point_cloud_29999_clean.ply")
    packed = read_gaussians(SHARED / "plush_dog_point_cloud_29999_clean.compressed.ply")
    index = pairs(plain, packed)
    np.testing.assert_allclose(packed.means[index], plain.means, atol=1e-3)
    assert np.abs(packed.harmonics[index][:, 1:] - plain.harmonics[:, 1:]).mean() < 0.02
    for name in ("raw", "v2", "v3"):
        assert read_gaussians(SHARED / f"pc_minimal-{name}.spz").count == 4
    pytest.importorskip("imagecodecs")
    newest, before = (read_gaussians(SHARED / f"pc_minimal-v{version}.spz") for version in (4, 3))
    np.testing.assert_array_equal(newest.means, before.means)
    np.testing.assert_array_equal(newest.quaternions, before.quaternions)
    np.testing.assert_array_equal(newest.harmonics, before.harmonics)


def as_version_4(data, degree, extension=b""):
    """Return version 4 of a SPZ file of version 3: Niantic's README states its layout."""
    imagecodecs = pytest.importorskip("imagecodecs")
    plain = gzip.decompress(data)
    magic, _, count, _, fraction, flags, _ = struct.unpack("<IIIBBBB", plain[:16])
    sizes = [count * width for width in (9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1)) if width]
    edges = np.cumsum([16, *sizes])
    blocks = [imagecodecs.zstd_encode(plain[a:b]) for a, b in itertools.pairwise(edges)]
    at = 32 + len(extension)
    flags |= 2 * bool(extension)
    head = struct.pack("<IIIBBBBI12x", magic, 4, count, degree, fraction, flags, len(blocks), at)
    table = b"".join(struct.pack("<QQ", len(block), size) for block, size in zip(blocks, sizes, strict=True))
    return head + extension + table + b"".join(blocks)


@pytest.mark.parametrize("degree", [0, 3])
def test_version_4_of_spz_holds_what_version_3_does(tmp_path, degree, caplog):
    write_gaussians(tmp_path / "3.spz", natural(degree=degree))
    data = (tmp_path / "3.spz").read_bytes()
    (tmp_path / "4.spz").write_bytes(as_version_4(data, degree))
    (tmp_path / "e.spz").write_bytes(as_version_4(data, degree, struct.pack("<II4x", 0xADBE0002, 4)))
    before, *newer = (read_gaussians(tmp_path / name) for name in ("3.spz", "4.spz", "e.spz"))
    for field, values in vars(before).items():
        for other in newer:
            np.testing.assert_array_equal(getattr(other, field), values)
    assert "e.spz: its extensions are not read" in caplog.text and "4.spz" not in caplog.text


def test_damaged_files_of_version_4_are_one_line(tmp_path):
    write_gaussians(tmp_path / "3.spz", natural())
    data = as_version_4((tmp_path / "3.spz").read_bytes(), 3)
    count, table = struct.pack("<I", 40_000_000), struct.pack("<I", 1 << 31)
    for damaged, problem in {
        data[:20]: "is damaged SPZ",
        data[:-9]: "is damaged SPZ",
        data[:15] + b"\5" + data[16:]: "has 5 streams in place of 6",
        data[:8] + count + data[12:]: "states 5400 bytes for stream 0, of 360000000",
        data[:16] + table + data[20:]: "is damaged SPZ",
        data[:-40] + bytes(40): "is damaged SPZ",
    }.items():
        (tmp_path / "a.spz").write_bytes(damaged)
        with pytest.raises(InputError, match=problem):
            read_gaussians(tmp_path / "a.spz")


def test_version_4_without_its_library_is_named(tmp_path, monkeypatch):
    write_gaussians(tmp_path / "3.spz", natural())
    (tmp_path / "a.spz").write_bytes(as_version_4((tmp_path / "3.spz").read_bytes(), 3))
    monkeypatch.setitem(sys.modules, "imagecodecs", None)
    with pytest.raises(SehdrError, match=r"SPZ of version 4 needs imagecodecs; run `pip install 'sehdr-warp\[spz\]'`"):
        read_gaussians(tmp_path / "a.spz")


def test_files_hold_one_color_model(tmp_path):
    for suffix in (*LOSSY_SUFFIXES, ".glb"):
        assert check_suffix(f"x{suffix.upper()}") == suffix
        with pytest.raises(InputError, match="holds display colors, and these are linear"):
            write_gaussians(tmp_path / f"a{suffix}", gaussians(color_model="linear"))


def test_positions_that_24_bits_do_not_hold_are_refused(tmp_path):
    far = natural()
    far.means[7, 0] = 9e6
    with pytest.raises(InputError, match="positions below 8388608, and these reach 9e.06"):
        write_gaussians(tmp_path / "a.spz", far)
    assert list(tmp_path.iterdir()) == []


def test_sizes_that_spz_cannot_hold_are_warned_of(tmp_path, caplog):
    write_gaussians(tmp_path / "a.spz", natural())
    assert not caplog.messages
    write_gaussians(tmp_path / "a.spz", natural().transformed(np.diag([0.001, 0.001, 0.001, 1.0])), overwrite=True)
    assert "a.spz: 92 % of the Gaussians are beyond SPZ's sizes" in caplog.text


def test_bounds_beyond_all_numbers_are_one_line_without_warnings(tmp_path):
    write_gaussians(tmp_path / "a.sog", natural())
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(files["meta.json"])
    meta["means"] |= {"mins": [1e308] * 3, "maxs": [-1e308] * 3}
    with zipfile.ZipFile(tmp_path / "b.sog", "w") as archive:
        for name, data in (files | {"meta.json": json.dumps(meta).encode()}).items():
            archive.writestr(name, data)
    with warnings.catch_warnings(), pytest.raises(InputError, match="all of its Gaussians have values that are not"):
        warnings.simplefilter("error")
        read_gaussians(tmp_path / "b.sog")


def test_damage_and_other_versions_are_one_line(tmp_path):
    original = natural(64)
    for suffix in LOSSY_SUFFIXES:
        whole = tmp_path / f"whole{suffix}"
        write_gaussians(whole, original)
        data = whole.read_bytes()
        for length in (0, 3, 40, len(data) // 2, len(data) - 30):
            cut = tmp_path / f"cut{suffix}"
            cut.write_bytes(data[:length])
            with pytest.raises(InputError) as refusal:
                read_gaussians(cut)
            assert len(str(refusal.value).splitlines()) == 1
    old = tmp_path / "old.sog"
    with zipfile.ZipFile(tmp_path / "whole.sog") as archive, zipfile.ZipFile(old, "w") as changed:
        for name in archive.namelist():
            text = archive.read(name)
            if name == "meta.json":
                text = json.dumps({key: value for key, value in json.loads(text).items() if key != "version"})
            changed.writestr(name, text)
    with pytest.raises(InputError, match="is SOG of version 1"):
        read_gaussians(old)
