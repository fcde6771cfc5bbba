"""Procedural textures: [H, W, 3] float32 linear reflectance in [0, 1], row 0 on top; skies and views as radiance.

Every function takes a NumPy random generator first and draws all its randomness from it.
"""

import numpy as np

_DARKEST, _BRIGHTEST = 0.01, 0.88
"""Reflectances of real matter; nothing is black or lossless."""


def noise(rng: np.random.Generator, height: int, width: int, base: int = 4, octaves: int = 6, gain: float = 0.55):
    """[height, width] tileable value noise (fractal sum of `octaves`), stretched to [0, 1]."""
    total, amplitude = np.zeros((height, width), np.float32), 1.0
    for octave in range(octaves):
        count = base * 2**octave
        if count > min(height, width):
            break
        grid = rng.random((count, count), dtype=np.float32)
        rows, row_part = _cells(height, count)
        columns, column_part = _cells(width, count)
        below, beside = (rows + 1) % count, (columns + 1) % count
        row_part, column_part = row_part[:, None], column_part[None]
        upper = grid[rows][:, columns] * (1 - column_part) + grid[rows][:, beside] * column_part
        lower = grid[below][:, columns] * (1 - column_part) + grid[below][:, beside] * column_part
        total += amplitude * (upper * (1 - row_part) + lower * row_part)
        amplitude *= gain
    return (total - total.min()) / (np.ptp(total) + 1e-9)


def wood(rng, planks: int = 9, dark=(0.16, 0.075, 0.03), light=(0.45, 0.26, 0.12), size: int = 512):
    """Boards along the vertical with grain and joints."""
    y, x = _axes(size)
    board = np.floor(x * planks).astype(int) + np.zeros((size, 1), int)
    offset = rng.random(planks)
    piece = np.floor((y + offset[board]) * 2.0).astype(int)
    tone = rng.random((planks, 8))[board, piece % 8]
    rough, fine = noise(rng, size, size, 4, 7), noise(rng, size, size, 8, 6)
    grain = 0.5 + 0.5 * np.sin((x * planks * 9 + rough * 6 + tone * 30) * 2 * np.pi)
    image = mix(dark, light, np.clip(0.15 + 0.45 * tone + 0.25 * grain * fine + 0.25 * (rough - 0.5), 0, 1))
    joints = (np.abs((x * planks) % 1 - 0.5) > 0.487) | (np.abs(((y + offset[board]) * 2) % 1 - 0.5) > 0.4975)
    image[joints] *= 0.25
    return limited(image)


def brick(rng, rows: int = 18, columns: int = 7, dark=(0.30, 0.08, 0.05), light=(0.55, 0.24, 0.15),
          mortar=(0.42, 0.40, 0.37), size: int = 512):  # fmt: skip
    """Courses of bricks, every second one shifted by half a brick; give other colours for stone or tiles."""
    y, x = _axes(size)
    y, x = y * rows, x * columns
    row = np.floor(y).astype(int)
    shifted = x + 0.5 * (row % 2)
    column = np.floor(shifted).astype(int)
    tone = rng.random((rows, columns + 1))[row % rows, column % (columns + 1)]
    rough = noise(rng, size, size, 16, 6)
    image = mix(dark, light, np.clip(0.75 * tone + 0.5 * (rough - 0.5) + 0.1, 0, 1))
    joint = (np.abs(y % 1 - 0.5) > 0.455) | (np.abs(shifted % 1 - 0.5) > 0.478)
    image[joint] = np.asarray(mortar, np.float32) * (0.75 + 0.5 * rough[joint])[:, None]
    return limited(image)


def checker(rng, count: int = 8, dark=(0.05, 0.06, 0.08), light=(0.65, 0.62, 0.55), size: int = 512):
    """count x count worn squares."""
    y, x = np.mgrid[0:size, 0:size]
    square = ((y * count // size) + (x * count // size)) % 2
    return limited(mix(dark, light, square) * (0.7 + 0.6 * noise(rng, size, size, 8, 6))[..., None])


def wallpaper(rng, ground=(0.50, 0.46, 0.36), stripe=(0.17, 0.30, 0.30), dot=(0.55, 0.16, 0.10), size: int = 512):
    """Stripes and staggered dots."""
    y, x = _axes(size)
    stripes = (np.sin(x * 2 * np.pi * 14) > 0.3) + np.zeros((size, 1))
    away = np.hypot((x * 14) % 1 - 0.5, (y * 20 + 0.5 * (np.floor(x * 14) % 2)) % 1 - 0.5)
    image = mix(ground, stripe, np.clip(stripes * 0.55 + 0.5 * (noise(rng, size, size, 8, 6) - 0.5), 0, 1))
    image[away < 0.17] = image[away < 0.17] * 0.4 + np.asarray(dot, np.float32) * 0.6
    return limited(image)


def plaster(rng, colour=(0.62, 0.60, 0.56), contrast: float = 1.0, size: int = 512):
    """Stained, cracked plaster: never an even wall."""
    stain, crack = noise(rng, size, size, 4, 8), noise(rng, size, size, 6, 6)
    shade = 1 - contrast * (0.45 * stain + 0.5 * (np.abs(crack - 0.5) < 0.012))
    return limited(np.asarray(colour, np.float32) * (1.2 * shade)[..., None])


def fabric(rng, dark, light, size: int = 512):
    """Two scales of woven squares."""
    y, x = _axes(size)
    weave = np.sin(x * 2 * np.pi * 24) * np.sin(y * 2 * np.pi * 24) > 0
    squares = (np.floor(x * 6) + np.floor(y * 6)) % 2
    return limited(
        mix(dark, light, np.clip(0.3 * weave + 0.5 * squares + 0.4 * noise(rng, size, size, 4, 7) - 0.1, 0, 1))
    )


def painting(rng, cells: int = 40, size: int = 256):
    """Crooked fields of strong colours with dark outlines."""
    places, colours = rng.random((cells, 2)) * size, rng.random((cells, 3)) ** 1.5 * 0.75 + 0.02
    y, x = np.mgrid[0:size, 0:size]
    first, second = noise(rng, size, size, 4, 5), noise(rng, size, size, 4, 5)
    bend = size / 7
    distance = np.hypot(y[..., None] + bend * (first[..., None] - 0.5) - places[:, 0],
                        x[..., None] + bend * (second[..., None] - 0.5) - places[:, 1])  # fmt: skip
    image = colours[distance.argmin(-1)] * (0.8 + 0.4 * second[..., None])
    nearest = np.sort(distance, axis=-1)[..., :2]
    image[nearest[..., 1] - nearest[..., 0] < size / 100] = 0.02
    return limited(image)


def globe(rng, size: int = 512):
    """Seas, lands and a grid of meridians, [size / 2, size, 3]."""
    height, width = size // 2, size
    land, tint = noise(rng, height, width, 4, 8), noise(rng, height, width, 8, 6)
    image = mix((0.03, 0.10, 0.30), (0.10, 0.25, 0.45), tint)
    dry = land > 0.52
    image[dry] = mix((0.12, 0.28, 0.06), (0.50, 0.36, 0.16), np.clip((land[dry] - 0.52) * 5, 0, 1))
    line = max(1, 3 * height // 256)
    image[np.arange(height) % (height // 12) < line] *= 0.35
    image[:, np.arange(width) % (width // 24) < line] *= 0.35
    return limited(image)


def ground(rng, dark=(0.05, 0.09, 0.02), light=(0.30, 0.36, 0.10), size: int = 512):
    """Grass, gravel or soil: fine grain with patches."""
    grain, patch = noise(rng, size, size, 64, 4, 0.8), noise(rng, size, size, 4, 5)
    return limited(mix(dark, light, np.clip(0.75 * grain + 0.6 * patch - 0.25, 0, 1)))


def books(rng, size: int = 64):
    """The back of a book: one colour with a few bands."""
    image = np.ones((size, size, 3), np.float32) * (rng.random(3) ** 1.6 * 0.7 + 0.02).astype(np.float32)
    for _ in range(3):
        start = rng.integers(4, size - 8)
        image[start : start + rng.integers(2, 7)] = rng.random(3) * 0.7 + 0.05
    return limited(image)


def facade(rng, lit: float, colour=(1.0, 0.62, 0.28), columns: int = 6, rows: int = 5, size: int = 256):
    """Radiance of a wall of windows at night, of which a share `lit` shines, each with its own strength up to 1."""
    y, x = np.mgrid[0:size, 0:size] / size
    strength = (rng.random((rows, columns)) < lit) * rng.uniform(0.15, 1.0, (rows, columns))
    row, column = np.floor(y * rows).astype(int), np.floor(x * columns).astype(int)
    v, u = (y * rows) % 1, (x * columns) % 1
    pane = (u > 0.22) & (u < 0.78) & (v > 0.2) & (v < 0.82) & (np.abs(u - 0.5) > 0.03) & (np.abs(v - 0.45) > 0.02)
    curtain = 0.35 + 0.65 * noise(rng, size, size, 8, 4)
    return np.asarray(colour, np.float32) * (pane * strength[row, column] * curtain).astype(np.float32)[..., None]


def outside(rng, size: int = 512):
    """Radiance through a window by day, sky about 1: sky, clouds, houses, trees."""
    y, x = np.mgrid[0:size, 0:size] / size
    clouds = np.clip((noise(rng, size, size, 4, 7) - 0.5) * 4, 0, 1)[..., None]
    sky = mix((0.35, 0.60, 1.25), (1.05, 1.2, 1.35), np.clip(y * 1.5, 0, 1))
    image = 2.2 * clouds + sky * (1 - clouds)
    horizon, left = 0.52, 0.0
    while left < 1:
        wide, high, colour = 0.09 + 0.12 * rng.random(), 0.12 + 0.22 * rng.random(), rng.random(3) * 0.35 + 0.12
        house = (x >= left) & (x < left + wide) & (y > horizon - high + 0.25)
        image[house] = colour
        v, u = ((y - horizon) * 26) % 1, ((x - left) / wide * 4) % 1
        image[house & (v > 0.3) & (v < 0.75) & (u > 0.3) & (u < 0.75)] = colour * 0.18
        left += wide
    trees = y > 0.78 + 0.10 * (noise(rng, size, size, 8, 5)[0][None] - 0.5)
    image[trees] = mix((0.03, 0.10, 0.02), (0.22, 0.38, 0.08), noise(rng, size, size, 32, 5))[trees]
    return image.astype(np.float32)


def sky(rng, zenith, horizon, clouds: float = 1.0, ground=(0.2, 0.19, 0.17), size: int = 256):
    """[size / 2, size, 3] radiance of a whole sphere, equirectangular, zenith on top; the lower half is `ground`."""
    height, width = size // 2, size
    up = np.cos((np.arange(height)[:, None] + 0.5) / height * np.pi) + np.zeros((1, width))
    image = mix(horizon, zenith, np.clip(up, 0, 1) ** 0.6)
    # A sphere's noise of equal grain everywhere is not worth having: what is seen of a sky lies near the horizon.
    cover = np.clip((noise(rng, height, width, 4, 6) - 0.5) * 4, 0, 1) * np.clip(up * 4, 0, 1)
    image += clouds * (cover * np.mean(horizon))[..., None]
    image[up < 0] = ground
    return image.astype(np.float32)


def mix(first, second, share) -> np.ndarray:
    """[..., 3] float32 between two colours by a share in [0, 1] of any shape."""
    share = np.asarray(share, np.float32)[..., None]
    return np.asarray(first, np.float32) * (1 - share) + np.asarray(second, np.float32) * share


def limited(image: np.ndarray) -> np.ndarray:
    """Reflectance within what real matter has."""
    return np.clip(image, _DARKEST, _BRIGHTEST).astype(np.float32)


def _axes(size: int):
    return np.arange(size)[:, None] / size, np.arange(size)[None] / size


def _cells(length: int, count: int):
    """The noise cell of each pixel, and the smoothed place within it."""
    place = np.arange(length) * count / length
    cell = place.astype(int)
    part = (place - cell).astype(np.float32)
    return cell, part * part * (3 - 2 * part)
