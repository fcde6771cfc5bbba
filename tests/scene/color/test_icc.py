"""Tables of ICC profiles that the test writes, against LittleCMS in floating point (imagecodecs)."""

import struct

import colour
import numpy as np
import pytest

from sehdr_warp.scene.color.encoding import encoding_of_profile
from sehdr_warp.scene.color.icc import read_profile, xyz_to_rec709
from sehdr_warp.scene.images.ldr_files import read_ldr
from tests.make_scenes import load

from .test_encoding import icc_profile, light_of, s15, save_as, write_set

D50 = np.array([0.9642, 1, 0.8249])
GRID = 9


def with_tag(profile: bytes, name: bytes, tag: bytes, space: bytes, version=4) -> bytes:
    """A profile of icc_profile() with one more tag and another connection space."""
    count = struct.unpack_from(">I", profile, 128)[0]
    table, body = profile[132 : 132 + 12 * count], profile[132 + 12 * count :]
    entries = [struct.unpack_from(">4sII", table, 12 * i) for i in range(count)]
    moved = b"".join(struct.pack(">4sII", key, at + 12, size) for key, at, size in entries)
    tag += b"\0" * (-len(tag) % 4)
    moved += struct.pack(">4sII", name, 132 + 12 * (count + 1) + len(body), len(tag))
    rest = struct.pack(">I", count + 1) + moved + body + tag
    head = (
        struct.pack(">I", 128 + len(rest)) + profile[4:8] + bytes([version]) + profile[9:20] + space + profile[24:128]
    )
    return head + rest


def device(grid=GRID):
    """[grid, grid, grid, 3] XYZ of a device in Adobe RGB whose codes are the square roots of light."""
    axes = np.meshgrid(*[np.linspace(0, 1, grid) ** 2] * 3, indexing="ij")
    space = colour.RGB_COLOURSPACES["Adobe RGB (1998)"]
    white = colour.xy_to_XYZ(space.whitepoint)
    adapt = colour.adaptation.matrix_chromatic_adaptation_VonKries(white, D50, "Bradford")
    return np.stack(axes, -1) @ (adapt @ space.matrix_RGB_to_XYZ).T


def lab():
    return colour.XYZ_to_Lab(device(), colour.XYZ_to_xy(D50))


def lut(space, deep=True):
    """`mft1` or `mft2`, with input curves that bend and output curves that do not."""
    values = device() / (65535 / 32768) if space == b"XYZ " else (lab() + np.array([0, 128, 128])) / [100, 255, 255]
    values = values * (65280 / 65535) if deep and space == b"Lab " else values
    bend = np.linspace(0, 1, 256) ** 1.2
    kind, top, head = ("u2", 65535, struct.pack(">HH", 256, 2)) if deep else ("u1", 255, b"")
    straight = np.linspace(0, 1, 2 if deep else 256)
    numbers = np.concatenate([*[bend] * 3, np.clip(values, 0, 1).ravel(), *[straight] * 3])
    table = np.rint(numbers * top).astype(f">{kind}").tobytes()
    return (b"mft2" if deep else b"mft1") + bytes(4) + bytes([3, 3, GRID, 0]) + s15(np.eye(3).ravel()) + head + table


def stages(space, clut=True):
    """`mAB `: curves, a table, curves, a matrix, curves."""
    gamma = b"para\0\0\0\0\0\0\0\0" + s15([1.3])
    soft = b"curv\0\0\0\0" + struct.pack(">I3HH", 3, 0, 30000, 65535, 0)
    if space == b"XYZ ":
        values = device() / (65535 / 32768)
    else:
        values = (lab() + np.array([0, 128, 128])) / [100, 255, 255]
    grid = (
        bytes([GRID] * 3).ljust(16, b"\0")
        + b"\2\0\0\0"
        + np.rint(np.clip(values, 0, 1) * 65535).astype(">u2").tobytes()
    )
    matrix = s15([0.9, 0.05, 0, 0, 0.95, 0, 0.02, 0, 0.9, 0.01, 0.02, 0])
    parts, places, at = [], [], 32
    for part in (soft * 3, matrix, gamma * 3, grid if clut else b"", gamma * 3 if clut else b""):
        part += b"\0" * (-len(part) % 4)
        places.append(at if part else 0)
        parts.append(part)
        at += len(part)
    return b"mAB \0\0\0\0\3\3\0\0" + struct.pack(">5I", *places) + b"".join(parts)


TABLES = {
    "mft2 Lab": (lut(b"Lab "), b"Lab ", b"A2B0"),
    "mft2 XYZ": (lut(b"XYZ "), b"XYZ ", b"A2B0"),
    "mft1 Lab": (lut(b"Lab ", deep=False), b"Lab ", b"A2B0"),
    "mAB Lab": (stages(b"Lab "), b"Lab ", b"A2B0"),
    "mAB XYZ": (stages(b"XYZ "), b"XYZ ", b"A2B1"),
    "mAB without a table": (stages(b"XYZ ", clut=False), b"XYZ ", b"A2B0"),
}


def profile_of(case):
    tag, space, name = TABLES[case]
    return with_tag(icc_profile("sRGB", 2.2, name="scanner"), name, tag, space)


@pytest.mark.parametrize("case", TABLES)
def test_tables_agree_with_littlecms(case):
    imagecodecs = pytest.importorskip("imagecodecs")
    codes = np.random.default_rng(0).integers(2000, 65536, (40, 50, 3), dtype=np.uint16)
    codes[0] = np.linspace(0, 65535, 50).astype(np.uint16)[:, None]  # Neutral
    xyz = imagecodecs.cms_profile("xyz")
    theirs = imagecodecs.cms_transform(
        codes, profile_of(case), xyz, colorspace="rgb", outcolorspace="xyz", outdtype="float64", intent=1
    )
    ours = read_profile(profile_of(case)).table.to_xyz(codes / 65535)
    assert np.abs(ours - theirs).max() < 2e-4 + 1e-4 * theirs.max()
    light, expected = xyz_to_rec709(ours), xyz_to_rec709(theirs)
    assert (np.abs(light - expected) <= 0.005 * expected.max(-1, keepdims=True) + 1e-4).all()


@pytest.mark.parametrize("kind", ["tif 16", "png 16", "jpg"])
def test_photos_with_a_table_keep_their_bits(tmp_path, kind):
    scene = load(write_set(tmp_path, save_as(kind, profile_of("mft2 Lab"))), holdout=0)
    photo = read_ldr(tmp_path / "images" / f"000.{kind.partition(' ')[0]}")
    expected = np.maximum(
        xyz_to_rec709(read_profile(profile_of("mft2 Lab")).table.to_xyz(photo.pixels / photo.levels)), 0
    )
    error = np.abs(light_of(scene.views[0], scene) - expected)
    assert (error <= 0.005 * expected.max(-1, keepdims=True) + 1e-4)[(photo.pixels < photo.levels).all(-1)].all()
    assert scene.views[0].codes.dtype == np.uint16
    assert any("are in scanner (ICC profile) and converted to Rec.709" in note for note in scene.notes)


def test_colors_that_were_converted_before_are_the_same_again():
    encoding = encoding_of_profile(profile_of("mft2 Lab"))
    table = read_profile(profile_of("mft2 Lab")).table
    random = np.random.default_rng(0)
    for _ in range(2):
        codes = random.integers(100, 120, (30, 40, 3), dtype=np.uint8)  # Half of the colors occur in both
        light, clipped = encoding.to_linear(codes)
        np.testing.assert_allclose(light, xyz_to_rec709(table.to_xyz(codes / 255)), atol=1e-5)
        assert not clipped.any()


@pytest.mark.parametrize("damage", ["cut", "grid", "channels", "kind"])
def test_a_damaged_table_is_named(damage):
    tag, space, name = TABLES["mft2 XYZ"]
    tag = {"cut": tag[:2000], "grid": tag[:10] + b"\xff" + tag[11:], "channels": tag[:8] + b"\4" + tag[9:],
           "kind": b"mBA " + tag[4:]}[damage]  # fmt: skip
    with pytest.raises(ValueError, match="is damaged"):
        read_profile(with_tag(icc_profile("sRGB", 2.2), name, tag, space))
