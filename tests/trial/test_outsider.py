"""Cases of somebody who had seen neither the program's sources nor this trial: what was sent to a user, and odd places.

Each says what it expects: a refusal in one line, or, under EITHER, that line or the right result.
"""

import gzip
import json
import os
import struct
import zipfile
import zlib
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from .harness import call
from .hostile import SHORT, tried

pytestmark = pytest.mark.trial
REFUSED, EITHER = (1, 2), (0, 1)
NAN, FAR = float("nan"), 1e300
RENDER = "render run --out new --cameras test --size 8x8 --device cpu"
STATE = "checkpoints/iteration_00000024/state.safetensors"
DEEP = "[" * 100_000
IDENTITY = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]
CAMERA = {"name": "c", "width": 8, "height": 8, "fx": 9, "fy": 9, "cx": 4, "cy": 4, "world_to_camera": IDENTITY}


def case(name: str, *values: Any, codes: tuple[int, ...] = REFUSED):
    return pytest.param(*values, codes, id=name[:60])


def put(path: Path, content: Any) -> None:
    """Write bytes, text or JSON to a file, or make one of another kind: `fifo`, `zero`, `folder`, `sparse`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    kinds = {"fifo": os.mkfifo, "zero": lambda place: place.symlink_to("/dev/zero"), "folder": os.mkdir}
    if isinstance(content, str) and content in kinds:
        kinds[content](path)
    elif isinstance(content, bytes):
        path.write_bytes(content)
    else:
        text = content if isinstance(content, str) else json.dumps(content)
        path.write_bytes(text.encode("utf-8", "surrogatepass"))


# Splats

COLUMNS = [*"xyz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
COLUMNS += [f"rot_{i}" for i in range(4)]
ROW = struct.pack("<14f", 0.1, 0.2, 0.3, 0.1, 0.1, 0.1, 2, -2, -2, -2, 1, 0, 0, 0)


def ply(
    count: Any = 3, columns=COLUMNS, body: bytes = ROW * 3, kind="binary_little_endian 1.0", extra="", type="float"
):
    names = "".join(f"property {type} {name}\n" for name in columns)
    return f"ply\nformat {kind}\n{extra}element vertex {count}\n{names}end_header\n".encode() + body


def glb(*place: Any, value: Any = None, fill: float = 0.5) -> bytes:
    """Two Gaussians as binary glTF, with another value at a place of the description."""
    shapes = {"POSITION": "VEC3", "COLOR_0": "VEC4"}
    shapes |= {f"KHR_gaussian_splatting:{name}": kind for name, kind in (("ROTATION", "VEC4"), ("SCALE", "VEC3"))}
    shapes |= {"KHR_gaussian_splatting:OPACITY": "SCALAR", "KHR_gaussian_splatting:SH_DEGREE_0_COEF_0": "VEC3"}
    views, accessors, offset = [], [], 0
    for kind in shapes.values():
        length = 8 * {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[kind]
        accessors.append({"bufferView": len(views), "componentType": 5126, "count": 2, "type": kind})
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": length})
        offset += length
    extension = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"mode": 0, "attributes": {name: i for i, name in enumerate(shapes)}}
    tree: dict[str, Any] = {
        "meshes": [{"primitives": [primitive | {"extensions": {"KHR_gaussian_splatting": extension}}]}],
        "nodes": [{"mesh": 0}], "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": offset}],
    }  # fmt: skip
    at: Any = tree
    for key in place[:-1]:
        at = at[key]
    if place:
        at[place[-1]] = value
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<5I", 0x46546C67, 2, 28 + len(text) + offset, len(text), 0x4E4F534A)
    return head + text + struct.pack("<2I", offset, 0x4E4942) + struct.pack("<f", fill) * (offset // 4)


def bomb(head: bytes = b"", size: int = 300_000_000) -> bytes:
    packer = zlib.compressobj(9, zlib.DEFLATED, 31)
    return (
        packer.compress(head) + b"".join(packer.compress(bytes(10**7)) for _ in range(size // 10**7)) + packer.flush()
    )


def spz(count=2, version=2, degree=0, body: bytes | None = None) -> bytes:
    head = struct.pack("<IIIBBBB", 0x5053474E, version, count, degree, 12, 0, 0)
    return gzip.compress(head + (bytes(40 * 2) if body is None else body))


def webp(width=2, height=2) -> bytes:
    file = BytesIO()
    Image.new("RGBA", (width, height), (9, 9, 9, 252)).save(file, "WEBP", lossless=True)
    return file.getvalue()


def sog(changes: dict[str, Any] | None = None, files: dict[str, bytes] | None = None) -> bytes:
    levels = {"codebook": [0.0] * 256}
    meta: dict[str, Any] = {"version": 2, "count": 4, "quats": {"files": ["quats.webp"]}}
    meta["means"] = {"mins": [0, 0, 0], "maxs": [1, 1, 1], "files": ["means_l.webp", "means_u.webp"]}
    meta |= {"scales": levels | {"files": ["scales.webp"]}, "sh0": levels | {"files": ["sh0.webp"]}}
    for place, value in (changes or {}).items():
        part, _, name = place.partition(".")
        meta[part] = meta[part] | {name: value} if name else value
    names = ("means_l.webp", "means_u.webp", "scales.webp", "quats.webp", "sh0.webp")
    content: dict[str, Any] = {"meta.json": json.dumps(meta)} | dict.fromkeys(names, webp()) | (files or {})
    packed = BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in content.items():
            archive.writestr(name, data)
    return packed.getvalue()


def usd(body="", meta="", points="(0,0,0)", degree=0) -> bytes:
    return f"""#usda 1.0
(
 defaultPrim = "A"
{meta})
def ParticleField3DGaussianSplat "A" {body} {{
 point3f[] positions = [{points}]
 float[] opacities = [0.5]
 quatf[] orientations = [(1,0,0,0)]
 float3[] scales = [(0.1,0.1,0.1)]
 uniform int radiance:sphericalHarmonicsDegree = {degree}
 float3[] radiance:sphericalHarmonicsCoefficients = [(0.1,0.1,0.1)]
}}
""".encode()


NESTED = [{"children": [i + 1]} for i in range(10_000)] + [{"mesh": 0}]
ATTRIBUTES = ("meshes", 0, "primitives", 0, "attributes")
VIEW, ACCESSOR = ("bufferViews", 0), ("accessors", 0)
SPLATS = [
    *(case(f"ply of {n} vertices", ".ply", partial(ply, n)) for n in (2**40, -1, 10**30, "x", "")),
    case("ply of none", ".ply", partial(ply, 0, body=b"")),
    case("ply cut in its header", ".ply", lambda: ply()[:60]),
    case("ply header without lines, 60 MB", ".ply", lambda: b"ply\nformat " + b"a" * 60_000_000),
    case("ply of words", ".ply", partial(ply, body=b"a b c\n" * 3, kind="ascii 1.0")),
    case("ply, 10^6 digits", ".ply", lambda: ply(1, body=b"1" * 10**6 + b" 0" * 13, kind="ascii 1.0")),
    case("ply of NaN", ".ply", partial(ply, body=struct.pack("<f", NAN) * 42)),
    case("ply of 1e38", ".ply", partial(ply, body=struct.pack("<f", 1e38) * 42), codes=EITHER),
    case("ply, big endian", ".ply", partial(ply, kind="binary_big_endian 1.0"), codes=EITHER),
    case("ply of lists", ".ply", partial(ply, type="list uchar float")),
    case("ply, 100,000 columns", ".ply", lambda: ply(columns=[*COLUMNS, *(f"p{i}" for i in range(10**5))], body=b"")),
    case("ply, 1000 harmonics", ".ply", lambda: ply(columns=[*COLUMNS, *(f"f_rest_{i}" for i in range(1000))])),
    case("ply, 7 harmonics", ".ply", lambda: ply(columns=[*COLUMNS, *(f"f_rest_{i}" for i in range(7))])),
    case("ply, escapes as model", ".ply", partial(ply, extra="comment sehdr:color_model \x1b[31m<script>\n")),
    *(
        case(f"ply, base time {t[:9]}", ".ply", partial(ply, extra=f"comment sehdr:base_exposure_time {t}\n"))
        for t in ("nan", "-1", "0", "1e-320", "1e999", "1/0", "a" * 5000, "9" * 5000)
    ),
    *(
        case(f"ply, matrix {m[:9]}", ".ply", partial(ply, extra=f"comment sehdr:world_matrix {m}\n"))
        for m in ("nan " * 16, "1 " * 9, "x", "0 " * 16, "[" * 5000)
    ),
    *(
        case(f"glb, {'.'.join(map(str, place))} = {value!s:.20}", ".glb", partial(glb, *place, value=value))
        for place, value in (
            *(((*ACCESSOR, "count"), value) for value in (2**40, -1, "x", FAR, 0)),
            *(((*ACCESSOR, "bufferView"), value) for value in (-1, 99, "0", True)),
            *(((*VIEW, "byteOffset"), value) for value in (-8, 2**63, "x")),
            *(((*VIEW, "byteStride"), value) for value in (0, 1, -4, 2**40)),
            *(((*VIEW, "buffer"), value) for value in (-1, 1)),
            ((*ACCESSOR, "sparse"), {"count": 1}), ((*ACCESSOR, "componentType"), 9), ((*ACCESSOR, "type"), "MAT9"),
            *((("buffers", 0, "uri"), uri) for uri in ("file:///etc/passwd", "http://127.0.0.1:9/x", "../x", "data:,")),
            (("nodes", 0, "children"), [0]), (("nodes", 0, "matrix"), [NAN] * 16), (("nodes", 0, "scale"), [0, 0, 0]),
            (("nodes",), [{"mesh": 0}] * 200_000), (("nodes", 0, "mesh"), -1), (("meshes",), "abc"), (ATTRIBUTES, []),
            (("meshes", 0, "extras"), {"world_matrix": "x"}),
        )
    ),
    case("glb, nested nodes", ".glb", partial(glb, "nodes", value=NESTED), codes=(0,)),
    case("glb of NaN", ".glb", partial(glb, fill=NAN)),
    case("spz of 2^32 - 1", ".spz", partial(spz, 2**32 - 1, body=b"")),
    case("spz of 300 MB", ".spz", bomb),
    case("spz, version 77", ".spz", partial(spz, version=77)),
    case("spz, degree 200", ".spz", partial(spz, degree=200)),
    case("spz, cut", ".spz", lambda: spz()[:20]),
    case("spz of 100,000 parts", ".spz", lambda: spz() + gzip.compress(b"") * 100_000, codes=EITHER),
    *(
        case(f"sog, {place} = {value!s:.20}", ".sog", partial(sog, {place: value}))
        for place, value in (
            ("count", 2**40), ("count", -1), ("count", "x"), ("means.mins", [NAN] * 3), ("version", 9),
            ("means.files", ["/etc/passwd", "../x"]), ("sh0.files", ["http://127.0.0.1:9/a.webp"]),
            ("scales.codebook", [1, 2]), ("scales.codebook", [0.0] * 10**6), ("sh0.codebook", ["a"] * 256),
            ("shN", {"count": 10**9, "bands": 3, "codebook": [0.0] * 256, "files": ["quats.webp", "sh0.webp"]}),
        )
    ),
    case("sog, 64 million pixels", ".sog", lambda: sog(files={"means_l.webp": webp(16000, 4000)})),
    case("sog, another size", ".sog", lambda: sog(files={"quats.webp": webp(1, 1)})),
    case("sog, 500 MB of zeros", ".sog", lambda: sog(files={"quats.webp": bytes(500_000_000)})),
    case("sog, 200 MB of spaces", ".sog", lambda: sog(files={"meta.json": b" " * 200_000_000})),
    case("sog, names outside", ".sog", lambda: sog(files={"../../evil": b"x", "/tmp/evil": b"x"}), codes=EITHER),
    case("sog, deep", ".sog", lambda: sog(files={"meta.json": DEEP.encode()})),
    case("usd, a file outside", ".usda", partial(usd, meta=" subLayers = [@/etc/passwd@]\n"), codes=EITHER),
    case("usd, itself", ".usda", partial(usd, "(references = @x.usda@</A>)"), codes=EITHER),
    case("usd, a device", ".usda", partial(usd, "(payload = @/dev/zero@</A>)"), codes=EITHER),
    case("usd, degree 10^9", ".usda", partial(usd, degree=10**9)),
    case("usd, NaN", ".usda", partial(usd, points="(nan,0,0)")),
    case("usd, lengths differ", ".usda", partial(usd, points="(0,0,0),(1,1,1)")),
    case("usd, empty", ".usda", partial(usd, points="")),
    *(case(f"a page as {suffix}", suffix, lambda: b"<html>") for suffix in (".html", ".splat", ".ksplat", ".txt", "")),
]  # fmt: skip


@pytest.mark.parametrize(("suffix", "make", "codes"), SPLATS)
def test_splats_of_an_outsider(space, suffix, make, codes):
    put(space / f"x{suffix}", make())
    put(space / "cams.json", {"cameras": [CAMERA]})
    assert tried(space, f"render x{suffix} --cameras cams.json --out new --device cpu", codes).memory < 1500


@pytest.mark.parametrize(
    ("content", "line", "codes"),
    [
        case(f"{what}, {how}", content, line, codes=codes)
        for how, line, codes in (
            ("rendered", "render x.ply --cameras cams.json --out new", REFUSED),
            ("written over", "export run --out x.ply --kind hdr --overwrite", REFUSED),
            ("merged", "export run --out new.ply --kind hdr --merge x.ply", REFUSED),
        )
        for what, content in (("fifo", "fifo"), ("device", "zero"), ("folder", "folder"))
    ]
    + [case("30 GB without content", b"", "render x.ply --cameras cams.json --out new")],
)
def test_places_of_splats_of_an_outsider(space, content, line, codes):
    put(space / "x.ply", content or ply(500_000_000))
    if not content:
        os.truncate(space / "x.ply", 30 << 30)  # Nothing of it is on the disk.
    put(space / "cams.json", {"cameras": [CAMERA]})
    try:
        tried(space, f"{line} --device cpu", codes) if content else _refused_unread(space, line)
    finally:
        (space / "x.ply").unlink() if not (space / "x.ply").is_dir() else None


def _refused_unread(space: Path, line: str) -> None:
    ended = call(*line.split(), folder=space)
    assert ended.code == 1 and "GB of memory" in ended.err and ended.memory < 1500


# Cameras

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
            LENS.format("float horizontalAperture = 0"),
            "(\n startTimeCode = 0\n endTimeCode = 1e12\n)\n"
            + LENS.format("float focalLength.timeSamples = {0: 30, 1e12: 40}"),
        )
    ),
]  # fmt: skip


@pytest.mark.parametrize(("name", "content", "codes"), CAMERAS)
def test_cameras_of_an_outsider(space, name, content, codes):
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
def test_models_of_an_outsider(space, cameras, images, codes):
    put(space / "model" / "sparse" / "0" / "cameras.bin", cameras)
    put(space / "model" / "sparse" / "0" / "images.bin", images)
    model = space / "model"
    try:
        tried(space, "render files/a.glb --cameras model --out new --device cpu", codes)
    finally:
        os.rename(model, space.parent / "model")  # Nobody else waits for its pipe.


# Runs

VIEWS = ("views", 0)
FIELDS = [
    *(("scene.json", (*VIEWS, "camera", "width"), value) for value in (None, "a", [], {}, -1, 0, FAR, NAN, True, 2.5)),
    *(("scene.json", (*VIEWS, "camera", "fx"), value) for value in (NAN, 0, -1.0, "x")),
    *(("scene.json", (*VIEWS, "camera", "cx"), value) for value in (FAR, NAN)),
    ("scene.json", (*VIEWS, "camera", "world_to_camera"), [[1, 2], [3]]),
    ("scene.json", (*VIEWS, "camera", "world_to_camera"), [[NAN] * 4] * 4),
    ("scene.json", (*VIEWS, "camera", "world_to_camera"), [[1, 0, 0, FAR], *IDENTITY[1:]]),
    *(("scene.json", (*VIEWS, "name"), value) for value in ("../../x", "/x", "a/b", "..", "", "a\0b", "x" * 5000, 5)),
    *(("scene.json", (*VIEWS, "exposure_time"), value) for value in (0, -1, NAN, "1/2", None)),
    *(("run.json", ("base_time",), value) for value in (0, -1, NAN, "x", None)),
    *(("run.json", ("response",), value) for value in (None, 5, "x", {}, {"kind": "file", "path": "/dev/zero"})),
    *(("run.json", ("response",), {"kind": "analytic", "name": name}) for name in ("../x", "gamma-1e999", "gamma-0")),
    *(("run.json", ("normalization", "unit"), value) for value in (NAN, 0, -1, "x")),
    *(("run.json", ("up", "direction"), value) for value in ([NAN] * 3, [1], "y", [1, 0, 0, 0, 0])),
    *(("run.json", ("format",), value) for value in (99, -1, "3", None, 3.5, 10**30)),
    *(("config.json", ("model", "sh_degree"), value) for value in (-1, 9, 1e9, 10**12, "3", NAN)),
    ("config.json", ("__class__",), "os.system"),
]


def rehash(space: Path) -> None:
    """Make the hashes of a changed run fit: whoever sends a run can."""
    from sehdr_warp.errors import SehdrError
    from sehdr_warp.runs.run_folder import RunFolder

    file = (space / "run" / STATE).with_name("checkpoint.json")
    values = json.loads(file.read_text())
    try:
        values["run"] = RunFolder(space / "run").hashes()
    except SehdrError:  # Not even JSON
        return
    file.write_text(json.dumps(values))


@pytest.mark.parametrize(
    ("file", "place", "value", "codes"),
    [
        case(
            f"{file[:-5]}.{place[-1]} = {value!s:.24}", file, place, value, codes=EITHER if "name" in place else REFUSED
        )
        for file, place, value in FIELDS
    ],
)
def test_fields_of_a_run_of_an_outsider(space, file, place, value, codes):
    tree = at = json.loads((space / "run" / file).read_text())
    for key in place[:-1]:
        at = at.setdefault(key, {}) if isinstance(at, dict) else at[key]
    at[place[-1]] = value
    put(space / "run" / file, tree)
    rehash(space)
    tried(space, RENDER, codes)


RUN_FILES = ("config.json", "scene.json", "run.json", "plan.json", "summary.json", "metrics.jsonl", "extension.json")
RUN_FILES += ("confidence.safetensors", "orientation.json", "light_unit.json", "blocks.json")


@pytest.mark.parametrize("name", RUN_FILES)
@pytest.mark.parametrize("kind", ["fifo", "zero", "folder"])
@pytest.mark.parametrize("line", [RENDER, "compare run", "train --resume --out run --device cpu"])
def test_kinds_of_files_of_a_run_of_an_outsider(space, name, kind, line):
    put(space / "run" / name, kind)
    ended = tried(space, line, (1,))
    assert name in ended.err


TEXTS = (DEEP, "null", "{}" * 1000, '{"a":' * 900 + "1" + "}" * 900, b"\xff\xfe\x00{", "9" * 5000, "")


@pytest.mark.parametrize("name", ["run.json", "scene.json", "config.json", "summary.json", "plan.json"])
@pytest.mark.parametrize("number", range(len(TEXTS)))
def test_texts_of_a_run_of_an_outsider(space, name, number):
    put(space / "run" / name, TEXTS[number])
    reported = name in ("summary.json", "plan.json")
    line = "report run --out new --device cpu" if reported else RENDER
    tried(space, line, EITHER if reported and not TEXTS[number] else (1,))


def tensors(**changes: Any):
    """Another description of the checkpoint's means; `body` replaces the whole file."""

    def make(data: bytes) -> bytes:
        length = struct.unpack("<Q", data[:8])[0]
        header = json.loads(data[8 : 8 + length])
        header["gaussians.means"] |= changes
        text = json.dumps(header).encode()
        return struct.pack("<Q", len(text)) + text + data[8 + length :]

    return make


def filled(name: str, value: float):
    """The checkpoint with one value in all of a tensor."""

    def make(data: bytes) -> bytes:
        length = struct.unpack("<Q", data[:8])[0]
        first, last = json.loads(data[8 : 8 + length])[f"gaussians.{name}"]["data_offsets"]
        first, last = first + 8 + length, last + 8 + length
        return data[:first] + struct.pack("<f", value) * ((last - first) // 4) + data[last:]

    return make


TENSORS = [
    case("header of 2^63", lambda data: struct.pack("<Q", 2**63) + b"{}"),
    case("header of 90 MB", lambda data: struct.pack("<Q", 90_000_000) + bytes(90_000_000)),
    case("header, deep", lambda data: struct.pack("<Q", 100_000) + DEEP.encode() + data),
    case("a pickle", lambda data: b"\x80\x04\x8c\x05posix\x8c\x06system\x93\x8c\x08touch pw\x85R."),
    case("an archive", lambda data: b"PK\x03\x04" + bytes(1000)),
    case("empty", lambda data: b""),
    *(
        case(f"{name} = {value!s:.20}", tensors(**{name: value}))
        for name, value in (
            ("shape", [2**40, 2**40]), ("shape", [-1, 3]), ("shape", []), ("shape", "x"), ("dtype", "F64"),
            ("dtype", "\x1b[31mX"), ("dtype", "I32"), ("data_offsets", [10**12, 10**12 + 9]), ("data_offsets", [9, 3]),
        )
    ),
    *(
        case(f"{name} of {value}", filled(name, value), codes=EITHER if abs(value) < 1e39 else REFUSED)
        for name, value in (
            ("means", NAN), ("means", float("inf")), ("means", 1e38), ("log_scales", 88.0), ("log_scales", -3e38),
            ("opacity_logits", float("inf")), ("quaternions", 0.0), ("quaternions", NAN), ("harmonics_dc", 3e38),
            ("harmonics_dc", NAN), ("harmonics_rest", 1e20),
        )
    ),
]  # fmt: skip


@pytest.mark.parametrize(("make", "codes"), TENSORS)
def test_tensors_of_a_run_of_an_outsider(space, make, codes):
    import hashlib

    state = space / "run" / STATE
    state.write_bytes(make(state.read_bytes()))
    file = state.with_name("checkpoint.json")
    values = json.loads(file.read_text())
    put(file, values | {"sha256": hashlib.sha256(state.read_bytes()).hexdigest()})
    tried(space, RENDER, codes)


# Sets of photos

OUTSIDE = ("/etc/passwd", "../../etc/passwd", "http://127.0.0.1:9/a.png", "/dev/zero", "a\0b", "x" * 5000, 5, None)
SETS = [
    *((("frames", 0, "file_path"), value) for value in OUTSIDE),
    *((("frames", 0, "transform_matrix"), value) for value in ("abc", [[NAN] * 4] * 4, [[FAR] * 4] * 4)),
    *((("frames",), value) for value in ({}, [], 5)),
    *((("camera_angle_x",), value) for value in (NAN, 0, "x", 7)),
    *((("w",), value) for value in (-1, 10**12)),
]


@pytest.mark.parametrize(
    ("place", "value", "codes"), [case(f"{place[-1]} = {value!s:.20}", place, value) for place, value in SETS]
)
def test_sets_of_an_outsider(space, place, value, codes):
    tree = at = json.loads((space / "photos" / "transforms.json").read_text())
    for name in ("fl_x", "fl_y") if place[0] == "camera_angle_x" else ():
        tree.pop(name, None)
    for key in place[:-1]:
        at = at[key]
    at[place[-1]] = value
    put(space / "photos" / "transforms.json", tree)
    either = place[0] == "w" or place[-1] == "transform_matrix" or str(value).startswith(("http", "/"))  # Left out
    tried(space, SHORT, EITHER if either else codes)


@pytest.mark.parametrize("name", ["transforms.json", "exposures.json", "images/r_1.png"])
@pytest.mark.parametrize("kind", ["fifo", "zero", "folder"])
def test_kinds_of_files_of_a_set_of_an_outsider(space, name, kind):
    put(space / "photos" / name, kind)
    tried(space, SHORT, EITHER if name.startswith("images") else (1,))


TIMES = (
    '{"r_0.png": NaN}',
    '{"r_0.png": 0}',
    '{"r_0.png": -1}',
    '{"r_0.png": "1/0"}',
    '{"r_0.png": [1]}',
    "[]",
    "null",
)
TIMES += (DEEP, '{"r_0.png": 1e999}', '{"r_0.png": ' + "9" * 5000 + "}", '{"\\u001b[31mq": -1}', "")


@pytest.mark.parametrize("number", range(len(TIMES)))
def test_times_of_an_outsider(space, number):
    put(space / "photos" / "exposures.json", TIMES[number])
    tried(space, SHORT, EITHER if TIMES[number] == "[]" else (1,))


# Presets, responses and configs of color

PRESETS = (
    "base = \n", "a = " + DEEP, "a = " + "{b=" * 3000, 'base = "p.toml"', 'base = "../../../etc/passwd"',
    'base = "/dev/zero"', 'base = "default"\n[loss]\nssim_weight = nan',
    'base = "default"\n[schedule]\niterations = inf',
    'base = "default"\n[schedule]\niterations = ' + "9" * 30,
    'base = "default"\n[schedule]\niterations = ' + "9" * 5000,
    'base = "default"\n"\\u001b[31mx" = 1', 'base = "default"\n[__class__]\nx = 1', "base".encode("utf-16"),
    'base = "default"\n[loss]\nssim_weight = 1979-05-27', "fifo", "zero", "folder",
)  # fmt: skip


@pytest.mark.parametrize("number", range(len(PRESETS)))
def test_presets_of_an_outsider(space, number):
    put(space / "p.toml", PRESETS[number])
    try:
        tried(space, "config p.toml", (1, 2))
    finally:
        os.rename(space / "p.toml", space.parent / "p.toml")


CURVES = {
    "words.csv": "a,b\nc,d\n", "nan.csv": "0,0\nnan,nan\n1,1\n", "falling.csv": "0,1\n1,0\n", "one.csv": "0,0\n",
    "bytes.csv": bytes(range(256)) * 50, "long.csv": "0," + "1" * 10_000_000 + "\n", "deep.json": DEEP,
    "words.json": '{"exposure": ["a"], "encoded": {}}', "huge.cube": "LUT_1D_SIZE 1000000000\n0 0 0\n",
    "nan.cube": "LUT_1D_SIZE 2\nnan nan nan\n1 1 1\n", "flat.cube": "LUT_1D_SIZE 2\n0 0 0\n0 0 0\n",
    "garbage.mat": b"MATLAB 5.0 MAT-file" + bytes(109) + b"\0\x01IM" + bytes(range(256)) * 4,
    "hdf5.mat": b"\x89HDF\r\n\x1a\n" + bytes(500), "pickle.npy": b"\x93NUMPY\x01\0v\0{'descr': '|O'}cos\nsystem\n",
    "pipe.csv": "fifo", "device.csv": "zero", "folder.csv": "folder",
}  # fmt: skip


@pytest.mark.parametrize("name", CURVES)
def test_responses_of_an_outsider(space, name):
    put(space / name, CURVES[name])
    try:
        tried(space, SHORT.replace("srgb", name), (1, 2))
    finally:
        os.rename(space / name, space.parent / name)


LUTS = {
    "none.cube": None, "pipe.cube": "fifo", "device.cube": "zero", "huge.cube": "LUT_3D_SIZE 1000000000\n0 0 0\n",
    "below.cube": "LUT_3D_SIZE -1\n",
    "long.spi1d": "Version 1\nFrom 0 1\nLength 1000000000000\nComponents 1\n{\n0\n}\n",
    "garbage.icc": "x" * 200, "broken.csp": "CSPLUTV100\n3D\n\n99999999\n", "pipe.clf": "fifo",
    "laughs.clf": '<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "' + "A" * 1000 + '">'
    + "".join(f'<!ENTITY a{i} "{f"&a{i - 1 if i else str()};" * 10}">' for i in range(9))
    + ']><ProcessList id="a" compCLFversion="3">&a8;</ProcessList>',
}  # fmt: skip


@pytest.mark.parametrize("name", LUTS)
def test_luts_of_an_outsider(space, name):
    if LUTS[name] is not None:
        put(space / name, LUTS[name])
    put(space / "c.ocio", _CONFIG.format(name=name))
    try:
        tried(space, f"{RENDER} --ocio c.ocio --view v", (1,))
    finally:
        if LUTS[name] is not None:
            os.rename(space / name, space.parent / name)


_CONFIG = """ocio_profile_version: 2
search_path: "."
roles: {{default: raw, scene_linear: raw, aces_interchange: raw}}
displays:
  d:
    - !<View> {{name: v, colorspace: c}}
colorspaces:
  - !<ColorSpace>
    name: raw
  - !<ColorSpace>
    name: c
    from_scene_reference: !<FileTransform> {{src: {name}}}
"""


# Ranks, output

ALONE = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "29931", "SEHDR_RANK_TIMEOUT": "1", "LOCAL_WORLD_SIZE": "2"}
RANKS = [
    *({"RANK": rank, "WORLD_SIZE": "2"} for rank in ("x", "5", "-1", "", "1e3", "9" * 5000)),
    *({"RANK": "0", "WORLD_SIZE": count} for count in ("0", "-1", "x", "1000000000", "99999999999999999999")),
    *({"RANK": "0", "WORLD_SIZE": "2", "MASTER_PORT": port} for port in ("99999", "x", "0", "-1", "9" * 5000)),
    *({"RANK": "0", "WORLD_SIZE": "2", "SEHDR_RANK_TIMEOUT": time} for time in ("nan", "-1", "x", "inf", "1e300")),
    *({"RANK": "0", "WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": count} for count in ("0", "-2", "4")),
    *({"RANK": "0", "WORLD_SIZE": "2", "LOCAL_RANK": rank} for rank in ("2", "-1")),
    {"RANK": "0", "WORLD_SIZE": "2"},  # The other never comes.
]


@pytest.mark.parametrize("number", range(len(RANKS)))
def test_ranks_of_an_outsider(space, number):
    ended = tried(space, SHORT, (1,), prepare=lambda: os.environ.update(ALONE | RANKS[number]), seconds=30)
    assert "set" in ended.err or any(name in ended.err for name in (*ALONE, *RANKS[number])), ended.err


OUTPUTS = [
    *(
        case(f"list of the folder: {kind}", kind, "export run --out new.ply --kind hdr --overwrite")
        for kind in ("fifo", "zero", "folder")
    ),
    case("a flag of 100,000 letters", None, "render run --" + "x" * 100_000),
    *(
        case(f"to {place}", None, f"export run --kind hdr --overwrite --out {place}")
        for place in ("/dev/full", "/dev/null", "/proc/x.ply", "a" * 300 + ".ply", "a/" * 2500 + "x.ply", "run", "..")
    ),
    case("10^6 x 10^6 pixels", None, "render run --out new --size 1000000x1000000"),
    case("10^18 views", None, "render run --out new --cameras orbit --count 1000000000000000000"),
    case("10^9 pixels around", None, "envmap run --out new.exr --size 1000000000"),
    case("10^6 voxels", None, "mesh run --out new.obj --resolution 1000000"),
    case("a film of a URL", None, "render run --video http://127.0.0.1:9/o.mp4"),
    case("a film to a device", None, "render run --video /dev/full"),
    case("10^-300 frames a second", None, "render run --video new.mp4 --fps 1e-300"),
    case("stops of NaN", None, "render run --video new.mp4 --ev-ramp=nan:4"),
]


@pytest.mark.parametrize(("kind", "line", "codes"), OUTPUTS)
def test_output_of_an_outsider(space, kind, line, codes):
    mine = space / ".sehdr-warp"
    if kind is not None:
        put(mine, kind)
    try:
        tried(space, f"{line} --device cpu" if " --xx" not in line else line, codes)
    finally:
        if kind is not None:
            os.rename(mine, space.parent / "list")
