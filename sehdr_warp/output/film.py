"""Films of camera paths.

H.264 for any display, HEVC with 10 bits as HLG or HDR10 for HDR displays, or ProRes 4444 in a camera's logarithm for
grading.
"""

import logging
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError, SehdrError, did_you_mean, path_of, require_extra, require_loaded
from ..files import atomic_path
from ..progress import stage
from ..scene import Camera
from ..scene.camera import require_camera
from .cameras.selection import reframe
from .images.colorspace import color_space, matrix_to
from .images.display import display_gain, encode_srgb
from .render_views import shared_tone_map

if TYPE_CHECKING:
    from ..runs.run import RenderableScene

log = logging.getLogger(__name__)

REFERENCE_WHITE, PEAK = 203.0, 1000.0
"""cd/m^2 of the photos' white in HDR (ITU-R BT.2408), and of the brightest that is shown."""


@dataclass(frozen=True)
class Transfer:
    """Encoding of light as codes."""

    codec: str  # Encoder of FFmpeg
    pixels: str  # Pixel format of FFmpeg
    options: dict[str, str]  # Options of the encoder
    primaries: int  # Code point of ITU-T H.273, as are the next two
    curve: int  # Transfer characteristics
    matrix: int  # Matrix coefficients


_X265 = "log-level=error:repeat-headers=1"
# x265 4 writes beyond its arrays for adaptive quantization of pictures narrower than 50 pixels.
_X265_SMALL, _X265_SMALLEST_SIDE = ":aq-mode=0:no-cutree=1", 64
# With B-frames, decoding times of films of one or two frames are whatever its memory held.
_X265_SHORT, _X265_SHORTEST = ":bframes=0", 3
# As if mastered on a Rec.2020 display of PEAK; the steps are 0.00002 and 0.0001 cd/m2. No pixel is brighter. The
# mean of the brightest frame is not known while the first one is written; 0 states that.
_MASTER = "hdr-opt=1:master-display=G(8500,39850)B(6550,2300)R(35400,14600)WP(15635,16450)L(10000000,50):max-cll=1000,0"
LOG_CURVES = {
    "logc3": ("ARRI LogC3", "ARRI Wide Gamut 3"),
    "slog3": ("S-Log3", "S-Gamut3.Cine"),
    "acescct": ("ACEScct", "ACEScg"),
}
"""Curve and primaries of each logarithm, as colour-science names them. H.273 has no code points for them."""
TRANSFERS = {
    "sdr": Transfer("libx264", "yuv420p", {"crf": "16", "preset": "medium"}, 1, 1, 1),
    "hlg": Transfer("libx265", "yuv420p10le", {"crf": "18", "x265-params": _X265}, 9, 18, 9),
    "hdr10": Transfer("libx265", "yuv420p10le", {"crf": "18", "x265-params": f"{_X265}:{_MASTER}"}, 9, 16, 9),
    **dict.fromkeys(LOG_CURVES, Transfer("prores_ks", "yuv444p10le", {"profile": "4444"}, 2, 2, 1)),
}
_FASTSTART = (".mp4", ".mov", ".m4v")
FORMATS = {".mp4": "mp4", ".m4v": "mp4", ".mov": "mov", ".mkv": "matroska", ".avi": "avi", ".ts": "mpegts"}
"""FFmpeg's formats by suffix: those of one file. Others write further files beside it, whoever owns their names."""
_SLOWEST, _FASTEST = 0.1, 1000.0  # Frames a second
_NTSC = 1e-4  # Relative difference up to which a rate is a whole one over 1.001, as of television
_SAME_SHAPE = 0.01  # Relative difference of width over height up to which it is that of rounded sizes
_SQUARE = 0.005  # Difference of width and height up to which a calibrated camera's pixels are meant to be square


def write_film(
    run: "RenderableScene",
    out: Path | str,
    cameras: Sequence[Camera],
    *,
    fps: float = 24.0,
    transfer: str = "sdr",
    ev_ramp: tuple[float, float] = (0.0, 0.0),
    exposed: bool = False,
    overwrite: bool = False,
    tell: Callable[[str], None] | None = None,
) -> Path:
    """Render a film of cameras, one each frame, at the size of the first, and return its path.

    Cameras of another shape keep their vertical field of view, and show more or less at the sides.

    Args:
        run: From load_run, train or load_splats.
        out: The file; its suffix decides the container.
        cameras: One for each frame.
        fps: Frames a second.
        transfer: "sdr": H.264 in Rec.709, tone-mapped by one map for all frames, or exposed and
            clipped as by a camera if the ramp moves. "hlg", "hdr10": 10-bit HEVC in
            Rec.2020 in which the photos' white is 203 cd/m2 and light is kept up to 1000. "logc3", "slog3", "acescct":
            10-bit ProRes 4444 (.mov) in which the photos' white is a reflectance of 1.
        ev_ramp: Stops from the photos' exposure at the first and the last frame, changing evenly.
        exposed: Expose and clip SDR as a camera does, instead of tone mapping. Also done if the ramp moves.
        overwrite: Replace a film that exists.
        tell: Receives a line of progress at each frame, as the viewer shows it; by default the log has one now and
            then.

    Raises:
        SehdrError: Without PyAV (the extra `film`) or its encoder, without cameras, for another transfer or ramp, or
            for a panorama among cameras of another shape.
        TypeError: For what is not a Camera.
        InputError: If `out` exists (unless overwrite), or is not a film in one file by its suffix.
    """
    require_loaded("load_run", run)
    _check_options(cameras, transfer, ev_ramp)
    out = path_of(out, "out")
    av, kind = film_library(), TRANSFERS[transfer]
    first, container_format = cameras[0], film_format(out)
    check_rate(fps)
    frames = _at_one_size(cameras, out)
    width, height = frames[0].width, frames[0].height
    aspect = first.fy / first.fx if first.is_pinhole else 1.0  # Width of a pixel over its height
    gain = run.base_time * display_gain(run.response)
    stops = np.linspace(*ev_ramp, len(cameras))
    mapped = transfer == "sdr" and not exposed and ev_ramp[0] == ev_ramp[1]
    tone_map = shared_tone_map(run, cameras) if mapped else None
    options = {"movflags": "faststart"} if out.suffix.lower() in _FASTSTART else {}
    with atomic_path(out, overwrite) as temporary:
        try:
            # FFmpeg takes what stands before a colon for a protocol, and would connect to a URL.
            name = f"file:{temporary.absolute()}"
            with av.open(name, "w", format=container_format, options=options) as container:
                stream = _add_stream(container, kind, fps, width, height, len(cameras))
                if abs(aspect - 1) > _SQUARE:
                    stream.codec_context.sample_aspect_ratio = Fraction(aspect).limit_denominator(100)
                for camera, ev in zip(_with_progress(frames, out, tell), stops):
                    hdr = run.render(camera).hdr.cpu().numpy() * np.float32(2.0**ev)
                    encoded = tone_map(hdr) if tone_map else encode(hdr * np.float32(gain), transfer)
                    for packet in stream.encode(_frame(av, encoded, kind)):
                        container.mux(packet)
                for packet in stream.encode():
                    container.mux(packet)
        except (av.FFmpegError, ValueError) as error:
            remedy = f"choose {'.mov' if transfer in LOG_CURVES else '.mp4'} or another size"
            raise SehdrError(f"{out}: cannot be written as a film ({error}); {remedy}") from error
    return out


def _at_one_size(cameras: Sequence[Camera], out: Path) -> list[Camera]:
    """Return cameras at the size of the first, up to a pixel of each side."""
    first = cameras[0]
    # Chroma of 4:2:0 covers two by two pixels.
    size = max(2, first.width - first.width % 2), max(2, first.height - first.height % 2)
    shapes = np.array([camera.width / camera.height for camera in cameras])
    alike = abs(shapes / shapes[0] - 1) < _SAME_SHAPE
    if others := (~alike).sum():
        problem = (
            f"{others} of {len(cameras)} cameras are not of the shape of the first, {first.width} x {first.height}"
        )
        log.warning("%s: %s: their frames show more or less at the sides", out, problem)
    return [camera.resized(*size) if same else reframe(camera, *size) for camera, same in zip(cameras, alike)]


def _check_options(cameras: Sequence[Camera], transfer: str, ev_ramp: tuple[float, float]) -> None:
    """Raise for what no film can be made of; `cameras` may be something else than the annotation says."""
    if not isinstance(cameras, Sequence) or not cameras:
        raise SehdrError(f"cameras: {cameras or 'none'}; a film has a list of Cameras, one for each frame")
    for camera in cameras:
        require_camera(camera)
    if transfer not in TRANSFERS:
        hint = did_you_mean(str(transfer), TRANSFERS)
        raise SehdrError(f"transfer {transfer!r} is not one of {', '.join(TRANSFERS)}{hint}")
    numbers = [stops for stops in np.ravel(ev_ramp) if isinstance(stops, Real) and math.isfinite(stops)]
    if np.shape(ev_ramp) != (2,) or len(numbers) != 2:
        raise SehdrError(f"ev_ramp {ev_ramp} is not two numbers of stops, of the first and the last frame")


def _add_stream(container: Any, kind: Transfer, fps: float, width: int, height: int, count: int) -> Any:
    """Add the video stream of a film of `count` frames to a container of PyAV, and return it."""
    stream = container.add_stream(kind.codec, rate=_frame_rate(fps))
    stream.width, stream.height, stream.pix_fmt = width, height, kind.pixels
    stream.options = kind.options
    context = stream.codec_context
    if kind.codec == "libx265":
        small = _X265_SMALL if min(width, height) < _X265_SMALLEST_SIDE else ""
        short = _X265_SHORT if count < _X265_SHORTEST else ""
        stream.options = kind.options | {"x265-params": kind.options["x265-params"] + small + short}
        context.codec_tag = "hvc1"  # What Apple's players look for.
    context.color_primaries, context.color_trc, context.colorspace = kind.primaries, kind.curve, kind.matrix
    context.color_range = 1
    return stream


def _frame_rate(fps: float) -> Fraction:
    """Return frames a second as a fraction: of 23.976, 29.97 and the like, whole rates over 1.001."""
    whole = round(fps * 1.001)
    if fps != round(fps) and abs(whole / 1.001 - fps) < _NTSC * fps:
        return Fraction(whole * 1000, 1001)
    return Fraction(fps).limit_denominator(1001)


def film_format(out: Path | str) -> str:
    """Return FFmpeg's name of the format of a film.

    Raises:
        InputError: For a URL, and for a suffix that is not one of FORMATS.
    """
    if re.match(r"[a-z][a-z0-9+.-]+:/", str(out), re.IGNORECASE):
        raise InputError(out, "is a URL", "name a file")
    suffix = Path(out).suffix.lower()
    if suffix not in FORMATS:
        raise InputError(out, f"{suffix or 'no suffix'} is not the suffix of a film", f"use one of {' '.join(FORMATS)}")
    return FORMATS[suffix]


def check_rate(fps: float) -> None:
    """Raise TypeError for what is no number, and SehdrError for frames a second that no film has."""
    if not isinstance(fps, Real):
        raise TypeError(f"fps is {fps!r:.60}, expected a number")
    if not _SLOWEST <= fps <= _FASTEST:
        raise SehdrError(f"{fps} frames a second are not between {_SLOWEST} and {_FASTEST}")


def encode(light: np.ndarray, transfer: str) -> np.ndarray:
    """Encode [..., 3] linear Rec.709 display light, in which 1 is the photos' white, as R'G'B' in [0, 1].

    sdr: Rec.709's primaries, the sRGB curve. hdr10: Rec.2020, SMPTE ST 2084 of cd/m2. hlg: Rec.2020, BT.2100's OETF of
    the scene light that its system gamma of 1.2 shows as this light on a display of 1000 cd/m2. logc3 (at EI 800),
    slog3, acescct: in the primaries of LOG_CURVES.
    """
    if transfer == "sdr":
        return encode_srgb(light)
    import colour

    if transfer in LOG_CURVES:
        curve, primaries = LOG_CURVES[transfer]
        linear = np.maximum(np.asarray(light, np.float64) @ matrix_to(primaries).T, 1e-10)
        return np.clip(colour.log_encoding(linear, curve), 0, 1)
    white = np.asarray(light, np.float64) @ matrix_to(color_space("rec2020").dataset).T
    luminances = np.clip(REFERENCE_WHITE * white, 1e-12, PEAK)  # The curves divide by them.
    if transfer == "hdr10":
        return colour.models.eotf_inverse_ST2084(luminances)
    with np.errstate(invalid="ignore"):  # In the half of the curve that is not used.
        return np.clip(colour.models.eotf_inverse_BT2100_HLG(luminances, L_B=0, L_W=PEAK, gamma=1.2), 0, 1)


def _frame(av: Any, encoded: np.ndarray, kind: Transfer) -> Any:
    """Return a video frame of R'G'B' [H, W, 3] in [0, 1].

    FFmpeg's scaler converts it to Y'CbCr by the matrix of the transfer.
    """
    deep = np.rint(np.clip(encoded, 0, 1) * 65535).astype(np.uint16)
    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(deep), format="rgb48le")
    spaces = {1: "ITU709", 9: "BT2020"}
    converted = frame.reformat(format=kind.pixels, dst_colorspace=spaces[kind.matrix], dst_color_range="MPEG")
    converted.color_primaries, converted.color_trc, converted.colorspace = kind.primaries, kind.curve, kind.matrix
    return converted


def _with_progress(cameras: Sequence[Camera], out: Path, tell: Callable[[str], None] | None) -> Iterator[Camera]:
    """Yield the cameras, and report progress as a stage and through `tell`."""
    with stage(f"{out.name}: frames", len(cameras), log) as progress:
        for index, camera in enumerate(cameras):
            progress.update(index)
            if tell and index:
                tell(progress.line())
            yield camera


def film_library() -> Any:
    """Return PyAV; raise SehdrError if it is not installed."""
    return require_extra("av", "films need PyAV", "film")
