"""Batches of training photos of several families in fixed shares: usual and overexposed ones, white surfaces, lamps."""

import numpy as np
import torch

from .panoramas import Pack
from .photos import SCALES, SIZES, Camera, Photos
from .rooms import LitRooms

USUAL = {"stretch_share": 0.5}
LIT_ROOMS = 1000  # Rendered for a training
LIT = {"overexposed_share": 0.2, "overexposed_light_share": 0.0, "darkest": 12.5}
FAMILIES = {
    "usual": (0.35, USUAL),
    "overexposed": (0.15, USUAL | {"overexposed_share": 1.0, "light_share": 0.05}),
    "pages": (0.15, USUAL | {"overexposed_share": 0.05, "page_share": 1.0, "light_share": 0.05}),
    "lamps": (0.1, USUAL | {"light_share": 1.0}),
    "lit rooms": (0.25, LIT),
}
"""Share of a batch that each family has, and what its photos hold. With shares of all photos in place of families, more
white surfaces made lamps darker, and more lamps made white surfaces brighter."""


class Families:
    """Random batches of photos, each of the same number of photos of each family."""

    def __init__(
        self,
        pack: Pack,
        device: torch.device | str,
        chosen: np.ndarray,
        *,
        rooms: bool,
        seed: int,
        lit_rooms: LitRooms | None = None,
    ):
        """Make a camera for each family, of lit rooms if there are some; the arguments are those of Camera."""
        self.random, self.cameras = np.random.default_rng(seed), {}
        for index, (name, (_, shares)) in enumerate(FAMILIES.items()):
            options: dict = {
                "rooms": rooms,
                "seed": len(FAMILIES) * seed + index,
                "varied": True,
                "scales": SCALES,
            } | shares
            if name == "lit rooms":
                options["lit_rooms"] = lit_rooms
            if name != "lit rooms" or lit_rooms is not None:
                self.cameras[name] = Camera(pack, device, chosen, **options)

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
