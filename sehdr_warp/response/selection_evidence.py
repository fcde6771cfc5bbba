"""Evidence of photos about the response: colors at their edges, and how often each code occurs."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ..errors import SehdrError

CODE = 1.0 / 255
# Edges: pixels this far on both sides of the middle one; each side must be flat to 3 codes and 20 from the other, with
# some slack for how a float rounds, and the sides' encoded colors at an angle (radians), not one gray scaled.
EDGE_REACH, FLAT_CODES, EDGE_CODES, SLACK, EDGE_ANGLE = 2, 3, 20, 0.25, 0.05
MAX_EDGES = 4000  # Of more edges, a random sample is taken
# The middle lies between these shares of the way from one side to the other, in encoded values.
LEAST_SHARE, MOST_SHARE = 0.15, 0.85
MOST_PIXELS, BAND_ROWS = 400_000, 32  # Photos larger than MOST_PIXELS are read in bands


@dataclass(frozen=True)
class Band:
    """A photo, or a band of a large one."""

    encoded: np.ndarray  # [h, W, 3] float64 encoded values
    clear: np.ndarray  # [h, W] bool, where no channel is black or clipped


@dataclass(frozen=True)
class PhotoEvidence:
    """Evidence of photos of one camera about its response."""

    edges: np.ndarray  # [E, 3, 3] encoded colors (one side, middle, other side) of clean, colored edges
    shares: np.ndarray  # [256] fraction of values at each 8-bit code
    clearest: list[Band]  # Bands of the photo with the most clear pixels
    clear_pixels: int  # Number of its clear pixels


def collect_evidence(images: Iterable[np.ndarray], seed: int) -> PhotoEvidence:
    """Collect the evidence of photos, which are taken one by one.

    Args:
        images: Photos as in select_response().
        seed: Of the sample of edges if there are more than MAX_EDGES.
    """
    photos = list(map(_bands, images))
    clear_pixels = [sum(band.clear.sum() for band in photo) for photo in photos]
    bands = [band for photo in photos for band in photo]
    edges = np.concatenate([_edge_colors(band.encoded, band.clear) for band in bands])
    if len(edges) > MAX_EDGES:
        edges = edges[np.random.default_rng(seed).choice(len(edges), MAX_EDGES, replace=False)]
    codes = [np.rint(255 * band.encoded.clip(0, 1)).astype(int).ravel() for band in bands]
    shares = np.bincount(np.concatenate(codes), minlength=256) / sum(map(len, codes))
    return PhotoEvidence(edges, shares, photos[int(np.argmax(clear_pixels))], max(clear_pixels))


def _bands(image: np.ndarray) -> list[Band]:
    """Return a photo as one band, or bands of a large one."""
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3:
        raise SehdrError(f"select_response: an image of shape {list(image.shape)} is not [H, W, 3]")
    rows, columns = image.shape[:2]
    bands = [image]
    if rows * columns > MOST_PIXELS:
        starts = np.linspace(0, rows - BAND_ROWS, max(1, MOST_PIXELS // (BAND_ROWS * columns)))
        bands = [image[int(start) : int(start) + BAND_ROWS] for start in starts]
    white = np.iinfo(image.dtype).max if image.dtype.kind == "u" else 1.0
    bands = [each / np.float64(white) for each in bands]
    if not all(np.isfinite(each).all() for each in bands):
        raise SehdrError("select_response: an image holds values that are not finite")
    return [Band(each, np.all((each > 1.5 * CODE) & (each < 1 - 4.5 * CODE), axis=2)) for each in bands]


def _edge_colors(image: np.ndarray, clear: np.ndarray) -> np.ndarray:
    """Return encoded colors [E, 3, 3] (one side, middle, other side) of clean, colored edges along rows and columns."""
    colors, length = [np.zeros((0, 3, 3))], 2 * EDGE_REACH + 3
    planes = np.ascontiguousarray(np.moveaxis(image, 2, 0))  # Sums over the first axis are many times as fast.
    for rows, valid in ((planes, clear), (planes.swapaxes(1, 2), clear.T)):
        starts = len(valid) - length + 1
        if starts < 1:
            continue
        at = [rows[:, k : k + starts] for k in range(length)]
        all_valid = np.logical_and.reduce([valid[k : k + starts] for k in range(1, length - 1, EDGE_REACH)])
        first, middle, last = at[1:-1:EDGE_REACH]
        flat = np.maximum(np.abs(at[0] - first), np.abs(at[-1] - last)).max(0) <= (FLAT_CODES + SLACK) * CODE
        apart = np.abs(last - first).max(0) >= (EDGE_CODES - SLACK) * CODE
        # Between the sides in every channel, and well off both: another surface at the edge is not.
        between = ((middle - first) * (last - middle) >= -(1 + SLACK) * CODE**2).all(0)
        share = np.linalg.norm(middle - first, axis=0) / np.maximum(np.linalg.norm(last - first, axis=0), CODE)
        cosine = (first * last).sum(0) / (np.linalg.norm(first, axis=0) * np.linalg.norm(last, axis=0) + 1e-12)
        mixed = (share > LEAST_SHARE) & (share < MOST_SHARE) & (cosine < np.cos(EDGE_ANGLE))
        edges = all_valid & flat & apart & between & mixed
        colors.append(np.stack([side[:, edges].T for side in (first, middle, last)], axis=1))
    return np.concatenate(colors)
