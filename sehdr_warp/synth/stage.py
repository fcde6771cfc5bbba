"""A scene under construction: materials, things and lights in Mitsuba 3's terms. Metres, z up."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from .shapes import Surface, write_mesh

Material = dict
Paint = np.ndarray | Sequence[float]
"""A texture [H, W, 3], or one colour (r, g, b)."""


class Stage:
    """Collects a scene for mitsuba.load_dict (`items`).

    mi: the imported mitsuba module with its variant set. rng: all randomness comes from it. folder: for meshes.
    """

    def __init__(self, mi, rng: np.random.Generator, folder: Path):
        self.mi, self.rng, self.folder = mi, rng, folder
        self.items: dict = {"type": "scene"}

    # Materials. Nothing is perfectly smooth but glass: a mirror's reflection of a small lamp is found by chance alone.

    def paint(self, paint: Paint, repeat=(1.0, 1.0)) -> dict:
        if not isinstance(paint, np.ndarray):
            return {"type": "rgb", "value": list(paint)}
        # Rows of an array go down while v goes up.
        bitmap = self.mi.Bitmap(np.ascontiguousarray(paint[::-1], np.float32))
        transform = self.mi.ScalarTransform3f().scale([float(repeat[0]), float(repeat[1])])
        return {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "repeat", "to_uv": transform}

    def matt(self, paint: Paint, repeat=(1.0, 1.0)) -> Material:
        return _both_sides({"type": "diffuse", "reflectance": self.paint(paint, repeat)})

    def varnished(self, paint: Paint, roughness: float = 0.2, repeat=(1.0, 1.0)) -> Material:
        layer = {"type": "roughplastic", "diffuse_reflectance": self.paint(paint, repeat), "alpha": roughness}
        return _both_sides(layer | {"nonlinear": False})

    def metal(self, name: str = "Au", roughness: float = 0.2) -> Material:
        """name: of Mitsuba's measured metals (Au, Cu, Cr, Al, Ag, W ...)."""
        return _both_sides({"type": "roughconductor", "material": name, "alpha": roughness, "distribution": "ggx"})

    def glass(self, index: float = 1.5, tint=(1.0, 1.0, 1.0)) -> Material:
        """Clear, smooth; for closed bodies only. tint: what passes each surface."""
        return {"type": "dielectric", "int_ior": index, "ext_ior": 1.0, "specular_transmittance": self.paint(tint)}

    # Things.

    def add(self, **entry) -> None:
        self.items[f"item_{len(self.items):04d}"] = entry

    def panel(self, centre, half_u, half_v, material: Material, **more) -> None:
        """A rectangle from its centre and half edges (3-vectors); it faces half_u x half_v."""
        facing = np.cross(half_u, half_v)
        matrix = np.eye(4)
        matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = half_u, half_v, facing / np.linalg.norm(facing)
        matrix[:3, 3] = centre
        self.add(type="rectangle", to_world=self.mi.ScalarTransform4f(matrix), bsdf=material, **more)

    def box(self, centre, half, material: Material, turn: float = 0.0) -> None:
        """half: half edge lengths; turn: about z, degrees."""
        self.add(type="cube", to_world=self._place(centre, turn).scale(list(half)), bsdf=material)

    def ball(self, centre, radius: float, material: Material, turn: float = 0.0, tilt: float = 0.0) -> None:
        place = self._place(centre, turn).rotate([1, 0, 0], tilt).scale(radius)
        self.add(type="sphere", to_world=place, bsdf=material)

    def rod(self, start, end, radius: float, material: Material) -> None:
        self.add(type="cylinder", p0=list(start), p1=list(end), radius=radius, bsdf=material)

    def drum(self, centre, radius: float, height: float, material: Material) -> None:
        """An upright closed cylinder from its bottom's centre."""
        top = np.add(centre, [0, 0, height])
        self.rod(centre, top, radius, material)
        self.add(type="disk", to_world=self._place(top).scale(radius), bsdf=material)

    def surface(self, surface: Surface, columns: int, rows: int, centre, material: Material, turn: float = 0.0,
                tilt: float = 0.0) -> None:  # fmt: skip
        path = self.folder / f"mesh_{len(self.items):04d}.ply"
        write_mesh(path, surface, columns, rows)
        place = self._place(centre, turn).rotate([1, 0, 0], tilt)
        self.add(type="ply", filename=str(path), to_world=place, bsdf=material)

    # Lights. `weight` is how often a light is drawn: proportional to what it gives, for the least noise.

    def lamp(self, centre, radius: float, radiance, weight: float = 1.0) -> None:
        """A glowing ball."""
        self.add(type="sphere", center=list(centre), radius=radius, bsdf=self.matt((0, 0, 0)),
                 emitter=self._area(radiance, weight))  # fmt: skip

    def bright_panel(self, centre, half_u, half_v, radiance: Paint, weight: float = 1.0) -> None:
        """A glowing rectangle that faces half_u x half_v."""
        self.panel(centre, half_u, half_v, self.matt((0, 0, 0)), emitter=self._area(radiance, weight))

    def tube(self, start, end, radius: float, radiance, weight: float = 1.0) -> None:
        """A glowing rod."""
        self.add(type="cylinder", p0=list(start), p1=list(end), radius=radius, bsdf=self.matt((0, 0, 0)),
                 emitter=self._area(radiance, weight))  # fmt: skip

    def sky(self, radiance: np.ndarray, weight: float = 1.0) -> None:
        """radiance: [H, 2 H, 3], equirectangular, zenith on top."""
        bitmap = self.mi.Bitmap(np.ascontiguousarray(radiance, np.float32))
        upright = self.mi.ScalarTransform4f().rotate([1, 0, 0], 90)
        self.add(type="envmap", bitmap=bitmap, to_world=upright, sampling_weight=weight)

    def sun(self, direction, irradiance, weight: float = 1.0) -> None:
        """Parallel light that travels along `direction`; irradiance (r, g, b) on a surface that faces it."""
        self.add(type="directional", direction=list(direction), irradiance={"type": "rgb", "value": list(irradiance)},
                 sampling_weight=weight)  # fmt: skip

    def _area(self, radiance: Paint, weight: float) -> dict:
        return {"type": "area", "radiance": self.paint(radiance), "sampling_weight": weight}

    def _place(self, centre, turn: float = 0.0):
        return self.mi.ScalarTransform4f().translate([float(c) for c in centre]).rotate([0, 0, 1], turn)


def _both_sides(layer: dict) -> Material:
    return {"type": "twosided", "layer": layer}
