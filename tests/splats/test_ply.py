"""PLY of the reference release and of other programs: filters, marks, comments, sizes, colors."""

import csv
import logging
from dataclasses import replace

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from sehdr_warp.errors import InputError
from sehdr_warp.splats import read_gaussians, write_gaussians
from sehdr_warp.splats.arrays import HARMONIC_0

from .samples import DEGREE_0_NAMES, gaussians, node, package, write_ply


def test_ply_has_the_names_and_order_of_the_reference_release(tmp_path):
    written = gaussians()
    write_gaussians(tmp_path / "a.ply", written)
    vertex = PlyData.read(tmp_path / "a.ply")["vertex"]
    names = ["x", "y", "z", "nx", "ny", "nz"] + [f"f_dc_{i}" for i in range(3)] + [f"f_rest_{i}" for i in range(45)]
    names += ["opacity"] + [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
    assert [p.name for p in vertex.properties] == names
    # All of red's higher coefficients, then green's, then blue's.
    np.testing.assert_array_equal(vertex["f_rest_16"], written.harmonics[:, 2, 1])
    np.testing.assert_array_equal(vertex["rot_0"], written.quaternions[:, 0])


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


def test_a_file_of_the_reference_release(shared):
    read = read_gaussians(shared / "data" / "splats" / "plush_dog_point_cloud_29999_clean.ply")
    assert (read.count, read.degree, read.color_model) == (15105, 3, "display")


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


def test_comments_in_any_encoding(tmp_path):
    read = read_gaussians(write_ply(tmp_path / "a.ply", ["Müller, 5 \xb5m", "SplatRenderMode: mip"]))
    assert read.count == 3 and read.antialiased


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


def test_ply_larger_than_the_memory_is_refused_unread(tmp_path, monkeypatch):
    write_gaussians(tmp_path / "a.ply", gaussians(degree=0, color_model="display"))
    monkeypatch.setattr("sehdr_warp.splats.ply.available_memory", lambda: 1000)
    with pytest.raises(InputError, match="GB of memory to read"):
        read_gaussians(tmp_path / "a.ply")


def test_what_is_not_finite_is_left_out_and_odd_harmonics_are_refused(tmp_path, logged):
    original = gaussians(degree=1)
    write_gaussians(tmp_path / "a.ply", original)
    data = PlyData.read(tmp_path / "a.ply", mmap=False)
    data["vertex"]["x"][3], data["vertex"]["opacity"][4] = np.nan, np.inf  # An opacity of 1.
    data["vertex"]["scale_0"][5], data["vertex"]["scale_1"][5] = 300, -np.inf  # Drawn as the largest and smallest are.
    data.write(tmp_path / "b.ply")
    result = read_gaussians(tmp_path / "b.ply")
    assert result.count == 49 and "1 of 50" in logged[0] and result.log_scales[4, :2].tolist() == [20, -20]
    data["vertex"]["y"][:] = np.inf
    data.write(tmp_path / "c.ply")
    with pytest.raises(InputError, match="all of its Gaussians"):
        read_gaussians(tmp_path / "c.ply")
    text = (tmp_path / "a.ply").read_bytes().replace(b"f_rest_8", b"f_othe_8")
    (tmp_path / "d.ply").write_bytes(text)
    with pytest.raises(InputError, match=r"has 3.667 harmonics for each channel, not 1, 4, 9 or 16"):
        read_gaussians(tmp_path / "d.ply")
    foreign = (tmp_path / "a.ply").read_bytes().replace(b"color_model log", b"color_model hsv")
    (tmp_path / "e.ply").write_bytes(foreign)
    with pytest.raises(InputError, match="color model 'hsv'"):
        read_gaussians(tmp_path / "e.ply")
