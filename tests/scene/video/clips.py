"""Clips made by PyAV from known codes."""

from pathlib import Path

import numpy as np
import pytest

LUMA = {1: (0.2126, 0.0722), 9: (0.2627, 0.0593)}


def pan(count=40, height=96, width=128, step=4, blur=()):
    """[H, W, 3] codes in [0, 1] of a camera that passes a wall; frames whose numbers are in `blur` are blurred."""
    from scipy.ndimage import gaussian_filter, uniform_filter1d

    random = np.random.default_rng(0)
    wall = gaussian_filter(random.random((height, width + step * count, 3)), (2, 2, 0))
    wall = (wall - wall.min()) / np.ptp(wall) * 0.9 + 0.05
    for i in range(count):
        frame = wall[:, step * i : step * i + width]
        yield uniform_filter1d(frame, 9, axis=1) if i in blur else frame


def write_clip(path: Path, frames, *, tags=(1, 1, 1), codec="libx265", pixels="yuv444p10le", metadata=None, rotation=0,
               times=None, full=False, lossless=False, aspect=1) -> None:  # fmt: skip
    """tags: transfer, primaries, matrix (ITU-T H.273). frames: [H, W, 3] codes in [0, 1]. times: in thirtieths."""
    av = pytest.importorskip("av")
    transfer, primaries, matrix = tags
    kr, kb = LUMA.get(matrix, LUMA[1])
    options = {"movflags": "use_metadata_tags"} if path.suffix in (".mp4", ".mov") else {}
    with av.open(str(path), "w", options=options) as container:
        container.metadata.update(metadata or {})
        stream = None
        for i, rgb in enumerate(frames):
            if stream is None:
                stream = container.add_stream(codec, rate=30)
                stream.height, stream.width, stream.pix_fmt = *rgb.shape[:2], pixels
                # FFmpeg puts chroma samples between luma samples, as the stream then states.
                params = "log-level=none:chromaloc=1" if "420" in pixels else "log-level=none"
                params += ":lossless=1" if lossless else ""
                stream.options = {"crf": "2", "x265-params": params} if codec == "libx265" else {"crf": "2"}
                context = stream.codec_context
                context.color_trc, context.color_primaries, context.colorspace = transfer, primaries, matrix
                context.color_range = 2 if full else 1
                context.sample_aspect_ratio = aspect
                if rotation:
                    stream.set_display_rotation(rotation)
            y = kr * rgb[..., 0] + (1 - kr - kb) * rgb[..., 1] + kb * rgb[..., 2]
            u, v = (rgb[..., 2] - y) / (2 * (1 - kb)), (rgb[..., 0] - y) / (2 * (1 - kr))
            top = 1023 * 64
            if full:
                planes = np.stack([y * top, 32768 + u * top, 32768 + v * top], 2)
            else:
                planes = np.stack([4096 + y * 56064, 32768 + u * 57344, 32768 + v * 57344], 2)
            planes = np.rint(np.clip(planes, 0, 65535)).astype(np.uint16)
            frame = av.VideoFrame.from_ndarray(planes, format="yuv444p16le")
            same = {"src_color_range": 2 if full else 1, "dst_color_range": 2 if full else 1}
            frame = frame.reformat(format=pixels, interpolation="AREA", **same)  # As cameras average chroma
            frame.pts = i if times is None else times[i]
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)


def still(value=None, height=48, width=64):
    """One frame: a ramp of grey beside patches of color, or one value."""
    frame = np.repeat(np.linspace(0.02, 0.98, width)[None, :, None], height, 0).repeat(3, 2)
    frame[height // 2 :, :16], frame[height // 2 :, 16:32] = (0.7, 0.2, 0.1), (0.1, 0.3, 0.8)
    return [frame if value is None else np.full((height, width, 3), value)] * 3
