"""Files of Gaussians that take much or were made to do harm. Damaged ones are tests of their readers."""

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
from .hostile import CAMERA, DEEP, EITHER, NAN, REFUSED, case, put, tried

pytestmark = pytest.mark.trial
COLUMNS = [*"xyz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
COLUMNS += [f"rot_{i}" for i in range(4)]
ROW = struct.pack("<14f", 0.1, 0.2, 0.3, 0.1, 0.1, 0.1, 2, -2, -2, -2, 1, 0, 0, 0)


def ply(
    count: Any = 3, columns=COLUMNS, body: bytes = ROW * 3, kind="binary_little_endian 1.0", extra="", type="float"
):
    names = "".join(f"property {type} {name}\n" for name in columns)
    return f"ply\nformat {kind}\n{extra}element vertex {count}\n{names}end_header\n".encode() + body


def glb(nodes: Any = ({"mesh": 0},), fill: float = 0.5) -> bytes:
    """Two Gaussians as binary glTF."""
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
        "nodes": list(nodes), "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": offset}],
    }  # fmt: skip
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<5I", 0x46546C67, 2, 28 + len(text) + offset, len(text), 0x4E4F534A)
    return head + text + struct.pack("<2I", offset, 0x4E4942) + struct.pack("<f", fill) * (offset // 4)


def bomb() -> bytes:
    packer = zlib.compressobj(9, zlib.DEFLATED, 31)
    return b"".join(packer.compress(bytes(10**7)) for _ in range(30)) + packer.flush()


def spz(count=2, version=2, body: bytes | None = None) -> bytes:
    head = struct.pack("<IIIBBBB", 0x5053474E, version, count, 0, 12, 0, 0)
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


def usd(body="", meta="", degree=0) -> bytes:
    return f"""#usda 1.0
(
 defaultPrim = "A"
{meta})
def ParticleField3DGaussianSplat "A" {body} {{
 point3f[] positions = [(0,0,0)]
 float[] opacities = [0.5]
 quatf[] orientations = [(1,0,0,0)]
 float3[] scales = [(0.1,0.1,0.1)]
 uniform int radiance:sphericalHarmonicsDegree = {degree}
 float3[] radiance:sphericalHarmonicsCoefficients = [(0.1,0.1,0.1)]
}}
""".encode()


NESTED = [{"children": [i + 1]} for i in range(10_000)] + [{"mesh": 0}]
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
    case("ply, escapes as model", ".ply", partial(ply, extra="comment sehdr:color_model \x1b[31m<script>\n")),
    case("glb, nested nodes", ".glb", partial(glb, NESTED), codes=(0,)),
    case("glb of NaN", ".glb", partial(glb, fill=NAN)),
    case("glb, deep", ".glb", lambda: glb()[:20] + DEEP.encode()),
    case("glb, a chunk of 4 GiB", ".glb", lambda: glb()[:12] + b"\xff" * 4 + glb()[16:]),
    case("spz of 2^32 - 1", ".spz", partial(spz, 2**32 - 1, body=b"")),
    case("spz of 300 MB", ".spz", bomb),
    case("spz, version 77", ".spz", partial(spz, version=77)),
    case("spz of 100,000 parts", ".spz", lambda: spz() + gzip.compress(b"") * 100_000, codes=EITHER),
    *(
        case(f"sog, {place} = {value!s:.20}", ".sog", partial(sog, {place: value}))
        for place, value in (
            ("count", 2**40), ("means.files", ["/etc/passwd", "../x"]), ("scales.codebook", [0.0] * 10**6),
            ("sh0.files", ["http://127.0.0.1:9/a.webp"]),
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
    *(case(f"a page as {suffix}", suffix, lambda: b"<html>") for suffix in (".html", ".splat", ".ksplat", ".txt", "")),
]  # fmt: skip


@pytest.mark.parametrize(("suffix", "make", "codes"), SPLATS)
def test_splats(space, suffix, make, codes):
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
def test_places_of_splats(space, content, line, codes):
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
