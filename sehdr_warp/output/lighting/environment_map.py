"""Environment maps of a trained scene: scene-linear light from all directions, in OpenEXR's conventions."""

import json
import logging
from dataclasses import dataclass, fields, replace
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...errors import SehdrError, path_of, require_loaded
from ...files import check_absent
from ...scene.camera_focus import camera_positions
from ...scene.wide_camera import typical_focal_length
from ..cameras.scene_cameras import training_cameras
from ..images.colorspace import color_space, from_rec709
from ..images.display import exposure_for_white
from ..images.exr import Part, as_data, write_multipart_exr, write_radiance
from ..picture_header import PictureHeader
from ..world_transform import AXES, WorldTransform, world_transform
from .map_center import MapCenter, check_beyond, find_center
from .shares import light_shares
from .unit import EFFICACY, luminance_of_one

if TYPE_CHECKING:
    from ...runs.run import RenderableScene

log = logging.getLogger(__name__)
LAYOUTS = {"latlong": 2048, "cube": 512}  # Pixels across by default, equally fine
SUFFIXES = (".exr", ".hdr")
LEAST_VISIBLE = 1e-3  # Share of all directions below which nothing counts as visible from a point
COVERED = 0.5  # Alpha above which a direction counts as covered
_LEAST_COVERED = 0.1  # Covered share of all directions below which a warning names the point
_NEAR = 0.02  # Spread of the cameras: surfaces that near in most directions mean that the point is inside something
_LARGEST = 1 << 15  # Pixels across
_WHOLE = 99.5  # Covered per cent from which nothing is said of the rest
_FINEST = {"latlong": 4096, "cube": 1024}  # Smaller maps are averaged from renders of at most so many pixels across
BAND_PIXELS = 1 << 21  # Pixels that are rendered at once
_COARSE, _DARKEST = 128, 1e-9  # Inpainting: columns of the coarse map, and the least light
_SURROUNDINGS, _MOST_OVER = 0.1, 32.0  # Inpainting: radians, and the most times the mean around that counts
# The nearest axes of a cube's faces in OpenEXR's order (+X -X +Y -Y +Z -Z): to the right, down, and out.
_FACES = np.array(
    [
        [(0, 0, 1), (0, -1, 0), (1, 0, 0)],
        [(0, 0, -1), (0, -1, 0), (-1, 0, 0)],
        [(1, 0, 0), (0, 0, -1), (0, 1, 0)],
        [(1, 0, 0), (0, 0, 1), (0, -1, 0)],
        [(-1, 0, 0), (0, -1, 0), (0, 0, 1)],
        [(1, 0, 0), (0, -1, 0), (0, 0, -1)],
    ],
    dtype=float,
)


def write_environment_map(
    run: "RenderableScene",
    path: Path | str,
    *,
    at: str | tuple[float, float, float] = "center",
    size: int | None = None,
    layout: str = "latlong",
    axes: str = "upright",
    up: str | tuple[float, float, float] | None = None,
    scale: float | None = None,
    beyond: float | None = None,
    inpaint: bool = False,
    colorspace: str = "rec709",
    reference_white: float | None = None,
    pixel: str = "half",
    overwrite: bool = False,
) -> Path:
    """Write the light that reaches a point of a trained scene from all directions; return the path.

    Args:
        run: From load_run, train or load_splats.
        path: .exr (R, G, B radiance; A coverage; in a second part, `data`, distance.Z and, if the run has it,
            confidence and clipped; attribute `envmap`) or .hdr (Radiance: R, G, B only).
        at: A point in the coordinates that `axes` names, "camera:NAME", or "center": the mean of the training
            cameras, or, if they walk around something, the point that they look at.
        size: Pixels across, 2048 by default; for a cube those of one face, 512.
        layout: "latlong": size x size / 2, the left edge at longitude pi, +Z in the middle, +X at a quarter, +Y up.
            "cube": OpenEXR's six faces, one above the other.
        axes: "upright": turned as render and export turn the scene (see world_transform), so that the map lights its
            Gaussians as they stand: +Y is up, +Z is ahead of the middle camera, and 0, 0, 0 is the point that most
            photos look at, or else the mean place of the cameras. "scene": the photos' coordinates.
        up: As in world_transform.
        scale: As in world_transform.
        beyond: Leave out what is nearer than this distance, in the units of `at`, so that a CG object can stand in the
            place of a photographed one. None: 0, or for the center of a walk around something half the distance of the
            nearest camera.
        inpaint: Fill directions that no photo covers with the light around them, as far as A is below 1; A still marks
            them.
        colorspace: Primaries of the file.
        reference_white: Value of the photos' white in the file; `expTime` (.hdr: EXPOSURE) states the exposure. None
            leaves radiance.
        pixel: "half" (float if half would overflow) or "float".
        overwrite: Replace a file that exists.

    Raises:
        SehdrError: For options that do not fit, or a point from which next to nothing is visible.
        InputError: If the file exists or a pixel is not finite.
    """
    require_loaded("load_run", run)
    path = path_of(path, "path")
    check_map(path, size, layout, axes, beyond, pixel)
    size = size or LAYOUTS[layout]
    color_space(colorspace)
    transform = world_transform(run, axes, up=up, scale=scale)
    exposure = exposure_for_white(run, reference_white)
    check_absent(path, overwrite)
    photos = training_cameras(run)
    center = find_center(run, at, beyond, transform)
    focal = typical_focal_length(photos) if photos else 0.0
    what = {"beyond": center.beyond, "shares": run.clipped_share()}
    rendered = render_map(run, center.position, size, layout, transform.rotation, focal, **what)
    weight = solid_angles(size, layout)
    _judge(run, center, transform.points(center.position), rendered, weight)
    added = np.zeros_like(rendered.hdr)
    if inpaint:
        directions = map_directions(size, layout) @ transform.rotation
        added = (1 - rendered.alpha[..., None]) * inpainted_light(rendered.hdr, rendered.alpha, directions, weight)
    shares = light_shares(rendered.hdr, added, rendered.clipped, rendered.certain, weight)
    coverage = covered_percent(rendered.alpha, weight)
    rest = "" if inpaint or coverage > _WHOLE else "; the rest is black, --inpaint fills it with the light around it"
    log.info("%s: photos cover %.0f %% of all directions%s", path.name, coverage, rest)
    log.info("its light is\n%s", shares.table())
    light = rendered.hdr + added
    if path.suffix.lower() == ".hdr":
        luminance, hdr = luminance_of_one(run), exposure * from_rec709(light, colorspace)
        absolute = 1.0 if luminance is None else EFFICACY / luminance
        write_radiance(path, hdr, exposure=exposure * absolute, colorspace=colorspace, overwrite=overwrite)
        return path
    of_file = {"colorspace": colorspace, "exposure": exposure, "lightShares": json.dumps(shares.to_dict())}
    picture = map_part(run, light, rendered.alpha, center, transform, axes, layout, name="rgba", **of_file)
    # In a part of their own: Mitsuba takes a map with a fifth channel for no map at all.
    data = {"distance.Z": rendered.distance * transform.scale}
    data |= {"confidence": rendered.confidence, "clipped": rendered.clipped}
    data = {name: values for name, values in data.items() if values is not None}
    parts = [picture, Part(data, as_data(picture.header), "data")]
    pixel_type = write_multipart_exr(path, parts, pixel=pixel, overwrite=overwrite)
    if pixel_type != pixel:
        log.info("%s: holds values above 65504, which half cannot; written as float", path.name)
    return path


def map_part(
    run: "RenderableScene",
    light: np.ndarray,
    alpha: np.ndarray,
    center: MapCenter,
    transform: WorldTransform,
    axes: str,
    layout: str = "latlong",
    *,
    name: str = "",
    colorspace: str = "rec709",
    exposure: float = 1.0,
    **facts: str,
) -> Part:
    """Return the part of a file that shows a map, whose attributes say where it was taken, and its axes and units.

    `light` is its radiance [H, W, 3] and `alpha` the coverage [H, W]. `transform` leads from the scene's coordinates to
    those of the file, which `axes` names. `facts` are further text by key; all others are as of PictureHeader.part().
    """
    facts |= {
        "position": json.dumps(transform.points(center.position).tolist()),
        "axes": axes,
        "beyond": repr(float(f"{center.beyond * transform.scale:.15g}")),  # As stated, but for rounding
        "mapToWorld": json.dumps(transform.rotation.T.tolist()),
    }
    part = PictureHeader.of(run, transform, colorspace).part(light, exposure, None, {"A": alpha}, name, **facts)
    return replace(part, header={**part.header, "envmap": envmap(layout)})


def check_map(path: Path, size: int | None, layout: str, axes: str, beyond: float | None, pixel: str) -> None:
    """Raise the errors of write_environment_map() about options that need no scene."""
    if path.suffix.lower() not in SUFFIXES:
        raise SehdrError(f"{path}: an environment map is one of {', '.join(SUFFIXES)}; choose a suffix")
    if path.suffix.lower() == ".hdr" and pixel != "half":
        raise SehdrError(f"{path}: pixel {pixel} is a type of .exr; leave it out, or write .exr")
    for name, value, allowed in (("layout", layout, LAYOUTS), ("axes", axes, AXES)):
        if value not in allowed:
            raise SehdrError(f"{name} {value!r} is not one of {', '.join(allowed)}")
    if size is not None and not (isinstance(size, Integral) and 16 <= size <= _LARGEST and size % 2 == 0):
        raise SehdrError(f"size {size!r:.60} is not usable; give an even number of pixels from 16 to {_LARGEST}")
    check_beyond(beyond)


@dataclass(frozen=True, eq=False)
class RenderedMap:
    """The pixels of an environment map."""

    hdr: np.ndarray  # [H, W, 3] radiance
    alpha: np.ndarray  # [H, W] coverage
    distance: np.ndarray  # [H, W] mean distance of what is seen, 0 where nothing is
    confidence: np.ndarray | None  # [H, W] mean of what is seen; None if it was not measured
    clipped: np.ndarray | None  # [H, W] share of clipped light; None without shares
    certain: np.ndarray | None  # [H, W] clipped light up to the photos' white, mean of channels; None without shares


def render_map(
    run: "RenderableScene",
    position: np.ndarray,
    size: int,
    layout: str,
    to_scene: np.ndarray,
    focal: float,
    **options: Any,
) -> RenderedMap:
    """Render an environment map in pixels as fine as the photos' and average them to the map's.

    Gaussians that are smoothed to coarse pixels no longer hide each other, so that a small lamp of several would come
    out up to twice as bright.

    Args:
        run: From load_run, train or load_splats.
        position: [3] in the scene's coordinates.
        size: Pixels across; for a cube those of one face.
        layout: "latlong" or "cube".
        to_scene: [3, 3] that turns the map's directions, as rows, to the scene's.
        focal: Focal length of the photos, pixels; 0 if it is not known.
        options: Of render_directions().
    """
    angle = 2 * np.pi / size if layout == "latlong" else 2 / size
    finer = int(np.clip(np.ceil(angle * focal), 1, max(1, _FINEST[layout] // size)))
    rows = size // 2 if layout == "latlong" else 6 * size
    # In bands, because the fine pixels of a whole map would take a gigabyte.
    step = max(1, BAND_PIXELS // (size * finer * finer))
    options |= {"focal_length": focal or 1 / angle, "pixel_angle": angle / finer}
    bands = []
    for start in range(0, rows, step):
        band = slice(start * finer, min(rows, start + step) * finer)
        rays = map_directions(size * finer, layout, band) @ to_scene
        white = run.response.white / run.base_time
        bands.append(_averaged_map(run.render_directions(position, rays, **options), finer, white))

    def join_parts(name: str) -> Any:
        parts = [getattr(band, name) for band in bands]
        return None if parts[0] is None else np.concatenate(parts)

    return RenderedMap(*(join_parts(field.name) for field in fields(RenderedMap)))


def _averaged_map(rendered: Any, finer: int, white: float) -> RenderedMap:
    """Return a render along directions as pixels of `finer` x `finer` of its own; `white`: radiance of white."""

    def average(values: np.ndarray) -> np.ndarray:
        height, width, *channels = values.shape
        return values.reshape(height // finer, finer, width // finer, finer, *channels).mean(axis=(1, 3))

    def weighted_mean(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Return the mean of values with weights; the mean without where all are 0."""
        total = average(weight)
        mean = average(values * weight) / np.where(total > 0, total, 1)
        return np.where(total > 0, mean, average(values)).astype(np.float32)

    hdr, alpha, distance = (values.cpu().numpy() for values in (rendered.hdr, rendered.alpha, rendered.distance))
    coverage, light = alpha * (distance > 0), np.maximum(hdr.mean(2), 0)
    confidence = None if rendered.confidence is None else rendered.confidence.cpu().numpy()
    clipped = None if rendered.clipped is None else rendered.clipped.cpu().numpy()
    return RenderedMap(
        average(hdr),
        average(alpha),
        weighted_mean(distance, coverage),
        None if confidence is None else weighted_mean(confidence, coverage),
        None if clipped is None else weighted_mean(clipped, light),
        None if clipped is None else average(clipped * np.minimum(light, white)),
    )


def envmap(layout: str) -> Any:
    """Return the value of OpenEXR's attribute `envmap`."""
    import OpenEXR

    return OpenEXR.Envmap.ENVMAP_LATLONG if layout == "latlong" else OpenEXR.Envmap.ENVMAP_CUBE


def map_directions(size: int, layout: str, rows: slice = slice(None)) -> np.ndarray:
    """Return [H, size, 3] unit directions of the pixel centers of a map, or of some of its rows."""
    return (latlong if layout == "latlong" else cube)(size, rows)


def latlong(size: int, rows: slice = slice(None)) -> np.ndarray:
    """Return [size / 2, size, 3] unit directions of the pixel centers of a latitude-longitude map, or some rows."""
    longitude = np.pi - 2 * np.pi * (np.arange(size) + 0.5) / size
    latitude = (np.pi / 2 - np.pi * (np.arange(size // 2)[rows] + 0.5) / (size // 2))[:, None]
    across = np.cos(latitude)
    up = np.broadcast_to(np.sin(latitude), (len(latitude), size))
    return np.stack([across * np.sin(longitude), up, across * np.cos(longitude)], axis=2)


def cube(size: int, rows: slice = slice(None)) -> np.ndarray:
    """Return [6 size, size, 3] unit directions of OpenEXR's cube map, or some rows."""
    place, row = 2 * (np.arange(size) + 0.5) / size - 1, np.arange(6 * size)[rows]
    across, down = np.meshgrid(place, place[row % size])
    local = np.stack([across, down, np.ones(across.shape)], axis=2)
    faces = np.einsum("hwk,hkj->hwj", local, _FACES[row // size])
    return faces / np.linalg.norm(faces, axis=2, keepdims=True)


def solid_angles(size: int, layout: str) -> np.ndarray:
    """Return [H, W], the solid angle of each pixel up to scale."""
    if layout == "latlong":
        latitude = np.pi / 2 - np.pi * (np.arange(size // 2) + 0.5) / (size // 2)
        return np.repeat(np.cos(latitude)[:, None], size, axis=1)
    place = 2 * (np.arange(size) + 0.5) / size - 1
    face = (1 + place[:, None] ** 2 + place**2) ** -1.5
    return np.tile(face, (6, 1))


def covered_percent(alpha: np.ndarray, weight: np.ndarray) -> float:
    """Return how much of all directions photos cover, each as far as its alpha [H, W], in per cent."""
    return 100 * float((alpha * weight).sum() / weight.sum())


def inpainted_light(hdr: np.ndarray, alpha: np.ndarray, directions: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return [H, W, 3] of light for each direction, interpolated from the directions that photos cover.

    It is the geometric mean of their light weighted by the inverse fourth power of the distance on the sphere. What is
    brighter than its surroundings, such as a lamp, counts as at most _MOST_OVER times these, so that it floods nothing.
    """
    from scipy.ndimage import map_coordinates

    x, y, z = np.moveaxis(directions, 2, 0)
    columns, rows = _COARSE, _COARSE // 2
    across, down = (np.pi - np.arctan2(x, z)) / (2 * np.pi) * columns, np.arccos(np.clip(y, -1, 1)) / np.pi * rows
    cells = np.minimum(down.astype(int), rows - 1) * columns + across.astype(int) % columns
    covered = alpha > COVERED
    logs = np.log(np.maximum(hdr[covered] / alpha[covered][:, None], _DARKEST))
    values = np.concatenate([logs, np.ones((len(logs), 1))], axis=1) * weight[covered][:, None]
    sums = np.stack([np.bincount(cells[covered], column, rows * columns) for column in values.T], axis=1)
    has_light, places = sums[:, 3] > 0, latlong(columns).reshape(-1, 3).astype(np.float32)
    angles = sums[has_light, 3].astype(np.float32)

    def mean_around(at: np.ndarray, logs: np.ndarray, width: float, power: int) -> np.ndarray:
        near = angles / (2 - 2 * at @ places[has_light].T + width**2) ** power
        return near @ logs / near.sum(axis=1, keepdims=True)

    logs = sums[has_light, :3] / sums[has_light, 3:]
    most = mean_around(places[has_light], logs, _SURROUNDINGS, 1) + np.log(_MOST_OVER)
    light = np.exp(mean_around(places, np.minimum(logs, most), 2 * np.pi / columns, 2))
    wrapped = np.pad(light.reshape(rows, columns, 3), ((0, 0), (1, 1), (0, 0)), mode="wrap")
    at = np.stack([down - 0.5, across + 0.5])
    return np.stack([map_coordinates(wrapped[..., i], at, order=1, mode="nearest") for i in range(3)], axis=2)


def little_visible(run: "RenderableScene", center: MapCenter, point: np.ndarray, share: float) -> str | None:
    """Return what to say if a small share of all directions is visible from a center; None if it is not small.

    The center is `point` [3] as `--at` takes it.
    """
    if share >= LEAST_VISIBLE:
        text = f"from ({_place(point)}) only {100 * share:.1f} % of all directions are seen: is it within the scene?"
        return text if share < _LEAST_COVERED else None
    remedy = "choose a point among the cameras (center, camera:NAME)" + " or a smaller --beyond" * (center.beyond > 0)
    return f"{run.path}: from ({_place(point)}) nothing of the scene is seen; {remedy}"


def _place(point: np.ndarray) -> str:
    return ", ".join(f"{value:.4g}" for value in np.round(point, 6) + 0.0)


def _judge(
    run: "RenderableScene", center: MapCenter, point: np.ndarray, rendered: RenderedMap, weight: np.ndarray
) -> None:
    """Warn about a point from which little, or only near things, are visible; raise SehdrError if nothing is.

    `point` [3] is the center as `--at` takes it, for messages. `weight` [H, W] is the solid angle of each pixel.
    """
    covered, positions = rendered.alpha > COVERED, camera_positions(training_cameras(run))
    share, place = float(weight[covered].sum() / weight.sum()), _place(point)
    if problem := little_visible(run, center, point, share):
        if share < LEAST_VISIBLE:
            raise SehdrError(problem)
        log.warning("%s", problem)
    spread = np.linalg.norm(np.ptp(positions, axis=0)) if len(positions) > 1 else 0.0
    near = weight[covered & (rendered.distance < _NEAR * spread)].sum() / weight.sum()
    if near > 0.5:
        text = "from (%s) %.0f %% of all directions are blocked at once: is it inside of something?"
        log.warning(text, place, 100 * near)
