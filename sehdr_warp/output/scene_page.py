"""A scene as one HTML file that opens from disk: its Gaussians as linear light, and an engine that blends them so.

The engine is PlayCanvas 2.23.3 (MIT, page/playcanvas.LICENSE), unchanged; scene.js has it draw whole Gaussians, as ours
are. It blends into half floats, which light.js exposes: light above white stays.
"""

import base64
import logging
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError, path_of, require_loaded
from ..files import atomic_path, check_absent
from ..kernels.constants import EPS2D, FRUSTUM_MARGIN, NEAR_PLANE
from ..model.baking import field_of, gaussians_of
from ..runs.run import RenderableScene, Splats
from ..scene import Camera
from ..splats.arrays import HARMONIC_0
from .cameras.opening import camera_facts, opening_facts
from .cameras.scene_cameras import split_or_all
from .export.splat_edits import SplatEdits, most_visible, without_strays
from .html import data_block, join, json_block, page_file, page_markup, whole_page
from .images.display import display_gain
from .light_pictures import curve_table
from .world_transform import WorldTransform, world_transform

log = logging.getLogger(__name__)
_HALF = float(np.finfo(np.float16).max)
_ANY_FOCALS = 0.0, 1e9  # Pixels; if those of the photos are not known, every picture is filtered like a photo
_ANY_RAY = 1e9  # Without photos; JSON has no infinity.


def write_scene_page(
    run: RenderableScene, path: Path | str, *, edits: SplatEdits | None = None, overwrite: bool = False
) -> Path:
    """Write a run as one HTML file that any browser with WebGL2 shows; return the path.

    The page has an exposure slider and needs no network. Means are float32, all else half.

    Args:
        run: From load_run, train or load_splats.
        path: The file, of the suffix .html.
        edits: What the page leaves out; by default Gaussians too faint to be drawn.
        overwrite: Replace a file that exists.

    Raises:
        InputError: For another suffix, if the file exists (unless overwrite), or a value is not finite.
    """
    require_loaded("load_run", run)
    path = path_of(path, "path")
    if path.suffix.lower() != ".html":  # By which browsers know a page
        raise InputError(path, f"has {path.suffix or 'no suffix'}, a page has .html", "use .html")
    if not isinstance(edits, SplatEdits | None):
        raise TypeError(f"edits is a {type(edits).__name__}, expected SplatEdits, such as SplatEdits(min_views=2)")
    check_absent(path, overwrite)
    opening = opening_facts(run)
    cameras = split_or_all(run, "train")
    places = [camera.position for camera in cameras or [Camera.from_dict(opening["opening"])]]
    gaussians = gaussians_of(run.field, "linear", np.array(places), color_matrix=run.color_matrix)
    transform = world_transform(run)
    edits = edits or SplatEdits()
    mask = edits.mask(gaussians.opacities, transform.points(gaussians.means), run)
    if edits.max_gaussians is not None:
        mask = most_visible(mask, edits.max_gaussians, run)
    gaussians = without_strays(gaussians.rows(mask), cameras)
    if edits.shows_part and not cameras:  # What is left is looked at from outside.
        opening = opening_facts(Splats(Path(run.path), field_of(gaussians), ()))
    gaussians.require_finite(path)
    entries = run.cameras
    if gaussians.means.dtype == np.float64:  # Map coordinates: a page's float32 would be too coarse.
        from_middle = WorldTransform(np.eye(3), -gaussians.means.mean(0))
        gaussians = replace(gaussians, means=from_middle.points(gaussians.means))
        entries = [replace(entry, camera=from_middle.camera(entry.camera)) for entry in entries]
        opening = _moved(opening, from_middle)
    harmonics = gaussians.harmonics * np.float32(run.base_time)
    too_bright = (np.abs(harmonics) > _HALF).any(axis=(1, 2))
    if too_bright.any():
        text = "%s: its half floats end at %.0f times white; %d Gaussians are brighter, up to %.3g times, "
        text += "and are shown at that; .usdc, or .ply with --kind hdr, keeps their light"
        one = HARMONIC_0 / run.response.white
        log.warning(text, path.name, one * _HALF, too_bright.sum(), one * float(np.abs(harmonics).max()))
        harmonics = np.clip(harmonics, -_HALF, _HALF)
    columns = dict(zip("xyz", gaussians.means.T))
    # As 3DGS has them: a color is 0.5 and the sum.
    columns |= {f"f_dc_{i}": harmonics[:, 0, i] - 0.5 / HARMONIC_0 for i in range(3)}
    higher = harmonics[:, 1:].transpose(2, 1, 0).reshape(-1, gaussians.count)
    columns |= {f"f_rest_{i}": column for i, column in enumerate(higher)}
    columns["opacity"] = gaussians.opacity_logits
    columns |= {f"scale_{i}": column for i, column in enumerate(gaussians.log_scales.T)}
    columns |= {f"rot_{i}": column for i, column in enumerate(gaussians.unit_quaternions.T)}
    values = np.stack(list(columns.values()))
    facts = camera_facts(entries) | {
        **opening,
        "up": transform.rotation[1].tolist(),
        "columns": list(columns),
        "near": NEAR_PLANE * run.field.normalization.unit,
        "margin": FRUSTUM_MARGIN,
        "rays": [min(limit, _ANY_RAY) for limit in run.field.ray_limits],
        "eps2d": EPS2D,
        "photo_eps2d": 0 if run.field.antialiased else EPS2D,
        "focals": run.field.photo_focals or _ANY_FOCALS,
        "base_time": run.base_time,
        "grey": display_gain(run.response),
        "curve": curve_table(run.response),
    }
    blocks = [
        json_block("facts", facts),
        data_block(_pack(values[:3].astype("<f4")), id="means"),
        data_block(_pack(values[3:].astype("<f2")), id="rest"),
    ]
    body = page_markup("scene.html", title=run.scene_name, data=join(blocks, "\n"))
    own = "".join(map(page_file, ("tables.js", "light.js", "camera.js", "scene.js")))
    page = whole_page(run.scene_name, page_file("scene.css"), body, [page_file("playcanvas.min.js"), own], workers=True)
    with atomic_path(path, overwrite) as temporary:
        temporary.write_text(page, encoding="utf-8")
    log.info("%s: %d Gaussians, %.1f MB; light above white stays", path.name, gaussians.count, len(page) / 1e6)
    return path


def _moved(facts: dict[str, Any], transform: WorldTransform) -> dict[str, Any]:
    """Return opening_facts() in other coordinates of the same size."""
    if facts["opening"] is not None:
        camera = transform.camera(Camera.from_dict(facts["opening"]))
        facts = facts | {"opening": camera.to_dict()}
    return facts | {"focus": transform.points(np.array(facts["focus"])).tolist()} if "focus" in facts else facts


def _pack(values: np.ndarray) -> str:
    return base64.b64encode(zlib.compress(np.ascontiguousarray(values).tobytes(), 6)).decode()
