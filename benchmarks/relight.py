"""Three balls lit in Mitsuba by trained rooms, by their maps and by their lights, against the truth.

python -m benchmarks.relight JOBS --json docs/reports/results/relight.json --picture docs/reports/relight.png

JOBS is the folder of `python -m benchmarks quality --out`. Needs `pip install mitsuba`. The balls, matte, lacquered and
of gold, are small against the room and stand at the first place of its maps of light. Light of directions that no photo
shows is left out, of the truth too.
"""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from scenes.generator.render import load_mitsuba
from sehdr_warp.errors import SehdrError
from sehdr_warp.files import read_json
from sehdr_warp.model.light_shapes import LightShape
from sehdr_warp.output.images.display import encode_srgb
from sehdr_warp.output.images.ldr_files import quantize, write_picture
from sehdr_warp.output.lighting.environment_map import latlong, solid_angles
from sehdr_warp.scene import embedded_folder, look_at

from .irradiance import LIGHT, LightMap, read_light, read_light_maps
from .quality import KNOWN, RESULT
from .results import finish, new_result
from .study import run

LOG = logging.getLogger("relight")
SIZE, SAMPLES, DEPTH = 96, 256, 3  # Pixels of a ball, paths of a pixel, and surfaces of a path
FINER = 8  # Rows of Mitsuba's map for each of ours
RADIUS, DISTANCE = 0.05, 0.6  # Meters: of a ball, and from the balls to the camera
SHOWN = ("lamps", "night", "window"), (1, 2, 3)  # Rooms and exposures that are compared
METHODS = "default", "3dgs", "paper", "truth"
PICTURED = ("default", "map"), ("default", "lights"), ("3dgs", "map"), ("paper", "map")


def main(jobs: Path, /, json: Path, picture: Path | None = None, samples: int = SAMPLES) -> None:
    """Light the balls and compare.

    Args:
        jobs: folder of quality's jobs.
        json: file of the result.
        picture: PNG with a row for each room at exposure 2: the truth, then default's map and lights, and the maps of
            3dgs and of paper.
        samples: paths of a pixel.
    """
    mi: Any = load_mitsuba()
    result = new_result("relight", torch.device("cpu"), {"samples": samples})
    strips, truths = [], {}
    for config, folder in _finished_jobs(jobs):
        scene, exposure, method = config["scene"]["name"], config["exposure"], config["method"]
        place = read_light_maps(embedded_folder(f"embedded:{scene}"))[0]
        if scene not in truths:
            truths[scene] = balls(mi, place, place.radiance, (), samples)
        truth, light = truths[scene], read_light(folder / LIGHT)
        pictures = {"map": balls(mi, place, light.maps[0], (), samples)}
        if light.lights and method == METHODS[0]:
            pictures["lights"] = balls(mi, place, light.rest[0], light.lights, samples)
        for by, lit in pictures.items():
            row = {"scene": scene, "exposure": exposure, "method": method, "by": by}
            row |= {"off": float(np.abs(lit - truth).mean() / truth.mean()), "energy": float(lit.mean() / truth.mean())}
            result["rows"].append(row)
            LOG.info("%s", row)
        if exposure == SHOWN[1][1] and method != METHODS[-1]:
            strips.append((scene, truth, {(method, by): lit for by, lit in pictures.items()}))
    if not result["rows"]:
        raise SehdrError(f"{jobs}: holds no light of {', '.join(SHOWN[0])}; run quality with these scenes")
    result["command"] = "python -m benchmarks.relight JOBS --json docs/reports/results/relight.json"
    finish(result, json, overwrite=True)
    if picture is not None:
        picture.unlink(missing_ok=True)
        write_picture(picture, quantize(_montage(strips)))


def _finished_jobs(jobs: Path) -> list[tuple[dict, Path]]:
    """Return config and folder of the finished jobs that are compared, ordered."""
    result = []
    for path in sorted(jobs.glob(f"jobs/*/{RESULT}")):
        config = read_json(path)["config"]
        is_shown = config["scene"]["name"] in SHOWN[0] and config["exposure"] in SHOWN[1] and config["seed"] == 0
        knows_curve = config["response"] in (KNOWN, "linear") or config["sees_truth"]
        if is_shown and knows_curve and config["method"] in METHODS and (path.parent / LIGHT).is_file():
            result.append((config, path.parent))
    order = [(config["scene"]["name"], config["exposure"], METHODS.index(config["method"])) for config, _ in result]
    return [result[i] for i in sorted(range(len(result)), key=order.__getitem__)]


def balls(
    mi: Any, place: LightMap, radiance: np.ndarray, lights: Sequence[tuple[LightShape, np.ndarray]], samples: int
) -> np.ndarray:
    """Return [SIZE, 3 SIZE, 3], the balls at a place in the light of a map, and of lights around it.

    Args:
        mi: mitsuba, with a variant set.
        place: which directions photos show, and where the balls stand.
        radiance: [H, W, 3] of the map.
        lights: shapes in the scene's coordinates, with their radiance [3].
        samples: paths of a pixel.
    """
    visible_light = np.maximum(radiance, 0) * place.coverage[..., None]
    scene: dict[str, Any] = {"type": "scene", "integrator": {"type": "path", "max_depth": DEPTH}}
    # Mitsuba has the middle of a map's first row at the pole, so coarse rows near it give too little light: in 64 rows,
    # a lamp at 13 degrees from the pole has 0.91 of its light.
    fine = np.kron(visible_light, np.ones((FINER, FINER, 1)))
    scene["map"] = {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(fine, np.float32))}
    for index, (shape, light) in enumerate(lights):
        scene[f"light_{index}"] = _emitter(mi, shape, light, place.position)
    weight = solid_angles(place.coverage.shape[1], "latlong") * place.coverage
    ahead = np.einsum("hw,hwk->k", weight, latlong(place.coverage.shape[1]))
    ahead = np.array([*ahead[:2], 0.0]) / max(np.linalg.norm(ahead[:2]), 1e-9)
    across = np.cross(ahead, (0.0, 0.0, 1.0))
    gold = {"type": "roughconductor", "material": "Au", "alpha": 0.2}
    lacquer = {"type": "plastic", "diffuse_reflectance": {"type": "rgb", "value": [0.1, 0.2, 0.6]}}
    matte = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    for index, surface in enumerate((matte, lacquer, gold)):
        center = (index - 1) * 2.2 * RADIUS * across
        scene[f"ball_{index}"] = {"type": "sphere", "center": center.tolist(), "radius": RADIUS, "bsdf": surface}
    # The camera stands on the side that the light comes from. Mitsuba's has +x left and +y up.
    pose = np.linalg.inv(look_at(DISTANCE * ahead, np.zeros(3), up=(0.0, 0.0, 1.0))) @ np.diag([-1.0, -1, 1, 1])
    angle = 2 * np.degrees(np.arctan(3.3 * RADIUS / DISTANCE))
    film = {"type": "hdrfilm", "width": 3 * SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "fov": float(angle), "to_world": mi.ScalarTransform4f(pose), "film": film}
    scene["sensor"] = sensor | {"near_clip": 1e-3}
    # The background is the map itself, which no ball shows: only pixels of balls count.
    picture = np.array(mi.render(mi.load_dict(scene), spp=samples, seed=0), np.float32)[..., :3]
    y, x = np.mgrid[:SIZE, : 3 * SIZE] + 0.5
    half = 1.5 * SIZE / 3.3  # Pixels of a radius
    inside = np.zeros(y.shape, bool)
    for index in range(3):
        inside |= np.hypot(x - 1.5 * SIZE - (index - 1) * 2.2 * half, y - SIZE / 2) < half - 2
    return picture * inside[..., None]


def _emitter(mi: Any, shape: LightShape, radiance: np.ndarray, place: np.ndarray) -> dict[str, Any]:
    """Return a light as Mitsuba has it, around the place."""
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": np.maximum(radiance, 0).tolist()}}
    center = shape.position - place
    if shape.kind == "sphere":
        return {"type": "sphere", "center": center.tolist(), "radius": shape.size[0] / 2, "emitter": emitter}
    matrix = np.eye(4)
    matrix[:3, :3] = (shape.axes * np.array([shape.size[0] / 2, shape.size[1] / 2, 1.0])[:, None]).T
    matrix[:3, 3] = center
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f(matrix), "emitter": emitter}


def _montage(strips: Sequence[tuple[str, np.ndarray, dict[tuple[str, str], np.ndarray]]]) -> np.ndarray:
    """Return [H, W, 3] sRGB: a row for each room, of the truth and of PICTURED; black where there is none."""
    rows = []
    for scene in dict.fromkeys(strip[0] for strip in strips):
        mine = [strip for strip in strips if strip[0] == scene]
        truth, lit = mine[0][1], {key: picture for strip in mine for key, picture in strip[2].items()}
        pictures = [truth, *(lit.get(key, np.zeros_like(truth)) for key in PICTURED)]
        rows.append(np.concatenate(pictures, axis=1) * (0.9 / max(float(np.percentile(truth, 99.5)), 1e-9)))
    return encode_srgb(np.clip(np.concatenate(rows), 0, 1))


if __name__ == "__main__":
    run(main)
