"""Files of cameras, and COLMAP models, that are damaged or were made to do harm."""

import os
import struct

import pytest

from .hostile import CAMERA, DEEP, EITHER, FAR, IDENTITY, NAN, case, put, tried

pytestmark = pytest.mark.trial
ROTATIONS = ([[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]], [[-1, 0, 0, 0], *IDENTITY[1:]])
INRIA = {"id": 0, "img_name": "a", "width": 8, "height": 8, "position": [0, 0, 0], "fx": 9, "fy": 9}
INRIA |= {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
FRAME = {"camera_to_world": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 4, 0, 0, 0, 1], "fov": 50}
PATH = {"render_height": 8, "render_width": 8, "seconds": 1, "fps": 24, "camera_path": [FRAME]}
SHOT = {"camera_angle_x": 0.8, "w": 8, "h": 8, "frames": [{"file_path": "a.png", "transform_matrix": IDENTITY}]}
LENS = 'def Camera "c" {{\n {}\n}}\n'
CAMERAS = [
    *(
        case(f"{name} = {value!s:.30}", "cams.json", {"cameras": [CAMERA | {name: value}]})
        for name, value in (
            *(("width", value) for value in (2_000_000, -3, 1.5, "48", None, True, 10**40, 0, NAN, FAR, [8])),
            *(("height", value) for value in (0, 2.5, False)),
            *(("fx", value) for value in (0, NAN, 1e308, 1e-320, "x")),
            *(("cx", value) for value in (FAR, NAN, -FAR)),
            *(("world_to_camera", value) for value in (5, [[1]], [["a"] * 4] * 4, *ROTATIONS, [[NAN] * 4] * 4)),
            ("world_to_camera", [[1, 0, 0, FAR], *IDENTITY[1:]]), ("world_to_camera", [*IDENTITY[:3], [5, 5, 5, 5]]),
            *(("name", value) for value in ("../../x", "/abs", "a\0b", "..", "", "a" * 300, "a/b", "\ud800")),
        )
    ),
    *(
        case(f"name {value!r:.20}", "cams.json", {"cameras": [CAMERA | {"name": value}]}, codes=EITHER)
        for value in ("\x1b[2J", "\u202egpj", " ", ".hidden", "a\nb", 5, None, ["x"])
    ),
    case("60000 x 60000", "cams.json", {"cameras": [CAMERA | {"width": 60000, "height": 60000}]}),
    case("two of one name", "cams.json", {"cameras": [CAMERA, CAMERA]}),
    case("10,000 of one name", "cams.json", {"cameras": [CAMERA] * 10_000}),
    *(case(f"cameras = {value}", "cams.json", {"cameras": value}) for value in ({}, [], 5, "x", [[]], [None])),
    *(
        case(f"text {text[:12]}", "cams.json", text)
        for text in (DEEP, "", "null", "5", '{"cameras": [], "cameras": 5}', '{"cameras": ' + "9" * 10**5 + "}")
    ),
    case("keys, one twice", "cams.json", "{" + ", ".join(f'"{i % 299_999}": 0' for i in range(300_000)) + "}"),
    *(case(kind, "cams.json", kind) for kind in ("fifo", "zero", "folder")),
    *(
        case(f"of 3DGS, {value!s:.40}", "cams.json", [INRIA | value])
        for value in ({"position": "abc"}, {"rotation": 3}, {"rotation": [[0] * 3] * 3}, {"width": 8.5}, {"fx": "x"})
    ),
    *(
        case(f"path, {name} = {value!s:.30}", "cams.json", PATH | {name: value})
        for name, value in (
            *(("camera_path", [FRAME | {"fov": fov}]) for fov in (0, 180, NAN, "x", -5)),
            ("camera_path", [FRAME | {"camera_to_world": [1] * 15}]), ("camera_path", "abc"), ("camera_path", []),
            *(("render_height", value) for value in (10**9, 0, 1.5, "8")),
        )
    ),
    *(
        case(f"transforms, {name} = {value!s:.30}", "transforms.json", SHOT | {name: value})
        for name, value in (
            *(("camera_angle_x", value) for value in (0, 7.0, NAN, "x")), ("frames", None), ("frames", 5),
            ("frames", [{"file_path": "a", "transform_matrix": [[NAN] * 4] * 4}]),
        )
    ),
    *(
        case(f"chan {text[:16]!r}", "x.chan", text)
        for text in (
            "1 0 0 0 0 0 0 0\n", "1 0 0 0 0 0 0 180\n", "nan " * 8, "1 2 3\n", "a b c d e f g h\n", "\0" * 1000, "",
            "1e999 0 0 0 0 0 0 50\n", "1 0 0 0 0 0 0 50\n" * 2, "1 1e200 0 0 0 0 0 50\n",
            "1 0 0 4 0 0 0 50\n" * 300_000,
        )
    ),
    *(
        case(f"usd, {text[:40]}", "c.usda", "#usda 1.0\n" + text)
        for text in (
            LENS.format("float focalLength = 0"), LENS.format("float focalLength = nan"), 'def Xform "a" {\n}\n',
            LENS.format("float horizontalAperture = 0"), "(\n metersPerUnit = 0\n)\n" + LENS.format(""),
            "(\n startTimeCode = 0\n endTimeCode = 1e12\n)\n"
            + LENS.format("float focalLength.timeSamples = {0: 30, 1e12: 40}"),
        )
    ),
]  # fmt: skip


@pytest.mark.parametrize(("name", "content", "codes"), CAMERAS)
def test_cameras(space, name, content, codes):
    put(space / name, content)
    tried(space, f"render files/a.glb --cameras {name} --out new --device cpu", codes)


COLMAP_CAMERA = struct.pack("<QiiQQ4d", 1, 1, 1, 8, 8, 9, 9, 4, 4)
COLMAP_IMAGE = struct.pack("<Qi7di", 1, 1, 1, 0, 0, 0, 0, 0, 4, 1) + b"a.png\0" + struct.pack("<Q", 0)
COUNT = struct.pack("<Q", 2**60)
COLMAP = [
    case("2^60 cameras", COUNT + COLMAP_CAMERA[8:], COLMAP_IMAGE),
    case("2^60 images", COLMAP_CAMERA, COUNT + COLMAP_IMAGE[8:]),
    case("2^60 points of an image", COLMAP_CAMERA, COLMAP_IMAGE[:-8] + COUNT),
    case("a name without end", COLMAP_CAMERA, COLMAP_IMAGE[:76] + b"a" * 3_000_000),
    case("an unknown model", struct.pack("<QiiQQ4d", 1, 1, 999, 8, 8, 9, 9, 4, 4), COLMAP_IMAGE),
    case("2^60 columns", struct.pack("<QiiQQ4d", 1, 1, 1, 2**60, 8, 9, 9, 4, 4), COLMAP_IMAGE),
    case("a focal length of NaN", struct.pack("<QiiQQ4d", 1, 1, 1, 8, 8, NAN, NAN, 4, 4), COLMAP_IMAGE),
    case("empty files", b"", b""),
    case("no rotation", COLMAP_CAMERA, struct.pack("<Qi7di", 1, 1, 0, 0, 0, 0, 0, 0, 4, 1) + COLMAP_IMAGE[72:]),
    case("another camera", COLMAP_CAMERA, struct.pack("<Qi7di", 1, 1, 1, 0, 0, 0, 0, 0, 4, 77) + COLMAP_IMAGE[72:]),
    case("a pipe", "fifo", COLMAP_IMAGE),
    case("a device", COLMAP_CAMERA, "zero"),
]


@pytest.mark.parametrize(("cameras", "images", "codes"), COLMAP)
def test_models(space, cameras, images, codes):
    put(space / "model" / "sparse" / "0" / "cameras.bin", cameras)
    put(space / "model" / "sparse" / "0" / "images.bin", images)
    model = space / "model"
    try:
        tried(space, "render files/a.glb --cameras model --out new --device cpu", codes)
    finally:
        os.rename(model, space.parent / "model")  # Nobody else waits for its pipe.
