"""Photos of colored tiles under a known response."""

import numpy as np

from sehdr_warp.response import Response, response_by_name


def mosaic(seed=0, size=96, tile=12) -> np.ndarray:
    """Colored tiles, anti-aliased in linear light: each boundary pixel is a mixture. [size, size, 3] in (0, 1)."""
    rng = np.random.default_rng(seed)
    colors = rng.uniform(0.02, 0.9, (size // tile, size // tile, 3))
    fine = np.roll(colors.repeat(tile * 4, 0).repeat(tile * 4, 1), (2, 1), (0, 1))
    return fine.reshape(size, 4, size, 4, 3).mean((1, 3))


def photograph(response, light) -> np.ndarray:
    """Encoded values as 8 bits store them."""
    response = response_by_name(response) if isinstance(response, str) else response
    return np.round(np.clip(response.encode(light), 0, 1) * 255) / 255


def by_name(selection) -> dict:
    return {score.response.name: score for score in selection.scores}


def responses(*names) -> list[Response]:
    return [response_by_name(name) for name in names]


CODES = np.arange(256) / 255


def stops_off(response, truth) -> float:
    return float(np.std(np.log2(response.decode(CODES[10:246])) - np.log2(truth.decode(CODES[10:246]))))
