"""Bad data, flags and configs through the command line: one clear line, status 1, nothing written."""

import json
import re
import struct
import zlib

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from sehdr_warp import load_scene
from sehdr_warp.scene.images.hdr_files import read_hdr

from ..make_scenes import edited_json, png_of, write_blender, write_colmap
from ..refusals import call, train_refused


@pytest.fixture
def frames(tmp_path):
    write_blender(tmp_path / "data")
    return tmp_path / "data"


def png_bomb(width: int, height: int) -> bytes:
    """A PNG file of a few bytes that states a huge size."""
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    pixels = zlib.compress(b"\0" * 1000)
    return png_of((b"IHDR", header), (b"IDAT", pixels), (b"IEND", b""))


# ---------------------------------------------------------------------------------------------------- data folders


@pytest.mark.parametrize("preset", ["truth", "hdr-gs-truth", "paper-truth"])
def test_photos_without_truth_are_refused_before_a_response_is_chosen(data, capfd, monkeypatch, preset):
    monkeypatch.setattr("sehdr_warp.scene.load.choose_response", lambda *_: pytest.fail("chose a response"))
    line = train_refused(capfd, data, "--preset", preset)
    assert "data: no training view has the HDR truth that loss.hdr_" in line and "a preset that needs none" in line


def test_folders_without_a_scene(tmp_path, capfd):
    (tmp_path / "empty").mkdir()
    (tmp_path / "text").mkdir()
    (tmp_path / "text" / "readme.md").write_text("photos to come")
    (tmp_path / "file").write_text("x")
    for name, photos in (("one", "a"), ("two", "ab")):
        (tmp_path / name).mkdir()
        for level, photo in enumerate(photos):  # Photos of the same bytes count as copies.
            Image.fromarray(np.full((8, 8, 3), 90 + level, np.uint8)).save(tmp_path / name / f"{photo}.png")
    write_blender(tmp_path / "blender", count=1)
    for name, words in {
        "nowhere": "not found",
        "empty": "empty",
        "text": "no photos",
        "file": "not a folder",
        "one": "only photo",
        "two": "): depth and light cannot be told apart",
        "blender": "has 1 view",
    }.items():
        line = train_refused(capfd, tmp_path / name)
        assert name in line and words in line


COLMAP_TEXT = {
    "cameras empty": ("cameras.txt", lambda text: "", "cameras.txt"),
    "images empty": ("images.txt", lambda text: "", "images.txt"),
    "images without entries": ("images.txt", lambda text: "# none\n", "no registered views"),
    "cameras truncated": ("cameras.txt", lambda text: text[:-12], "cameras.txt"),
    "not text": ("images.txt", lambda text: "\x00\xff\xfe" * 50, "images.txt"),
    "poses NaN": (
        "images.txt",
        lambda text: re.sub(r"(?m)^(\d+)( \S+){4}(?=.*png)", r"\1 nan 0 0 0", text),
        "not finite",
    ),
    "leaves within": ("images.txt", lambda text: text.replace("000.png", "b/../../a.png"), "'..'"),
    "unknown camera": ("images.txt", lambda text: text.replace(" 1 000.png", " 9 000.png"), "camera 9"),
    "huge camera": ("cameras.txt", lambda text: text.replace(" 64 48 ", " 999999999 48 "), "999999999"),
    "negative focal length": ("cameras.txt", lambda text: text.replace(" 50 ", " -50 "), "cameras.txt"),
    "infinite focal length": ("cameras.txt", lambda text: text.replace(" 50 ", " inf "), "cameras.txt"),
    "other size": ("cameras.txt", lambda text: text.replace(" 64 48 ", " 48 64 "), "64 x 48"),
    "unknown model": ("cameras.txt", lambda text: text.replace("PINHOLE", "PERSPEX"), "PERSPEX"),
    "point in words": ("points3D.txt", lambda text: re.sub(r"(?m)^1 \S+", "1 far", text), "points3D.txt"),
}


@pytest.mark.parametrize("case", COLMAP_TEXT)
def test_colmap_text(data, capfd, case):
    name, change, words = COLMAP_TEXT[case]
    path = data / "sparse" / "0" / name
    before = path.read_text()
    path.write_text(change(before), encoding="latin-1")
    assert path.read_bytes() != before.encode()
    assert words in train_refused(capfd, data)


@pytest.mark.parametrize(
    ("quaternion", "words"), [("nan 0 0 0", "is not finite"), ("0 0 0 0", "quaternion of '000.png'")]
)
def test_an_image_without_a_usable_pose_is_left_out(data, quaternion, words):
    path = data / "sparse" / "0" / "images.txt"
    path.write_text(re.sub(r"(?m)^1( \S+){4}", f"1 {quaternion}", path.read_text()))
    scene = load_scene(data, response="srgb")
    assert any("1 of 6 photos" in note and words in note for note in scene.notes) and len(scene.views) == 5


@pytest.mark.parametrize("name", ["/etc/passwd", "C:\\x.png", "../../etc/passwd"])
def test_a_name_outside_is_that_of_a_missing_photo(data, name):
    """Copied sets state them; what lies outside of a set is never read."""
    path = data / "sparse" / "0" / "images.txt"
    path.write_text(path.read_text().replace("000.png", name))
    scene = load_scene(data, response="srgb")
    assert f"1 image of the model is missing and was left out: {name!r}" in scene.notes
    assert name not in {str(view.source) for view in scene.views}


def put(at: int, layout: str, *values):
    """Return a function that packs values over a file's bytes from `at` on."""
    new = struct.pack(layout, *values)
    return lambda content: content[:at] + new + content[at + len(new) :]


def observations(content: bytes) -> bytes:
    return put(content.index(b"000.png") + 8, "<Q", 2**61)(content)


PICKLE = b"cos\nsystem\n(S'id'\ntR."
COLMAP_BINARY = {
    "cameras truncated": ("cameras.bin", lambda content: content[:20], "cameras.bin"),
    "cameras empty": ("cameras.bin", lambda content: b"", "empty"),
    "images truncated": ("images.bin", lambda content: content[: len(content) // 2], "or train on the folder"),
    "huge camera count": ("cameras.bin", put(0, "<Q", 2**60), "count"),
    "huge image count": ("images.bin", put(0, "<Q", 2**63 + 5), "count"),
    "huge point count": ("points3D.bin", put(0, "<Q", 2**40), "count"),
    "huge track": ("points3D.bin", put(8 + 43, "<Q", 2**61), "count"),
    "unterminated name": ("images.bin", lambda c: c[: c.index(b"000.png")] + b"a" * 9000, "no end within"),
    "huge count of observations": ("images.bin", observations, "count"),
    "no images": ("images.bin", put(0, "<Q", 0), "no registered views"),
    "name leaves": ("images.bin", lambda content: content.replace(b"000.png", b"a/../../p"), "'..'"),
    "images are a pickle": ("images.bin", lambda content: b"\x80\x04\x95" + PICKLE * 9, "images.bin"),
    "unknown camera model": ("cameras.bin", put(12, "<i", 77), "77"),
}


@pytest.mark.parametrize("case", COLMAP_BINARY)
def test_colmap_binary(tmp_path, capfd, case):
    name, change, words = COLMAP_BINARY[case]
    write_colmap(tmp_path / "data", binary=True)
    path = tmp_path / "data" / "sparse" / "0" / name
    path.write_bytes(change(path.read_bytes()))
    assert words in train_refused(capfd, tmp_path / "data")


def _truth(data, value=0.5):
    import OpenEXR

    pixels = np.full((48, 64, 3), 0.5, np.float32)
    pixels[7, 3, 1] = value
    (data / "hdr").mkdir(exist_ok=True)
    path = data / "hdr" / "001.exr"
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": pixels}) as file:
        file.write(str(path))
    return path


def _huge_window(path):
    """Corners of dataWindow and displayWindow, each an int32 after its name, type and length."""
    content = bytearray(path.read_bytes())
    for name in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
        start = content.index(name) + len(name) + 4
        content[start : start + 16] = struct.pack("<4i", -(2**30), -(2**30), 2**30, 2**30)
    path.write_bytes(content)


def photo(content):
    """Return a function that replaces one photo by bytes, or by a function of its own bytes."""

    def change(data):
        path = data / "images" / "002.png"
        path.write_bytes(content(path.read_bytes()) if callable(content) else content)

    return change


ODD_PHOTOS = {
    "empty": (photo(b""), "002.png"),
    "truncated": (photo(lambda content: content[:900]), "002.png"),
    "a pickle": (photo(PICKLE), "002.png"),
    "a bomb": (photo(png_bomb(100_000, 100_000)), "100000 x 100000"),
    "a bomb of stated size": (photo(png_bomb(64, 48)), "002.png"),
    "another size": (lambda data: Image.new("RGB", (30, 40), "grey").save(data / "images" / "002.png"), "30 x 40"),
}


@pytest.mark.parametrize("case", ODD_PHOTOS)
def test_an_odd_photo_is_left_out_and_named(data, case):
    change, words = ODD_PHOTOS[case]
    change(data)
    scene = load_scene(data, response="srgb")
    assert [view.name for view in scene.views] == ["000", "001", "003", "004", "005"]
    (note,) = (note for note in scene.notes if "1 of 6 photos cannot be used and were left out" in note)
    assert words in note


PHOTOS = {
    "truth with NaN": (lambda data: _truth(data, np.nan), "x=3, y=7"),
    "truth with infinity": (lambda data: _truth(data, np.inf), "x=3, y=7"),
    "truth truncated": (lambda data: (path := _truth(data)).write_bytes(path.read_bytes()[:-100]), "001.exr"),
    "truth empty": (lambda data: _truth(data).write_bytes(b""), "001.exr"),
    "truth of huge windows": (lambda data: _huge_window(_truth(data)), "001.exr"),
    "truth is no OpenEXR": (lambda data: _truth(data).write_bytes(b"\x76\x2f\x31\x01" + b"\xff" * 64), "001.exr"),
    "no folder of photos": (lambda data: (data / "images").rename(data.parent / "photos"), "images: folder not found"),
    "no photos": (lambda data: [path.unlink() for path in (data / "images").iterdir()], "none of the model's 6"),
}


@pytest.mark.parametrize("case", PHOTOS)
def test_photos(data, capfd, case):
    change, words = PHOTOS[case]
    change(data)
    assert words in train_refused(capfd, data)


def test_photos_of_noise_have_no_poses(tmp_path, capfd):
    (tmp_path / "noise").mkdir()
    for i in range(3):
        noise = np.random.default_rng(i).integers(0, 256, (60, 80, 3), dtype=np.uint8)
        Image.fromarray(noise).save(tmp_path / "noise" / f"{i}.png")
    line = train_refused(capfd, tmp_path / "noise")
    assert "none of the 3 photos could be placed" in line
    assert [path.name for path in tmp_path.iterdir()] == ["noise"]


def test_exposure_times_of_zero_in_exif_count_as_none(tmp_path):
    write_colmap(tmp_path / "data", name="{:03d}.jpg", exif={i: {33434: IFDRational(0, 1)} for i in range(6)})
    assert not load_scene(tmp_path / "data", response="srgb").exposure_times_known


@pytest.mark.parametrize(
    "flag, value, words",
    [
        ("--exposure-index", "3", "exposure index 3"),
        ("--max-size", "0", "0 pixels"),
        ("--max-size", "-5", "-5"),
        ("--preset", ".", "."),
    ],
)
def test_values_that_cannot_be(data, capfd, flag, value, words):
    assert words in train_refused(capfd, data, flag, value)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e300, "x", None, "stretched", "mirrored", "no axis"])
def test_a_frame_without_a_place_is_left_out(frames, value):
    with edited_json(frames / "transforms.json") as values:
        matrix = values["frames"][2]["transform_matrix"]
        if value in ("stretched", "mirrored", "no axis"):
            factors = {"stretched": (2, 1, 1), "mirrored": (-1, 1, 1), "no axis": (float("nan"), 1, 1)}[value]
            values["frames"][2]["transform_matrix"] = [[*np.multiply(row[:3], factors), row[3]] for row in matrix]
        else:
            matrix[0][3] = value
    scene = load_scene(frames)
    assert "r_2" not in {view.name for view in scene.views} and any("r_2" in note for note in scene.notes)


PLY_HEADER = "ply\nformat binary_little_endian 1.0\nelement vertex {}\n" + "".join(
    f"property float {axis}\n" for axis in "xyz"
)
PLY = {
    "absurd count": PLY_HEADER.format(10**15).encode() + b"end_header\n" + b"\0" * 24,
    "negative count": PLY_HEADER.format(-4).encode() + b"end_header\n",
    "truncated": PLY_HEADER.format(9).encode() + b"end_header\n" + b"\0" * 24,
    "no end": PLY_HEADER.format(9).encode(),
    "not PLY": b"\x80\x04 no points here",
    "a list of absurd length": b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list int float x\nend_header\n"
    b"2000000000 1\n",
}


@pytest.mark.parametrize("case", PLY)
def test_points_of_a_ply_file(frames, capfd, case):
    values = json.loads((frames / "transforms.json").read_text()) | {"ply_file_path": "points.ply"}
    (frames / "transforms.json").write_text(json.dumps(values))
    (frames / "points.ply").write_bytes(PLY[case])
    assert "points.ply" in train_refused(capfd, frames)


# ------------------------------------------------------------------------------------------------ flags and configs


def test_photos_reduced_to_a_pixel_train_and_render(data, tmp_path, capfd):
    out = data.parent / "run"
    flags = ("--iterations", "2", "--device", "cpu", "--max-size", "1", "-q")
    assert call("train", data, "--out", out, *flags) == 0
    assert call("render", out, "--out", tmp_path / "views", "--cameras", "train", "--device", "cpu", "-q") == 0
    pictures = [read_hdr(path) for path in (tmp_path / "views" / "hdr").glob("*.exr")]
    assert pictures and all(picture.shape == (1, 1, 3) and np.isfinite(picture).all() for picture in pictures)
