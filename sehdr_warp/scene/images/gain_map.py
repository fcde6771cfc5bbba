"""Gain maps: pictures beside a photo that state how much brighter than its codes its light was.

Ultra HDR (Android: metadata as XMP `hdrgm`), ISO 21496-1 (binary metadata in JPEG, HEIF and AVIF), and Apple's HDR gain
map (headroom in the maker note, or in XMP). All are decoded to the rendition of the largest headroom, which is the
light that the phone recorded, as a multiple of the light of white.
"""

import io
import logging
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from ...errors import InputError
from ...subsets import first_names
from ..color.encoding import ColorEncoding, encoding_of, encoding_of_boxes, encoding_of_profile
from ..color.primaries import srgb_to_linear
from ..raw.decode import linear_codes
from .downsampling import area_average
from .gain_map_parameters import (
    MOST_STOPS,
    GainMapParameters,
    parameters_of_apple,
    parameters_of_iso,
    parameters_of_xmp,
)
from .guided_upsampling import enlarge_guided
from .heif import HeifItems, is_heif, item_bytes, read_items, register_heif, with_primary
from .ldr_files import PILLOW_ERRORS, EncodedImage, exif_of, open_image, orientation_of, turn_upright
from .xmp import xmp_of, xmp_text

_log = logging.getLogger("sehdr_warp.scene")

MOST_STOPS_IN_CODES = 4.0  # Above white; of more, 16 bits would keep less of the dark than 8 bits of a photo
DEVIATION = 0.05
"""Standard deviation of the logarithm of decoded light: 8 bits of map and photo, and a map of fewer pixels."""
_SHAPE = 0.02  # Part by which the aspect of a map may differ from its photo's
_HEAD_BYTES = 1 << 18  # In which a file names a second picture: behind EXIF and a profile
_ISO_JPEG = b"urn:iso:std:iso:ts:21496:-1\0"
_HDRGM = "http://ns.adobe.com/hdr-gain-map/1.0/"
_APPLE_AUX = "urn:com:apple:photo:2020:aux:hdrgainmap"


@dataclass(frozen=True)
class GainMap:
    """A gain map as its file stores it."""

    encoded: np.ndarray  # [h, w, 1 or 3] float32 in [0, 1], of fewer pixels than the photo as a rule
    parameters: GainMapParameters  # What they stand for
    to_alternate: np.ndarray | None = None  # [3, 3] from the photo's primaries to the gains'; None if the same

    @property
    def headroom(self) -> float:
        """Log2 of the brightest light that its pixels make of white, as a multiple of white.

        Metadata may state more, such as what the encoder could have stored.
        """
        largest = replace(self, encoded=self.encoded.max((0, 1), keepdims=True)).light(np.ones((1, 1, 3), np.float32))
        return math.log2(max(float(largest.max()), 2.0**-MOST_STOPS))

    def light(self, base: np.ndarray) -> np.ndarray:
        """Return the light [H, W, 3] float32 of a photo whose own light [H, W, 3] is in [0, 1], 1 at white."""
        parameters = self.parameters
        guide = np.sqrt(base @ np.full(3, 1 / 3, np.float32))  # Even steps for the eye, about
        planes = [np.clip(_at_size_of(guide, plane), 0, 1) for plane in np.moveaxis(self.encoded, 2, 0)]
        if self.to_alternate is not None:
            base = base @ self.to_alternate.T.astype(np.float32)
        result = np.empty(base.shape, np.float32)
        for channel in range(3):
            share = planes[min(channel, len(planes) - 1)] ** np.float32(1 / parameters.gamma[channel])
            span = parameters.maximum[channel] - parameters.minimum[channel]
            gain = np.exp2(np.float32(parameters.minimum[channel]) + np.float32(span) * share)
            light = (base[..., channel] + np.float32(parameters.base_offset[channel])) * gain
            result[..., channel] = light - np.float32(parameters.alternate_offset[channel])
        if self.to_alternate is not None:
            result = result @ np.linalg.inv(self.to_alternate).T.astype(np.float32)
        return np.maximum(result, 0)


def _at_size_of(guide: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """Return a channel of a gain map at the size of its photo, of which `guide` is [H, W] codes in [0, 1]."""
    (height, width), (rows, columns) = guide.shape, plane.shape

    def resized(values: np.ndarray, kind: Image.Resampling = Image.Resampling.BICUBIC) -> np.ndarray:
        return np.asarray(Image.fromarray(values).resize((width, height), kind))

    if plane.shape == guide.shape or rows > height or columns > width:
        return resized(plane, Image.Resampling.BILINEAR)
    return enlarge_guided(plane, guide, reduce=lambda values: area_average(values, columns, rows), enlarge=resized)


def light_of(photo: EncodedImage, gain_map: GainMap | None, scale: float = 1.0) -> EncodedImage:
    """Return the light of a photo encoded by sRGB's curve as 16-bit sRGB codes, and what is above white beside it.

    Args:
        photo: as decoded.
        gain_map: of the photo; None for one without, whose light ends at white.
        scale: light that code 65535 stands for is white's divided by it.
    """
    light = _decode(photo)
    light = light if gain_map is None else gain_map.light(light) * np.float32(scale)
    codes = linear_codes(np.minimum(light, 1))
    above = None if gain_map is None else _above_white(light, codes == 65535)
    return replace(photo, pixels=codes, above_white=above, above_white_deviation=DEVIATION)


def with_light_above_white(photo: EncodedImage, gain_map: GainMap) -> EncodedImage:
    """Return a photo with the same codes, and the light of its white pixels beside them."""
    above = _above_white(gain_map.light(_decode(photo)), photo.pixels == photo.levels)
    return replace(photo, above_white=above, above_white_deviation=DEVIATION)


def _decode(photo: EncodedImage) -> np.ndarray:
    """Return [H, W, 3] float32 light by sRGB's transfer function (that of Display P3, too), 1 at white."""
    codes = np.arange(photo.levels + 1) / photo.levels
    return srgb_to_linear(codes).astype(np.float32)[photo.pixels]


def _above_white(light: np.ndarray, white: np.ndarray) -> np.ndarray | None:
    return np.where(white, np.maximum(light, 1), 0).astype(np.float16) if white.any() else None


def read_gain_map(path: Path, *, oriented: bool = False, problems: dict[Path, str] | None = None) -> GainMap | None:
    """Return the gain map of a photo, or None if it has none that applies to it as it is decoded.

    A damaged one counts as none, because the photo itself is good. It is named in a warning, or added to `problems`.
    `oriented` turns it like the photo, as EXIF's orientation says.

    Raises:
        InputError: if the photo itself is missing or damaged.
    """
    try:
        if not _is_marked(path):
            return None
        with path.open("rb") as file:
            is_jpeg = file.read(2) == b"\xff\xd8"
        gain_map = _of_jpeg(path) if is_jpeg else _of_items(path)
        if gain_map is not None and oriented:
            with open_image(path) as image:
                gain_map = replace(gain_map, encoded=turn_upright(gain_map.encoded, orientation_of(image)))
        return gain_map
    except InputError:
        raise
    except (*PILLOW_ERRORS, IndexError, KeyError) as error:
        if problems is None:
            _log.warning("%s: its gain map is damaged (%s): the photo is used without it", path, str(error)[:80])
        else:
            problems[path] = str(error)[:80]
        return None


def gain_map_notes(problems: dict[Path, str]) -> list[str]:
    """Return a note on photos whose gain maps are damaged."""
    if not problems:
        return []
    first = min(problems)
    names = first_names(sorted(path.name for path in problems))
    return [f"gain maps of {len(problems)} photos are damaged and not used: {names} ({problems[first]})"]


def _is_marked(path: Path) -> bool:
    """Return whether the head of a file says that it holds a second picture."""
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    if head[:2] == b"\xff\xd8":
        return b"MPF\0" in head or b"GainMap" in head
    return head[4:8] == b"ftyp" and (b"tmap" in head or b"auxC" in head)


def _of_jpeg(path: Path) -> GainMap | None:
    with open_image(path) as image:
        photo, exif, own = image.size, exif_of(image), encoding_of(image)
        for second in _further_pictures(image, path):
            iso = next((data for _, data in getattr(second, "applist", ()) if data.startswith(_ISO_JPEG)), None)
            xmp = _with_usual_prefix(xmp_of(second))
            if iso is not None and len(iso) > len(_ISO_JPEG) + 4:
                make = parameters_of_iso(iso[len(_ISO_JPEG) :])
            elif "hdrgm:" in xmp:
                make = parameters_of_xmp(xmp)
            elif "HDRGainMap" in xmp:
                make = parameters_of_apple(xmp, exif)
            else:
                continue
            profile = second.info.get("icc_profile")
            alternate = encoding_of_profile(bytes(profile)) if profile else None
            pixels = _of_shape(_pixels(second, photo), photo)
            return _gain_map_of(make, pixels, _primaries_matrix(own, alternate))
    return None


def _further_pictures(image: Image.Image, path: Path) -> Iterator[Image.Image]:
    """Yield the pictures behind the first of a JPEG.

    They are listed in its multi-picture index (MPF), or in its XMP (GContainer), which editors keep more often.
    """
    if image.format == "MPO":
        for number in range(1, getattr(image, "n_frames", 1)):
            image.info.pop("xmp", None)  # Pillow keeps that of the picture before for one without.
            image.seek(number)
            yield image
        return
    items = []
    for text in re.findall(r"<\w+:Item\b[^>]*>", xmp_of(image)):
        attributes = dict(re.findall(r'\b\w+:(\w+)\s*=\s*["\']([^"\']*)["\']', text))
        length = int(attributes.get("Length") or 0)
        items.append((attributes.get("Semantic"), length, length + int(attributes.get("Padding") or 0)))
    # Items follow each other up to the end of the file; the first one states no length.
    for number, (semantic, length, _) in enumerate(items):
        if semantic == "GainMap" and number and 0 < length < path.stat().st_size:
            with path.open("rb") as file:
                file.seek(-sum(size for _, _, size in items[number:]), 2)
                data = file.read(length)
            with Image.open(io.BytesIO(data), formats=("JPEG", "MPO")) as second:
                yield second


def _of_items(path: Path) -> GainMap | None:
    """Return the gain map of a HEIF or AVIF file."""
    with path.open("rb") as file:
        if file.read(12)[4:8] != b"ftyp":
            return None
    with open_image(path) as image:
        photo, exif, own = image.size, exif_of(image), encoding_of(image)
    items = read_items(path)
    inputs = {number: to for kind, number, to in items.references if kind == "dimg"}
    for number, item in items.items.items():
        if item.kind == "tmap" and len(to := inputs.get(number, ())) >= 2 and to[0] == items.primary:
            make = parameters_of_iso(item_bytes(path, item)[1:])
            alternate = encoding_of_boxes([data for name, data in item.properties if name == "colr"])
            return _gain_map_of(make, _item_pixels(path, items, to[1], photo), _primaries_matrix(own, alternate))
    for number, item in items.items.items():
        kinds = [data[4:].split(b"\0")[0].decode("latin-1") for name, data in item.properties if name == "auxC"]
        if _APPLE_AUX in kinds:
            sources = (source for kind, source, to in items.references if kind == "cdsc" and number in to)
            described = (items.items[n] for n in sources if n in items.items and items.items[n].kind == "mime")
            xmp = "".join(xmp_text(item_bytes(path, each)) for each in described)
            return _gain_map_of(parameters_of_apple(xmp, exif), _item_pixels(path, items, number, photo))
    return None


def _item_pixels(path: Path, items: HeifItems, number: int, photo: tuple[int, int]) -> np.ndarray:
    """Return the pixels of an item of a HEIF or AVIF file, turned like its primary picture."""
    heif, auxiliary = is_heif(path), any(name == "auxC" for name, _ in items.items[number].properties)
    if heif:
        register_heif(path)
    if heif and auxiliary:  # libheif shows it only as what belongs to another picture.
        import pillow_heif

        pixels = _pixels(pillow_heif.open_heif(path).get_aux_image(number).to_pillow(), photo)
    else:
        source = io.BytesIO(with_primary(path, items, number))
        with Image.open(source, formats=("HEIF",) if heif else ("AVIF",)) as image:
            pixels = _pixels(image, photo)
    turned = {name: data for name, data in items.items[items.primary].properties if name in ("irot", "imir")}
    own = {name for name, _ in items.items[number].properties}
    if heif and "irot" in turned and "irot" not in own:
        pixels = np.rot90(pixels, turned["irot"][-1] & 3)
    return _of_shape(pixels, photo)


def _of_shape(pixels: np.ndarray, photo: tuple[int, int]) -> np.ndarray:
    """Return the pixels of a gain map; raise ValueError for another shape than its photo's, as of one cropped later."""
    height, width = pixels.shape[:2]
    if abs(width * photo[1] / (height * photo[0]) - 1) > _SHAPE + 1 / width + 1 / height:
        raise ValueError(f"it has {width} x {height} pixels, which is not the shape of {photo[0]} x {photo[1]}")
    return pixels


def _pixels(image: Image.Image, photo: tuple[int, int]) -> np.ndarray:
    """Return [h, w, 1 or 3] float32 in [0, 1] of an opened gain map, which has at most the photo's pixels."""
    if not 0 < image.width * image.height <= photo[0] * photo[1]:
        raise ValueError(f"it has {image.width} x {image.height} pixels, the photo {photo[0]} x {photo[1]}")
    image = image if image.mode in ("L", "RGB") else image.convert("RGB")
    values = np.asarray(image)
    return (values.reshape(*values.shape[:2], -1) / np.float32(255)).astype(np.float32)


def _with_usual_prefix(xmp: str) -> str:
    """Return XMP whose names of Adobe's gain map begin with `hdrgm:`, whatever prefix it binds to their namespace."""
    bound = re.search(rf"""xmlns:(\w{{1,40}})\s*=\s*["']{re.escape(_HDRGM)}["']""", xmp)
    return xmp if bound is None or bound[1] == "hdrgm" else re.sub(rf"\b{bound[1]}:", "hdrgm:", xmp)


def _primaries_matrix(own: ColorEncoding | None, alternate: ColorEncoding | None) -> np.ndarray | None:
    """Return [3, 3] from the primaries of a photo to those of its alternate rendition; None if they do not differ.

    An alternate rendition that states no primaries has the photo's.
    """
    if alternate is None or alternate.problem or alternate.table or (own is not None and own.table is not None):
        return None
    to_rec709 = [np.eye(3) if each is None or each.to_rec709 is None else each.to_rec709 for each in (own, alternate)]
    matrix = np.linalg.solve(to_rec709[1], to_rec709[0])
    return None if np.allclose(matrix, np.eye(3), atol=1e-3) else matrix


def _gain_map_of(
    parameters: GainMapParameters, encoded: np.ndarray, primaries: np.ndarray | None = None
) -> GainMap | None:
    """Return the gain map of parameters and pixels; None if the photo itself is the HDR rendition.

    `primaries` [3, 3] leads from the photo's to those of the alternate rendition, where the metadata may apply gains.
    """
    if parameters.base_is_hdr:
        return None
    if parameters.is_apple:
        # light = base (1 + (headroom - 1) g), g decoded by Rec.709; as a gain map of stops.
        linear = np.where(encoded <= 0.08145, encoded / 4.5, ((encoded + 0.099) / 1.099) ** (1 / 0.45))
        stops = float(parameters.maximum[0])
        encoded = (np.log2(1 + (2.0**stops - 1) * linear) / stops).astype(np.float32)
    return GainMap(encoded, parameters, primaries if parameters.in_alternate_colors else None)
