"""A whole HDR-NeRF synthetic set of a scene with truth: photos at several exposures through any response."""

from collections.abc import Sequence
from pathlib import Path

from ..errors import InputError
from ..files import atomic_folder
from ..scene import Scene
from ..scene.hdr_nerf_layout import RadianceView, write_hdr_nerf_scene
from .expose import Curve, SensorNoise, expose


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
