"""Places, links, masks and copies in sets of photos, checkpoints, blocks and requests, made to do harm."""

import hashlib
import json
import os
import pickle
import shutil
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.output.exr import rgb_channels
from sehdr_warp.output.exr import write_exr as write_channels
from tests.make_scenes import pattern, write_colmap

from .harness import call
from .hostile import MARKUP, SHORT, gif_named, heic, link, png, tried
from .test_hostile_later import PLAN
from .test_requests import answer_to, got, posted, served  # noqa: F401 - a fixture

pytestmark = pytest.mark.trial


def write_exr(path: Path, values: np.ndarray) -> None:
    write_channels(path, rgb_channels(values))


TRAIN_SET = SHORT.replace(" -q", "")
EARTH = 6.371e6


def exif_of_place(table: dict[int, tuple[int, int, bytes]]) -> bytes:
    """EXIF of a place: type, count and bytes of each of its tags."""
    head = b"II*\0\x08\0\0\0" + struct.pack("<HHHIII", 1, 0x8825, 4, 1, 26, 0)
    entries, data, start = b"", b"", 26 + 2 + 12 * len(table) + 4
    for tag, (kind, count, value) in sorted(table.items()):
        place = value.ljust(4, b"\0") if len(value) <= 4 else struct.pack("<I", start + len(data))
        entries += struct.pack("<HHI", tag, kind, count) + place
        data += value if len(value) > 4 else b""
    return b"Exif\0\0" + head + struct.pack("<H", len(table)) + entries + bytes(4) + data


def doubles(*values: float) -> tuple[int, int, bytes]:
    return 12, len(values), struct.pack(f"<{len(values)}d", *values)


def place_photos(photos: Path, tags: dict[int, tuple[int, int, bytes]], scale: float = 10.0) -> None:
    """States a place in each photo, by its camera: `scale` meters a unit, and tags of EXIF that are others."""
    for frame in json.loads((photos / "transforms.json").read_text())["frames"]:
        path = photos / f"{frame['file_path'].removesuffix('.png')}.png"
        x, y, z = (scale * row[3] for row in frame["transform_matrix"][:3])
        table = {1: (2, 2, b"N\0" if y >= 0 else b"S\0"), 2: doubles(abs(np.degrees(y / EARTH)), 0, 0)}
        table |= {3: (2, 2, b"E\0" if x >= 0 else b"W\0"), 4: doubles(abs(np.degrees(x / EARTH)), 0, 0)}
        table |= {5: (1, 1, b"\0"), 6: doubles(z)}
        image = Image.open(path)
        image.load()
        image.save(path, exif=exif_of_place(table | tags))


PLACES = {
    "as they are": {},
    "altitude 1e308": {6: doubles(1e308)},
    "altitude -1e308": {6: doubles(-1e308)},
    "altitude nan": {6: doubles(float("nan"))},
    "altitude by 0": {6: (5, 1, bytes(8))},
    "altitude of a text": {6: (2, len(MARKUP), MARKUP.encode())},
    "latitude 91": {2: doubles(91, 0, 0)},
    "latitude of many": {2: doubles(*[1.0] * 9999)},
    "latitude of texts": {2: (2, 6, b"x,y,z\0")},
    "count of 2^32": {2: (12, 2**32 - 1, bytes(24))},
    "references of zeros": {1: (2, 5000, bytes(5000)), 3: (1, 1, b"\xff")},
    "all in one place": {},
    "a planet apart": {},
    "an atom apart": {},
}
SCALES = {"all in one place": 0.0, "a planet apart": 2.2e6, "an atom apart": 1e-8}


@pytest.mark.parametrize("name", PLACES)
def test_places_of_photos(space, name):
    """Whatever a photo says of its place, a run that was trained is one that can be read."""
    place_photos(space / "photos", PLACES[name], SCALES.get(name, 10.0))
    tried(space, TRAIN_SET, codes=(0,))
    tried(space, "render new --out seen --device cpu", codes=(0,))


UPS = {
    "1e308": [1e308, 1e308, 1e308],
    "1e-320": [1e-320, 0, 0],
    "zeros": [0, 0, 0],
    "1e300": [0, 1e300, 0],
}


@pytest.mark.parametrize("name", UPS)
def test_ups_of_a_run(space, name):
    values = json.loads((space / "run" / "run.json").read_text())
    values["up"] = {"direction": UPS[name], "source": MARKUP, "unit": 1.0}
    (space / "run" / "run.json").write_text(json.dumps(values))
    hashes = {"run": {"run.json": hashlib.sha256((space / "run" / "run.json").read_bytes()).hexdigest()}}
    for state in (space / "run").glob("checkpoints/*/checkpoint.json"):
        known = json.loads(state.read_text())
        state.write_text(json.dumps(known | {"run": known["run"] | hashes["run"]}))
    ended = tried(space, "render run --out seen --cameras orbit --count 2 --device cpu")
    assert ended.code or all(np.isfinite(np.asarray(Image.open(file))).all() for file in (space / "seen").glob("*.png"))
    tried(space, "envmap run --out seen.exr --size 16 --device cpu")


LAYOUTS = ("transforms", "colmap")
LINKS = {
    "masks of the disk": ("masks", "/"),
    "mask of the disk": ("mask", "/"),
    "old masks of the disk": ("old_masks", "/"),
    "segments above": ("segmentation", "../elsewhere"),
    "truth of the disk": ("hdr", "/"),
    "truth above": ("hdr", "../elsewhere"),
    "exr of processes": ("exr", "/proc"),
    "a folder of the disk": ("other", "/"),
    "sparse of the disk": ("sparse2", "/"),
    "one mask above": ("mask.png", "../elsewhere/secret.png"),
    "one mask of a device": ("mask.png", "/dev/zero"),
    "times of a device": ("exposures.json", "/dev/zero"),
    "itself": ("masks/again", ".."),
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("name", LINKS)
def test_links_that_lead_out_of_a_set(space, name, layout):
    """Files outside are neither searched nor read: the whole disk would take minutes."""
    if layout == "colmap":
        pytest.importorskip("pycolmap")
        write_colmap(space / "set", 4, size=(24, 16), params=(20.0, 21.0, 12.0, 8.0))
    else:
        shutil.copytree(space / "photos", space / "set", dirs_exist_ok=True)
    (space / "elsewhere").mkdir()
    for stem in ("000", "r_0", "secret"):
        write_exr(space / "elsewhere" / f"{stem}.exr", np.full((16, 24, 3), 3.0, np.float32))
        Image.new("L", (24, 16), 255).save(space / "elsewhere" / f"{stem}.png")
    link(f"set/{LINKS[name][0]}", LINKS[name][1])(space)

    def watch(event, arguments):
        if event == "open" and isinstance(arguments[0], str | bytes):
            place = os.path.realpath(os.fsdecode(arguments[0]))
            if place.startswith(str(space / "elsewhere")) or place in ("/dev/zero", "/etc/passwd"):
                os.write(2, f"STARTED to open {place}\n".encode())

    ended = tried(space, TRAIN_SET.replace("photos", "set"), seconds=100, prepare=lambda: sys.addaudithook(watch))
    assert "secret" not in ended.err.replace("mask.png", "")


def many(photos: Path) -> None:
    for suffix in ("jpg", "tif", "webp", "avif", "bmp"):
        for number in range(40):
            (photos / "images" / f"r_{number}.{suffix}").write_bytes(b"\xff\xd8\xff" * 50)


COMMON = {
    "of 2^31": lambda photos: png(photos / "mask.png", size=(2**31 - 1, 2**31 - 1)),
    "a text": lambda photos: (photos / "mask.png").write_text("mask"),
    "empty": lambda photos: (photos / "mask.png").touch(),
    "a folder": lambda photos: (photos / "mask.png").mkdir(),
    "a pipe": lambda photos: os.mkfifo(photos / "mask.png"),
    "a gif": lambda photos: gif_named(photos / "mask.png"),
    "cut": lambda photos: (photos / "mask.png").write_bytes((photos / "images" / "r_0.png").read_bytes()[:60]),
    "of nothing": lambda photos: Image.new("L", (24, 16), 0).save(photos / "camera_mask.png"),
    "of one pixel": lambda photos: Image.new("L", (1, 1), 255).save(photos / "mask.png"),
    "of names that repeat": lambda photos: [
        (photos / f"{name}{suffix}").write_text("x")
        for name in ("mask", "camera_mask", "MASK")
        for suffix in (".png", ".jpg", ".PNG", ".webp")
    ],
    "copies that are damaged": many,
    "a pipe beside photos": lambda photos: os.mkfifo(photos / "images" / "r_9.mov"),
    "folders of a thousand": lambda photos: [
        (photos / "images" / f"d{n}" / "mask").mkdir(parents=True) for n in range(1000)
    ],
    "a deep folder": lambda photos: (photos / "images" / "/".join(["masks"] * 200)).mkdir(parents=True),
    "a name of markup": lambda photos: (photos / "images" / MARKUP.replace("/", "_")).write_text("x"),
    "a name that commands": lambda photos: (photos / "images" / "a\x1b[2J.mov").write_text("x"),
}


@pytest.mark.parametrize("name", COMMON)
def test_masks_of_all_photos_and_files_beside_them(space, name):
    COMMON[name](space / "photos")
    tried(space, TRAIN_SET)


def tensors(path: Path, header: dict | bytes, data: bytes = b"", length: int | None = None, sparse: int = 0) -> None:
    """Writes a checkpoint's tensors, with the hash that fits."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text) if length is None else length) + text + data)
    if sparse:
        os.truncate(path, sparse)
        return
    values = path.with_name("checkpoint.json")
    known = json.loads(values.read_text()) | {"sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    values.write_text(json.dumps(known))


MEANS = {"gaussians.means": {"dtype": "F32", "shape": [4, 3], "data_offsets": [0, 48]}}
STATES = {
    "header of 2^63": {"header": b"{}", "length": 2**63},
    "header of 100 MB": {"header": b"{}" + b" " * 100_000_000},
    "header of many names": {"header": {f"t{n}": MEANS["gaussians.means"] for n in range(100_000)}, "data": bytes(48)},
    "no tensors": {"header": {}},
    "means alone": {"header": MEANS, "data": bytes(48)},
    "means of 10^12": {"header": {"gaussians.means": MEANS["gaussians.means"] | {"shape": [10**12, 3]}}},
    "means of integers": {
        "header": {"gaussians.means": MEANS["gaussians.means"] | {"dtype": "I32"}},
        "data": bytes(48),
    },
    "means of one number": {
        "header": {"gaussians.means": MEANS["gaussians.means"] | {"shape": [12]}},
        "data": bytes(48),
    },
    "offsets that overlap": {"header": {**MEANS, "gaussians.quaternions": MEANS["gaussians.means"]}, "data": bytes(48)},
    "offsets below 0": {"header": {"a": MEANS["gaussians.means"] | {"data_offsets": [-48, 0]}}, "data": bytes(48)},
    "deep": {"header": b"[" * 100_000},
}


LOOKS = ("render run --out seen --device cpu", "train --resume --out run --device cpu -q")


@pytest.mark.parametrize("line", LOOKS)
@pytest.mark.parametrize("name", STATES)
def test_states_of_a_checkpoint(space, name, line):
    tensors(next((space / "run").glob("checkpoints/*/state.safetensors")), **STATES[name])
    tried(space, line, codes=(1,), seconds=100)


@pytest.mark.parametrize("line", LOOKS)
def test_a_state_of_60_gib_of_zeros(space, line):
    """A sparse file of a few kilobytes: it is not read whole before its header says that it is none of ours."""
    tensors(next((space / "run").glob("checkpoints/*/state.safetensors")), MEANS, sparse=60 << 30)
    ended = call(*line.split(), folder=space)
    assert ended.code == 1 and ended.seconds < 20 and not (space / "seen").exists()


MORE_PLANS = {
    "a base time of 1e400": {"base_time": "@1e400"},
    "times of 1e400": {"exposure_times": {"r_0": "@1e400"}},
    "times of others": {"exposure_times": {"nobody": 1.0}},
    "views of nobody": {"blocks": [PLAN["blocks"][0] | {"views": ["nobody", "r_0", "r_0"]}]},
    "a share of 1e-320": {"blocks": [PLAN["blocks"][0] | {"fraction": 1e-320}]},
    "walls of nan": {"blocks": [PLAN["blocks"][0] | {"low": ["@NaN"] * 3}]},
    "a margin of 1e308": {"blocks": [PLAN["blocks"][0] | {"margin": [1e308] * 3}]},
    "a unit of 1e-320": {"normalization": {"center": [1e308] * 3, "unit": 1e-320}},
    "bytes of 10^30": {"photo_bytes": {"r_0": 10**30}},
    "two of a name": {"blocks": PLAN["blocks"] * 2},
    "a number of 9 digits": {"blocks": [PLAN["blocks"][0] | {"name": "block_999999999"}]},
    "steps of 10^18": {"config": {"schedule": {"iterations": 10**18}}},
}


@pytest.mark.parametrize("name", MORE_PLANS)
def test_more_plans_of_blocks(space, name):
    """With pickled values where submitit would put its own: nobody reads them."""
    logs = space / "new" / "blocks" / "logs"
    logs.mkdir(parents=True)
    for file in ("0_0_result.pkl", "0_submitted.pkl", "20261126-000000-aaaaaaaa/1_0_result.pkl"):
        (logs / file).parent.mkdir(exist_ok=True)
        (logs / file).write_bytes(pickle.dumps(_Harm(str(space / "PWNED"))))
    text = json.dumps(PLAN | MORE_PLANS[name]).replace('"@1e400"', "1e400").replace('"@NaN"', "NaN")
    (space / "new" / "blocks.json").write_text(text)
    tried(space, "train photos --resume --out new --device cpu -q", seconds=100)
    assert not (space / "PWNED").exists()


class _Harm:
    def __init__(self, path: str):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (self.path,)


def patched_exr(path: Path, value: float) -> None:
    import OpenEXR

    pixels = {"RGB": np.full((16, 16, 3), value, np.float32)}
    OpenEXR.File({"compression": OpenEXR.NO_COMPRESSION, "type": OpenEXR.scanlineimage}, pixels).write(str(path))


TRUTHS = {
    "of another size": lambda path: write_exr(path, np.ones((9, 9, 3), np.float32)),
    "of nan": lambda path: patched_exr(path, np.nan),
    "of 1e38": lambda path: write_exr(path, np.full((16, 16, 3), 3e38, np.float32)),
    "below 0": lambda path: write_exr(path, np.full((16, 16, 3), -5.0, np.float32)),
    "a text": lambda path: path.write_text("exr"),
    "a pipe": lambda path: os.mkfifo(path),
    "a folder": lambda path: path.mkdir(),
    "of a device": lambda path: path.symlink_to("/dev/zero"),
    "cut": lambda path: path.write_bytes(b"\x76\x2f\x31\x01\x02\0\0\0" + bytes(300)),
    "of 10,000 names": lambda path: [path.with_name(f"x{number}.exr").touch() for number in range(10_000)],
}


@pytest.mark.parametrize("name", TRUTHS)
def test_pictures_that_are_scored(space, name):
    (space / "theirs").mkdir()
    for number in range(6):
        write_exr(space / "theirs" / f"r_{number}.exr", np.ones((16, 16, 3), np.float32))
    path = space / "theirs" / "r_2.exr"
    path.unlink()
    TRUTHS[name](path)
    tried(space, "eval theirs --truth truth --json seen.json", seconds=100)


def with_copy(make):
    def beside(photos: Path) -> None:
        make(photos / "images" / "r_2.jpg")

    return beside


BESIDE = {
    "a jpeg of 2^16": with_copy(lambda path: path.write_bytes(
        b"\xff\xd8\xff\xc0\0\x11\x08\xff\xff\xff\xff\3\1\x22\0\2\x11\1\3\x11\1" + bytes(64))),
    "a pipe": with_copy(os.mkfifo),
    "a link to itself": with_copy(lambda path: path.symlink_to(path.name)),
    "a heic": with_copy(lambda path: heic(path.with_suffix(".heic"))),
    "the same": with_copy(lambda path: Image.fromarray(pattern(24, 16, seed=2)).save(path)),
}  # fmt: skip


@pytest.mark.parametrize("name", BESIDE)
def test_copies_of_photos(space, name):
    (space / "photos" / "transforms.json").unlink()
    BESIDE[name](space / "photos")
    tried(space, TRAIN_SET, codes=(1,), seconds=100)


ASKED = {
    "run of 1e400": ("/frame", b'{"camera": {}, "run": 1e400}'),
    "count of 1e400": ("/path", b'{"cameras": [{}], "count": 1e400}'),
    "count of 5,000 digits": ("/path", b'{"cameras": [{}], "count": ' + b"9" * 5000 + b"}"),
    "light of 1e400": ("/gain", b'{"light": 1e400, "stops": 1}'),
    "gain of 1e400": ("/gain", b'{"light": 0, "stops": 1e400}'),
    "gain of a text": ("/gain", b'{"light": 0, "stops": "nan"}'),
    "up of zeros": ("/orientation", b'{"up": [0, 0, 0]}'),
    "up of 1e400": ("/orientation", b'{"up": [1e400, 0, 0]}'),
    "up of many": ("/orientation", json.dumps({"up": [1] * 100_000}).encode()),
    "scale of 1e-320": ("/orientation", b'{"scale": 1e-320}'),
    "crop of a text": ("/edit", b'{"crop": "' + b"9," * 50_000 + b'"}'),
    "page of a run that is none": ("/save", b'{"kind": "page", "run": 7, "cameras": [{}]}'),
}


@pytest.mark.parametrize("name", ASKED)
def test_further_requests_that_are_refused(served, name):  # noqa: F811
    path, body = ASKED[name]
    if path in ("/path", "/frame", "/save"):
        body = body.replace(b"{}", json.dumps(served.camera).encode())
    said = answer_to(served.server_address[1], posted(path, body), 60)
    assert said.startswith((b"HTTP/1.1 4", b"HTTP/1.1 5")) and b"Traceback" not in said, said[:300]
    assert answer_to(served.server_address[1], got("/versions")).startswith(b"HTTP/1.1 200")


def test_a_length_of_5000_digits(served):  # noqa: F811
    said = answer_to(served.server_address[1], posted("/frame", {}, Content_Length="9" * 5000), ends=True)
    assert not said.startswith(b"HTTP/1.1 2") and b"Traceback" not in said
