"""Batches of training photos of several families in fixed shares: usual and overexposed ones, white surfaces, lamps."""

import numpy as np
import torch

from .panoramas import Pack
from .photos import SIZES, Camera, Photos

USUAL = {"stretch_share": 0.5}
FAMILIES = {
    "usual": (0.5, USUAL),
    "overexposed": (0.2, USUAL | {"overexposed_share": 1.0, "light_share": 0.05}),
    "pages": (0.15, USUAL | {"overexposed_share": 0.05, "page_share": 1.0, "light_share": 0.05}),
    "lamps": (0.15, USUAL | {"light_share": 1.0}),
}
"""Share of a batch that each family has, and what its photos hold. With shares of all photos in place of families, more
white surfaces made lamps darker, and more lamps made white surfaces brighter."""


class Families:
    """Random batches of photos, each of the same number of photos of each family."""

    def __init__(self, pack: Pack, device: torch.device | str, chosen: np.ndarray, *, rooms: bool, seed: int):
        """Make a camera for each family; the arguments are those of Camera."""
        self.random = np.random.default_rng(seed)
        self.cameras = {
            name: Camera(pack, device, chosen, rooms=rooms, seed=len(FAMILIES) * seed + index, varied=True, **shares)
            for index, (name, (_, shares)) in enumerate(FAMILIES.items())
        }

    def take(self, count: int, batches: int, size: int | None = None) -> list[Photos]:
        """Return batches of about `count` photos, all of one size; many at once take less time than one by one."""
        size = size or int(self.random.choice(SIZES))
        parts = []
        for name, camera in self.cameras.items():
            photos = camera.take(max(1, round(count * FAMILIES[name][0])) * batches, size)
            parts.append([values.chunk(batches) for values in (photos.exposure, photos.clipped, photos.truth)])
        return [
            Photos(*(torch.cat([part[field][batch] for part in parts]) for field in range(3)))
            for batch in range(batches)
        ]
