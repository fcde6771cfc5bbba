"""Curved surfaces as triangle meshes: functions (u, v) in [0, 1] -> places, and the PLY file a renderer reads."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

Surface = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""(u, v), each of one shape in [0, 1] -> [..., 3]; the outer side is where d/du x d/dv points."""


def lathe(profile) -> Surface:
    """The surface of revolution about z of a smooth line through (radius, height) points."""
    line = _smooth(profile)
    share = np.linspace(0, 1, len(line))

    def surface(u, v):
        v = np.clip(v, 0, 1)
        radius, height, angle = np.interp(v, share, line[:, 0]), np.interp(v, share, line[:, 1]), u * 2 * np.pi
        return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], -1)

    return surface


def torus_knot(p: int = 2, q: int = 3, radius: float = 0.13, wave: float = 0.055, tube: float = 0.042) -> Surface:
    """A tube along the (p, q) torus knot, about 0.4 across."""

    def line(t):
        away = radius + wave * np.cos(q * t)
        return np.stack([away * np.cos(p * t), away * np.sin(p * t), wave * 1.6 * np.sin(q * t)], -1)

    def surface(u, v):
        t, angle = u * 2 * np.pi, v * 2 * np.pi
        tangent = line(t + 1e-3) - line(t - 1e-3)
        tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
        side = np.cross(tangent, np.broadcast_to([0.0, 0.0, 1.0], tangent.shape))
        side /= np.linalg.norm(side, axis=-1, keepdims=True) + 1e-9
        up = np.cross(tangent, side)
        return line(t) + tube * (np.cos(angle)[..., None] * side - np.sin(angle)[..., None] * up)

    return surface


def leaf(length: float, width: float, lean: float, turn: float) -> Surface:
    """A leaf from the origin, bending outwards by `lean` in [0, 1] towards the angle `turn` (radians)."""

    def surface(u, v):
        side = width * np.sin(np.pi * np.clip(u, 0, 1)) ** 0.8 * (v - 0.5) * 2
        away = length * u * lean
        up = length * u * (1.35 - lean) - 0.25 * length * u * u - 0.3 * side * side / width
        return np.stack([away * np.cos(turn) - side * np.sin(turn), away * np.sin(turn) + side * np.cos(turn), up], -1)

    return surface


def sheet(half_x: float, half_y: float, height: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Surface:
    """A height field z = height(x, y) over a rectangle around the origin."""

    def surface(u, v):
        x, y = (2 * u - 1) * half_x, (2 * v - 1) * half_y
        return np.stack([x, y, height(x, y)], -1)

    return surface


def write_mesh(path: Path, surface: Surface, columns: int, rows: int) -> None:
    """Sample a surface at columns x rows places into a binary PLY file with normals and texture coordinates."""
    u, v = np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows), indexing="ij")
    step = 1e-4
    normals = np.cross(surface(u + step, v) - surface(u - step, v), surface(u, v + step) - surface(u, v - step))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True) + 1e-12
    vertices = np.concatenate([surface(u, v), normals, u[..., None], v[..., None]], -1).reshape(-1, 8).astype("<f4")
    index = np.arange(columns * rows).reshape(columns, rows)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    corners = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    faces = np.empty(len(corners), [("count", "u1"), ("index", "<i4", 3)])
    faces["count"], faces["index"] = 3, corners
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz", "u", "v"))
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{names}"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    path.write_bytes(header.encode() + vertices.tobytes() + faces.tobytes())


def _smooth(profile) -> np.ndarray:
    """[160, 2] along the Catmull-Rom curve through the points."""
    points = np.asarray(profile, float)
    place = np.linspace(0, len(points) - 1, 160)
    first = np.clip(np.floor(place).astype(int), 0, len(points) - 2)
    t = (place - first)[:, None]
    a, b, c, d = (points[np.clip(first + k, 0, len(points) - 1)] for k in (-1, 0, 1, 2))
    return 0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
