"""Files of splats that were made to do harm."""

import gzip
import io
import json
import shutil
import struct
import zipfile
from pathlib import Path

import pytest
from PIL import Image

from tests.splats.ply_names import DEGREE_0_NAMES

from .hostile import MARKUP, tried

pytestmark = pytest.mark.trial


PLY_HEAD = "ply\nformat binary_little_endian 1.0\n"
SH = "".join(f"property float {name}\n" for name in DEGREE_0_NAMES)


def ply(head: str, body: bytes = bytes(14 * 4 * 3)):
    return lambda files: (PLY_HEAD + head + "end_header\n").encode() + body


def zipped(
    change=lambda meta: None, drop: str = "", extra: dict[str, bytes] | None = None, method=zipfile.ZIP_DEFLATED
):
    """A .sog with a changed description, without a part, or with further ones."""

    def make(files: Path) -> bytes:
        packed = io.BytesIO()
        with zipfile.ZipFile(files / "a.sog") as whole, zipfile.ZipFile(packed, "w", method) as archive:
            for name in whole.namelist():
                data = whole.read(name)
                if name == "meta.json":
                    meta = json.loads(data)
                    change(meta)
                    data = json.dumps(meta).encode()
                if name != drop and name not in (extra or {}):
                    archive.writestr(name, data)
            for name, data in (extra or {}).items():
                archive.writestr(name, data() if callable(data) else data)
        return packed.getvalue()

    return make


def webp(width: int, height: int) -> bytes:
    buffer = io.BytesIO()
    Image.new("RGBA", (width, height)).save(buffer, "WEBP", lossless=True)
    return buffer.getvalue()


def spz(count=3, version=3, degree=0, fraction=12, body=None, pack=True):
    def make(files: Path) -> bytes:
        head = struct.pack("<IIIBBBB", 0x5053474E, version, count, degree, fraction, 0, 0)
        data = head + (bytes(20 * 3) if body is None else body() if callable(body) else body)
        return gzip.compress(data) if pack else data

    return make


def described(change):
    """A .glb whose description was changed."""

    def make(files: Path) -> bytes:
        data = (files / "a.glb").read_bytes()
        length = struct.unpack_from("<I", data, 12)[0]
        tree, binary = json.loads(data[20 : 20 + length]), data[28 + length :]
        text = change(tree)
        text = json.dumps(tree).encode() if text is None else text
        text += b" " * (-len(text) % 4)
        head = struct.pack("<5I", 0x46546C67, 2, 28 + len(text) + len(binary), len(text), 0x4E4F534A)
        return head + text + struct.pack("<2I", len(binary), 0x4E4942) + binary

    return make


def usd(body: str):
    return lambda files: f'#usda 1.0\n(defaultPrim = "a" upAxis = "Y")\n{body}\n'.encode()


def set_in(*path, value):
    def change(tree):
        for key in path[:-1]:
            tree = tree[key]
        tree[path[-1]] = value

    return change


SPLATS = {
    "count of 10^12.ply": ply(f"element vertex {10**12}\n{SH}"),
    "count below 0.ply": ply(f"element vertex -3\n{SH}"),
    "no end.ply": lambda files: (PLY_HEAD + f"element vertex 3\n{SH}").encode() * 200,
    "list.ply": ply("element vertex 3\nproperty list uint int x\n" + SH, b"\xff" * 200),
    "header of 100 MB.ply": lambda files: PLY_HEAD.encode() + b"comment x\n" * 10_000_000,
    "same property twice.ply": ply(f"element vertex 3\n{SH}property float x\n"),
    "two elements.ply": ply(f"element a 4000000000\nproperty double q\nelement vertex 3\n{SH}"),
    "type of another.ply": ply(f"element vertex 3\n{SH}".replace("float x", "float128 x")),
    "text.ply": lambda files: (
        b"ply\nformat ascii 1.0\nelement vertex 3\n" + SH.encode() + b"end_header\n" + b"1 " * 1000
    ),
    "nan.ply": ply(f"element vertex 3\n{SH}", b"\xff" * 14 * 4 * 3),
    "huge.ply": ply(f"element vertex 3\n{SH}", struct.pack("<f", 3e38) * 42),
    "count of none.sog": zipped(set_in("count", value=0)),
    "count of many.sog": zipped(set_in("count", value=2**31)),
    "count of a text.sog": zipped(set_in("count", value="9" * 5000)),
    "codebook of nan.sog": zipped(set_in("scales", "codebook", value=[float("nan")] * 256)),
    "codebook of text.sog": zipped(set_in("sh0", "codebook", value="x" * 256)),
    "files above.sog": zipped(set_in("means", "files", value=["../../etc/passwd", "/etc/passwd"])),
    "version 1.sog": zipped(set_in("version", value=1)),
    "bands of 9.sog": zipped(
        set_in("shN", value={"bands": 9, "count": 1, "codebook": [0] * 256, "files": ["sh0.webp"] * 2})
    ),
    "no picture.sog": zipped(drop="quats.webp"),
    "no description.sog": zipped(drop="meta.json"),
    "picture of 16000.sog": zipped(extra={"quats.webp": lambda: webp(16000, 16000)}),
    "bomb.sog": zipped(extra={"zeros": lambda: bytes(200_000_000)}),
    "description of 60 MB.sog": zipped(extra={"meta.json": lambda: b" " * 60_000_000}),
    "deep.sog": zipped(extra={"meta.json": b"[" * 100_000}),
    "names above.sog": zipped(extra={"../PWNED": b"x", "/tmp/PWNED": b"x"}),
    "not zip.sog": lambda files: b"PK\5\6" + bytes(18),
    "a zip in front.sog": lambda files: (files / "a.sog").read_bytes() * 2,
    "world of nan.sog": zipped(set_in("sehdr", "world_matrix", value=[[float("nan")] * 4] * 4)),
    "count of many.spz": spz(count=49_999_999),
    "count of 2^32.spz": spz(count=2**32 - 1, pack=False),
    "degree 9.spz": spz(degree=9),
    "fraction 200.spz": spz(fraction=200),
    "version 9.spz": spz(version=9),
    "bomb.spz": spz(count=3, body=lambda: bytes(200_000_000)),
    "bomb that is asked for.spz": spz(count=20_000_000, body=lambda: bytes(300_000_000)),
    "cut.spz": lambda files: spz()(files)[:-9],
    "not packed.spz": spz(pack=False, body=b"\xff" * 60),
    "outside file.glb": described(set_in("buffers", value=[{"byteLength": 9, "uri": "../../../etc/passwd"}])),
    "url.glb": described(set_in("buffers", value=[{"byteLength": 9, "uri": "http://127.0.0.1:9/a"}])),
    "data of a gigabyte.glb": described(set_in("buffers", value=[{"byteLength": 1 << 30, "uri": "data:;base64,AAAA"}])),
    "no meshes.glb": described(set_in("meshes", value=[])),
    "nodes in a circle.glb": described(set_in("nodes", value=[{"children": [0], "mesh": 0}])),
    "nodes of a million.glb": described(
        set_in("nodes", value=[{"children": [n + 1]} for n in range(100_000)] + [{"mesh": 0}])
    ),
    "matrix of text.glb": described(set_in("nodes", value=[{"mesh": 0, "matrix": ["x"] * 16}])),
    "deep.glb": described(lambda tree: b"[" * 100_000),
    "accessors above.glb": described(set_in("accessors", value=[])),
    "chunk of 4 GiB.glb": lambda files: (
        (files / "a.glb").read_bytes()[:12] + b"\xff" * 4 + (files / "a.glb").read_bytes()[16:]
    ),
    "json alone.glb": lambda files: b'{"asset": {"version": "2.0"}}',
    "empty.glb": lambda files: b"",
    "reference outside.usda": usd('def "a" (references = @/etc/passwd@) {}'),
    "payload of a url.usda": usd('def "a" (payload = @http://127.0.0.1:9/a.usda@) {}'),
    "sublayer above.usda": lambda files: b"#usda 1.0\n(subLayers = [@../../../secret.usda@])\n",
    "itself.usda": usd('def "a" (references = @./b.usda@</a>) {}'),
    "clips.usda": usd('def "a" (clips = {dictionary default = {asset[] assetPaths = [@/etc/passwd@]}}) {}'),
    "deep.usda": usd('def "a" {' * 5000 + "}" * 5000),
    "array of many.usda": usd(f'def "a" {{ point3f[] positions = [{"(0,0,0)," * 100_000}] }}'),
    "names.usda": usd(f'def "a" {{ custom string x = "{MARKUP[2:]}" }}'),
    "variants.usda": usd(
        'def "a" (variants = {string v = "x"} prepend variantSets = "v") { variantSet "v" = { "x" '
        '{ def "b" (references = @/etc/passwd@) {} } } }'
    ),
    "header of others.compressed.ply": lambda files: (
        (files / "a.compressed.ply").read_bytes().replace(b"element vertex ", b"element vertex 9999999")
    ),
    "chunks of none.compressed.ply": lambda files: (
        (files / "a.compressed.ply").read_bytes().replace(b"element chunk 1", b"element chunk 0")
    ),
}


@pytest.mark.parametrize("name", SPLATS)
def test_splats_that_were_made(space, name):
    suffix = name[name.index(".") :] if name.endswith(".compressed.ply") else Path(name).suffix
    (space / f"b{suffix}").write_bytes(SPLATS[name](space / "files"))
    shutil.rmtree(space / "files")
    ended = tried(space, f"convert b{suffix} seen.ply")
    assert ended.code or "root:" not in (space / "seen.ply").read_text(errors="replace")
