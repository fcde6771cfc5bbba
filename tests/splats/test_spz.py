"""SPZ of versions 3 and 4: what it cannot hold, extensions, damage."""

import gzip
import itertools
import struct
import sys

import numpy as np
import pytest

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.splats import read_gaussians, write_gaussians

from .samples import gaussians, natural


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


def test_versions_of_other_programs_are_one_scene(shared):
    files = [shared / f"data/splats/pc_minimal-{name}.spz" for name in ("raw", "v2", "v3", "v4")]
    for file in files[:3]:
        assert read_gaussians(file).count == 4
    pytest.importorskip("imagecodecs")
    before, newest = map(read_gaussians, files[2:])
    for field in ("means", "quaternions", "harmonics"):
        np.testing.assert_array_equal(getattr(newest, field), getattr(before, field))


def test_version_2_turns_gaussians_by_three_bytes(tmp_path):
    """Niantic's README: x, y and z of a unit quaternion whose w is positive, in axes of y up and z back."""
    write_gaussians(tmp_path / "3.spz", natural(degree=0))
    written = read_gaussians(tmp_path / "3.spz")
    plain = gzip.decompress((tmp_path / "3.spz").read_bytes())
    turns = written.transformed(np.diag([1.0, -1.0, -1.0, 1.0])).unit_quaternions
    packed = np.rint((turns[:, 1:] * np.where(turns[:, :1] < 0, -1, 1) + 1) * 127.5).astype(np.uint8)
    end = 16 + written.count * (9 + 1 + 3 + 3)
    (tmp_path / "2.spz").write_bytes(gzip.compress(plain[:4] + struct.pack("<I", 2) + plain[8:end] + packed.tobytes()))
    read = read_gaussians(tmp_path / "2.spz")
    cosines = (read.unit_quaternions * written.unit_quaternions).sum(axis=1)
    assert (np.abs(cosines) > 0.99).all()
    np.testing.assert_array_equal(read.means, written.means)


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
        data[:15] + b"\5" + data[16:]: "has 5 streams instead of 6",
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


def test_extensions_are_named_and_harmonics_beyond_degree_3_refused(tmp_path, caplog):
    """An extension may state other axes; spz issue 84 and pull request 82."""
    write_gaussians(tmp_path / "a.spz", gaussians(5, 1, "display"))
    plain = gzip.decompress((tmp_path / "a.spz").read_bytes())
    with_flag = plain[:14] + bytes([plain[14] | 2]) + plain[15:]  # Extensions lie behind the Gaussians.
    (tmp_path / "b.spz").write_bytes(gzip.compress(with_flag + struct.pack("<III", 0xADBE0003, 4, 5)))
    np.testing.assert_array_equal(read_gaussians(tmp_path / "b.spz").means, read_gaussians(tmp_path / "a.spz").means)
    assert "b.spz: its extensions are not read" in caplog.text and "a.spz" not in caplog.text
    (tmp_path / "c.spz").write_bytes(gzip.compress(plain[:12] + b"\4" + plain[13:]))
    with pytest.raises(InputError, match="has harmonics of degree 4; export it with degree 0 to 3"):
        read_gaussians(tmp_path / "c.spz")
