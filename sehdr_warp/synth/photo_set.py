"""A whole HDR-NeRF synthetic set of a scene with truth: photos at several exposures through any response."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from ..errors import InputError
from ..files import atomic_folder
from ..scene import Camera, Scene
from .expose import Curve, SensorNoise, expose


@dataclass(frozen=True)
class RadianceView:
    """name: the view's stem (`r_0`); radiance: [H, W, 3] scene-linear, >= 0; split: "train" or "test".

    camera: its principal point is the centre and its focal lengths are equal, as the layout cannot say otherwise.
    """

    name: str
    camera: Camera
    radiance: np.ndarray
    split: str


def write_photo_set(
    scene: Scene,
    out: Path | str,
    response: Curve,
    times: Sequence[float],
    *,
    noise: SensorNoise | None = None,
    seed: int = 0,
    overwrite: bool = False,
) -> None:
    """Write photos (8-bit PNG) at each time, times, poses, truth and points, in a layout that load_scene reads.

    times: seconds, positive, in any order; photo k of a view is `<view>_<k>.png`. Noise is drawn anew for each time.
    Truth is stored as half floats where they hold it. Points have the colours of the middle time.
    Raises InputError for a scene without truth, an impossible time, or cameras that the layout cannot hold.
    """
    if not times:
        raise InputError(scene.name, "no exposure times are given", "give one or more, in seconds")
    exposed = [expose(scene, response, time, noise=noise, seed=seed * len(times) + k) for k, time in enumerate(times)]
    views = [RadianceView(view.name, view.camera, view.hdr, view.split) for view in scene.views]
    half = max(float(view.radiance.max()) for view in views) <= 65504
    points = (scene.points, exposed[len(times) // 2].point_colors) if len(scene.points) else None
    with atomic_folder(out, overwrite) as folder:
        try:
            photos = [[view.image for view in photographed.views] for photographed in exposed]
            write_hdr_nerf_scene(folder, views, times, photos, points=points, half=half)
        except ValueError as error:
            raise InputError(scene.name, str(error), "expose a set in HDR-NeRF's layout") from None


def write_hdr_nerf_scene(
    folder: Path | str,
    views: Sequence[RadianceView],
    exposure_times: Sequence[float],
    photos: Sequence[Sequence[np.ndarray]],
    *,
    points: tuple[np.ndarray, np.ndarray] | None = None,
    half: bool = True,
) -> None:
    """Write a set that load_scene reads, with HDR-NeRF's file names, into a folder that may exist but gets new files.

    exposure_times: seconds. photos: at each time one of each view, [H, W, 3] encoded in [0, 1], stored in 8 bits.
    points: ([P, 3] places, [P, 3] colours in [0, 1]) for `sparse/0/points3D.txt`; None writes none.
    half: the truth as half floats (values up to 65504), otherwise as floats.
    Raises ValueError for a camera that the layout cannot hold, cameras that differ, or radiance beyond the format.
    """
    import OpenEXR

    folder = Path(folder)
    angles = {_view_angle(view.camera) for view in views}
    if len(angles) != 1:
        raise ValueError(f"HDR-NeRF sets have one camera_angle_x, the views have {sorted(angles)[:4]}")
    for split in ("train", "test"):
        chosen = [index for index, view in enumerate(views) if view.split == split]
        frames, times = [], {}
        (folder / split).mkdir(parents=True, exist_ok=True)
        (folder / f"{split}_hdr").mkdir(exist_ok=True)
        for place, index in enumerate(chosen):
            view = views[index]
            stem = f"./{split}/{view.name}"
            for k, (time, taken) in enumerate(zip(exposure_times, photos, strict=True)):
                code = (np.clip(taken[index], 0.0, 1.0) * 255 + 0.5).astype(np.uint8)
                Image.fromarray(code).save(folder / f"{stem}_{k}.png")
                times[f"{stem}_{k}.png"] = float(time)
            if half and view.radiance.max() > 65504:
                raise ValueError(f"radiance {view.radiance.max():g} of {view.name} does not fit half floats")
            pixels = np.ascontiguousarray(view.radiance, dtype=np.float16 if half else np.float32)
            header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            with OpenEXR.File(header, {"RGB": pixels}) as file:
                file.write(str(folder / f"{split}_hdr" / f"hdr_{place:03d}.exr"))
            matrix = view.camera.camera_to_world.copy()
            matrix[:3, 1:3] *= -1
            frames.append({"file_path": stem, "transform_matrix": matrix.tolist()})
        transforms = {"camera_angle_x": next(iter(angles)), "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(transforms, indent=1))
        (folder / f"exposure_{split}.json").write_text(json.dumps(times, indent=1))
    if points is not None:
        (folder / "sparse" / "0").mkdir(parents=True, exist_ok=True)
        lines = ["# id x y z red green blue error track\n"]
        for i, (place, color) in enumerate(zip(*points, strict=True), start=1):
            code = np.clip(np.asarray(color) * 255 + 0.5, 0, 255).astype(int)
            lines.append(f"{i} {place[0]:.6g} {place[1]:.6g} {place[2]:.6g} {code[0]} {code[1]} {code[2]} 0\n")
        (folder / "sparse" / "0" / "points3D.txt").write_text("".join(lines))


def _view_angle(camera: Camera) -> float:
    centred = np.allclose([camera.cx, camera.cy], [camera.width / 2, camera.height / 2], atol=1e-6)
    if not centred or not np.isclose(camera.fx, camera.fy, rtol=1e-9):
        raise ValueError("HDR-NeRF sets have square pixels and a centred principal point")
    return 2 * math.atan(0.5 * camera.width / camera.fx)
