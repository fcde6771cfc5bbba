"""A scene under construction in Mitsuba 3's terms: materials, things, lights and furniture. Meters, z up."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from . import textures
from .textures import Color

Material = dict
Surface = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""(u, v), each of one shape in [0, 1] -> places [..., 3]; the outer side is where d/du x d/dv points."""


class Stage:
    """Collects a scene for mitsuba.load_dict (`items`).

    mi: the imported mitsuba module with its variant set. rng: all randomness comes from it. folder: for meshes.
    A paint is the name of a function in `textures` followed by its arguments, a name in `paints`, a picture [H, W, 3],
    or one color.
    """

    def __init__(self, mi, rng: np.random.Generator, folder: Path):
        self.mi, self.rng, self.folder = mi, rng, folder
        self.items: dict = {"type": "scene"}
        self.paints: dict[str, np.ndarray] = {}

    # Materials. Nothing is perfectly smooth but glass: a mirror's reflection of a small lamp is found by chance alone.

    def image(
        self, paint: str, *args, power: float = 1.0, gain: float = 1.0, lift: float = 0.0, **options
    ) -> np.ndarray:
        """A texture's picture [H, W, 3], or gain * picture ** power + lift."""
        texture = self.paints[paint] if paint in self.paints else getattr(textures, paint)(self.rng, *args, **options)
        return texture**power * gain + lift

    def paint(self, paint, *args, repeat=(1.0, 1.0), **options) -> dict:
        if isinstance(paint, dict):
            return paint
        picture = self.image(paint, *args, **options) if isinstance(paint, str) else paint
        if not isinstance(picture, np.ndarray):
            return {"type": "rgb", "value": list(picture)}
        # Rows of an array go down while v goes up.
        bitmap = self.mi.Bitmap(np.ascontiguousarray(picture[::-1], np.float32))
        transform = self.mi.ScalarTransform3f().scale([float(repeat[0]), float(repeat[1])])
        return {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "repeat", "to_uv": transform}

    def uniform(self, low: float, high: float) -> float:
        return self.rng.uniform(low, high)

    def matt(self, *paint, **options) -> Material:
        return two_sided(type="diffuse", reflectance=self.paint(*paint, **options))

    def varnish(self, *paint, rough: float = 0.2, **options) -> Material:
        reflectance = self.paint(*paint, **options)
        return two_sided(type="roughplastic", diffuse_reflectance=reflectance, alpha=rough, nonlinear=False)

    def metal(self, name: str = "Au", rough: float = 0.2) -> Material:
        """name: of Mitsuba's measured metals (Au, Cu, Cr, Al, Ag, W ...)."""
        return two_sided(type="roughconductor", material=name, alpha=rough, distribution="ggx")

    def glass(self, index: float = 1.5, tint: Color = (1.0, 1.0, 1.0)) -> Material:
        """Clear, smooth; for closed bodies only. tint: what passes each surface."""
        return {"type": "dielectric", "int_ior": index, "ext_ior": 1.0, "specular_transmittance": self.paint(tint)}

    # Things.

    def add(self, **entry) -> None:
        self.items[f"item_{len(self.items):04d}"] = entry

    def panel(self, center, half_u, half_v, bsdf: Material, **more) -> None:
        """A rectangle from its center and half edges (3-vectors); it faces half_u x half_v."""
        facing = np.cross(half_u, half_v)
        matrix = np.eye(4)
        matrix[:3] = np.stack([half_u, half_v, facing / np.linalg.norm(facing), center], 1)
        self.add(type="rectangle", to_world=self.mi.ScalarTransform4f(matrix), bsdf=bsdf, **more)

    def box(self, center, half, bsdf: Material, turn: float = 0.0) -> None:
        """half: half edge lengths; turn: about z, degrees."""
        self.add(type="cube", to_world=self._place(center, turn).scale(list(half)), bsdf=bsdf)

    def ball(self, center, radius: float, bsdf: Material, turn: float = 0.0, tilt: float = 0.0) -> None:
        self.add(type="sphere", to_world=self._place(center, turn, tilt).scale(radius), bsdf=bsdf)

    def rod(self, start, end, radius: float, bsdf: Material, **more) -> None:
        self.add(type="cylinder", p0=list(start), p1=list(end), radius=radius, bsdf=bsdf, **more)

    def drum(self, center, radius: float, height: float, bsdf: Material) -> None:
        """An upright closed cylinder from its bottom's center."""
        top = np.add(center, [0, 0, height])
        self.rod(center, top, radius, bsdf)
        self.add(type="disk", to_world=self._place(top).scale(radius), bsdf=bsdf)

    def surface(self, surface: Surface, columns: int, rows: int, center, bsdf: Material, turn=0.0, tilt=0.0) -> None:
        path = self.folder / f"mesh_{len(self.items):04d}.ply"
        write_mesh(path, surface, columns, rows)
        self.add(type="ply", filename=str(path), to_world=self._place(center, turn, tilt), bsdf=bsdf)

    def _place(self, center, turn: float = 0.0, tilt: float = 0.0):
        place = self.mi.ScalarTransform4f().translate([float(c) for c in center]).rotate([0, 0, 1], turn)
        return place.rotate([1, 0, 0], tilt) if tilt else place

    # Lights. `weight` is how often a light is drawn: proportional to what it gives, for the least noise.

    def lamp(self, center, radius: float, radiance, weight: float = 1.0) -> None:
        """A glowing ball."""
        self.add(type="sphere", center=list(center), radius=radius, **self._glow(radiance, weight))

    def bright_panel(self, center, half_u, half_v, radiance, weight: float = 1.0) -> None:
        """A glowing rectangle that faces half_u x half_v."""
        self.panel(center, half_u, half_v, **self._glow(radiance, weight))

    def tube(self, start, end, radius: float, radiance, weight: float = 1.0) -> None:
        """A glowing rod."""
        self.rod(start, end, radius, **self._glow(radiance, weight))

    def sky(self, weight: float, *paint) -> None:
        """paint: radiance [H, 2 H, 3], equirectangular, zenith on top."""
        bitmap = self.mi.Bitmap(np.ascontiguousarray(self.image(*paint), np.float32))
        upright = self.mi.ScalarTransform4f().rotate([1, 0, 0], 90)
        self.add(type="envmap", bitmap=bitmap, to_world=upright, sampling_weight=weight)

    def sun(self, direction, irradiance: Color, weight: float = 1.0) -> None:
        """Parallel light that travels along `direction`; irradiance on a surface that faces it."""
        direction = list(direction / np.linalg.norm(direction))
        self.add(type="directional", direction=direction, irradiance=self.paint(irradiance), sampling_weight=weight)

    def _glow(self, radiance, weight: float) -> dict:
        emitter = {"type": "area", "radiance": self.paint(radiance), "sampling_weight": weight}
        return {"bsdf": self.matt((0, 0, 0)), "emitter": emitter}

    # Buildings.

    def room(self, half_width: float, front: float, back: float, height: float, *walls: Material) -> None:
        """Panels facing inwards: floor, ceiling, left, right, front, back; a back left out is open at +y."""
        middle, half, up = (front + back) / 2, (back - front) / 2, height / 2
        sides = (
            ([0, middle, 0], [half_width, 0, 0], [0, half, 0]),
            ([0, middle, height], [half_width, 0, 0], [0, -half, 0]),
            ([-half_width, middle, up], [0, half, 0], [0, 0, up]),
            ([half_width, middle, up], [0, -half, 0], [0, 0, up]),
            ([0, front, up], [-half_width, 0, 0], [0, 0, up]),
            ([0, back, up], [half_width, 0, 0], [0, 0, up]),
        )
        for side, wall in zip(sides, walls):
            self.panel(*side, wall)

    def wall_with_hole(self, y: float, half_width: float, height: float, hole, paint: str, repeat) -> None:
        """A wall in the plane y with a hole (x0, x1, z0, z1); one texture over all."""
        texture = self.image(paint)
        (x0, x1, z0, z1), left, right = hole, -half_width, half_width
        scale = [repeat[0] / (right - left), repeat[1] / height]
        for a, b, c, d in ((left, x0, 0, height), (x1, right, 0, height), (x0, x1, 0, z0), (x0, x1, z1, height)):
            wall = self.matt(texture)
            place = self.mi.ScalarTransform3f().translate([(a - left) * scale[0], c * scale[1]])
            wall["layer"]["reflectance"]["to_uv"] = place.scale([(b - a) * scale[0], (d - c) * scale[1]])
            self.panel([(a + b) / 2, y, (c + d) / 2], [(b - a) / 2, 0, 0], [0, 0, (d - c) / 2], wall)

    def window_frame(self, y: float, hole, material: Material) -> None:
        """Bars and a sill for wall_with_hole's hole."""
        x0, x1, z0, z1 = hole
        x, z, half_x, half_z = (x0 + x1) / 2, (z0 + z1) / 2, (x1 - x0) / 2, (z1 - z0) / 2
        for level in (z0, z1, z + half_z / 3):
            self.box([x, y, level], [half_x + 0.04, 0.06, 0.025], material)
        for place in (x0, x1, x):
            self.box([place, y, z], [0.025, 0.06, half_z], material)
        self.box([x, y - 0.10, z0 - 0.03], [half_x + 0.10, 0.12, 0.02], material)

    # Gardens.

    def lawn(self, center, material: Material) -> None:
        """12 m of gentle hills."""

        def surface(u, v):
            x, y = (2 * u - 1) * 6, (2 * v - 1) * 6
            return np.stack([x, y, hills(x, y)], -1)

        self.surface(surface, 120, 120, center, material)

    def pebbles(self, count: int, ranges: dict[str, list[float]], ground: float | str, *paint, **options) -> None:
        """Balls at random. ranges: of x, y and radius, drawn in this order; ground: its height, or "lawn"."""
        low, high = zip(*ranges.values())
        for _ in range(count):
            sample = dict(zip(ranges, self.rng.uniform(low, high).tolist()))
            x, y, radius = (sample[name] for name in ("x", "y", "radius"))
            height = hills(x, y - 1.5) - 0.4 * radius if ground == "lawn" else ground
            self.ball([x, y, height + radius], radius, self.matt(*paint, **options))

    # Furniture.

    def rug(self, x: float, y: float, half_x: float, half_y: float, dark: Color, light: Color, repeat) -> None:
        cloth = self.matt("fabric", dark, light, repeat=repeat)
        self.panel([x, y, 0.006], [half_x, 0, 0], [0, half_y, 0], cloth)

    def table(self, center, half, height: float = 0.72) -> float:
        """A wooden table around (x, y); returns the height of its top."""
        x, y = center
        board = self.image("wood", 4, (0.08, 0.04, 0.02), (0.34, 0.20, 0.11))
        self.box([x, y, height - 0.025], [half[0], half[1], 0.025], self.varnish(board))
        for side in (-0.9, 0.9):
            for end in (-0.85, 0.85):
                foot = x + side * half[0], y + end * half[1]
                self.rod([*foot, 0], [*foot, height - 0.04], 0.03, self.varnish(board, rough=0.25))
        return height

    def shelf(self, center, half_width: float, depth: float, levels: int) -> None:
        """A bookcase standing at (x, y), open towards -y, full of books; its depths are dark."""
        rng, (x, y), gap = self.rng, center, 0.42
        boards = self.varnish("wood", 2, (0.05, 0.03, 0.02), (0.20, 0.12, 0.07), rough=0.3)
        half = levels * gap / 2
        for level in range(levels + 1):
            self.box([x, y, 0.02 + level * gap], [half_width, depth, 0.018], boards)
        for side in (-1, 1):
            self.box([x + side * half_width, y, half], [0.018, depth, half + 0.02], boards)
        self.box([x, y + depth, half], [half_width, 0.01, half], boards)
        for level in range(levels):
            place = x - half_width + 0.03
            while place < x + half_width - 0.10:
                thick, high = 0.015 + 0.022 * rng.random(), 0.11 + 0.06 * rng.random()
                if rng.random() < 0.12:
                    place += 0.06
                    continue
                back = self.varnish("books", rough=0.3)
                middle = [place + thick, y - 0.03 + 0.03 * rng.random(), 0.04 + level * gap + high]
                self.box(middle, [thick, depth * 0.65, high], back)
                place += 2 * thick + 0.003

    def picture(self, center, across, half_height: float, cells: int = 40, frame: str = "Au") -> None:
        """A framed painting. across: half its width towards its right, a vector or, along x, a number."""
        half_u = np.asarray(across, float) if np.ndim(across) else np.array([across, 0, 0])
        half_v, center = np.array([0, 0, half_height]), np.asarray(center, float)
        facing = np.cross(half_u, half_v)
        facing /= np.linalg.norm(facing)
        self.panel(center + 0.02 * facing, half_u, half_v, self.varnish("painting", cells, rough=0.15))
        for sign in (-1, 1):
            for along, aside in ((half_u, half_v), (half_v, half_u)):
                ends = [center + sign * aside * 1.04 + s * along * 1.04 for s in (-1, 1)]
                self.rod(*ends, radius=0.025, bsdf=self.metal(frame, 0.3))

    def lathe(self, profile, columns: int, rows: int, center, bsdf: Material) -> None:
        """A body of revolution; see the function of this name."""
        self.surface(lathe(profile), columns, rows, center, bsdf)

    def vase(self, center, material: Material, height: float = 0.42) -> None:
        line = np.array([[0.01, 0], [0.08, 0.0], [0.13, 0.12], [0.10, 0.26], [0.05, 0.36], [0.075, 0.42]])
        self.lathe(line * (height / 0.42), 64, 96, center, material)

    def plant(self, center, leaves: int = 11, size: float = 0.3) -> None:
        """Broad leaves from one place."""
        for k in range(leaves):
            green = self.varnish("fabric", (0.03, 0.16, 0.03), (0.16, 0.40, 0.08), 64, rough=0.3)
            length, lean = size * self.rng.uniform(0.8, 1.3), self.rng.uniform(0.3, 0.85)
            self.surface(leaf(length, 0.16 * length, lean, k * 2.399), 20, 7, center, green)

    def knot(self, center, material: Material, tilt: float = 65.0, turn: float = 0.0) -> None:
        self.surface(torus_knot, 300, 24, center, material, turn=turn, tilt=tilt)

    def crate(self, center, half: float) -> None:
        """A box open towards -y, dark inside, with a ball in it."""
        x, y, z = center
        boards = self.matt("wood", 5, (0.20, 0.12, 0.06), (0.50, 0.34, 0.18))
        for side in (-1, 1):
            self.box([x + side * half, y, z + half], [0.015, half, half], boards)
            self.box([x, y, z + half + side * (half - 0.015)], [half, half, 0.015], boards)
        self.box([x, y + half, z + half], [half, 0.015, half], boards)
        self.ball([x + 0.05, y + 0.1, z + 0.03 + 0.4 * half], 0.4 * half, self.varnish("checker", 10))

    def armchair(self, center, turn: float) -> None:
        """Upholstered boxes; `turn` 0 faces -y."""
        cloth = self.matt("fabric", (0.05, 0.10, 0.22), (0.26, 0.36, 0.46), repeat=(2, 2))
        cos, sin = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        for x, y, z, *half in (
            (0, 0, 0.24, 0.36, 0.36, 0.20),
            (0, 0.32, 0.58, 0.40, 0.10, 0.42),
            (0.36, 0, 0.40, 0.09, 0.36, 0.24),
            (-0.36, 0, 0.40, 0.09, 0.36, 0.24),
        ):
            self.box([center[0] + x * cos - y * sin, center[1] + x * sin + y * cos, z], half, cloth, turn)


def two_sided(**layer) -> Material:
    return {"type": "twosided", "layer": layer}


def lathe(profile) -> Surface:
    """The surface of revolution about z of the Catmull-Rom curve through (radius, height) points."""
    points = np.asarray(profile, float)
    share = np.linspace(0, 1, 160)
    place = np.linspace(0, len(points) - 1, 160)
    first = np.clip(np.floor(place).astype(int), 0, len(points) - 2)
    t = (place - first)[:, None]
    a, b, c, d = (points[np.clip(first + k, 0, len(points) - 1)] for k in (-1, 0, 1, 2))
    line = 0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)

    def surface(u, v):
        radius, height = (np.interp(np.clip(v, 0, 1), share, values) for values in line.T)
        return np.stack([radius * np.cos(u * 2 * np.pi), radius * np.sin(u * 2 * np.pi), height], -1)

    return surface


def hills(x, y):
    return 0.10 * np.sin(1.3 * x + 0.4) * np.cos(1.1 * y) + 0.05 * np.sin(3.1 * x + 2.2 * y) - 0.05


def torus_knot(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """A tube along the (2, 3) torus knot, about 0.4 across; a Surface."""

    def line(t):
        away = 0.13 + 0.055 * np.cos(3 * t)
        return np.stack([away * np.cos(2 * t), away * np.sin(2 * t), 0.055 * 1.6 * np.sin(3 * t)], -1)

    t, angle = u * 2 * np.pi, v[..., None] * 2 * np.pi
    tangent = line(t + 1e-3) - line(t - 1e-3)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    side = np.cross(tangent, np.broadcast_to([0.0, 0.0, 1.0], tangent.shape))
    side /= np.linalg.norm(side, axis=-1, keepdims=True) + 1e-9
    return line(t) + 0.042 * (np.cos(angle) * side - np.sin(angle) * np.cross(tangent, side))


def leaf(length: float, width: float, lean: float, turn: float) -> Surface:
    """A leaf from the origin, bending outwards by `lean` in [0, 1] towards the angle `turn` (radians)."""

    def surface(u, v):
        side = width * np.sin(np.pi * np.clip(u, 0, 1)) ** 0.8 * (v - 0.5) * 2
        away = length * u * lean
        up = length * u * (1.35 - lean) - 0.25 * length * u * u - 0.3 * side * side / width
        return np.stack([away * np.cos(turn) - side * np.sin(turn), away * np.sin(turn) + side * np.cos(turn), up], -1)

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
