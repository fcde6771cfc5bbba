"""Small real scenes for tests, written with the formats' own libraries."""

import json
import struct
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from sehdr_warp.scene import Camera, Scene, load_scene, look_at
from sehdr_warp.scene.dataparser import reinhard_gamma
from sehdr_warp.scene.images.downsampling import area_average
from sehdr_warp.scene.images.hdr_files import read_hdr
from sehdr_warp.synth.expose import RadianceView, write_hdr_nerf_scene


def load(path, response="srgb", **options) -> Scene:
    """load_scene by a response that need not be chosen, which takes seconds."""
    return load_scene(path, response=response, **options)


@contextmanager
def edited_json(path: Path) -> Iterator[Any]:
    """The values of a JSON file, which are written back as they are at the end of the block."""
    values = json.loads(path.read_text())
    yield values
    path.write_text(json.dumps(values))


def arc_poses(count: int) -> list[np.ndarray]:
    """Cameras on an arc around the origin, 4 units away."""
    angles = np.linspace(-0.6, 0.6, count)
    return [look_at((4 * np.sin(a), -4 * np.cos(a), 0.5)) for a in angles]


def write_frames(folder: Path, names: list[str], size: tuple[int, int]) -> None:
    """A transforms.json of photos of one size [W, H] that all were taken at one place."""
    frames = [{"file_path": name, "transform_matrix": np.eye(4).tolist()} for name in names]
    values = {"w": size[0], "h": size[1], "fl_x": 100, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(values))


def pattern(width: int, height: int, seed: int = 0) -> np.ndarray:
    """[H, W, 3] uint8: smooth noise that uses the full range."""
    noise = np.random.default_rng(seed).random((height // 4 + 2, width // 4 + 2, 3))
    picture = Image.fromarray((noise * 255).astype(np.uint8)).resize((width, height), Image.Resampling.BICUBIC)
    return np.asarray(picture)


def write_photos(folder: Path, names: Iterable[str], size=(16, 12), seed: int = 0) -> None:
    """Photos of one size that all show something else, in a folder that is made if it is missing."""
    folder.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        Image.fromarray(pattern(*size, seed + i)).save(folder / name)


def png_of(*chunks: tuple[bytes, bytes], head: bytes = b"\x89PNG\r\n\x1a\n") -> bytes:
    """A PNG file of (kind, data) of its chunks; `head` is empty for chunks alone."""
    parts = (
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )
    return head + b"".join(parts)


def write_colmap(
    folder: Path,
    count: int = 6,
    *,
    binary: bool = False,
    model: str = "PINHOLE",
    params=(50.0, 52.0, 30.0, 25.0),
    size=(64, 48),
    name="{:03d}.png",
    exif: dict[int, dict] | None = None,
) -> None:
    """images/ and sparse/0 written by pycolmap: `count` views, 5 points, observations in every image."""
    import pycolmap

    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model=model, width=size[0], height=size[1], params=list(params), camera_id=1)
    reconstruction.add_camera_with_trivial_rig(camera)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for i, pose in enumerate(arc_poses(count)):
        keypoints = [pycolmap.Point2D(np.array([x, 5.0])) for x in (3.0, 9.0)]
        image = pycolmap.Image(name.format(i), pycolmap.Point2DList(keypoints), camera_id=1, image_id=i + 1)
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
        photo = Image.fromarray(pattern(*size, seed=i))
        tags = Image.Exif()
        for tag, value in (exif or {}).get(i, {}).items():
            tags.get_ifd(0x8769)[tag] = value
        path = folder / "images" / name.format(i)
        path.parent.mkdir(parents=True, exist_ok=True)
        photo.save(path, exif=tags)
    for i in range(5):
        track = pycolmap.Track([pycolmap.TrackElement(1, i % 2)]) if i < 2 else pycolmap.Track()
        reconstruction.add_point3D(np.array([i, -i / 3, 0.25]), track, np.array([10 * i, 255, 0], np.uint8))
    (folder / "sparse" / "0").mkdir(parents=True, exist_ok=True)
    (reconstruction.write_binary if binary else reconstruction.write_text)(folder / "sparse" / "0")


def write_blender(folder: Path, count: int = 6, *, rgba: bool = False, size=(40, 30), **fields) -> None:
    """transforms.json with OpenGL poses and file names without ending, and its PNG files; more fields as given."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    frames = []
    for i, pose in enumerate(arc_poses(count)):
        photo = pattern(*size, seed=i)
        if rgba:
            alpha = np.full((*photo.shape[:2], 1), 255, np.uint8)
            alpha[:, : size[0] // 2] = 0
            photo = np.concatenate([photo, alpha], axis=2)
        Image.fromarray(photo).save(folder / "images" / f"r_{i}.png")
        matrix = np.linalg.inv(pose)
        matrix[:3, 1:3] *= -1
        frames.append({"file_path": f"./images/r_{i}", "transform_matrix": matrix.tolist()})
    values = {"camera_angle_x": 0.8, "frames": frames, **fields}
    (folder / "transforms.json").write_text(json.dumps(values))


def write_llff(folder: Path, count: int = 6, size=(64, 48), focal: float = 50.0) -> list[np.ndarray]:
    """images/ and poses_bounds.npy as LLFF's imgs2poses writes them; returns the world_to_camera matrices."""
    (folder / "images").mkdir()
    poses, rows = arc_poses(count), []
    for i, pose in enumerate(poses):
        Image.fromarray(pattern(*size, seed=i)).save(folder / "images" / f"{i:03d}.png")
        right, down, forward, position = np.linalg.inv(pose)[:3].T
        matrix = np.stack([down, right, -forward, position, [size[1], size[0], focal]], axis=1)
        rows.append([*matrix.ravel(), 1.0, 10.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return poses


def write_ply(path: Path, points, colors=None) -> None:
    """Points and, where given, their 8-bit colors as text."""
    rows = [[*point, *color] for point, color in zip(points, colors or [()] * len(points))]
    names = [f"float {axis}" for axis in "xyz"] + [f"uchar {name}" for name in ("red", "green", "blue")]
    lines = [
        "ply",
        "format ascii 1.0",
        f"element vertex {len(rows)}",
        *(f"property {n}" for n in names[: len(rows[0])]),
    ]
    path.write_text("\n".join([*lines, "end_header", *(" ".join(map(str, row)) for row in rows), ""]))


def room_views(
    shared: Path, *, room: str = "room", weights=(1.0, 1.0, 1.0), size: int = 200, count: int | None = None
) -> list[RadianceView]:
    """The rendered room's views as radiance: weighted sums of its light groups (window, spot, lamps)."""
    folder = shared / "data" / room
    values = json.loads((folder / "transforms.json").read_text())
    views = []
    for i, frame in enumerate(values["frames"][:count]):
        stem = Path(frame["file_path"]).stem
        groups = [read_hdr(folder / "groups" / f"{stem}_{group}.exr") for group in ("window", "spot", "lamps")]
        radiance = sum(weight * group for weight, group in zip(weights, groups, strict=True))
        camera = Camera(
            values["w"], values["h"], values["fl_x"], values["fl_y"], values["cx"], values["cy"], frame["w2c_opencv"]
        ).resized(size, size)
        views.append(RadianceView(f"r_{i}", camera, area_average(radiance, size, size), frame["split"]))
    return views


def reinhard_gamma_inverse(value):
    """The exposure x >= 0 of an encoded value in [0, 1); see reinhard_gamma."""
    linear = np.asarray(value, dtype=np.float64) ** 2.2
    return linear / (1.0 - linear)


def write_reinhard(folder: Path, views: list[RadianceView], times, **options) -> None:
    """An HDR-NeRF synthetic set of views in `folder`, its photos at `times` seconds by HDR-NeRF's response."""
    photos = [[reinhard_gamma(view.radiance * time) for view in views] for time in times]
    write_hdr_nerf_scene(folder, views, times, photos, **options)


def write_room(folder: Path, shared: Path, *, points: bool = True, **options) -> list[float]:
    """An HDR-NeRF synthetic set of the rendered room in `folder`; returns its five exposure times, each four times the
    last, whose middle encodes the median luminance as 0.5.

    options: as room_views takes them. points: with the room's own sparse points.
    """
    views = room_views(shared, **options)
    median = np.median(np.concatenate([(view.radiance @ [0.2126, 0.7152, 0.0722]).ravel() for view in views]))
    times = [float(reinhard_gamma_inverse(0.5) / median * 4.0**k) for k in range(-2, 3)]
    cloud = None
    if points:
        with np.load(shared / "data" / options.get("room", "room") / "points_hdr.npz") as stored:
            cloud = stored["xyz"], reinhard_gamma(stored["radiance"] * times[2])
    write_reinhard(folder, views, times, points=cloud)
    return times


def said(scene, word):
    return [note for note in scene.notes if word in note]


def edit_transforms(folder, **fields):
    path = folder / "transforms.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))
