"""Light an object by a trained scene: photos in, environment map out, beside the same object lit by the truth.

python examples/relighting.py [OUT]        needs `pip install mitsuba`

Mitsuba renders linear EXR photos of a box with a lamp from cameras all around. A scene is trained on them, and its map
lights two balls: gold, and lacquer on blue. So does the map that Mitsuba renders of the same place.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import sehdr_warp as sw
from sehdr_warp.output.images.display import encode_srgb
from sehdr_warp.output.images.exr import write_exr
from sehdr_warp.output.lighting.environment_map import latlong
from sehdr_warp.scene import look_at

PLACE = np.array([0.0, 0.1, 0.3])
FACES = np.concatenate([np.eye(3), -np.eye(3)])


def main(out: Path, *, views: int = 72, size: int = 48, samples: int = 32, iterations: int = 900) -> float:
    """Write photos/, run/, env.exr, truth.exr and relighting.png (truth, ours, four times the difference).

    Returns:
        The mean error of the light on the balls, over the mean light.
    """
    import mitsuba

    mi: Any = mitsuba
    mi.set_variant("scalar_rgb")
    box = mi.cornell_box()
    tiles = {"type": "checkerboard", "color0": {"type": "rgb", "value": 0.35}, "color1": {"type": "rgb", "value": 0.7}}
    tiles["to_uv"] = mi.ScalarTransform3f().scale([5, 5])
    box["white"] = {"type": "diffuse", "reflectance": tiles}
    room = mi.load_dict(box)

    # Photos: linear EXR, whose light is known, in the layout of nerfstudio and Blender.
    (out / "photos").mkdir(parents=True, exist_ok=True)
    random, frames = np.random.default_rng(0), []
    for index in range(views):
        place, ahead = PLACE + random.uniform(-0.35, 0.35, 3), random.normal(size=3)
        camera = camera_of(size, 80, place, ahead)
        write(out / "photos" / f"{index}.exr", picture(mi, room, camera, samples))
        to_world = camera.camera_to_world @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": f"{index}.exr", "transform_matrix": to_world.tolist()})
    lens = {"w": size, "h": size, "fl_x": camera_of(size, 80, PLACE, PLACE).fx}
    (out / "photos" / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))

    # The walls are matt: harmonics of a higher degree would only learn from where few photos saw the lamp.
    config = sw.load_config("default", {"schedule.iterations": iterations, "model.sh_degree": 1})
    run = sw.train(sw.load_scene(out / "photos", holdout=0), out / "run", config, overwrite=True)
    at = (float(PLACE[0]), float(PLACE[1]), float(PLACE[2]))
    sw.write_environment_map(run, out / "env.exr", at=at, size=4 * size, axes="scene", overwrite=True)
    write(out / "truth.exr", true_map(mi, room, size, 4 * samples))

    truth, ours = (lit_balls(mi, out / name, 2 * size, samples) for name in ("truth.exr", "env.exr"))
    gain = 0.8 / np.percentile(truth, 99)
    panels = encode_srgb(np.concatenate([truth, ours, 4 * np.abs(ours - truth)], axis=1) * gain)
    Image.fromarray(np.rint(panels * 255).astype(np.uint8)).save(out / "relighting.png")
    error = float(np.abs(ours - truth).mean() / truth.mean())
    print(f"{out / 'relighting.png'}: truth, ours, four times the difference; {100 * error:.1f} % off in the mean")
    return error


def camera_of(size: int, degrees: float, place: np.ndarray, ahead: np.ndarray, up=(0.0, 1.0, 0.0)) -> sw.Camera:
    focal = 0.5 * size / np.tan(np.radians(degrees) / 2)
    return sw.Camera(size, size, focal, focal, size / 2, size / 2, look_at(place, place + ahead, up))


def picture(mi: Any, scene: Any, camera: sw.Camera, samples: int) -> np.ndarray:
    """Return [H, W, 3] radiance from a camera; Mitsuba's cameras have +x left and +y up."""
    film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}}
    pose = mi.ScalarTransform4f(camera.camera_to_world @ np.diag([-1.0, -1, 1, 1]))
    angle = float(np.degrees(2 * np.arctan(0.5 * camera.width / camera.fx)))
    sensor = mi.load_dict({"type": "perspective", "fov": angle, "to_world": pose, "near_clip": 1e-3, "film": film})
    return np.array(mi.render(scene, sensor=sensor, spp=samples), np.float32)[..., :3]


def write(path: Path, radiance: np.ndarray) -> None:
    write_exr(path, dict(zip("RGB", np.moveaxis(radiance, 2, 0), strict=True)), pixel="float", overwrite=True)


def true_map(mi: Any, room: Any, size: int, samples: int) -> np.ndarray:
    """Return [2 size, 4 size, 3], the true map, from the faces of a cube around the place."""
    directions = latlong(4 * size)
    latlong_map = np.zeros(directions.shape, np.float32)
    for axis in FACES:
        camera = camera_of(size, 90, PLACE, axis, np.roll(axis, 1))
        face = picture(mi, room, camera, samples)
        x, y, z = np.moveaxis(directions @ camera.world_to_camera[:3, :3].T, 2, 0)
        inside = (z > 0) & (np.maximum(np.abs(x), np.abs(y)) <= z)
        column, row = (np.clip(v[inside] / z[inside] * camera.fx + size / 2, 0, size - 1).astype(int) for v in (x, y))
        latlong_map[inside] = face[row, column]
    return latlong_map


def lit_balls(mi: Any, env: Path, size: int, samples: int) -> np.ndarray:
    """Return [size / 2, size, 3], two balls lit by a map."""
    gold = {"type": "roughconductor", "material": "Au", "alpha": 0.15}
    lacquer = {"type": "plastic", "diffuse_reflectance": {"type": "rgb", "value": [0.1, 0.2, 0.6]}}
    scene = {"type": "scene", "integrator": {"type": "path", "max_depth": 4}}
    scene |= {"light": {"type": "envmap", "filename": str(env)}}
    for x, surface in ((-0.5, gold), (0.5, lacquer)):
        scene[surface["type"]] = {"type": "sphere", "center": [x, 0, 0], "radius": 0.46, "bsdf": surface}
    focal, pose = 2.0 * size, look_at((0.0, 0.3, 4.0), up=(0.0, 1.0, 0.0))
    camera = sw.Camera(size, size // 2, focal, focal, size / 2, size / 4, pose)
    return picture(mi, mi.load_dict(scene), camera, samples)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/relighting"))
