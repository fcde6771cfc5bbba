"""Points of the surfaces that photos show: a plane sweep (Collins 1996) for individually chosen pixels.

A training starts from such points (initialization.py), and adds Gaussians at others (seeding.py).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from ..parallel import prefetch_map
from ..rasterizer.ops.plane_sweep import BORDER, NEIGHBORS, PhotoSet, matched_points, matching_costs, trusted_depths
from ..response import Response
from ..scene import Camera, View, codes_of

LARGEST_SIDE = 800  # Photos are matched at this size at most: depths need no more pixels
RESIZED_AT_ONCE = 8  # Photos that are resized in parallel
PLANES = 48, 256  # Smallest and largest number of depths to try; within these they are a pixel of parallax apart
WORST_COST = 0.05  # Largest mean difference of encoded colors of a match
MARGIN = 1.3, 0.004  # Depths with costs below this multiple of the least, plus this, count as equally good
FEW, WIDEST = 6, 1.2  # A match needs at most this many equally good depths, or all within this factor
LEAST_COSINE = 0.5  # Smallest cosine between the axes of two photos that are compared
FLAT, STEEPEST, WHITE = 0.5, 4.0, 250
"""Of a pixel's chance to be chosen: gradients count up to STEEPEST times their mean, a code from WHITE on as much, and
FLAT is added."""
PROBES = 1500  # Pixels that are matched to estimate the range of depths
FEWEST_FOUND = 50  # With fewer matches of these, the range is GUESS
RANGE = 0.1, 30.0  # Range of depths to try for the probes, in units of the focus
GUESS = 0.25, 8.0  # Range of depths without enough matches, in units of the focus
SLACK = 0.6, 2.0  # Factors that extend the range of the matches
MIDTONE, LEAST_EXPONENT = 0.3, 0.4
"""Encoded value to which a power, at least LEAST_EXPONENT, brightens dark photos for matching. Costs are compared by
absolute margins, so without it most depths of dark photos count as equally good."""
ALIKE = 0.05  # Photos whose exposures differ by fewer stops are compared as they are
CHUNK = 1 << 20  # Costs held at one time


@dataclass(frozen=True)
class Matches:
    """Matched points, on the matcher's device."""

    points: Tensor  # [M, 3] float32 world coordinates
    colors: Tensor  # [M, 3] float32 encoded values in [0, 1] of the photo
    footprints: Tensor  # [M] float32 size that a pixel of the photo covers there, world units
    views: Tensor  # [M] int64 index of the photo


class Matcher:
    """Finds the depth of pixels of posed photos by comparing photos."""

    def __init__(self, views: Sequence[View], response: Response, focus: float, device: torch.device | str):
        """Prepare photos for matching and estimate the range of depths.

        Args:
            views: Two or more views, at_matching_size().
            response: Response by which photos of different exposure are made comparable.
            focus: Approximate distance of the scene, world units.
            device: Torch device.
        """
        base = float(np.median([view.exposure_time for view in views]))
        self._exponent = brightening(views)
        self._images = [_comparable_codes(view, view.exposure_time / base, response, self._exponent) for view in views]
        self._cameras = cameras = [view.camera for view in views]
        self._masks = [view.mask for view in views]
        self.device = torch.device(device)
        neighbors = _neighbors(cameras, cameras)
        self._photos = PhotoSet.of(self._images, cameras, neighbors, device)
        poses = np.stack([camera.camera_to_world for camera in cameras])
        self._poses = torch.tensor(poses, dtype=torch.float32, device=device)
        depths = np.geomspace(focus * RANGE[1], focus * RANGE[0], PLANES[1])
        self._depths = torch.tensor(depths, dtype=torch.float32, device=device)
        probes = self.match(self.pixels(PROBES, np.random.default_rng(0))).footprints * float(cameras[0].fx)
        near, far = (part * focus for part in GUESS)
        if len(probes) >= FEWEST_FOUND:
            near, far = (float(probes.quantile(part)) * slack for part, slack in zip((0.01, 0.99), SLACK, strict=True))
        planes = int(np.clip(_parallax(cameras, neighbors, near, far), *PLANES))
        self._depths = torch.tensor(1 / np.linspace(1 / far, 1 / near, planes), dtype=torch.float32, device=device)

    def pixels(self, count: int, rng: np.random.Generator) -> Tensor:
        """Choose about `count` pixels, one from each square of equal size, by gradients and brightness.

        Edges can be matched, and lamps are small.

        Returns:
            [about count, 3] int32 view, column and row.
        """
        side = max(1.0, (sum(image.shape[0] * image.shape[1] for image in self._images) / count) ** 0.5)
        photos = zip(self._images, self._masks, strict=True)
        white = 255 * (WHITE / 255) ** self._exponent
        chances = prefetch_map(lambda photo: _probabilities(*photo, white), photos, len(self._images))
        samples = [_sample_squares(chance, side, rng, index) for index, chance in enumerate(chances)]
        return torch.from_numpy(np.concatenate(samples).astype(np.int32)).to(self.device)

    def size(self, index: int) -> tuple[int, int]:
        """Return width and height at which a photo is matched."""
        height, width = self._images[index].shape[:2]
        return width, height

    def near(self, others: Sequence[Camera]) -> np.ndarray:
        """Return the neighbors of the V photos and of other cameras: photos from nearby that look the same way.

        Returns:
            [V + len(others), V] bool, a row for each photo and then each other camera; a photo is near itself.
        """
        neighbors = _neighbors((*self._cameras, *others), self._cameras)
        near = np.eye(len(neighbors), len(self._cameras) + 1, dtype=bool)
        np.put_along_axis(near, neighbors, True, 1)  # -1 is the last.
        return near[:, :-1]

    @torch.no_grad()
    def match(self, pixels: Tensor) -> Matches:
        """Return the points that pixels [N, 3] show, for those whose depth the photos agree on."""
        depth = self._depths_of(pixels)
        return self._matches(pixels[depth > 0], depth[depth > 0])

    @torch.no_grad()
    def match_each(self, pixels: Tensor) -> tuple[Matches, Tensor]:
        """Return a point for each of the pixels [N, 3], and a mask [N] of those whose depth the photos agree on.

        Does not wait for the device.
        """
        depth = self._depths_of(pixels)
        return self._matches(pixels, depth), depth > 0

    def _depths_of(self, pixels: Tensor) -> Tensor:
        """Return the depths [N] of pixels, between planes; 0 if none is reliable."""
        depths = [self._depths[:0]]
        for part in pixels.split(max(1, CHUNK // len(self._depths))):
            costs = matching_costs(self._photos, part, self._depths.expand(len(part), -1))
            options = {"worst": WORST_COST, "margin": MARGIN, "few": FEW, "widest": WIDEST}
            depths.append(trusted_depths(costs, self._depths, **options))
        return torch.cat(depths)

    def _matches(self, pixels: Tensor, depth: Tensor) -> Matches:
        """Return the points of pixels [N, 3] at depths [N]."""
        points, colors, footprints = matched_points(self._photos, self._poses, pixels, depth)
        return Matches(points, colors ** (1 / self._exponent), footprints, pixels[:, 0].long())


def brightening(views: Sequence[View]) -> float:
    """Return the exponent in [LEAST_EXPONENT, 1] that takes the median encoded value of dark photos to MIDTONE."""
    samples = []
    for view in views:
        step = max(1, min(view.codes.shape[:2]) // 64)
        samples.append(view.codes[::step, ::step].reshape(-1).astype(np.float32) / view.levels)
    median = float(np.clip(np.median(np.concatenate(samples)), 1e-3, 1.0))
    return float(np.clip(np.log(MIDTONE) / np.log(median), LEAST_EXPONENT, 1.0)) if median < MIDTONE else 1.0


def _comparable_codes(view: View, ratio: float, response: Response, exponent: float) -> np.ndarray:
    """Return the 8-bit codes [H, W, 3] of 1 / ratio of a photo's exposure, brightened by an exponent."""
    values = np.linspace(0, 1, view.levels + 1)
    is_alike = response.learnable or abs(np.log2(ratio)) <= ALIKE
    if is_alike and exponent == 1:
        return _codes8(view)
    if not is_alike:
        values = np.asarray(response.encode(response.decode(values) / ratio))
    return codes_of(np.clip(values, 0, 1) ** exponent, 8)[view.codes]


def at_matching_size(views: Sequence[View]) -> tuple[View, ...]:
    """Return views reduced to 8 bits and the size for matching; smaller ones as they are. Masks keep their size."""
    return tuple(prefetch_map(_at_matching_size, views, RESIZED_AT_ONCE))


def _at_matching_size(view: View) -> View:
    """Return one view of at_matching_size()."""
    scale = LARGEST_SIDE / max(view.camera.width, view.camera.height)
    if scale >= 1:
        return view
    size = max(1, round(view.camera.width * scale)), max(1, round(view.camera.height * scale))
    codes = np.asarray(Image.fromarray(_codes8(view)).resize(size, Image.Resampling.BOX))
    return replace(view, codes=codes, camera=view.camera.resized(*size), hdr=None)


def _codes8(view: View) -> np.ndarray:
    """Return the codes of a photo in 8 bits."""
    return view.codes if view.codes.dtype == np.uint8 else codes_of(view.image, 8)


def _probabilities(image: np.ndarray, mask: np.ndarray | None, white: float = WHITE) -> np.ndarray:
    """Return [H, W] the probability of each pixel to be chosen, up to a factor; 0 if it cannot be matched.

    Codes count as white from `white` on.
    """
    grey = image.astype(np.float32).mean(2)
    chance = np.zeros_like(grey)
    if min(grey.shape) < 2 * BORDER + 2:
        return chance
    steep = np.abs(np.gradient(grey)).sum(0)
    steep = np.minimum(steep / max(float(steep.mean()), 1e-6), STEEPEST) + FLAT
    steep[image.max(2) >= white] += STEEPEST
    if mask is not None:
        size = grey.shape[1], grey.shape[0]
        steep *= np.asarray(Image.fromarray(mask).resize(size, Image.Resampling.BOX)) > 0.5
    inside = slice(BORDER, -BORDER), slice(BORDER, -BORDER)
    chance[inside] = steep[inside]
    return chance


def _sample_squares(chance: np.ndarray, side: float, rng: np.random.Generator, view: int) -> np.ndarray:
    """Return [N, 3] view, column and row: one pixel from each square of a photo, sampled by its probability."""
    # The largest power u^(1 / chance) of a uniform u is drawn so (Efraimidis and Spirakis 2006).
    with np.errstate(divide="ignore"):
        key = np.log(rng.random(chance.shape, np.float32)) / chance
    edges = [np.arange(0, size, side).astype(int) for size in chance.shape]
    largest = np.maximum.reduceat(np.maximum.reduceat(key, edges[0], axis=0), edges[1], axis=1)
    sizes = [np.diff(edge, append=size) for edge, size in zip(edges, chance.shape, strict=True)]
    row, column = np.nonzero((key == largest.repeat(sizes[0], 0).repeat(sizes[1], 1)) & (chance > 0))
    return np.stack([np.full_like(row, view), column, row], 1)


def _neighbors(cameras: Sequence[Camera], others: Sequence[Camera]) -> np.ndarray:
    """Return [V, NEIGHBORS] the nearest other cameras that look the same way; -1 if there are fewer."""
    positions, others_positions = (np.stack([camera.position for camera in pair]) for pair in (cameras, others))
    axes, others_axes = (np.stack([camera.world_to_camera[2, :3] for camera in pair]) for pair in (cameras, others))
    distance = np.linalg.norm(positions[:, None] - others_positions, axis=2)
    distance[(axes @ others_axes.T < LEAST_COSINE) | (distance == 0)] = np.inf
    nearest = np.argsort(distance, axis=1, kind="stable")[:, :NEIGHBORS]
    return np.where(np.isfinite(np.take_along_axis(distance, nearest, 1)), nearest, -1).astype(np.int32)


def _parallax(cameras: Sequence[Camera], neighbors: np.ndarray, near: float, far: float) -> float:
    """Return the median parallax in pixels between the nearest and the farthest depth; 0 without neighbors."""
    positions = np.stack([camera.position for camera in cameras])
    focal = np.array([camera.fx for camera in cameras])
    apart = np.linalg.norm(positions[:, None] - positions[neighbors], axis=2) * focal[:, None]
    apart = apart[neighbors >= 0]
    return float(np.median(apart)) * (1 / near - 1 / far) if len(apart) else 0.0
