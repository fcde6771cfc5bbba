"""Colors that the file of a photo states: primaries and transfer function, and their way to linear Rec.709.

ICC profiles (PNG, JPEG, TIFF, WebP), PNG's cICP, gAMA and cHRM, TIFF's chromaticities, EXIF's ColorSpace. A photo whose
file states nothing is sRGB. Display curves (gamma, sRGB) say how a picture is to be shown, not how the camera turned
light into codes: such photos are converted to sRGB's codes, and their response is still to be found. The curves of
video cameras (BT.709, BT.601, BT.2020, SMPTE 240M) are never inverted to show a picture, so they count as sRGB's, as in
clips, browsers and players. Linear light, PQ, HLG and logarithmic curves are light, and leave nothing to guess.
"""

import re
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ...errors import InputError
from ...subsets import first_names
from ..images.heif import read_items
from ..images.ldr_files import PILLOW_ERRORS, EncodedImage, exif_of, png_chunks
from .icc import IccTable, read_profile
from .primaries import REC709, matrix_to_rec709, srgb_to_linear
from .srgb_codes import bands_of, srgb_codes

_ADOBE_RGB = (0.640, 0.330, 0.210, 0.710, 0.150, 0.060, 0.3127, 0.3290)
_ADOBE_GAMMA = 563 / 256
_LIGHT = {8: "linear light", 9: "log light", 10: "log light", 16: "PQ light", 18: "HLG light"}
"""Transfer characteristics of ITU-T H.273 that state light."""
_UNSTATED = (0, 2, 3)  # Code points of ITU-T H.273 that state nothing
_BT709_GAMMA = 0.50994  # 1 / 1.961, the power that FFmpeg and Apple state for the curves of video cameras
_SAMPLES = 65_536  # Of curves: exact at all codes of 8 and 16 bits
_PQ_WHITE = 1000.0  # cd/m2 of the code of white, BT.2100's nominal peak; what is brighter is light above white
_SAME = 0.004  # Linear difference by which curves and primaries may differ and still be sRGB's
DEVIATION = 0.02  # Standard deviation of the logarithm of light that conversion puts above white, by codes of 8 bits
_GREY = ("L", "LA", "La", "I", "I;16", "I;16L", "I;16B", "I;16N")
_INTEROP = 0xA005, 1  # EXIF's interoperability table, and its index
_COLOR_SPACE = 0xA001
# EXIF's entry of a ColorSpace of 2 or 65535, in either byte order.
_NOT_SRGB = re.compile(
    rb"\xa0\x01\x00\x03\x00\x00\x00\x01(\x00\x02|\xff\xff)|\x01\xa0\x03\x00\x01\x00\x00\x00(\x02\x00|\xff\xff)"
)
_EXIF_IFD = 0x8769


@dataclass(frozen=True)
class ColorEncoding:
    """Encoding of a photo, as its file states it."""

    name: str  # For the user, such as "Display P3 (ICC profile)"
    to_rec709: np.ndarray | None = None  # [3, 3] from the codes' primaries to linear Rec.709; None if the same
    curves: tuple[np.ndarray, ...] = ()  # Decoded values at even codes, by channel; empty for sRGB's, or a table
    light: str | None = None  # What light the codes state ("linear light", "PQ light", ...); None for a display curve
    table: IccTable | None = None  # Of an ICC profile, in place of primaries and curves
    problem: str | None = None  # What is wrong with the statement, if it is not used

    @property
    def is_srgb(self) -> bool:
        """True if the codes are sRGB's as they are."""
        return self.to_rec709 is None and not self.curves and self.table is None

    def to_linear(self, pixels: np.ndarray, above: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Decode codes to linear Rec.709.

        Args:
            pixels: [H, W, 3] uint8 or uint16.
            above: [H, W, 3] light above white that is known beside them, 0 elsewhere.

        Returns:
            [H, W, 3] float32, which may be negative or above 1 outside of Rec.709's gamut, and [H, W, 3] bool, which
            channels are clipped.
        """
        clipped = pixels == np.iinfo(pixels.dtype).max
        if self.table is None:
            light = self._decode(pixels)
        else:
            light = self.table.light(pixels)
        if above is not None:
            light, clipped = np.where(above > 0, above, light), clipped & (above == 0)
        if self.to_rec709 is not None:
            # A product with a transposed view is slower.
            matrix = np.ascontiguousarray(self.to_rec709.T, np.float32)
            light = (light.reshape(-1, 3) @ matrix).reshape(light.shape)
        return light, clipped

    def _decode(self, pixels: np.ndarray) -> np.ndarray:
        """Return [H, W, 3] float32 light of codes by the curves, in the primaries of the codes."""
        levels = int(np.iinfo(pixels.dtype).max)
        if levels not in self._decoders:
            curves = self.curves or (_srgb_curve(_SAMPLES),)
            curves = curves[:1] if all(curve is curves[0] for curve in curves) else curves[:3]
            codes = np.linspace(0, 1, levels + 1)
            tables = [np.interp(codes, np.linspace(0, 1, len(c)), c).astype(np.float32) for c in curves]
            self._decoders[levels] = tables
        decoders = self._decoders[levels]
        if len(decoders) == 1:
            return decoders[0][pixels]
        return np.stack([decoder[pixels[..., channel]] for channel, decoder in enumerate(decoders)], axis=-1)

    @cached_property
    def _decoders(self) -> dict[int, list[np.ndarray]]:
        """Decoded values of all codes, by the largest code; one array if all channels share it."""
        return {}

    def convert(self, image: EncodedImage) -> EncodedImage:
        """Return a photo as the codes of a photo in sRGB, of 16 bits if they change.

        Values above white that the primaries or the light give stay known beside the codes.
        """
        if self.is_srgb:
            return image
        pixels, above, brighter = image.pixels, image.above_white, None
        codes, encode = np.empty(pixels.shape, np.uint16), srgb_codes()
        for rows in bands_of(slice(0, len(pixels)), pixels.shape[1]):
            light, clipped = self.to_linear(pixels[rows], None if above is None else above[rows])
            codes[rows] = np.where(clipped, np.uint16(65535), encode(light))
            measurable = (light > 1) & ~clipped
            if measurable.any():
                brighter = np.zeros(pixels.shape, np.float16) if brighter is None else brighter
                brighter[rows] = np.where(measurable, light, 0)
        deviation = 0.0 if brighter is None else max(DEVIATION, image.above_white_deviation)
        return EncodedImage(codes, image.alpha, brighter, deviation)


def encoding_of(image: Image.Image) -> ColorEncoding | None:
    """Return what an opened image states of its colors, None if it states nothing.

    Later statements are ignored: PNG's cICP, the ICC profile, PNG's sRGB, gAMA and cHRM, TIFF's chromaticities, EXIF.
    A statement that is damaged becomes an encoding with a `problem`, which counts as sRGB.
    """
    if image.format == "PNG":
        cicp = _png_cicp(Path(image.filename))  # pyright: ignore[reportAttributeAccessIssue]
        if cicp is not None:
            return _from_cicp(cicp, "cICP")
    if image.format in ("HEIF", "AVIF"):
        nclx = _nclx(Path(image.filename))  # pyright: ignore[reportAttributeAccessIssue]
        if nclx is not None:
            return nclx
    if image.info.get("icc_profile", b"") is None:  # Pillow found parts that do not fit together
        return ColorEncoding("ICC profile", problem="its ICC profile is damaged")
    if profile := image.info.get("icc_profile"):
        return encoding_of_profile(bytes(profile), "GRAY" if image.mode in _GREY else "RGB")
    if image.format == "PNG":
        return None if "srgb" in image.info else _from_gama(image.info) or _from_exif(image)
    if image.format == "TIFF":
        return _from_tiff(image)
    return _from_exif(image)


@lru_cache(maxsize=64)
def encoding_of_profile(data: bytes, colors: str = "RGB") -> ColorEncoding:
    """Return the encoding that an ICC profile states.

    Args:
        data: the profile.
        colors: of the image, "RGB" or "GRAY"; a grey profile of an image in color is not used.
    """
    try:
        profile = read_profile(data)
        if profile.colors == "GRAY" and colors != "GRAY":
            raise ValueError("is of grey, not RGB")
    except ValueError as error:
        return ColorEncoding("ICC profile", problem=f"its ICC profile {error}")
    name = f"{profile.name} (ICC profile)"
    if profile.cicp is not None and (profile.cicp[1] in _LIGHT or not profile.curves):
        return _from_cicp((*profile.cicp, 1), name)
    if profile.table is not None:
        return ColorEncoding(name, table=profile.table)
    return _simplify(name, profile.to_rec709, profile.curves)


def note_of(encodings: dict[Path, ColorEncoding | None]) -> list[str]:
    """Describe for the user what photos state of their colors.

    Args:
        encodings: by the path of each photo, None for a photo that states nothing.
    """
    notes: dict[tuple[str, str, str], list[Path]] = {}
    for name, encoding in encodings.items():
        if encoding is not None and encoding.problem:
            notes.setdefault(("counts", "count", f"as sRGB: {encoding.problem}"), []).append(name)
        elif encoding is not None and encoding.light:
            text = f"{encoding.light}, {encoding.name}: no response is guessed"
            notes.setdefault(("states", "state", text), []).append(name)
        elif encoding is not None and not encoding.is_srgb:
            text = f"in {encoding.name} and converted to Rec.709"
            notes.setdefault(("is", "are", text), []).append(name)
    return [
        f"colors: {len(names)} of {len(encodings)} photos {one if len(names) == 1 else several} {text} "
        f"({first_names([name.name for name in names], 1)})"
        for (one, several, text), names in notes.items()
    ]


@lru_cache(maxsize=8)
def _srgb_curve(count: int) -> np.ndarray:
    return srgb_to_linear(np.linspace(0, 1, count))


def _simplify(name: str, matrix: np.ndarray | None, curves: tuple[np.ndarray, ...]) -> ColorEncoding:
    """Return an encoding by primaries and curves, without those that are sRGB's or linear."""
    if matrix is not None and np.abs(matrix - np.eye(3)).max() < _SAME:
        matrix = None
    if curves and all(np.abs(curve - np.linspace(0, 1, len(curve))).max() < _SAME for curve in curves):
        return ColorEncoding(name, matrix, (np.linspace(0, 1, _SAMPLES),) * 3, "linear light")
    if curves and all(np.abs(curve - _srgb_curve(len(curve))).max() < _SAME for curve in curves):
        curves = ()
    return ColorEncoding(name, matrix, curves)


def _png_cicp(path: Path) -> tuple[int, int, int] | None:
    """Return primaries, transfer and full range of a PNG's cICP chunk, which Pillow does not read."""
    for kind, length, start in png_chunks(path):
        if kind == b"cICP" and length == 4:
            primaries, transfer, _, full = start.ljust(4, b"\0")
            return primaries, transfer, full
        if kind in (b"IDAT", b"PLTE", b"IEND"):
            return None
    return None


def _nclx(path: Path) -> ColorEncoding | None:
    """Return what the primary picture of a HEIF or AVIF file states by code points, unless it has an ICC profile."""
    try:
        items = read_items(path)
        boxes = [data for kind, data in items.items[items.primary].properties if kind == "colr"]
    except (InputError, KeyError):
        return None
    codes, profile = _code_points(boxes), _profile_in(boxes)
    return encoding_of_code_points(*codes) if codes and (profile is None or codes[1] in _LIGHT) else None


def encoding_of_boxes(boxes: Sequence[bytes]) -> ColorEncoding | None:
    """Return what the `colr` boxes of a picture in a HEIF or AVIF file state, the profile first; None for nothing."""
    if profile := _profile_in(boxes):
        return encoding_of_profile(profile)
    codes = _code_points(boxes)
    return None if codes is None else encoding_of_code_points(*codes)


def encoding_of_code_points(primaries: int, transfer: int) -> ColorEncoding:
    """Return what code points of ITU-T H.273 state of full-range codes, as in a HEIF, AVIF or video file."""
    return _from_cicp((primaries, transfer, 1), "nclx")


def _code_points(boxes: Sequence[bytes]) -> tuple[int, int] | None:
    """Return primaries and transfer of ITU-T H.273 in `colr` boxes, None if they hold none."""
    return next((struct.unpack_from(">2H", box, 4) for box in boxes if box[:4] == b"nclx" and len(box) >= 8), None)


def _profile_in(boxes: Sequence[bytes]) -> bytes | None:
    """Return the ICC profile in `colr` boxes, None if they hold none."""
    return next((box[4:] for box in boxes if box[:4] in (b"prof", b"rICC")), None)


@lru_cache(maxsize=64)
def _from_cicp(values: tuple[int, int, int], source: str) -> ColorEncoding:
    primaries, transfer, full = values
    name = f"{source} {primaries}/{transfer}"
    try:
        matrix = None
        if primaries not in _UNSTATED:
            from colour.models.rgb import itut_h_273 as h273

            places, white = h273.COLOUR_PRIMARIES_ITUTH273[primaries], h273.CCS_WHITEPOINTS_ITUTH273[primaries]
            matrix = matrix_to_rec709((*map(float, np.ravel(places)), *map(float, white)))
        curve = _h273_curve(13 if transfer in _UNSTATED else transfer)
    except (KeyError, ValueError):
        return ColorEncoding(name, problem=f"its {name} is not known")
    if not full:  # The codes of black and white are 16 / 255 and 235 / 255.
        codes = np.linspace(0, 1, len(curve))
        curve = np.interp((255 * codes - 16) / 219, codes, curve)
    if transfer in _LIGHT:
        return ColorEncoding(name, matrix, (curve,) * 3, _LIGHT[transfer])
    return _simplify(name, matrix, (curve,) * 3)


def _h273_curve(transfer: int) -> np.ndarray:
    """Return samples of the decoding of a transfer characteristic, 1 at white; PQ is 1 at _PQ_WHITE."""
    import colour.models as models

    decoders: dict[int, Callable[[np.ndarray], Any]] = {
        5: lambda value: value**2.8,
        8: lambda value: value,
        9: lambda value: np.where(value > 0, 10 ** (2 * (value - 1)), 0),
        10: lambda value: np.where(value > 0, 10 ** (2.5 * (value - 1)), 0),
        16: lambda value: models.eotf_ST2084(value) / _PQ_WHITE,
        17: lambda value: value**2.6,
        18: models.oetf_inverse_BT2100_HLG,
    }
    # Gamma 2.2 as in gAMA.
    decoders |= dict.fromkeys((1, 4, 6, 7, 11, 12, 13, 14, 15), srgb_to_linear)
    return np.asarray(decoders[transfer](np.linspace(0, 1, _SAMPLES)), float)


def _from_gama(info: dict) -> ColorEncoding | None:
    """Return what PNG's gAMA and cHRM state; 1 / 2.2 is how tools write sRGB, 1 / 1.961 how FFmpeg writes BT.709."""
    gamma, places = info.get("gamma"), info.get("chromaticity")
    if gamma is None and places is None:
        return None
    matrix, curves = None, ()
    if places is not None:
        white, red, green, blue = (tuple(places[i : i + 2]) for i in range(0, 8, 2))
        try:
            matrix = matrix_to_rec709((*red, *green, *blue, *white))
        except (ValueError, TypeError):
            return ColorEncoding("cHRM", problem="its cHRM (primaries) spans no colors")
    if gamma is not None:
        if not 0.05 < gamma < 20:
            return ColorEncoding("gAMA", problem=f"its gAMA is {gamma:g}")
        if abs(gamma * 2.2 - 1) > 0.02 and abs(gamma - _BT709_GAMMA) > 1e-3:
            curves = (np.linspace(0, 1, _SAMPLES) ** (1 / gamma),) * 3
    if gamma is None:
        return _simplify("cHRM, without a curve (frames of HLG and PQ clips: give the clip itself),", matrix, curves)
    return _simplify(f"gAMA {gamma:.5g}{'' if matrix is None else ' and cHRM'}", matrix, curves)


def _from_tiff(image: Image.Image) -> ColorEncoding | None:
    tags = getattr(image, "tag_v2", {})
    places, white = tags.get(319), tags.get(318)
    if not places or len(places) != 6:
        return _from_exif(image)
    try:
        white = tuple(map(float, white)) if white and len(white) == 2 else REC709[6:]
        matrix = matrix_to_rec709((*map(float, places), *white))
    except (ValueError, TypeError, ZeroDivisionError):
        return ColorEncoding("TIFF", problem="its PrimaryChromaticities span no colors")
    return _simplify("primaries of the TIFF", matrix, ())


def _from_exif(image: Image.Image) -> ColorEncoding | None:
    """Return Adobe RGB for EXIF's ColorSpace 2, or for interoperability index R03 (DCF 2.0)."""
    # To parse EXIF takes longer than to open a JPEG, so its bytes are looked at first.
    raw = image.info.get("exif", b"")
    if image.format in ("JPEG", "MPO", "WEBP") and not (isinstance(raw, bytes) and _NOT_SRGB.search(raw)):
        return None
    try:
        exif = exif_of(image)
        space = exif.get_ifd(_EXIF_IFD).get(_COLOR_SPACE)
        if space in (None, 1):
            return None
        index = str(exif.get_ifd(_INTEROP[0]).get(_INTEROP[1]) or "").strip("\0 ")
    except PILLOW_ERRORS:
        return None
    return _adobe_rgb() if space == 2 or index == "R03" else None


@cache
def _adobe_rgb() -> ColorEncoding:
    curve = np.linspace(0, 1, _SAMPLES) ** _ADOBE_GAMMA
    return ColorEncoding("Adobe RGB (EXIF)", matrix_to_rec709(_ADOBE_RGB), (curve,) * 3)
