"""Splat files as other tools write them: smoothing filters, marks, comments, nodes of glTF, times of OpenUSD."""

import gzip
import json
import logging
import re
import struct
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from sehdr_warp.errors import InputError
from sehdr_warp.splats import read_gaussians, write_gaussians
from sehdr_warp.splats.arrays import HARMONIC_0

from .test_splat_files import gaussians, rewrite

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


def test_the_smoothing_filter_is_fused(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    read = read_gaussians(write_ply(tmp_path / "a.ply", filter_3D=0.01))
    assert "a.ply: its 3D smoothing filter (filter_3D) is fused" in caplog.text
    sizes = np.array([0.002, 0.02, 0.001])
    wide = np.hypot(sizes, 0.01)
    np.testing.assert_allclose(np.exp(read.log_scales), [wide] * 3, rtol=1e-5)
    expected = 1 / (1 + np.exp(-2)) * np.prod(sizes / wide)
    np.testing.assert_allclose(read.opacities, expected, rtol=1e-4)
    plain = read_gaussians(write_ply(tmp_path / "b.ply", filter_3D=0))
    np.testing.assert_allclose(np.exp(plain.log_scales), [sizes] * 3, rtol=1e-5)


def test_properties_of_other_models_are_named(tmp_path, caplog):
    """Spacetime Gaussians move, Beta Splatting has another kernel: as 3D Gaussians they look otherwise."""
    read_gaussians(write_ply(tmp_path / "plain.ply", red=1, alpha=1))
    assert not caplog.records
    assert read_gaussians(write_ply(tmp_path / "a.ply", trbf_center=0.5, motion_0=1)).count == 3
    assert "a.ply: is read as 3D Gaussians, without its further properties trbf_center, motion_0" in caplog.text


def test_the_mark_of_opacity_compensation_is_kept_and_logged(tmp_path, caplog):
    caplog.set_level(logging.INFO, "sehdr_warp")
    comments = ["Exported from Brush", "SplatRenderMode: mip"]
    read = read_gaussians(write_ply(tmp_path / "a.ply", comments))
    assert read.antialiased and "states opacity compensation" in caplog.text
    write_gaussians(tmp_path / "b.ply", read)
    assert b"comment SplatRenderMode: mip\n" in (tmp_path / "b.ply").read_bytes()
    caplog.clear()
    other = read_gaussians(write_ply(tmp_path / "c.ply", ["SplatRenderMode: default"]))
    assert not other.antialiased and "compensation" not in caplog.text
    write_gaussians(tmp_path / "d.ply", other)
    assert b"SplatRenderMode" not in (tmp_path / "d.ply").read_bytes()


def test_gaussians_of_two_sizes_are_flat(tmp_path, caplog):
    """SuperSplat issue 975: 2D Gaussian Splatting writes scale_0 and scale_1 alone."""
    write_ply(tmp_path / "a.ply")
    data = (tmp_path / "a.ply").read_bytes()
    head, _, body = data.partition(b"end_header\n")
    table = np.frombuffer(body, "<f4").reshape(3, -1)
    place = DEGREE_0_NAMES.index("scale_2")
    flat = head.replace(b"property float scale_2\n", b"") + b"end_header\n" + np.delete(table, place, axis=1).tobytes()
    (tmp_path / "a.ply").write_bytes(flat)
    with caplog.at_level(logging.INFO):
        read = read_gaussians(tmp_path / "a.ply")
    np.testing.assert_allclose(np.exp(read.log_scales), [[0.002, 0.02, 1e-6]] * 3, rtol=1e-5)
    assert "have two sizes (2D Gaussian Splatting)" in caplog.text


def test_colors_of_eight_bits(tmp_path):
    """UnityGaussianSplatting issue 176: `ns-export gaussian-splat --ply-color-mode rgb` writes red, green and blue."""
    names = [name for name in DEGREE_0_NAMES if not name.startswith("f_dc")]
    table = np.zeros(2, [*((name, "<f4") for name in names), *((name, "u1") for name in ("red", "green", "blue"))])
    table["rot_0"], table["red"], table["blue"] = 1, [255, 128], [51, 204]
    PlyData([PlyElement.describe(table, "vertex")]).write(str(tmp_path / "a.ply"))
    read = read_gaussians(tmp_path / "a.ply")
    colors = read.harmonics[:, 0] * HARMONIC_0 + 0.5
    np.testing.assert_allclose(colors, np.array([[255, 0, 51], [128, 0, 204]]) / 255, atol=1e-6)
    assert read.degree == 0 and read.color_model == "display"


def test_extensions_of_spz_are_named(tmp_path, caplog):
    """One of them states other axes; spz issue 84 and pull request 82."""
    write_gaussians(tmp_path / "a.spz", gaussians(5, 1, "display"))
    data = bytearray(gzip.decompress((tmp_path / "a.spz").read_bytes()))
    data[14] |= 2  # A flag says that extensions lie behind the Gaussians.
    extension = struct.pack("<III", 0xADBE0003, 4, 5)
    (tmp_path / "b.spz").write_bytes(gzip.compress(bytes(data) + extension))
    np.testing.assert_array_equal(read_gaussians(tmp_path / "b.spz").means, read_gaussians(tmp_path / "a.spz").means)
    assert "b.spz: its extensions are not read" in caplog.text and "a.spz" not in caplog.text


def test_sog_in_pieces_and_in_a_folder(tmp_path):
    write_gaussians(tmp_path / "a.sog", gaussians(300, 1, "display"))
    with zipfile.ZipFile(tmp_path / "a.sog") as packed, zipfile.ZipFile(tmp_path / "b.sog", "w") as other:
        for name in packed.namelist():
            other.writestr(f"scene/{name}", packed.read(name))
        packed.extractall(tmp_path / "pieces")
    np.testing.assert_array_equal(read_gaussians(tmp_path / "b.sog").means, read_gaussians(tmp_path / "a.sog").means)
    with pytest.raises(InputError, match=r"is SOG in pieces; zip it and the pictures beside it as scene\.sog"):
        read_gaussians(tmp_path / "pieces" / "meta.json")


def test_harmonics_beyond_degree_3_are_named(tmp_path):
    write_gaussians(tmp_path / "a.spz", gaussians(5, 1, "display"))
    data = bytearray(gzip.decompress((tmp_path / "a.spz").read_bytes()))
    data[12] = 4
    (tmp_path / "a.spz").write_bytes(gzip.compress(bytes(data)))
    with pytest.raises(InputError, match="has harmonics of degree 4; export it with degree 0 to 3"):
        read_gaussians(tmp_path / "a.spz")


def test_comments_in_any_encoding(tmp_path):
    read = read_gaussians(write_ply(tmp_path / "a.ply", ["Müller, 5 \xb5m", "SplatRenderMode: mip"]))
    assert read.count == 3 and read.antialiased


def test_logarithms_in_gltf_are_read_as_such(tmp_path, caplog):
    """SplatTransform wrote them until June 2026 (its pull request 268); the extension forbids negative sizes."""
    written = gaussians(5, 1, "display")
    write_gaussians(tmp_path / "a.glb", written)
    data = (tmp_path / "a.glb").read_bytes()
    linear, stored = np.exp(written.log_scales), written.log_scales
    assert stored.min() < 0 and linear.tobytes() in data
    (tmp_path / "b.glb").write_bytes(data.replace(linear.tobytes(), stored.tobytes()))
    np.testing.assert_array_equal(read_gaussians(tmp_path / "b.glb").log_scales, stored)
    assert "b.glb: its SCALE has negative numbers and is read as logarithms" in caplog.text


def test_opacities_and_sizes_in_place_of_logits_and_logarithms_are_named(tmp_path, caplog):
    """pixelSplat issue 115, GPS-Gaussian issue 46, mesh2splat pull request 21."""
    splats = gaussians(100, 1, "display")
    write_gaussians(tmp_path / "right.ply", splats)
    write_gaussians(tmp_path / "opacity.ply", replace(splats, opacity_logits=splats.opacities))
    write_gaussians(tmp_path / "size.ply", replace(splats, log_scales=np.exp(splats.log_scales)))
    for name in ("right.ply", "opacity.ply", "size.ply"):
        read_gaussians(tmp_path / name)
    assert "opacity.ply: all opacities lie between 0 and 1: if they are not logits" in caplog.text
    assert "size.ply: all sizes are above 1 unit: if they are not logarithms" in caplog.text
    assert len(caplog.records) == 2


def test_compressed_primitives_are_named(tmp_path):
    write_gaussians(tmp_path / "a.glb", gaussians(5, 1, "display"))

    def compress(described):
        extension = described["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]
        extension["extensions"] = {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}}

    problem = "is compressed .KHR_gaussian_splatting_compression_spz_2.; export it uncompressed, or as SPZ"
    with pytest.raises(InputError, match=problem):
        read_gaussians(rewrite(tmp_path / "a.glb", compress))


def test_identity_nodes_cameras_and_lights_do_not_matter(tmp_path):
    write_gaussians(tmp_path / "a.glb", gaussians(5, 1, "display"))
    expected = read_gaussians(tmp_path / "a.glb")

    def change(described):
        described["nodes"] = [
            {"children": [1, 2], "matrix": np.eye(4).ravel().tolist()},
            {"mesh": 0, "translation": [0, 0, 0], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1]},
            {"camera": 0, "translation": [1, 2, 3]},
        ]
        described["scenes"] = [{"nodes": [0]}]

    read = read_gaussians(rewrite(tmp_path / "a.glb", change))
    np.testing.assert_array_equal(read.means, expected.means)


def test_transforms_of_nodes_move_gaussians(tmp_path):
    write_gaussians(tmp_path / "a.glb", gaussians(5, 1, "display"))
    before = read_gaussians(tmp_path / "a.glb")

    def change(described):
        described["nodes"] = [{"children": [1], "scale": [2, 2, 2]},
                              {"mesh": 0, "translation": [1, 0, 0], "rotation": [0, 0, 1, 0]}]  # fmt: skip
        described["scenes"] = [{"nodes": [0]}]

    read = read_gaussians(rewrite(tmp_path / "a.glb", change))
    np.testing.assert_allclose(read.means, 2 * (before.means * [-1, -1, 1] + [1, 0, 0]), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(read.log_scales, before.log_scales + np.log(2), rtol=1e-5)

    def stretch(described):
        described["nodes"][1]["scale"] = [1, 2, 1]

    with pytest.raises(InputError, match="stretches its Gaussians by a node's transform"):
        read_gaussians(rewrite(tmp_path / "a.glb", stretch))

    def cycle(described):
        described["nodes"] = [{"children": [1], "mesh": 0}, {"children": [0]}]

    with pytest.raises(InputError, match="nodes that hold each other"):
        read_gaussians(rewrite(tmp_path / "a.glb", cycle))


def test_several_primitives_are_one_scene(tmp_path):
    write_gaussians(tmp_path / "a.glb", gaussians(5, 2, "display"))
    before = read_gaussians(tmp_path / "a.glb")

    def change(described):
        first = described["meshes"][0]["primitives"][0]
        second = json.loads(json.dumps(first))
        second["attributes"] = {
            n: v for n, v in second["attributes"].items() if "DEGREE_1" not in n and "DEGREE_2" not in n
        }
        points = {"mode": 0, "attributes": {"POSITION": first["attributes"]["POSITION"]}}
        described["meshes"][0]["primitives"] = [first, second, points]

    read = read_gaussians(rewrite(tmp_path / "a.glb", change))
    assert read.count == 2 * before.count and read.degree == 2
    np.testing.assert_array_equal(read.harmonics[before.count :, 0], before.harmonics[:, 0])
    assert not read.harmonics[before.count :, 1:].any()


def test_values_of_openusd_at_times_alone(tmp_path):
    pytest.importorskip("pxr")
    write_gaussians(tmp_path / "a.usda", gaussians(5, 1, "linear"))
    text = (tmp_path / "a.usda").read_text()
    sampled = re.sub(
        r"(point3f\[\] positions) = (\[.*?\])", r"\1.timeSamples = { 3: \2, 5: [(0, 0, 0)] }", text, flags=re.DOTALL
    )
    assert sampled != text
    (tmp_path / "b.usda").write_text(sampled)
    np.testing.assert_allclose(read_gaussians(tmp_path / "b.usda").means, read_gaussians(tmp_path / "a.usda").means)


@pytest.mark.parametrize("value", [" = (1, 2, 3)", ".timeSamples = { 1: (1, 2, 3), 5: (0, 0, 0) }"])
def test_transforms_of_openusd_are_named(tmp_path, value):
    pytest.importorskip("pxr")
    write_gaussians(tmp_path / "a.usda", gaussians(5, 1, "linear"))
    text = (tmp_path / "a.usda").read_text()
    moved = (
        f'double3 xformOp:translate{value}\nuniform token[] xformOpOrder = ["xformOp:translate"]\npoint3f[] positions'
    )
    (tmp_path / "b.usda").write_text(text.replace("point3f[] positions", moved, 1))
    with pytest.raises(InputError, match="moved by a transform"):
        read_gaussians(tmp_path / "b.usda")
