"""Procedural textures: [H, W, 3] float32 linear reflectance in [0, 1], row 0 on top; skies and views as radiance.

Every function takes a NumPy random generator first and draws all its randomness from it. size: pixels.
"""

import numpy as np

Color = tuple[float, float, float]
# Reflectances of real matter; nothing is black or lossless.
_DARKEST, _BRIGHTEST = 0.01, 0.88


def noise(rng: np.random.Generator, height: int, width: int, base: int = 4, octaves: int = 6, gain: float = 0.55):
    """[height, width] tileable value noise (fractal sum of `octaves`), stretched to [0, 1]."""
    total, amplitude = np.zeros((height, width), np.float32), 1.0
    for octave in range(octaves):
        count = base * 2**octave
        if count > min(height, width):
            break
        grid = rng.random((count, count), dtype=np.float32)
        (rows, v), (columns, u) = _cells(height, count), _cells(width, count)
        beside = grid[:, columns] * (1 - u) + grid[:, (columns + 1) % count] * u
        total += amplitude * (beside[rows] * (1 - v[:, None]) + beside[(rows + 1) % count] * v[:, None])
        amplitude *= gain
    return (total - total.min()) / (np.ptp(total) + 1e-9)


def wood(rng, planks: int = 9, dark: Color = (0.16, 0.075, 0.03), light: Color = (0.45, 0.26, 0.12), size: int = 512):
    """Boards along the vertical with grain and joints."""
    y, x = _grid(size)
    board = np.floor(x * planks).astype(int)
    along = (y + rng.random(planks)[board]) * 2.0
    tone = rng.random((planks, 8))[board, np.floor(along).astype(int) % 8]
    rough, fine = noise(rng, size, size, 4, 7), noise(rng, size, size, 8, 6)
    grain = 0.5 + 0.5 * np.sin((x * planks * 9 + rough * 6 + tone * 30) * 2 * np.pi)
    image = mix(dark, light, 0.15 + 0.45 * tone + 0.25 * grain * fine + 0.25 * (rough - 0.5))
    image[(_off(x * planks) > 0.487) | (_off(along) > 0.4975)] *= 0.25
    return limit(image)


def brick(rng, rows=18, columns=7, dark=(0.30, 0.08, 0.05), light=(0.55, 0.24, 0.15), mortar=(0.42, 0.40, 0.37)):
    """Courses of bricks, every second one shifted by half a brick; give other colors for stone or tiles."""
    y, x = _grid(512)
    row = np.floor(y * rows).astype(int)
    x = x * columns + 0.5 * (row % 2)
    tone = rng.random((rows, columns + 1))[row % rows, np.floor(x).astype(int) % (columns + 1)]
    rough = noise(rng, 512, 512, 16, 6)
    image = mix(dark, light, 0.75 * tone + 0.5 * (rough - 0.5) + 0.1)
    joint = (_off(y * rows) > 0.455) | (_off(x) > 0.478)
    image[joint] = np.array(mortar, np.float32) * (0.75 + 0.5 * rough[joint])[:, None]
    return limit(image)


def checker(rng, count: int = 8, dark: Color = (0.05, 0.06, 0.08), light: Color = (0.65, 0.62, 0.55), size: int = 512):
    """count x count worn squares."""
    y, x = _grid(size)
    square = (np.floor(y * count) + np.floor(x * count)) % 2
    return limit(mix(dark, light, square) * (0.7 + 0.6 * noise(rng, size, size, 8, 6))[..., None])


def wallpaper(rng, ground=(0.50, 0.46, 0.36), stripe=(0.17, 0.30, 0.30), dot=(0.55, 0.16, 0.10), size: int = 512):
    """Stripes and staggered dots."""
    y, x = _grid(size)
    stripes = np.sin(x * 2 * np.pi * 14) > 0.3
    away = np.hypot((x * 14) % 1 - 0.5, (y * 20 + 0.5 * (np.floor(x * 14) % 2)) % 1 - 0.5)
    image = mix(ground, stripe, stripes * 0.55 + 0.5 * (noise(rng, size, size, 8, 6) - 0.5))
    image[away < 0.17] = image[away < 0.17] * 0.4 + np.array(dot, np.float32) * 0.6
    return limit(image)


def plaster(rng, size: int = 512):
    """Stained, cracked plaster: never an even wall."""
    stain, crack = noise(rng, size, size, 4, 8), noise(rng, size, size, 6, 6)
    shade = 1 - (0.45 * stain + 0.5 * (np.abs(crack - 0.5) < 0.012))
    return limit(np.array((0.62, 0.60, 0.56), np.float32) * (1.2 * shade)[..., None])


def fabric(rng, dark: Color, light: Color, size: int = 512):
    """Two scales of woven squares."""
    y, x = _grid(size)
    weave = np.sin(x * 2 * np.pi * 24) * np.sin(y * 2 * np.pi * 24) > 0
    squares = (np.floor(x * 6) + np.floor(y * 6)) % 2
    return limit(mix(dark, light, 0.3 * weave + 0.5 * squares + 0.4 * noise(rng, size, size, 4, 7) - 0.1))


def painting(rng, cells: int = 40, size: int = 256):
    """Crooked fields of strong colors with dark outlines."""
    places, colors = rng.random((cells, 2)) * size, rng.random((cells, 3)) ** 1.5 * 0.75 + 0.02
    bends = [noise(rng, size, size, 4, 5)[..., None] for _ in range(2)]
    y, x = (axis[..., None] * size + size / 7 * (bend - 0.5) for axis, bend in zip(_grid(size), bends))
    distance = np.hypot(y - places[:, 0], x - places[:, 1])
    image = colors[distance.argmin(-1)] * (0.8 + 0.4 * bends[1])
    nearest = np.sort(distance, axis=-1)[..., :2]
    image[nearest[..., 1] - nearest[..., 0] < size / 100] = 0.02
    return limit(image)


def globe(rng, size: int = 512):
    """Seas, lands and a grid of meridians, [size / 2, size, 3]."""
    height, width = size // 2, size
    land, tint = noise(rng, height, width, 4, 8), noise(rng, height, width, 8, 6)
    image = mix((0.03, 0.10, 0.30), (0.10, 0.25, 0.45), tint)
    dry = land > 0.52
    image[dry] = mix((0.12, 0.28, 0.06), (0.50, 0.36, 0.16), (land[dry] - 0.52) * 5)
    line = max(1, 3 * height // 256)
    image[np.arange(height) % (height // 12) < line] *= 0.35
    image[:, np.arange(width) % (width // 24) < line] *= 0.35
    return limit(image)


def ground(rng, dark: Color = (0.05, 0.09, 0.02), light: Color = (0.30, 0.36, 0.10), size: int = 512):
    """Grass, gravel or soil: fine grain with patches."""
    grain, patch = noise(rng, size, size, 64, 4, 0.8), noise(rng, size, size, 4, 5)
    return limit(mix(dark, light, 0.75 * grain + 0.6 * patch - 0.25))


def books(rng, size: int = 64):
    """The back of a book: one color with a few bands."""
    image = np.ones((size, size, 3), np.float32) * (rng.random(3) ** 1.6 * 0.7 + 0.02).astype(np.float32)
    for _ in range(3):
        start = rng.integers(4, size - 8)
        image[start : start + rng.integers(2, 7)] = rng.random(3) * 0.7 + 0.05
    return limit(image)


def facade(rng, lit: float, color: Color, columns: int, rows: int, size: int = 256):
    """Radiance of a wall of windows at night, of which a share `lit` shines, each with its own strength up to 1."""
    y, x = _grid(size)
    strength = (rng.random((rows, columns)) < lit) * rng.uniform(0.15, 1.0, (rows, columns))
    each = strength[np.floor(y * rows).astype(int), np.floor(x * columns).astype(int)]
    v, u = (y * rows) % 1, (x * columns) % 1
    pane = (u > 0.22) & (u < 0.78) & (v > 0.2) & (v < 0.82) & (np.abs(u - 0.5) > 0.03) & (np.abs(v - 0.45) > 0.02)
    curtain = 0.35 + 0.65 * noise(rng, size, size, 8, 4)
    return np.array(color, np.float32) * (pane * each * curtain).astype(np.float32)[..., None]


def outside(rng, size: int = 512):
    """Radiance through a window by day, sky about 1: sky, clouds, houses, trees."""
    y, x = _grid(size)
    clouds = np.clip((noise(rng, size, size, 4, 7) - 0.5) * 4, 0, 1)[..., None]
    image = 2.2 * clouds + mix((0.35, 0.60, 1.25), (1.05, 1.2, 1.35), y * 1.5) * (1 - clouds)
    horizon, edge = 0.52, 0.0
    while edge < 1:
        wide, high, color = 0.09 + 0.12 * rng.random(), 0.12 + 0.22 * rng.random(), rng.random(3) * 0.35 + 0.12
        house = (x >= edge) & (x < edge + wide) & (y > horizon - high + 0.25)
        image[house] = color
        v, u = ((y - horizon) * 26) % 1, ((x - edge) / wide * 4) % 1
        image[house & (v > 0.3) & (v < 0.75) & (u > 0.3) & (u < 0.75)] = color * 0.18
        edge += wide
    trees = y > 0.78 + 0.10 * (noise(rng, size, size, 8, 5)[0][None] - 0.5)
    image[trees] = mix((0.03, 0.10, 0.02), (0.22, 0.38, 0.08), noise(rng, size, size, 32, 5))[trees]
    return image.astype(np.float32)


def sky(rng, zenith: Color, horizon: Color, clouds: float, ground: Color, size: int = 256):
    """[size / 2, size, 3] radiance of a whole sphere, equirectangular, zenith on top; the lower half is `ground`."""
    height, width = size // 2, size
    up = np.cos((np.arange(height)[:, None] + 0.5) / height * np.pi) + np.zeros((1, width))
    image = mix(horizon, zenith, np.clip(up, 0, 1) ** 0.6)
    # A sphere's noise of equal grain everywhere is not worth having: what is seen of a sky lies near the horizon.
    cover = np.clip((noise(rng, height, width, 4, 6) - 0.5) * 4, 0, 1) * np.clip(up * 4, 0, 1)
    image += clouds * (cover * np.mean(horizon))[..., None]
    image[up < 0] = ground
    return image.astype(np.float32)


def even_sky(rng, color: Color, top: float, bottom: float):
    """[16, 32, 3] radiance of a whole sphere: one color, from `top` times it at the zenith to `bottom` times below."""
    return np.full((16, 32, 3), color, np.float32) * np.linspace(top, bottom, 16, dtype=np.float32)[:, None, None]


def mix(first: Color, second: Color, share) -> np.ndarray:
    """[..., 3] float32 between two colors by a share of any shape, clipped to [0, 1]."""
    share = np.asarray(np.clip(share, 0, 1), np.float32)[..., None]
    return np.array(first, np.float32) * (1 - share) + np.array(second, np.float32) * share


def limit(image: np.ndarray) -> np.ndarray:
    """Reflectance within what real matter has."""
    return np.clip(image, _DARKEST, _BRIGHTEST).astype(np.float32)


def _grid(size: int) -> np.ndarray:
    """(y, x) of each pixel in [0, 1), [2, size, size]."""
    return np.mgrid[0:size, 0:size] / size


def _off(place: np.ndarray) -> np.ndarray:
    """How far from the middle of its cell of length 1 a place lies, up to 0.5."""
    return np.abs(place % 1 - 0.5)


def _cells(length: int, count: int):
    """The noise cell of each pixel, and the smoothed place within it."""
    place = np.arange(length) * count / length
    cell = place.astype(int)
    part = (place - cell).astype(np.float32)
    return cell, part * part * (3 - 2 * part)
