"""Colors of a clip: what its stream, its frames and its metadata state of matrix, range, curve and primaries."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...errors import InputError
from ..color.encoding import ColorEncoding, encoding_of_code_points
from ..color.primaries import matrix_to_rec709
from ..types import codes_of

if TYPE_CHECKING:
    from ...response import Response

# Codes of ITU-T H.273: transfer characteristics, color primaries and matrix coefficients.
_HLG, _PQ, _GAMMA_28 = 18, 16, 5
_UNSPECIFIED = 2
_STATED_CURVES = {_HLG: "colour:ITU-R BT.2100 HLG", _PQ: "colour:ST 2084"}
_CURVE_NAMES = {
    1: "Rec.709", 4: "gamma 2.2", 5: "gamma 2.8", 6: "Rec.601", 8: "linear", 13: "sRGB", 14: "Rec.2020", 15: "Rec.2020",
    16: "PQ", 18: "HLG",
}  # fmt: skip
_PRIMARIES = {
    5: "ITU-R BT.470 - 625", 6: "SMPTE C", 7: "SMPTE C", 9: "ITU-R BT.2020", 11: "DCI-P3", 12: "Display P3",
}  # fmt: skip
_LUMA = {
    1: (0.2126, 0.0722), 4: (0.30, 0.11), 5: (0.299, 0.114), 6: (0.299, 0.114), 7: (0.212, 0.087), 9: (0.2627, 0.0593),
}  # fmt: skip
# Matrix coefficients that are not luma and color differences of encoded values; FFmpeg does not convert them either.
_OTHER_MATRICES = {8: "YCgCo", 10: "constant-luminance BT.2020", 11: "Y'D'zD'x", 12: "YCbCr of its own primaries",
                   13: "constant-luminance YCbCr of its own primaries", 14: "ICtCp", 15: "IPT-C2", 16: "YCgCo-Re",
                   17: "YCgCo-Ro"}  # fmt: skip
_DOLBY_VISION = ("dvh1", "dvhe", "dva1", "dvav", "dav1")
"""Codec tags of Dolby Vision. Without a stated curve the stream is profile 5, whose colors only Dolby's decoder knows;
phones write profile 8, which is HLG."""
_FULL_RANGE = 2
_OUTSIDE = 0.02  # Negative channel of a color outside Rec.709, as a part of its largest one: less is noise
_NEAR_WHITE = 0.9  # In light
# What makers call their log curves in a clip's metadata: colour-science's curve, and the primaries that belong to it.
_LOGS = {
    "applelog": ("Apple Log Profile", "ITU-R BT.2020"), "llog": ("L-Log", "ITU-R BT.2020"),
    "slog3": ("S-Log3", "S-Gamut3.Cine"), "slog2": ("S-Log2", "S-Gamut"), "vlog": ("V-Log", "V-Gamut"),
    "canonlog3": ("Canon Log 3", "Cinema Gamut"), "canonlog2": ("Canon Log 2", "Cinema Gamut"),
    "clog3": ("Canon Log 3", "Cinema Gamut"), "clog2": ("Canon Log 2", "Cinema Gamut"),
    "dlog": ("D-Log", "DJI D-Gamut"), "nlog": ("N-Log", "N-Gamut"), "flog2": ("F-Log2", "F-Gamut"),
    "flog": ("F-Log", "F-Gamut"), "logc4": ("ARRI LogC4", "ARRI Wide Gamut 4"),
    "logc3": ("ARRI LogC3", "ARRI Wide Gamut 3"), "log3g10": ("Log3G10", "REDWideGamutRGB"),
}  # fmt: skip


@dataclass(frozen=True)
class VideoColor:
    """Colors that a clip states."""

    curve: str  # Of its codes, in words
    response: str | None  # Name of the response that the curve stands for; None for a camera's own development (SDR)
    primaries: str | None  # Name of the primaries in colour-science; None for Rec.709
    matrix: tuple[float, float] | None  # (kr, kb) of the luma that the codes were made with; None for stored RGB
    full_range: bool  # Whether codes use the whole range
    bits: int  # Of a sample
    display: ColorEncoding | None = None  # From the codes to sRGB's; None if they are these, or have a response

    def to_rec709(self) -> np.ndarray | None:
        """Return [3, 3] from the clip's linear colors to linear Rec.709, or None if they are Rec.709."""
        if self.primaries is None:
            return None
        import colour

        space = colour.RGB_COLOURSPACES[self.primaries]
        return matrix_to_rec709((*map(float, np.ravel(space.primaries)), *map(float, space.whitepoint)))


def outside_rec709(pixels: np.ndarray, color: VideoColor) -> float:
    """Return the part of a frame's pixels [H, W, 3], codes, whose colors lie outside Rec.709.

    0 for a clip that states no curve or is in Rec.709. Pixels darker than a tenth of the mean do not count, because
    their colors are noise.
    """
    from ...response import response_by_name

    matrix = color.to_rec709()
    if matrix is None or color.response is None:
        return 0.0
    light = response_by_name(color.response).decode(pixels / np.iinfo(pixels.dtype).max) @ matrix.T
    largest = light.max(2)
    return float(((light.min(2) < -_OUTSIDE * largest) & (largest > 0.1 * largest.mean())).mean())


def codes_in_rec709(codes: np.ndarray, response: "Response", to_rec709: np.ndarray) -> np.ndarray:
    """Return [H, W, 3] uint16 codes of a response in Rec.709, from codes of the same response in other primaries.

    Where a channel is clipped, those that come out near white or above it are.
    """
    levels = int(np.iinfo(codes.dtype).max)
    decoded = response.decode(np.arange(levels + 1, dtype=np.float64) / levels).astype(np.float32)
    light = decoded[codes] @ to_rec709.T.astype(np.float32)
    clipped = (codes == levels).any(2, keepdims=True) & (light > _NEAR_WHITE * decoded[-1])
    return codes_of(np.where(clipped, np.float32(1), response.encode(np.maximum(light, 0))), 16)


def read_color(container: Any, stream: Any, frame: Any, path: Path) -> VideoColor:
    """Return the colors that stream, frame and metadata state.

    Raises:
        InputError: if its samples are of another kind than luma and color differences, or RGB.
    """
    context = stream.codec_context
    transfer, primaries, matrix = (
        int(getattr(context, name, _UNSPECIFIED) or _UNSPECIFIED)
        for name in ("color_trc", "color_primaries", "colorspace")
    )
    if matrix in _OTHER_MATRICES and not frame.format.is_rgb:
        problem = f"its frames are stored as {_OTHER_MATRICES[matrix]}, which is not read"
        raise InputError(path, problem, "convert the clip to YCbCr of BT.2020 or BT.709")
    if transfer == _UNSPECIFIED and context.codec_tag in _DOLBY_VISION:
        problem = "is Dolby Vision of profile 5, whose colors only Dolby's decoder knows"
        raise InputError(path, problem, "convert it to HLG or PQ, or film in HLG")
    bits = max((component.bits for component in frame.format.components), default=8)
    bits = min(max(bits, 8), 16)
    full = int(context.color_range or 0) == _FULL_RANGE or frame.format.name.startswith("yuvj")
    luma = None if frame.format.is_rgb else _LUMA.get(matrix, _LUMA[1 if frame.height > 576 else 5])
    texts = [*container.metadata.items(), *stream.metadata.items()]
    color = VideoColor("", None, _PRIMARIES.get(primaries), luma, full, bits)
    if log := _log_curve(texts, transfer, primaries, bits):
        return replace(color, curve=log[0], response=f"colour:{log[0]}", primaries=log[1])
    if transfer in _STATED_CURVES:
        # Where a clip states HLG or PQ alone, its primaries are those of BT.2100.
        space = color.primaries or (None if primaries == 1 else "ITU-R BT.2020")
        return replace(color, curve=_CURVE_NAMES[transfer], response=_STATED_CURVES[transfer], primaries=space)
    if transfer == 8:
        return replace(color, curve="linear", response="linear")
    display = encoding_of_code_points(_UNSPECIFIED, _GAMMA_28) if transfer == _GAMMA_28 else None
    return replace(color, curve=_CURVE_NAMES.get(transfer, "no curve"), display=display)


def _log_curve(texts: list[tuple[str, str]], transfer: int, primaries: int, bits: int) -> tuple[str, str] | None:
    """Return colour-science's names of a log curve and its primaries if a clip states them."""
    for _, text in texts:
        plain = "".join(letter for letter in text.lower() if letter.isalnum())
        for name, curve in _LOGS.items():
            if plain == name or plain.endswith(name) or f"gamma{name}" in plain:
                return curve
    makers = {text.lower() for key, text in texts if key.lower().endswith("make")}
    # iPhones leave the transfer function of Apple Log open, and state BT.2020 with 10 bits.
    if transfer == _UNSPECIFIED and primaries == 9 and bits >= 10 and "apple" in makers:
        return _LOGS["applelog"]
    return None
