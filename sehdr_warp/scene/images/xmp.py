"""Values of XMP, the metadata that editors write into photos as XML."""

import re
from typing import Any

from PIL import Image

_MOST = 1 << 22  # Bytes that are searched; editors write some thousand, and a history of edits more


def xmp_of(image: Image.Image) -> str:
    """Return the XMP of an opened image as text, empty if it has none. Raises ValueError for more than 4 MiB."""
    return xmp_text(image.info.get("xmp", b""))


def xmp_text(data: Any) -> str:
    """Return XMP as text. Raises ValueError for more than 4 MiB."""
    if len(data) > _MOST:
        raise ValueError(f"{len(data)} bytes of XMP")
    return data.decode("utf-8", "replace") if isinstance(data, bytes) else str(data)


def xmp_values(xmp: str, name: str) -> list[str]:
    """Return what an XMP element or attribute such as `hdrgm:Gamma` states: one value, or those of its sequence.

    Takes time in proportion to the length of `xmp`, whatever it holds.
    """
    if start := re.search(rf"<{name}(?:\s[^<>]*)?(?<!/)>", xmp):
        body, closed, _ = xmp[start.end() :].partition(f"</{name}>")
        if closed:
            return re.findall(r"<rdf:li[^<>]*>([^<]*)</rdf:li>", body) or [body.strip()]
    return re.findall(rf"""\b{name}\s*=\s*["']([^"']*)["']""", xmp)[-1:]
