"""Choose the cameras of a render: views of a run, a path through the scene, or those of a file."""

import operator
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ...errors import InputError, SehdrError, did_you_mean, require_loaded
from ...scene import Camera
from ...scene.camera import MAX_SIDE
from ...scene.file_names import safe_names
from ...scene.images.ldr_files import MAX_PIXELS
from ...scene.readers.camera_exchange import EXCHANGE_SUFFIXES
from ...scene.readers.camera_files import read_camera_file
from ...splats import cameras_beside
from ..world_transform import WorldTransform, photos_to_scene, world_transform
from .framing import default_path, widescreen_camera
from .paths import interpolate
from .scene_cameras import find_view, training_cameras

if TYPE_CHECKING:
    from ...runs.run import RenderableScene

SPLITS = ("train", "test", "all")
PATHS = ("orbit", "interpolate")


def select_cameras(
    run: "RenderableScene",
    cameras: str | Path,
    *,
    camera: str | None = None,
    count: int = 60,
    size: str | tuple[int, int] | None = None,
    transform: WorldTransform | None = None,
    up: str | Sequence[float] | None = None,
) -> list[tuple[str, Camera]]:
    """Return named cameras in the scene's coordinates; the names are safe for files and all different.

    Args:
        run: From load_run, train or load_splats.
        cameras: "train", "test", "all", "orbit", "interpolate", or a file (see load_cameras).
        camera: Only this camera of a file, or of the run, whatever its split.
        count: Views of an orbit or interpolation.
        size: Width and height in pixels, or "1920x1080", instead of the cameras' own.
        transform: From the scene's coordinates to those of camera files that other programs write (OpenUSD, .chan); by
            default that to upright coordinates.
        up: As in world_transform, for an orbit.

    Raises:
        SehdrError: If there are none, or `cameras` is neither a known name nor a file.
    """
    require_loaded("load_run", run)
    if not isinstance(transform, WorldTransform | None):
        raise TypeError(f"transform is a {type(transform).__name__}, expected what world_transform() returns")
    check_cameras(cameras)
    text = str(cameras)
    if not run.cameras and camera is None and text in SPLITS + PATHS:
        remedy = "name a file of cameras, or put one beside it, which export writes with --cameras"
        raise InputError(run.path, f"has no cameras of its own, and {text} needs them", remedy)
    if camera is not None and text in PATHS:
        raise SehdrError(f"--camera {camera}: chooses a photo or from a file of cameras, which --cameras {text} is not")
    if text in SPLITS and camera is not None:
        entry = find_view(run, camera)
        views = [(entry.name, entry.camera)]
    elif text in SPLITS:
        views = [(entry.name, entry.camera) for entry in run.cameras if text in (entry.split, "all")]
        if not views:
            others = ", ".join(word for word in SPLITS + PATHS if word != text)
            raise SehdrError(f"{run.path}: has no {text} views; choose other cameras ({others}, a file)")
    elif text in PATHS:
        photos = training_cameras(run)
        path = default_path(run, count, up) if text == "orbit" else interpolate(photos, count)
        if text == "interpolate":
            path = [widescreen_camera(each, photos) for each in path]
        digits = max(3, len(str(count - 1)))
        views = [(f"{text}_{index:0{digits}d}", each) for index, each in enumerate(path)]
    else:
        views = _from_file(run, Path(cameras), camera, transform)
    if size is not None:
        views = [(name, reframe(each, *read_size(size))) for name, each in views]
    return list(zip(safe_names([name for name, _ in views]), [each for _, each in views], strict=True))


def _from_file(
    run: "RenderableScene", path: Path, only: str | None, transform: WorldTransform | None
) -> list[tuple[str, Camera]]:
    """Return the cameras of a file, or `only` the one of this name, in the scene's coordinates."""
    file = read_camera_file(path)
    views, to_scene = file.cameras, [photos_to_scene(run)]  # Most files are in the photos' coordinates.
    if file.world_matrix is not None:
        try:
            to_scene.insert(0, WorldTransform.from_matrix(file.world_matrix).inverse())
        except ValueError as error:
            raise InputError(path, f"its sehdr:worldMatrix {error}", "leave that entry out of the file") from None
    elif path.suffix.lower() in EXCHANGE_SUFFIXES:
        to_scene = [(transform or world_transform(run)).inverse()]
    elif run.world_matrix is not None and (own := cameras_beside(Path(run.path))) is not None and own.samefile(path):
        to_scene = []  # They are in the coordinates of the Gaussians beside.
    for move in to_scene:
        views = [(name, move.camera(each)) for name, each in views]
    if only is None:
        return views
    # Frames of a moving camera are named as by read_exchange_cameras(): numbers of four characters or more.
    frames, names = re.compile(re.escape(only) + r"_[-\d.]{4,}"), [name for name, _ in views]
    same = [(name, each) for name, each in views if name == only]
    matches = same or [(name, each) for name, each in views if frames.fullmatch(name)]
    if not matches:
        raise SehdrError(f"{path}: has no camera {only!r}{did_you_mean(only, names)}")
    return matches


def check_cameras(cameras: str | Path) -> None:
    """Raise SehdrError if a choice of cameras is neither a known word nor a file."""
    words = (*SPLITS, *PATHS)
    if not isinstance(cameras, str | Path):
        remedy = "for a Camera of your own use run.render(camera), write_brackets, write_film, or write a cameras.json"
        raise TypeError(
            f"cameras is a {type(cameras).__name__}, expected one of {', '.join(words)} or a file; {remedy}"
        )
    if str(cameras) not in words and not Path(cameras).exists():
        hint = did_you_mean(str(cameras), words)
        raise SehdrError(f"cameras {str(cameras)!r} are neither a file nor one of {', '.join(words)}{hint}")


def may_move(cameras: str | Path) -> bool:
    """Return whether a choice of cameras may be one that moves; those of the run and of a COLMAP model are photos."""
    return str(cameras) in PATHS or (str(cameras) not in SPLITS and not Path(cameras).is_dir())


def read_size(size: str | tuple[int, int]) -> tuple[int, int]:
    """Return width and height in pixels from "1920x1080" or a pair; raise SehdrError for anything else."""
    try:
        sides = size.lower().split("x") if isinstance(size, str) else size
        width, height = (int(side) if isinstance(side, str) else operator.index(side) for side in sides)
    except (ValueError, TypeError):
        width = height = 0
    if min(width, height) < 1 or max(width, height) > MAX_SIDE or width * height > MAX_PIXELS:
        raise SehdrError(f"size {size!r} is not usable; write width and height in pixels, such as 1920x1080")
    return width, height


def reframe(camera: Camera, width: int, height: int) -> Camera:
    """Return a camera of another size with the same vertical field of view and pixel aspect ratio.

    The picture shows more or less at the sides. Raises SehdrError for a panorama that is not twice as wide as high.
    """
    if camera.projection == "equirectangular" and width != 2 * height:
        raise SehdrError(f"size {width}x{height} would distort a panorama; write one twice as wide as high")
    scale = height / camera.height
    cx = width / 2 + (camera.cx - camera.width / 2) * scale
    intrinsics = {"fx": camera.fx * scale, "fy": camera.fy * scale, "cx": cx, "cy": camera.cy * scale}
    return replace(camera, width=width, height=height, **intrinsics)
