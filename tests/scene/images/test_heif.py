"""HEIC and AVIF photos: pixels, orientation, EXIF, depth, and what is wrong with damaged ones."""

import struct
import sys

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.scene.images import heif
from sehdr_warp.scene.images.exif import are_camera_files, exif_exposure
from sehdr_warp.scene.images.ldr_files import image_sizes, read_ldr
from tests.make_scenes import edited_json, load, write_blender

Y, X = np.mgrid[:48, :64]
PIXELS = np.stack([3 * X, 4 * Y, 100 + 0 * X], 2).astype(np.uint8)


def exif(orientation=1):
    table = Image.Exif()
    table[0x0112] = orientation
    table.get_ifd(0x8769).update({33434: 0.01, 34855: 200})
    return table.tobytes()


def write_heic(path, pixels=PIXELS, **options):
    pillow_heif = pytest.importorskip("pillow_heif")
    if pixels.dtype == np.uint16:
        image = pillow_heif.from_bytes("RGB;16", pixels.shape[1::-1], pixels.tobytes())
    else:
        image = pillow_heif.from_pillow(Image.fromarray(pixels))
    image.save(path, **({"quality": 95} | options))
    return path


def test_a_heic_photo_is_upright_with_its_exposure(tmp_path):
    file = write_heic(tmp_path / "a.heic", exif=exif(6))
    assert image_sizes(file) == ((48, 64), (48, 64))
    read = read_ldr(file, oriented=True).pixels.astype(int)
    assert np.abs(read - np.rot90(PIXELS, -1)).mean() < 3
    assert exif_exposure(file)[:2] == (0.01, 200)
    assert are_camera_files([file]) and not are_camera_files([write_heic(tmp_path / "edited.heic")])


def test_ten_bits_of_a_heic_photo(tmp_path):
    deep = np.repeat(np.linspace(0, 65535, 64).astype(np.uint16)[None, :, None], 48, 0).repeat(3, 2)
    read = read_ldr(write_heic(tmp_path / "a.heic", deep, quality=-1, chroma=444)).pixels
    assert read.dtype == np.uint16 and read.max() == 65535
    assert np.abs(read.astype(int) - deep).max() < 200


def test_bits_of_avif_that_are_not_read_are_named(tmp_path):
    imagecodecs = pytest.importorskip("imagecodecs")
    write_blender(tmp_path)
    with edited_json(tmp_path / "transforms.json") as values:
        for i, frame in enumerate(values["frames"]):
            photo = np.asarray(Image.open(tmp_path / "images" / f"r_{i}.png"))
            deep = (photo.astype(np.uint16) << 2 | photo >> 6) if i % 2 else photo
            data = imagecodecs.avif_encode(deep, level=100, bitspersample=10 if i % 2 else 8)
            (tmp_path / "images" / f"r_{i}.avif").write_bytes(data)
            (tmp_path / "images" / f"r_{i}.png").unlink()
            frame["file_path"] += ".avif"
    note = (
        "AVIF is read with 8 bits, and 3 photos: r_1.avif, r_3.avif, r_5.avif hold more: use HEIC, PNG or TIFF for all"
    )
    assert note in load(tmp_path, holdout=0).notes


def test_sequences_and_damaged_files_are_named(tmp_path):
    pillow_heif = pytest.importorskip("pillow_heif")
    several = pillow_heif.HeifFile()
    several.add_from_pillow(Image.fromarray(PIXELS))
    several.add_from_pillow(Image.fromarray(PIXELS))
    several.save(tmp_path / "burst.heic")
    with pytest.raises(InputError, match=r"burst.heic: holds several pictures"):
        read_ldr(tmp_path / "burst.heic")
    whole = write_heic(tmp_path / "a.heic").read_bytes()
    for name, data in {"cut": whole[:400], "pixels": whole[:-200], "zeros": whole[:24] + bytes(2000)}.items():
        (tmp_path / f"{name}.heic").write_bytes(data)
        with pytest.raises(
            InputError, match=rf"{name}.heic: (is not a readable HEIC photo|cannot be decoded)"
        ) as raised:
            read_ldr(tmp_path / f"{name}.heic")
        assert "\n" not in raised.value.problem  # Libheif's message ends with one, and notes repeat the problem


def test_without_the_extra_the_remedy_is_named(tmp_path, monkeypatch):
    file = write_heic(tmp_path / "a.heic")
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(SehdrError, match=r"HEIC photos need pillow-heif; run `pip install 'sehdr-warp\[phone\]'"):
        read_ldr(file)


def test_boxes_that_cannot_be(tmp_path):
    whole = bytearray(write_heic(tmp_path / "a.heic").read_bytes())
    items = heif.read_items(tmp_path / "a.heic")
    assert items.items[items.primary].kind in ("hvc1", "grid")
    at = whole.index(b"iloc")
    whole[at + 12 : at + 40] = b"\xff" * 28
    (tmp_path / "b.heic").write_bytes(whole)
    with pytest.raises(InputError, match=r"b.heic: (its list of pictures is damaged|an item reaches)"):
        broken = heif.read_items(tmp_path / "b.heic")
        for item in broken.items.values():
            heif.item_bytes(tmp_path / "b.heic", item)


@pytest.mark.parametrize("inside", [True, False])
def test_parts_of_an_item_that_overlap_take_no_memory(tmp_path, inside):
    """A thousand parts, each of them the whole file or all of its inner data."""
    file, extents = tmp_path / "a.heic", ((0, 1000),) * 1000
    file.write_bytes(bytes(2000))
    if not inside:
        with pytest.raises(InputError, match="parts of an item have"):
            heif.item_bytes(file, heif.Item("mime", extents))
        return

    def full(kind, payload, version=0):
        return struct.pack(">I4sI", 12 + len(payload), kind, version << 24) + payload

    places = struct.pack(">BBHHHHH", 0x44, 0, 1, 1, 1, 0, len(extents)) + b"".join(
        struct.pack(">II", *e) for e in extents
    )
    boxes = (
        full(b"pitm", struct.pack(">H", 1))
        + full(b"iloc", places, 1)
        + struct.pack(">I4s", 1008, b"idat")
        + bytes(1000)
    )
    listed = full(b"infe", struct.pack(">HH4s", 1, 0, b"mime") + b"\0", 2)
    boxes += full(b"iinf", struct.pack(">H", 1) + listed)
    file.write_bytes(struct.pack(">I4s", 16, b"ftyp") + b"heic" + bytes(4) + full(b"meta", boxes))
    with pytest.raises(InputError, match="1000000 bytes of items"):
        heif.read_items(file)
