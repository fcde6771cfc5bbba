"""Truth denoised by Open Image Denoise, guided by what the first surfaces are: optional, and stated in synth.json."""

import importlib.util
from importlib.metadata import version

import numpy as np

from ..errors import SehdrError

DENOISERS = ("none", "oidn")
GUIDE_SAMPLES = 64
"""Rays of a pixel for the guides, to the first surface only."""
_WHITE = {"type": "rgb", "value": [1.0, 1.0, 1.0]}
# Radius of the ball that stands for the sky: beyond every scene, within the cameras' far plane.
_SKY = 500.0


def check_denoiser(name: str) -> None:
    """SehdrError where a denoiser is unknown or not installed."""
    if name not in DENOISERS:
        raise SehdrError(f"--denoise {name:.40}: is not one of {', '.join(DENOISERS)}")
    if name == "oidn" and importlib.util.find_spec("pyoidn") is None:
        raise SehdrError("Open Image Denoise is not installed; pip install 'sehdr-warp[synth]', or take --denoise none")


def denoiser_version() -> str:
    """As stated in synth.json; the first three numbers are the library's own."""
    return f"Open Image Denoise (pyoidn {version('pyoidn')})"


class Denoiser:
    """Denoises the views of one scene.

    The guides are each pixel's albedo and shading normal, box-filtered over GUIDE_SAMPLES rays: they hold edges and
    textures, and have no light in them, so hardly any noise. Albedo is that of a diffuse surface or a varnish's base;
    metal, glass, lights and the sky count as white. Where more than half of a pixel's radiance comes straight from a
    light or the sky it is kept as rendered: such light has no path noise, and at 10^5 times its surroundings a filter
    would spill it.

    mi: the imported mitsuba module with its variant set. items, scene: what Stage collected, and loaded.
    """

    def __init__(self, mi, items: dict, scene):
        self.mi, self.scene = mi, scene
        self.guides_of = mi.load_dict(guide_items(items))
        self.guides = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,facing:sh_normal"})
        self.straight = mi.load_dict({"type": "path", "max_depth": 1})

    def __call__(self, radiance: np.ndarray, sensor, seed: int) -> np.ndarray:
        """[H, W, 3] >= 0, of the same sensor -> the same, denoised, >= 0."""
        render = self.mi.render
        guides = np.array(
            render(self.guides_of, sensor=sensor, integrator=self.guides, spp=GUIDE_SAMPLES, seed=seed), np.float32
        )[..., -6:]
        straight = np.array(
            render(self.scene, sensor=sensor, integrator=self.straight, spp=GUIDE_SAMPLES, seed=seed), np.float32
        )[..., :3]
        return denoise(radiance, guides[..., :3], guides[..., 3:], straight)


def denoise(radiance: np.ndarray, albedo: np.ndarray, normal: np.ndarray, straight: np.ndarray) -> np.ndarray:
    """radiance, straight (of it, what lights and the sky send to the camera themselves): [H, W, 3] >= 0; albedo in
    [0, 1]; normal in [-1, 1]."""
    import pyoidn

    found = pyoidn.denoise(
        np.ascontiguousarray(radiance, np.float32),
        np.ascontiguousarray(np.clip(albedo, 0, 1), np.float32),
        np.ascontiguousarray(np.clip(normal, -1, 1), np.float32),
        hdr=True,
        clean_aux=True,
    )
    lit = straight.sum(-1) > 0.5 * radiance.sum(-1)
    return np.where(lit[..., None], radiance, np.maximum(found, 0)).astype(np.float32)


def guide_items(items: dict) -> dict:
    """A scene for albedo and normals: every surface diffuse, of its own albedo or white; the sky a white ball."""
    made = {}
    for name, item in items.items():
        if not isinstance(item, dict):
            made[name] = item
        elif item["type"] == "envmap":
            made[name] = {"type": "sphere", "radius": _SKY, "flip_normals": True, "bsdf": _diffuse(_WHITE)}
        elif "bsdf" in item:
            plain = _WHITE if "emitter" in item else _albedo(item["bsdf"])
            made[name] = {key: value for key, value in item.items() if key != "emitter"} | {"bsdf": _diffuse(plain)}
    return made


def _albedo(material: dict) -> dict:
    layer = material.get("layer", material)
    return layer.get("reflectance") or layer.get("diffuse_reflectance") or _WHITE


def _diffuse(paint: dict) -> dict:
    return {"type": "twosided", "layer": {"type": "diffuse", "reflectance": paint}}
