"""Photos with gain maps as phones write them, made in memory: JPEG (MPF) and HEIF or AVIF files of several pictures."""

import io
import struct
from fractions import Fraction
from pathlib import Path

import numpy as np
from PIL import Image

from sehdr_warp.scene.images.heif import item_bytes, read_items


def iso_metadata(
    maximum, minimum=0.0, gamma=1.0, offset=1 / 64, headroom=None, base_headroom=0.0, channels=1, base_colors=True
) -> bytes:
    """ISO 21496-1's binary metadata without the version byte that HEIF has before it. base_colors: whether the gains
    apply in the photo's primaries."""

    def fraction(value, layout):
        parts = Fraction(value).limit_denominator(1 << 16)
        return struct.pack(f">{layout}I", parts.numerator, parts.denominator)

    head = struct.pack(">HHB", 0, 0, (0x40 if base_colors else 0) | (0x80 if channels == 3 else 0))
    head += fraction(base_headroom, "I") + fraction(maximum if headroom is None else headroom, "I")
    row = (minimum, "i"), (maximum, "i"), (gamma, "I"), (offset, "i"), (offset, "i")
    return head + b"".join(fraction(*each) for each in row) * channels


def jpeg_bytes(pixels: np.ndarray, segments=(), **options) -> bytes:
    """A JPEG with further segments (marker, data) behind its start."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", quality=97, subsampling=0, **options)
    data = buffer.getvalue()
    extra = b"".join(struct.pack(">HH", marker, len(body) + 2) + body for marker, body in segments)
    return data[:2] + extra + data[2:]


def write_jpeg_pair(path: Path, base: np.ndarray, gain: np.ndarray, segments, **options) -> None:
    """A photo and a second picture, joined by a multi-picture index (CIPA DC-007). segments: of the second."""
    second = jpeg_bytes(gain, segments)
    size = 4 + 8 + 2 + 12 * 3 + 4 + 32
    length = len(jpeg_bytes(base, [(0xFFE2, bytes(size))], **options))
    start = 2 + 4 + 4  # Where the index's own places count from: behind SOI, the marker and `MPF\0`.
    index = b"MM\0*" + struct.pack(">I", 8) + struct.pack(">H", 3)
    index += struct.pack(">HHI4s", 0xB000, 7, 4, b"0100") + struct.pack(">HHII", 0xB001, 4, 1, 2)
    index += struct.pack(">HHII", 0xB002, 7, 32, 50) + struct.pack(">I", 0)
    index += struct.pack(">IIIHH", 0x030000, length, 0, 0, 0) + struct.pack(
        ">IIIHH", 0, len(second), length - start, 0, 0
    )
    first = jpeg_bytes(base, [(0xFFE2, b"MPF\0" + index)], **options)
    assert len(first) == length
    path.write_bytes(first + second)


def xmp_segment(fields: dict[str, str], prefix="hdrgm", space="http://ns.adobe.com/hdr-gain-map/1.0/"):
    """APP1 with XMP attributes of one namespace."""
    attributes = " ".join(f'{prefix}:{name}="{value}"' for name, value in fields.items())
    text = (
        f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description xmlns:{prefix}="{space}" {attributes}/></rdf:RDF></x:xmpmeta>'
    )
    return 0xFFE1, b"http://ns.adobe.com/xap/1.0/\0" + text.encode()


def _box(kind: str, payload: bytes) -> bytes:
    return struct.pack(">I4s", 8 + len(payload), kind.encode()) + payload


def _full(kind: str, payload: bytes, version=0, flags=0) -> bytes:
    return _box(kind, struct.pack(">I", version << 24 | flags) + payload)


def write_heif_pair(
    path: Path, base: Path, gain: Path, *, iso: bytes | None = None, colr=b"", apple_xmp: bytes | None = None
) -> None:
    """One file of two: the photo of `base`, and `gain` as its gain map by a derived item (iso: its metadata, colr: what
    it states of its colors) or as Apple's auxiliary picture (apple_xmp: the metadata that describe it)."""
    items, properties, associated, payloads = [], [], {}, {}
    for number, source in ((1, base), (2, gain)):
        stored = read_items(source)
        item = stored.items[stored.primary]
        items.append((number, item.kind))
        payloads[number] = item_bytes(source, item)
        associated[number] = []
        for kind, data in item.properties:
            properties.append(_box(kind, data))
            associated[number].append(len(properties))
    references = b""
    exif = read_items(base)
    for item in exif.items.values():
        if item.kind == "Exif":
            items.append((5, "Exif"))
            payloads[5] = item_bytes(base, item)
            references += _box("cdsc", struct.pack(">3H", 5, 1, 1))
    if iso is not None:
        items.append((3, "tmap"))
        payloads[3] = b"\0" + iso
        references += _box("dimg", struct.pack(">4H", 3, 2, 1, 2))
        if colr:
            properties.append(_box("colr", colr))
            associated[3] = [len(properties)]
    if apple_xmp is not None:
        properties.append(_full("auxC", b"urn:com:apple:photo:2020:aux:hdrgainmap\0"))
        associated[2].append(len(properties))
        references += _box("auxl", struct.pack(">3H", 2, 1, 1))
        items.append((4, "mime"))
        payloads[4] = apple_xmp
        references += _box("cdsc", struct.pack(">3H", 4, 1, 2))

    def info(number, kind):
        flags = 1 if number in (2, 4) else 0
        content = b"application/rdf+xml\0" if kind == "mime" else b""
        return _full("infe", struct.pack(">HH4s", number, 0, kind.encode()) + b"\0" + content, 2, flags)

    listed = _full("iinf", struct.pack(">H", len(items)) + b"".join(info(*item) for item in items))
    links = struct.pack(">I", len(associated))
    for number, used in associated.items():
        links += struct.pack(">HB", number, len(used)) + bytes(used)
    described = _box("iprp", _box("ipco", b"".join(properties)) + _full("ipma", links))
    brand = b"avif" if path.suffix == ".avif" else b"heic"
    head = _box("ftyp", brand + struct.pack(">I", 0) + b"mif1" + brand + b"tmap")

    def meta(start):
        places, at = b"", start
        for number, _ in items:
            places += struct.pack(">HHHII", number, 0, 1, at, len(payloads[number]))
            at += len(payloads[number])
        places = _full("iloc", struct.pack(">BBH", 0x44, 0, len(items)) + places)
        handler = _full("hdlr", struct.pack(">I4s12s", 0, b"pict", b"") + b"\0")
        return _full(
            "meta",
            handler + _full("pitm", struct.pack(">H", 1)) + places + listed + described + _full("iref", references),
        )

    start = len(head) + len(meta(0)) + 8
    path.write_bytes(head + meta(start) + _box("mdat", b"".join(payloads[number] for number, _ in items)))


HEIGHT, WIDTH = 96, 128
STOPS = 2.5


def linear(codes):
    values = codes / np.iinfo(codes.dtype).max
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4).astype(np.float32)


def encoded(light):
    light = np.clip(light, 0, 1)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


def scene():
    """[H, W, 3] smooth light from 0.05 to 2^STOPS times white."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] / WIDTH
    level = 0.5 + 0.5 * np.sin(2.5 * x + 2 * y)
    return (0.05 * (2**STOPS / 0.05) ** level)[..., None] * [1.0, 0.9, 0.8]


def pair(apple=False, channels=1):
    """The photo clipped at white, and what the map holds: [h, w(, 3)] uint8 at half of the size."""
    light = scene()
    base = np.rint(255 * encoded(light)).astype(np.uint8)
    base_light = linear(base)
    if apple:
        share = (light.max(2) / base_light.max(2) - 1) / (2**STOPS - 1)
        share = np.clip(share, 0, 1)
        stored = np.where(share <= 0.0181, 4.5 * share, 1.099 * np.maximum(share, 1e-9) ** 0.45 - 0.099)
    else:
        gains = np.log2((light + 1 / 64) / (base_light + 1 / 64)) / STOPS
        stored = gains if channels == 3 else gains[..., 0]
    small = np.clip(stored, 0, 1)
    small = small.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, -1).mean((1, 3)).squeeze()
    return light, base, np.rint(255 * small).astype(np.uint8)


def iso_segment(**options):
    return 0xFFE2, b"urn:iso:std:iso:ts:21496:-1\0" + iso_metadata(STOPS, **options)


def hdrgm(**more):
    fields = {"Version": "1.0", "GainMapMin": "0", "GainMapMax": str(STOPS), "HDRCapacityMin": "0"}
    return xmp_segment(fields | {"HDRCapacityMax": str(STOPS)} | more)
