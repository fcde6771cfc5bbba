"""Video as photos: a clip's color as its stream states it, and frames of it as upright RGB codes.

PyAV (FFmpeg) decodes. Luma and chroma are converted here, with the stream's matrix and range and all of its bits. A
stream that states HLG, PQ or a camera's log curve has a known response. One that states an SDR curve was developed by
the camera, and its response is found as for photos.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from ...errors import InputError, require_extra
from ...sandbox import read_sandboxed
from ..images.ldr_files import MAX_PIXELS, check_size
from .chroma import upsample_chroma
from .color import VideoColor, read_color

_log = logging.getLogger("sehdr_warp.scene")

VIDEO_SUFFIXES = (
    ".mp4", ".mov", ".m4v", ".3gp", ".mkv", ".avi", ".webm", ".mts", ".m2ts", ".ts", ".mpg", ".mpeg", ".mxf",
)  # fmt: skip
_IN_ONE_FRAME = b"\1", b"\2", b"\4", b"\5", b"\6", b"\7"  # FFmpeg's AVStereo3DType of two pictures in a frame
UNSTITCHED_SUFFIXES = (".insv", ".insp", ".360", ".lrv")
"""Pictures of two lenses of Insta360 and GoPro, before their own programs join them."""
UNSTITCHED_REMEDY = "export them from the camera's program as equirectangular photos or one equirectangular MP4"
_SMALLEST = 16  # Pixels of a frame's side: fewer show no movement
_REMEDY = "copy the clip again, or convert it with FFmpeg"
# FFmpeg's demuxers of VIDEO_SUFFIXES, by content. Others, such as playlists, would open the files that they name.
_DEMUXERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,mxf"
_OPTIONS = {"format_whitelist": _DEMUXERS, "protocol_whitelist": "file"}


@dataclass(frozen=True)
class Clip:
    """A video file that was opened once."""

    path: Path  # The file
    size: tuple[int, int]  # (width, height) of a frame, upright, in square pixels
    seconds: float  # Its length as the file states it; 0 if it does not
    color: VideoColor  # What the stream states
    interlaced: bool = False  # Whether even and odd rows of a frame are of two moments
    anamorphic: bool = False  # Whether the stored pixels are not square


def is_video(path: Path) -> bool:
    """Return whether a path names a video file."""
    return path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()


def open_clip(path: Path) -> Clip:
    """Return what a video file states.

    A process of its own reads it first, with bounds on memory and time, because FFmpeg believes the counts in a file.

    Raises:
        InputError: if it cannot be read, has no picture, or its frames are too large.
        SehdrError: if PyAV is not installed.
    """
    require_extra("av", f"{path}: video needs PyAV", "film")
    read_sandboxed(first_frame_size, path, "video", _REMEDY)
    with _container(path) as container:
        stream = _stream(container, path)
        frame = _first_frame(container, stream, path)
        if (packed := frame.side_data.get("STEREO3D")) is not None and bytes(packed)[:1] in _IN_ONE_FRAME:
            problem = "its frames hold the pictures of two lenses side by side or in turns of rows"
            raise InputError(path, problem, "crop it to the picture of one lens, such as by FFmpeg")
        if stream.metadata.get("alpha_mode") == "1" or any(part.is_alpha for part in frame.format.components):
            _log.warning("%s: its transparency is ignored, so transparent pixels count as visible", path)
        width, height = frame.width, frame.height
        aspect = float(stream.sample_aspect_ratio or 1)
        if not 0.25 <= aspect <= 4:
            raise InputError(path, f"states pixels {aspect:g} times as wide as high", "correct its sample aspect ratio")
        width, height = round(width * max(aspect, 1)), round(height / min(aspect, 1))  # So that no pixel is lost
        check_size(path, width, height)
        if min(width, height) < _SMALLEST:
            raise InputError(path, f"its frames have {width} x {height} pixels", f"give {_SMALLEST} and more a side")
        size = (height, width) if _orientation(frame).turns % 2 else (width, height)
        seconds = float(container.duration or 0) / 1e6
        color = read_color(container, stream, frame, path)
        return Clip(path, size, seconds, color, bool(frame.interlaced_frame), aspect != 1)


def first_frame_size(path: Path) -> dict[str, np.ndarray]:
    """Return `size`, the width and height of a clip's first frame as stored; raise ValueError if it has none."""
    try:
        with _container(path, threads=False) as container:
            frame = _first_frame(container, _stream(container, path), path)
            return {"size": np.array([frame.width, frame.height])}
    except InputError as error:
        raise ValueError(error.problem) from None


def _first_frame(container: Any, stream: Any, path: Path) -> Any:
    import av

    try:
        return next(iter(container.decode(stream)))
    except (StopIteration, EOFError):
        raise InputError(path, "has no frames", _REMEDY) from None
    except av.error.FFmpegError as error:  # pyright: ignore[reportAttributeAccessIssue]
        raise InputError(path, f"its first frame is damaged ({error.strerror:.80})", _REMEDY) from None


def decode(clip: Clip, counts: Any = None) -> Iterator[tuple[int, Any]]:
    """Yield the frames of a clip with their numbers, from the first.

    A clip that ends early, or is damaged in the middle, yields what can be decoded, and a line says so. Frames of
    another size than the first are left out, as where recordings were joined.

    Args:
        clip: the clip.
        counts: container of frame numbers; others are decoded, but not yielded. None yields all.
    """
    import av

    errors: Any = av.error  # pyright: ignore[reportAttributeAccessIssue]
    number, odd, size = -1, 0, None
    with _container(clip.path) as container:
        stream = _stream(container, clip.path)
        packets = container.demux(stream)
        while True:
            try:
                packet = next(packets)
                frames = packet.decode()
            except StopIteration:
                return
            except errors.FFmpegError as error:
                if isinstance(error, EOFError) or number < 0:
                    return
                _log.warning("%s: is damaged or ends early after frame %d", clip.path, number + 1)
                return
            for frame in frames:
                number += 1
                size = size or (frame.width, frame.height)
                if (frame.width, frame.height) != size:
                    if not odd:
                        _log.warning("%s: frames of another size from frame %d on are left out", clip.path, number)
                    odd += 1
                    continue
                if counts is None or number in counts:
                    yield number, frame


def grey(frame: Any, width: int) -> np.ndarray:
    """Return [h, w] float32 codes in [0, 1] of a frame's luma, as stored, at most `width` pixels wide."""
    width = min(width, frame.width)
    height = max(2, round(width * frame.height / frame.width))
    small = frame.reformat(width=width, height=height, format="gray")
    return small.to_ndarray().astype(np.float32) / np.float32(255)


def codes(frame: Any, color: VideoColor) -> np.ndarray:
    """Return [H, W, 3] codes of a frame, upright: uint8 for 8 bits, else uint16."""
    if color.matrix is None:
        rgb = _reformat(frame, "rgb48le", color).to_ndarray() / np.float32(65535)
    else:
        kr, kb = color.matrix
        y, uv = _luma_and_chroma(frame, color)
        red, blue = y + 2 * (1 - kr) * uv[..., 1], y + 2 * (1 - kb) * uv[..., 0]
        rgb = np.stack([red, (y - kr * red - kb * blue) / (1 - kr - kb), blue], axis=2)
    levels, kind = (255, np.uint8) if color.bits == 8 else (65535, np.uint16)
    orientation = _orientation(frame)
    upright = np.rot90(rgb[:, ::-1] if orientation.mirrored else rgb, orientation.turns)
    return np.ascontiguousarray(np.rint(np.clip(upright, 0, 1) * levels).astype(kind))


def in_square_pixels(pixels: np.ndarray, clip: Clip) -> np.ndarray:
    """Return the codes of a frame [H, W, 3] at the clip's size: anamorphic pixels are interpolated, others stay."""
    if not clip.anamorphic:
        return pixels
    planes = [Image.fromarray(pixels[..., i].astype(np.float32)) for i in range(3)]
    resized = [np.asarray(plane.resize(clip.size, Image.Resampling.BILINEAR)) for plane in planes]
    return np.rint(np.stack(resized, axis=2)).astype(pixels.dtype)


def _luma_and_chroma(frame: Any, color: VideoColor) -> tuple[np.ndarray, np.ndarray]:
    """Return luma [H, W] from 0 to 1 and chroma [H, W, 2] from -0.5 to 0.5, as float32."""
    component = frame.format.components[min(1, len(frame.format.components) - 1)]  # Grey has luma alone
    sizes = (frame.height, component.height), (frame.width, component.width)
    rows, columns = (bool(2 * small - size in (0, 1) and small < size) for size, small in sizes)  # Whether halved
    # FFmpeg interpolates chroma of other sizes, such as a quarter of the width.
    layout = {(False, True): "yuv422p16le", (True, True): "yuv420p16le"}.get((rows, columns), "yuv444p16le")
    y, u, v = _planes(_reformat(frame, layout, color))
    top, step = 2**color.bits - 1, np.float32(1 << (16 - color.bits))
    if color.full_range:
        # Below the bits of luma, FFmpeg repeats the highest ones (white is 65535) or, by layout, puts zeros.
        y, chroma = np.floor(y / step) / np.float32(top), top * step
    else:
        y, chroma = (y - np.float32(16 * 256)) / np.float32(219 * 256), 224 * 256
    uv = (np.stack([u, v], axis=2) - 32768) / np.float32(chroma)
    if uv.shape[:2] == y.shape:
        return y, uv
    down, right = _chroma_places(frame, layout)
    return y, upsample_chroma(y, uv, (down if rows else None, right if columns else None))


def _reformat(frame: Any, layout: str, color: VideoColor | None = None) -> Any:
    from av.video.reformatter import ColorRange, Interpolation

    same = ColorRange.JPEG if color is not None and color.full_range else ColorRange.MPEG
    return frame.reformat(
        format=layout, src_color_range=same, dst_color_range=same, interpolation=Interpolation.BICUBIC
    )


def _planes(frame: Any) -> list[np.ndarray]:
    """Return the samples of each plane of a frame of 16 bits as float32 [h, w]."""
    rows = [np.frombuffer(plane, "<u2").reshape(-1, plane.line_size // 2) for plane in frame.planes]
    return [row[: p.height, : p.width].astype(np.float32) for row, p in zip(rows, frame.planes, strict=True)]


def _chroma_places(frame: Any, layout: str) -> tuple[float, float]:
    """Return where a frame's first chroma sample lies, down and to the right of its first luma sample, in luma samples.

    PyAV does not pass on what the stream states, so FFmpeg interpolates a ramp of chroma with this frame's properties.
    """
    probe = frame.reformat(width=32, height=32, format=layout)
    steps = (2 if layout == "yuv420p16le" else 1), 2
    for plane, axis in zip(probe.planes, (None, 1, 0), strict=True):
        rows, columns = np.indices((plane.height, plane.line_size // 2))
        ramp = 0 * rows if axis is None else 1000 * steps[axis] * (columns if axis else rows)
        plane.update((20_000 + ramp).astype("<u2").tobytes())
    _, right, down = _planes(_reformat(probe, "yuv444p16le"))
    offsets = (16 - (ramp[16, 16] - 20_000) / 1000 for ramp in (down, right))
    first, second = (float(np.clip(round(2 * place) / 2, 0, 1)) for place in offsets)
    return first, second


class _Orientation(NamedTuple):
    """Way of a stored frame to an upright one."""

    turns: int  # Quarter turns counterclockwise
    mirrored: bool  # Whether it is mirrored left to right before that, as by front cameras


def _orientation(frame: Any) -> _Orientation:
    """Return what the display matrix of a frame asks for: x' = a x + c y, y' = b x + d y, with y down."""
    stored = frame.side_data.get("DISPLAYMATRIX")
    if stored is None or len(data := bytes(stored)) < 20:
        return _Orientation(0, mirrored=False)
    a, b, _, c, d = np.frombuffer(data[:20], np.int32) / 65536
    mirrored = bool(a * d - b * c < 0)
    a, b = (-a, -b) if mirrored else (a, b)
    return _Orientation(round(-np.degrees(np.arctan2(b, a)) / 90) % 4, mirrored)


def _container(path: Path, *, threads: bool = True) -> Any:
    """Return PyAV's open container. Raises InputError for another kind of file."""
    import av

    try:
        # FFmpeg takes what stands before a colon for a protocol.
        container = av.open(f"file:{path.absolute()}", options=_OPTIONS)
        for stream in container.streams.video:
            stream.thread_type = "AUTO" if threads else "NONE"
            stream.codec_context.options = {"max_pixels": str(MAX_PIXELS)}
        return container
    except (OSError, av.error.FFmpegError, ValueError) as error:  # pyright: ignore[reportAttributeAccessIssue]
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(path, f"cannot be opened ({reason:.80})", _REMEDY) from None


def _stream(container: Any, path: Path) -> Any:
    if not container.streams.video:
        raise InputError(path, "has no picture", "give a clip with video")
    # Cameras put thumbnails and covers into streams of their own, of which the first may be one.
    best = container.streams.best("video") or container.streams.video[0]
    return max([best, *container.streams.video], key=lambda stream: stream.width * stream.height)
