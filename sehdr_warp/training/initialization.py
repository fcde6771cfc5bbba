"""The field that a training starts from: response, points of the scene and points matched between photos."""

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch

from ..errors import InputError, SehdrError, require_loaded, require_whole_number
from ..model.baking import field_of, gaussians_of, to_normalized
from ..model.color_models import make_color_model
from ..model.gaussians import Gaussians
from ..model.radiance_field import RadianceField
from ..response import Response, ToneMapper, response_by_name
from ..runs.config import Config
from ..runs.device import pick_device
from ..runs.field import assemble_field
from ..scene import Camera, Scene, View
from ..scene.normalization import Normalization, normalization_of
from ..scene.response_choice import select_for_views
from ..scene.wide_camera import perspective_cameras, perspective_views
from ..splats import read_gaussians
from ..subsets import counted, every_nth
from .matching import Matcher, at_matching_size
from .strategies import mcmc_cap
from .strategies.mcmc import MAX_DISTANCE

_log = logging.getLogger(__name__)

MOST_DEPTHS = 100_000  # Largest number of points that the range of depths is estimated from
FEWEST_POINTS = 20  # With fewer points, random ones are added, and depths follow the cameras' focus
FEWEST_RANDOM = 5000  # Smallest number of random points
_NO_AGREEMENT = (
    "photos agree on almost no point, as if cameras were wrong or belonged to other photos: compare the order of "
    "photos and poses, or train on the folder of photos alone, whose cameras are then found"
)
DEPTH_RANGE = (0.5, 3.0)
"""Depths of random points in units of the cameras' focus. Nearer ones remain as floaters before the cameras: on the
embedded room, 0.15 in place of 0.5 costs 14 dB."""
LEAST_DISTANCE = 1e-6  # From a camera that a size is derived from, normalized units: a point may lie in a camera
MAX_START_ANGLE = 0.2
"""Largest standard deviation of a Gaussian at the start, as a multiple of its distance from the nearest camera. Points
that are far from all others, such as those of a background, would else start as veils before cameras of new views."""


def base_time_of(scene: Scene) -> float:
    """Return dt_1, the median exposure time of the training photos, seconds; of two in the middle the shorter.

    So it is the exposure of a photo, whose white and middle grey pictures at 0 EV have.
    """
    return float(np.quantile([view.exposure_time for view in scene.train_views], 0.5, method="lower"))


def response_for_training(scene: Scene, config: Config) -> Response:
    """Return the response that the config names.

    "learned" is a new ToneMapper. "auto" is the response that load_scene() chose, if it chose as the config asks; only
    a scene that was loaded otherwise is judged here.
    """
    options = config.response
    if scene.light_known and scene.response is not None:
        return scene.response
    if options.name == "learned":
        return ToneMapper(seed=config.seed)
    if options.name != "auto":
        return response_by_name(options.name)
    if scene.response is not None and scene.chosen_by == (options.method, options.candidates):
        return scene.response
    selection = select_for_views(scene.train_views, options.method, options.candidates)
    if selection.note:
        _log.info("%s", selection.note)
    return selection.response


def make_field(
    scene: Scene,
    config: Config,
    response: Response,
    device: torch.device | str,
    get_matcher: Callable[[], Matcher] | None = None,
    base_time: float | None = None,
) -> RadianceField:
    """Return the field at iteration 0: the Gaussians of model.init_file, or one at each of start_points().

    The scene is in its own coordinates, field and matcher in normalized ones. `base_time` is dt_1, the exposure
    time that colors refer to, seconds, by default base_time_of(). Raises InputError for a scene that cannot be trained.
    """
    check_views(scene)
    base_time = base_time or base_time_of(scene)
    normalization = normalization_of(scene)
    normalized = normalization.scene(scene)
    normalized = replace(normalized, views=perspective_views(normalized.train_views))
    rng = np.random.default_rng(config.seed)
    if config.model.init_file:
        gaussians = start_gaussians(normalized, config, response, rng, normalization, base_time)
        return assemble_field(gaussians, config, response, base_time, normalization).to(device)
    get_matcher = get_matcher or partial(make_matcher, normalized, response, device)
    points, colors = start_points(normalized, config, get_matcher, rng)
    most = config.densification.cap_max
    if len(points) > most:
        subset = np.sort(rng.choice(len(points), most, replace=False))
        points, colors = points[subset], colors[subset]
    dc = make_color_model(config.model.radiance).start(colors, response)
    points, dc = (torch.tensor(values, dtype=torch.float32) for values in (points, dc))
    gaussians = Gaussians.from_points(points, dc, config.model.sh_degree)
    if config.densification.strategy == "mcmc":  # Others start as 3DGS does.
        _limit_sizes(gaussians, normalized.views)
    return assemble_field(gaussians, config, response, base_time, normalization).to(device)


@torch.no_grad()
def _limit_sizes(gaussians: Gaussians, views: Sequence[View]) -> None:
    """Shrink Gaussians to MAX_START_ANGLE times their distance from the nearest camera of the views."""
    from scipy.spatial import KDTree

    cameras = KDTree(np.stack([view.camera.position for view in views]))
    distances = torch.from_numpy(cameras.query(gaussians.means.double().numpy())[0])
    largest = (MAX_START_ANGLE * distances.clamp_min(LEAST_DISTANCE)).log().float()
    gaussians.log_scales.clamp_(max=largest[:, None])


def start_gaussians(
    scene: Scene,
    config: Config,
    response: Response,
    rng: np.random.Generator,
    normalization: Normalization,
    base_time: float,
) -> Gaussians:
    """Return the Gaussians of the file that model.init_file names, in the config's color model and degree.

    Display colors count as codes of the scene's own photos; radiance is in the scene's units. The file is in the
    scene's own coordinates; the scene and the result are in normalized ones.
    """
    read = to_normalized(read_gaussians(config.model.init_file), normalization)
    if read.count > config.densification.cap_max:
        read = read.rows(np.sort(rng.choice(read.count, config.densification.cap_max, replace=False)))
    degree = config.model.sh_degree
    read = replace(read.padded(degree), base_time=base_time if read.color_model == "display" else read.base_time)
    read = replace(read, harmonics=read.harmonics[:, : (degree + 1) ** 2])
    field = field_of(read)
    field.response = response
    positions = np.stack([view.camera.position for view in scene.train_views])
    gaussians = gaussians_of(field, config.model.radiance, positions, base_time)
    _log.info("starting from the %d Gaussians of %s", read.count, config.model.init_file)
    return field_of(replace(gaussians, base_time=base_time)).gaussians.requires_grad_()


def start_points(
    scene: Scene, config: Config, get_matcher: Callable[[], Matcher], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return points to start from.

    They are the scene's points and, up to model.initial_density, points matched between its photos; if they are too
    few, also random points that several cameras see.

    Returns:
        [N, 3] points and their encoded colors [N, 3].
    """
    points, colors = scene.points, scene.point_colors
    number = start_count(config, sum(view.camera.pixel_count for view in scene.train_views))
    if number > len(points):
        matches = _match_points(get_matcher(), number - len(points), config.seed)
        points, colors = (np.concatenate(both) for both in zip((points, colors), matches, strict=True))
        _log.info("%s matched between the photos", counted(len(matches[0]), "point", "points"))
    # Points beyond MAX_DISTANCE move to it: from cameras within the unit ball the direction changes by under a degree.
    distances = np.linalg.norm(points, axis=1, keepdims=True)
    points = points * np.minimum(1.0, MAX_DISTANCE / np.maximum(distances, 1e-12))
    if len(points) < FEWEST_POINTS:
        if number:
            _log.warning("%s", _NO_AGREEMENT)
        random = random_points(scene, max(number, FEWEST_RANDOM), rng)
        points, colors = (np.concatenate(both) for both in zip((points, colors), random, strict=True))
    return points, colors


def match_points(
    scene: Scene, count: int, *, response: Response | None = None, device: torch.device | str = "cpu", seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Find points of the surfaces that the training photos show.

    A plane sweep (Collins 1996) for pixels all over the photos finds the depth of those on which photos agree.

    Args:
        scene: A scene from load_scene().
        count: Approximate number of pixels to match; N of them succeed.
        response: Response by which photos of different exposure are compared; None for that of the scene.
        device: "cpu", "cuda:0", ...
        seed: Seed of the choice of pixels.

    Returns:
        [N, 3] points, and their encoded colors [N, 3] in [0, 1].

    Raises:
        TypeError: For an argument of another type.
        SehdrError: For a count below 1, fewer than two training views, or a device that torch cannot use.
    """
    require_loaded("load_scene", scene)
    require_whole_number(count, "count", 1)
    require_whole_number(seed, "seed", 0)
    if not isinstance(response, Response | None):
        raise TypeError(f"response is {response!r:.60}, expected a curve, as response_by_name() returns it")
    check_views(scene)
    normalization = normalization_of(scene)
    response = response or scene.response or response_by_name("srgb")
    points, colors = _match_points(make_matcher(normalization.scene(scene), response, pick_device(device)), count, seed)
    return normalization.scene_points(points), colors


def _match_points(matcher: Matcher, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Match about `count` pixels; return points [N, 3] and colors [N, 3]."""
    matches = matcher.match(matcher.pixels(count, np.random.default_rng(seed)))
    return matches.points.double().cpu().numpy(), matches.colors.cpu().numpy()


def start_count(config: Config, pixels: int) -> int:
    """Return the number of points to start from, for photos with `pixels` pixels in total, if the scene has no more."""
    options = config.densification
    most = mcmc_cap(config, pixels) if options.strategy == "mcmc" else options.cap_max
    return min(most, round(config.model.initial_density * math.sqrt(pixels)))


def make_matcher(scene: Scene, response: Response, device: torch.device | str, depth: float | None = None) -> Matcher:
    """Create a matcher of the training views, with depths around `depth`, by default depth_of_points()."""
    views = at_matching_size(perspective_views(scene.train_views))
    return Matcher(views, response, depth_of_points(scene) if depth is None else depth, device)


def depth_of_points(scene: Scene) -> float:
    """Return the median depth of the points in the training views, or focus_distance() if these are too few."""
    cameras = perspective_cameras(view.camera for view in scene.train_views)
    points = every_nth(scene.points, MOST_DEPTHS)
    homogeneous = np.c_[points, np.ones(len(points))]
    depths = np.concatenate([homogeneous[each.project(points).inside] @ each.world_to_camera[2] for each in cameras])
    return float(np.median(depths)) if len(depths) >= FEWEST_POINTS else focus_distance(cameras)


def check_views(scene: Scene) -> None:
    """Raise InputError for a scene with too few views, or whose photos are all black or white."""
    views = scene.train_views
    if len(views) < 2:
        remedy = "a scene needs at least two photos from different places"
        raise InputError(scene.name, f"{len(views)} training view(s)", remedy)
    if all(view.codes.max() <= view.levels / 255 for view in views):
        raise InputError(scene.name, "every training photo is black", "use a longer exposure")
    if all(view.codes.min() >= view.levels * 254 / 255 for view in views):
        raise InputError(scene.name, "every training photo is white", "use a shorter exposure")


def random_points(scene: Scene, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return up to `count` random points that at least two training cameras see, and their mean encoded colors.

    They are sampled along the cameras' rays, uniform in inverse depth.

    Returns:
        [N, 3] points and colors [N, 3].

    Raises:
        SehdrError: If no two cameras see the same place.
    """
    views = scene.train_views
    cameras = [view.camera for view in views]
    distance, batches, total = focus_distance(cameras), [], 0
    for _ in range(8):
        points = points_on_rays(cameras, count, distance, rng)
        visible, mean = colors_in_views(points, views)
        batches.append((points[visible >= 2], mean[visible >= 2]))
        total += len(batches[-1][0])
        if total >= count:
            break
    if total < 4:
        raise SehdrError(f"{scene.name}: no two training cameras look at the same place; check the poses")
    points, colors = (np.concatenate(parts)[:count] for parts in zip(*batches, strict=True))
    return points, colors


def focus_distance(cameras: Sequence[Camera]) -> float:
    """Return the median distance from the cameras to the point nearest to all their axes, world units, positive.

    If they do not look at a common point, it is twice the spread of the cameras.
    """
    origins = np.stack([camera.position for camera in cameras])
    axes = np.stack([camera.world_to_camera[2, :3] for camera in cameras])
    spread = float(np.linalg.norm(origins - origins.mean(0), axis=1).max())
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    focus = np.linalg.lstsq(across.sum(0), (across @ origins[:, :, None]).sum(0)[:, 0], rcond=1e-4)[0]
    ahead = ((focus - origins) * axes).sum(1)
    return float(np.median(ahead)) if np.median(ahead) > 0.2 * spread else max(2 * spread, 1e-3)


def points_on_rays(cameras: Sequence[Camera], count: int, distance: float, rng: np.random.Generator) -> np.ndarray:
    """Return [N, 3] points in front of cameras, uniform over these, pixels and inverse depth within DEPTH_RANGE."""
    near, far = (factor * distance for factor in DEPTH_RANGE)
    camera_indices = rng.integers(len(cameras), size=count)
    across, depth = rng.random((count, 2)), 1 / rng.uniform(1 / far, 1 / near, count)
    points = np.empty((count, 3))
    for index, camera in enumerate(cameras):
        mine = camera_indices == index
        x, y = across[mine, 0] * camera.width, across[mine, 1] * camera.height
        points[mine] = camera.unproject(x, y, depth[mine])
    return points


def colors_in_views(points: np.ndarray, views: tuple[View, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return how many photos contain each point [N], and the mean of their encoded values there [N, 3]."""
    visible, total = np.zeros(len(points)), np.zeros((len(points), 3))
    for view in views:
        row, column, _, inside = view.camera.project(points)
        visible[inside] += 1
        total[inside] += view.image[row[inside].astype(int), column[inside].astype(int)]
    return visible, total / np.maximum(visible, 1)[:, None]
