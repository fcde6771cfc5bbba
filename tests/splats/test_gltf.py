"""glTF: layout, nodes and primitives, and what other writers make of them."""

import json
import struct

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.splats import read_gaussians, write_gaussians

from .samples import gaussians, node, package, rewrite

VALIDATE = """
const validator = require('gltf-validator'), file = require('fs').readFileSync(process.argv[1]);
validator.validateBytes(new Uint8Array(file)).then(report => console.log(JSON.stringify(report)));
"""


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


def test_glb_is_laid_out_as_the_extension_says(tmp_path):
    write_gaussians(tmp_path / "a.glb", gaussians(degree=1, color_model="display"))
    data = (tmp_path / "a.glb").read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    described = json.loads(data[20 : 20 + length])
    assert struct.unpack_from("<3I", data) == (0x46546C67, 2, len(data)) and length % 4 == 0
    primitive = described["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0 and described["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert primitive["extensions"]["KHR_gaussian_splatting"]["colorSpace"] == "srgb_rec709_display"
    names = {name.removeprefix("KHR_gaussian_splatting:") for name in primitive["attributes"]}
    harmonics = {"SH_DEGREE_0_COEF_0", *(f"SH_DEGREE_1_COEF_{n}" for n in range(3))}
    assert names == {"POSITION", "COLOR_0", "ROTATION", "SCALE", "OPACITY"} | harmonics
    assert all({"min", "max"} <= set(described["accessors"][i]) for i in [primitive["attributes"]["POSITION"]])


def test_glb_of_normalized_integers_and_strides_is_read(tmp_path):
    """Other writers quantize in this way."""
    write_gaussians(tmp_path / "a.glb", gaussians(2, 0, "display"))

    def quantize(described):
        opacity = described["meshes"][0]["primitives"][0]["attributes"]["KHR_gaussian_splatting:OPACITY"]
        described["accessors"][opacity] |= {"componentType": 5121, "normalized": True}
        view = {"buffer": 0, "byteOffset": described["buffers"][0]["byteLength"], "byteLength": 8, "byteStride": 4}
        described["bufferViews"][described["accessors"][opacity]["bufferView"]] = view

    rewrite(tmp_path / "a.glb", quantize, bytes([51, 0, 0, 0, 204, 0, 0, 0]))
    np.testing.assert_allclose(read_gaussians(tmp_path / "a.glb").opacities, [0.2, 0.8], rtol=1e-6)


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (("accessors", 0, "bufferView"), -1, "bufferViews has no -1"),
        (("accessors", 0, "sparse"), {"count": 1}, "accessor 0 is sparse"),
        (("buffers", 0, "uri"), "scene.bin", "buffer 0 is not in the file"),
        (("nodes",), [{"mesh": 0}] * 100_000, "Gaussians, more than its .* bytes"),
    ],
)
def test_glb_that_says_what_is_not_read_is_refused(tmp_path, place, value, words):
    write_gaussians(tmp_path / "a.glb", gaussians(degree=0, color_model="display"))

    def put(described):
        for key in place[:-1]:
            described = described[key]
        described[place[-1]] = value

    with pytest.raises(InputError, match=words):
        read_gaussians(rewrite(tmp_path / "a.glb", put))


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
