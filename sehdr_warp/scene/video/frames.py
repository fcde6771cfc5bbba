"""Frames of a clip to train on: of equal camera movement the sharpest each, kept in the cache as PNG files."""

import json
import logging
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from ...errors import InputError
from ...progress import stage
from ..cached_folder import cached_folder, file_digest
from ..dataparser import DataparserOutputs
from ..file_names import list_images
from ..images.ldr_files import EncodedImage, png16
from ..readers.bare_photos import find_photos
from .color import outside_rec709
from .decode import Clip, codes, decode, grey, in_square_pixels, open_clip

_log = logging.getLogger("sehdr_warp.scene")

_VERSION = 5
_STEP = 0.08  # Movement between two frames in parts of the width: neighbors overlap by more than nine tenths
_FEWEST, _MOST = 24, 240  # Frames of a clip
_MOST_OUTSIDE = 1e-3  # Part of a clip's pixels that may lie outside Rec.709 for its photos to be converted to it
_LEAST_MOVEMENT = 0.05  # In parts of the width, of a whole clip: less shows no depth
_LEAST_STEP = 4.0  # Pixels from a reference frame to the next one, at _MOVEMENT_WIDTH
_MOST_LOOKED_AT = 3000
_BLOCK = 64  # Pixels of the blocks whose movement is measured
_SHARPNESS_WIDTH, _MOVEMENT_WIDTH = 640, 192


@dataclass(frozen=True)
class FrameChoice:
    """Frames of a clip that are used."""

    numbers: tuple[int, ...]  # Of the chosen frames, in order
    total: int  # Frames that were decoded
    movement: float  # Of the whole clip, in widths of the picture


def choose_frames(clip: Clip) -> FrameChoice:
    """Return the sharpest frame of each interval of equal movement.

    Raises:
        InputError: if the clip has fewer than three frames, or its camera does not move.
    """
    stride = max(1, round(clip.seconds * 30 / _MOST_LOOKED_AT))
    numbers: list[int] = []
    sharp: list[float] = []
    moved: list[float] = []
    reference: np.ndarray | None = None
    before = 0.0  # Movement up to the reference
    total = 0
    with stage("looking at frames", 0, _log) as progress:  # A clip does not state reliably how many it has.
        for number, frame in decode(clip):
            total = number + 1
            progress.update(total)
            if number % stride:
                continue
            tiny = grey(frame, _MOVEMENT_WIDTH)
            # From a reference some pixels back: a slow camera moves by less than a pixel between frames.
            reference = tiny if reference is None else reference
            step = frame_shift(reference, tiny)
            moved.append(max(before + step, moved[-1] if moved else 0.0))
            if step * tiny.shape[1] >= _LEAST_STEP:
                reference, before = tiny, moved[-1]
            numbers.append(number)
            sharp.append(sharpness(grey(frame, _SHARPNESS_WIDTH)))
    if len(numbers) < 3:
        raise InputError(clip.path, f"holds {total} frames that can be decoded", "give a longer clip")
    movement = moved[-1]
    if movement < _LEAST_MOVEMENT:
        problem = f"its camera hardly moves ({100 * movement:.1f} % of the picture's width): that shows no depth"
        raise InputError(clip.path, problem, "walk with the camera while you film")
    count = int(np.clip(round(movement / _STEP), min(_FEWEST, len(numbers)), min(_MOST, len(numbers))))
    # By movement; frames of a camera that rests share an interval.
    intervals = np.minimum(np.array(moved) / movement * count, count - 1e-6).astype(int)
    best = {int(i): max(np.flatnonzero(intervals == i), key=lambda k: sharp[k]) for i in np.unique(intervals)}
    return FrameChoice(tuple(numbers[k] for k in sorted(best.values())), total, movement)


def sharpness(picture: np.ndarray) -> float:
    """Return the mean size of the Laplacian of a grey picture [h, w], relative to its brightness."""
    inner = picture[1:-1, 1:-1]
    around = picture[:-2, 1:-1] + picture[2:, 1:-1] + picture[1:-1, :-2] + picture[1:-1, 2:]
    return float(np.abs(around - 4 * inner).mean() / (inner.mean() + 1e-3))


def frame_shift(first: np.ndarray, second: np.ndarray) -> float:
    """Return how far two grey pictures [h, w] are moved, in parts of the width: the median over blocks.

    Phase correlation (Kuglin and Hines 1975). 0 if blocks agree on no movement.
    """
    height, width = first.shape
    side = min(_BLOCK, height, width)
    window = np.outer(np.hanning(side), np.hanning(side))
    lengths = []
    for top in np.linspace(0, height - side, max(1, round(height / side))).astype(int):
        for left in np.linspace(0, width - side, max(1, round(width / side))).astype(int):
            parts = [image[top : top + side, left : left + side] for image in (first, second)]
            spectra = [np.fft.rfft2((part - part.mean()) * window) for part in parts]
            cross = spectra[0] * spectra[1].conj()
            peak = np.fft.irfft2(cross / np.maximum(np.abs(cross), 1e-9), s=(side, side))
            shift = np.array(np.unravel_index(int(peak.argmax()), peak.shape))
            fine = shift + [_subpixel_offset(peak, shift, axis) for axis in (0, 1)]
            shift = np.where(fine > side / 2, fine - side, fine)
            lengths.append(math.hypot(*shift))
    return float(np.median(lengths)) / width


def _subpixel_offset(peak: np.ndarray, pixel: np.ndarray, axis: int) -> float:
    """Return how far a maximum lies beside its pixel along an axis: that of a parabola, -0.5 to 0.5."""
    line = np.roll(np.take(peak, pixel[1 - axis], axis=1 - axis), 1 - pixel[axis])
    before, center, after = line[:3]
    bend = 2 * center - before - after
    return float(np.clip((after - before) / (2 * bend), -0.5, 0.5)) if bend > 0 else 0.0


def frames_folder(clip: Clip, cache: Path | str | None = None) -> Path:
    """Return a folder of the chosen frames, made once for a clip's content; `cache` as of cached_folder()."""
    name = f"video-{file_digest(clip.path)[:16]}-{_VERSION}"
    return cached_folder(
        cache, name, "frames of the video", lambda folder: _write_frames(clip, choose_frames(clip), folder)
    )


def _write_frames(clip: Clip, choice: FrameChoice, folder: Path) -> None:
    numbers, outside = frozenset(choice.numbers), []
    with stage("keeping frames", len(numbers), _log) as progress:
        for count, (number, frame) in enumerate(decode(clip, numbers), start=1):
            pixels, file = in_square_pixels(codes(frame, clip.color), clip), folder / f"frame_{number:06d}.png"
            if clip.color.display is not None:
                pixels = clip.color.display.convert(EncodedImage(pixels, None)).pixels
            outside.append(outside_rec709(pixels[::4, ::4], clip.color))
            if pixels.dtype == np.uint8:
                Image.fromarray(pixels).save(file, compress_level=1)
            else:
                file.write_bytes(png16(pixels, level=1))
            progress.update(count)
    facts = {"total": choice.total, "movement": choice.movement, "outside_rec709": float(np.mean(outside))}
    (folder / "frames.json").write_text(json.dumps(facts))


def read_video(path: Path, cache: Path | str | None = None) -> DataparserOutputs:
    """Parse a clip: a record for each chosen frame, without cameras, which place_photos() adds.

    Raises:
        InputError: if the clip cannot be read or its camera does not move.
    """
    clip = open_clip(path)
    folder = frames_folder(clip, cache)
    facts = json.loads((folder / "frames.json").read_text())
    dataset = find_photos(folder)
    count = len(list_images(folder, (".png",)))
    color = clip.color
    note = f"video: the sharpest {count} of {facts['total']} frames are used; it states {color.curve}: its response is "
    note += color.response or "that of --response, or else chosen as for photos"
    squared = (f"its pixels are not square: frames are resampled to {clip.size[0]} x {clip.size[1]} square pixels",)
    interlaced = ("its frames are interlaced, rows of two moments each: deinterlace the clip for sharp edges",)
    return replace(
        dataset,
        format="video",
        notes=(note, *squared * clip.anamorphic, *interlaced * clip.interlaced, *dataset.notes),
        folder=folder,
        stated_response=color.response,
        color_matrix=color.to_rec709(),
        within_rec709=color.response is not None and facts["outside_rec709"] < _MOST_OUTSIDE,
    )
