import json
import re
import struct
from dataclasses import replace

import numpy as np
import pytest
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from sehdr_warp.errors import InputError
from sehdr_warp.output.world_transform import WorldTransform
from sehdr_warp.splats import SUFFIXES, GaussianArrays, path_is_lossy, read_gaussians, write_gaussians
from sehdr_warp.splats.arrays import join_gaussians

LOSSY_SUFFIXES = [suffix for suffix in SUFFIXES if path_is_lossy(f"a{suffix}")]
ARRAYS = ("means", "log_scales", "opacity_logits", "harmonics", "unit_quaternions")


def gaussians(count=50, degree=3, color_model="log", seed=0) -> GaussianArrays:
    random = np.random.default_rng(seed)
    harmonics = 0.3 * random.normal(size=(count, (degree + 1) ** 2, 3))
    harmonics[:, 0] -= 2
    shapes = ((count, 3), (count, 3), (count, 4), (count,))
    arrays = (random.normal(size=shape).astype(np.float32) for shape in shapes)
    return GaussianArrays(*arrays, harmonics.astype(np.float32), color_model, 0.5)


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


def test_positions_stay_precise_in_map_coordinates():
    near, moved = gaussians(), np.array([5e5, 5.4e6, 100.0])
    matrix = np.eye(4)
    matrix[:3, 3] = moved
    far = near.transformed(matrix)
    np.testing.assert_allclose(far.means - moved, near.means, atol=1e-8)
    assert near.transformed(np.eye(4)).means.dtype == np.float32


def test_a_far_sky_does_not_make_the_positions_of_a_scene_coarse(tmp_path, logged):
    """float32 moves Gaussians of the sky by 0.01 of the others' size, and by 1e-5 of their own."""
    near, matrix = gaussians(), np.eye(4)
    near = replace(near, log_scales=np.full((50, 3), np.log(0.005), np.float32))
    sky = replace(near, means=400 * near.means, log_scales=np.full((50, 3), np.log(4), np.float32))
    matrix[:3, :3] = Rotation.from_euler("xyz", [0.1, 0.2, 0.3]).as_matrix()
    turned = join_gaussians([*[near] * 12, sky]).transformed(matrix)
    write_gaussians(tmp_path / "a.ply", turned)
    assert turned.means.dtype == np.float32 and not any("too large for the float32" in line for line in logged)


def test_a_base_time_of_numpy_is_read_again(tmp_path):
    for name in ("a.ply", "a.compressed.ply", "a.sog", "a.glb"):
        write_gaussians(tmp_path / name, replace(gaussians(color_model="display"), base_time=np.float32(0.5)))
        assert read_gaussians(tmp_path / name).base_time == 0.5


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


def test_usd_states_the_extent_of_what_is_drawn(tmp_path):
    """Along its own axes, down to an opacity of 1/255: what viewers frame and cull by. Faint Gaussians do not count."""
    Usd = pytest.importorskip("pxr.Usd")
    written = gaussians(2, color_model="linear")
    turned = np.float32([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])  # A quarter about Z: the long axis is X.
    values = {
        "means": np.float32([[0, 0, 0], [9, 0, 0]]), "log_scales": np.log(np.float32([[0.1, 2, 0.3], [300, 300, 300]])),
        "quaternions": np.stack([turned, turned]), "opacity_logits": np.float32([0, -3.5]),
    }  # fmt: skip
    write_gaussians(tmp_path / "a.usdc", replace(written, **values))
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    reach = np.sqrt(2 * np.log(255 * 0.5)) * np.array([2, 0.1, 0.3])
    extent = np.array(stage.GetDefaultPrim().GetAttribute("extent").Get())
    np.testing.assert_allclose(extent, [-reach, reach], rtol=1e-5)

    values["opacity_logits"] = np.float32([-3.5, -3.5])
    write_gaussians(tmp_path / "b.usdc", replace(written, **values))
    stage = Usd.Stage.Open(str(tmp_path / "b.usdc"))
    assert np.ptp(np.array(stage.GetDefaultPrim().GetAttribute("extent").Get()), axis=0).min() > 600, "all are faint"


def test_usd_is_of_the_schema_and_tagged(tmp_path):
    Usd, UsdVol = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdVol")
    UsdValidation = pytest.importorskip("pxr.UsdValidation")
    written = gaussians(color_model="linear")
    write_gaussians(tmp_path / "a.usda", written)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    splat = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    assert Usd.ColorSpaceAPI(splat).GetColorSpaceNameAttr().Get() == "lin_rec709_scene"
    assert splat.GetRadianceSphericalHarmonicsCoefficientsAttr().GetMetadata("elementSize") == 16
    # A color is max(sum + 0.5, 0), as in 3DGS: the constant term says so.
    constant = np.array(splat.GetRadianceSphericalHarmonicsCoefficientsAttr().Get()).reshape(-1, 16, 3)[:, 0]
    np.testing.assert_allclose(constant * 0.28209479 + 0.5, written.harmonics[:, 0] * 0.28209479, atol=1e-6)
    np.testing.assert_allclose(splat.GetScalesAttr().Get(), np.exp(written.log_scales), rtol=1e-5)
    result = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators()).Validate(
        stage
    )
    assert [str(error.GetMessage()) for error in result] == []


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


def test_glb_of_normalized_integers_and_strides_is_read(tmp_path):
    """As other writers quantize."""
    write_gaussians(tmp_path / "a.glb", gaussians(2, 0, "display"))

    def quantize(described):
        opacity = described["meshes"][0]["primitives"][0]["attributes"]["KHR_gaussian_splatting:OPACITY"]
        described["accessors"][opacity] |= {"componentType": 5121, "normalized": True}
        view = {"buffer": 0, "byteOffset": described["buffers"][0]["byteLength"], "byteLength": 8, "byteStride": 4}
        described["bufferViews"][described["accessors"][opacity]["bufferView"]] = view

    rewrite(tmp_path / "a.glb", quantize, bytes([51, 0, 0, 0, 204, 0, 0, 0]))
    np.testing.assert_allclose(read_gaussians(tmp_path / "a.glb").opacities, [0.2, 0.8], rtol=1e-6)


def test_ply_of_others(tmp_path, shared, logged):
    folder = shared / "data" / "splats"
    read = read_gaussians(folder / "plush_dog_point_cloud_29999_clean.ply")
    assert (read.count, read.degree, read.color_model) == (15105, 3, "display")
    if (folder / "handmade_minimal.usda").is_file():
        pytest.importorskip("pxr")
        minimal = read_gaussians(folder / "handmade_minimal.usda")
        assert minimal.count == 2 and minimal.harmonics[1, 0, 0] > 10


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


def test_ply_larger_than_the_memory_is_refused_unread(tmp_path, monkeypatch):
    write_gaussians(tmp_path / "a.ply", gaussians(degree=0, color_model="display"))
    monkeypatch.setattr("sehdr_warp.splats.ply.available_memory", lambda: 1000)
    with pytest.raises(InputError, match="GB of memory to read"):
        read_gaussians(tmp_path / "a.ply")


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_refused_in_one_line(tmp_path, name):
    if name.endswith(".usda"):
        pytest.importorskip("pxr")
    data, words = BAD[name]
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=words):
        read_gaussians(tmp_path / name)


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


@pytest.mark.parametrize("matrix", [np.diag([0, 0, 0, 1]), np.diag([1, 1, 1.0003, 1]), np.diag([1, 1, -1, 1])])
def test_a_transform_that_cannot_be_undone_is_refused_as_the_file_is_read(tmp_path, matrix):
    """Files with a matrix that is no similarity are refused when they are read, not when they are placed."""
    write_gaussians(tmp_path / "a.ply", replace(gaussians(5), world_matrix=matrix.astype(float)))
    with pytest.raises(InputError, match=r"a\.ply: its world_matrix (does not keep|is not)"):
        read_gaussians(tmp_path / "a.ply")


@pytest.mark.parametrize("scale", [1e6, 1e-6])
def test_the_largest_scales_of_an_export_are_read_again_and_undone(tmp_path, scale):
    matrix = np.eye(4)
    matrix[:3, :3] = scale * Rotation.from_euler("xyz", [1.1, 0.4, 2.3]).as_matrix()
    for part, world in ((1, matrix), (2, matrix @ matrix)):  # Exported, and exported again
        write_gaussians(tmp_path / f"{part}.ply", replace(gaussians(5), world_matrix=world))
        read = read_gaussians(tmp_path / f"{part}.ply")
        undone = WorldTransform.from_matrix(read.world_matrix).inverse().matrix @ world
        np.testing.assert_allclose(undone, np.eye(4), atol=1e-9)


@pytest.mark.parametrize("comment", ["world_matrix [[1, 2]", "world_matrix [1]", "world_matrix [1" + 400 * "0" + "]"])
def test_a_transform_that_is_no_matrix_is_named_in_plain_words(tmp_path, comment):
    write_gaussians(tmp_path / "a.ply", replace(gaussians(5), world_matrix=np.diag([2.0, 2, 2, 1])))
    content = re.sub(rb"world_matrix .*", comment.encode(), (tmp_path / "a.ply").read_bytes(), count=1)
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(InputError, match="its world_matrix is not an affine 4 x 4 matrix; leave"):
        read_gaussians(tmp_path / "a.ply")
