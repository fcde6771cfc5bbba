"""Ultra HDR: a JPEG for any display, with a gain map inside by which an HDR display shows light above white.

By the Ultra HDR Image Format 1.1 (Android): the gain map is a second JPEG behind the first. XMP of both and a
Multi-Picture index (CIPA DC-007) say so. Encoders at hand tone-map the plain picture; here it is the caller's.
"""

import struct

import numpy as np

from ...scene.color.primaries import srgb_to_linear
from .ldr_files import jpeg, quantize

MOST_STOPS = 5.5  # Stops over white that are kept; brighter light is shown at that
QUALITY = 95
_OFFSET = 1 / 64  # Added to both lights before their ratio, as the format suggests
_PACKET = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description xmlns:hdrgm="http://ns.adobe.com/hdr-gain-map/1.0/" hdrgm:Version="1.0" {}</rdf:Description>'
    "</rdf:RDF></x:xmpmeta>"
)
_DIRECTORY = (
    'xmlns:Container="http://ns.google.com/photos/1.0/container/" '
    'xmlns:Item="http://ns.google.com/photos/1.0/container/item/"><Container:Directory><rdf:Seq>'
    '<rdf:li rdf:parseType="Resource"><Container:Item Item:Semantic="Primary" Item:Mime="image/jpeg"/></rdf:li>'
    '<rdf:li rdf:parseType="Resource"><Container:Item Item:Semantic="GainMap" Item:Mime="image/jpeg" '
    'Item:Length="{}"/></rdf:li></rdf:Seq></Container:Directory>'
)


def ultra_hdr(light: np.ndarray, base: np.ndarray) -> bytes:
    """Return a JPEG that an HDR display shows as `light`, and any other display as `base`.

    Args:
        light: [H, W, 3] linear Rec.709 display light, in which 1 is white.
        base: [H, W, 3] sRGB-encoded, in [0, 1].
    """
    codes = quantize(base).astype(np.float32) / 255
    plain = srgb_to_linear(codes)
    light = np.clip(light, 0, 2**MOST_STOPS)
    gain = np.log2((light + _OFFSET) / (plain + _OFFSET))
    return jpeg_with_gain_map(base, gain, float(np.log2(light.max(initial=0) + 1e-9)))


def jpeg_with_gain_map(base: np.ndarray, gain: np.ndarray, headroom: float) -> bytes:
    """Return a JPEG with a gain map.

    Args:
        base: [H, W, 3] sRGB-encoded, in [0, 1].
        gain: [h, w] or [h, w, 3] log2 of light over that of `base`, both plus 1/64.
        headroom: log2 of the brightest light over white, at which a display shows all of it.
    """
    low, high = float(gain.min()), max(float(gain.max()), float(gain.min()) + 0.1)
    facts = {"GainMapMin": low, "GainMapMax": high, "Gamma": 1, "OffsetSDR": _OFFSET, "OffsetHDR": _OFFSET}
    facts |= {"HDRCapacityMin": 0, "HDRCapacityMax": max(headroom, 0.1), "BaseRenditionIsHDR": False}
    attributes = " ".join(f'hdrgm:{name}="{value}"' for name, value in facts.items())
    options = {"quality": QUALITY, "subsampling": 0}
    second = jpeg((gain - low) / (high - low), xmp=_PACKET.format(f"{attributes}>").encode(), **options)
    first = jpeg(base, xmp=_PACKET.format(_DIRECTORY.format(len(second))).encode(), **options)
    # The index stands behind the start marker and JFIF's own segment. Offsets are counted from behind "MPF\0".
    head = 4 + struct.unpack(">H", first[4:6])[0]
    size = len(first) + len(_index(0, 0, 0))
    return first[:head] + _index(size, len(second), size - head - 8) + first[head:] + second


def _index(first: int, second: int, offset: int) -> bytes:
    """Return the Multi-Picture index of two pictures' bytes; the second is `offset` bytes behind the index's header."""
    entries = struct.pack(">IIIIIIII", 0x00030000, first, 0, 0, 0, second, offset, 0)
    fields = struct.pack(">HHI4s", 0xB000, 7, 4, b"0100") + struct.pack(">HHII", 0xB001, 4, 1, 2)
    fields += struct.pack(">HHII", 0xB002, 7, len(entries), 8 + 2 + 3 * 12 + 4)
    index = b"MPF\0" + b"MM\0*" + struct.pack(">IH", 8, 3) + fields + struct.pack(">I", 0) + entries
    return struct.pack(">BBH", 0xFF, 0xE2, len(index) + 2) + index
