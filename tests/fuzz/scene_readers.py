"""Small scenes, cameras and points to damage, and their readers."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image
from plyfile import PlyData, PlyElement

from sehdr_warp.scene import load_cameras, load_scene
from sehdr_warp.scene.readers.arkit import read_scan
from sehdr_warp.scene.readers.colmap import read_colmap
from sehdr_warp.scene.readers.colmap_model import read_ply_points
from sehdr_warp.scene.readers.hdr_sets import read_hdr_nerf, read_hdr_nerf_real
from sehdr_warp.scene.readers.llff import read_llff
from sehdr_warp.scene.readers.meshroom import read_meshroom
from sehdr_warp.scene.readers.opensfm import read_opensfm
from sehdr_warp.scene.readers.transforms import read_transforms
from sehdr_warp.synth.expose import RadianceView
from tests.make_scenes import pattern, write_blender, write_colmap, write_llff, write_reinhard
from tests.output.helpers import camera
from tests.scene.readers.test_arkit import write as write_scan
from tests.scene.readers.test_meshroom import write as write_meshroom
from tests.training.toy import orbit_camera

from .reader import Reader, each


def make_colmap(binary: bool) -> Callable[[Path], None]:
    return lambda folder: write_colmap(folder, 4, binary=binary, size=(24, 16), params=(20.0, 21.0, 12.0, 8.0))


def make_transforms(folder: Path) -> None:
    write_blender(folder, 4, size=(16, 12), fl_x=20.0, fl_y=20.0, w=16, h=12, k1=0.01, train_filenames=["images/r_0"])


def make_hdr_nerf(folder: Path) -> None:
    view = orbit_camera(0.0, 16)
    radiance = [np.full((16, 16, 3), 0.1 * i + 0.1) for i in (0, 1)]
    views = [RadianceView(f"r_{i}", view, radiance[i], ("train", "test")[i]) for i in (0, 1)]
    write_reinhard(folder, views, [0.5, 2.0], points=(np.eye(3), np.eye(3)))


def make_exposures(folder: Path) -> None:
    make_colmap(False)(folder)
    names = sorted(path.name for path in (folder / "images").iterdir())
    (folder / "exposures.json").write_text(json.dumps({name: 0.01 * (i + 1) for i, name in enumerate(names)}))


def make_points(folder: Path) -> None:
    rows = np.zeros(6, [(n, "f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")])
    for name, text in (("binary", False), ("text", True)):
        PlyData([PlyElement.describe(rows, "vertex")], text=text).write(str(folder / f"{name}.ply"))


def make_cameras(folder: Path) -> None:
    view = camera(16, 12).to_dict()
    (folder / "own.json").write_text(json.dumps({"cameras": [{"name": "a", **view}, {"camera": view}]}))
    path = [{"camera_to_world": np.eye(4).ravel().tolist(), "fov": 50}]
    (folder / "studio.json").write_text(json.dumps({"render_width": 8, "render_height": 6, "camera_path": path}))


def make_cameras_of_others(folder: Path) -> None:
    place = {"rotation": np.eye(3).tolist(), "position": [0, 0, 1]}
    listed = [{"id": 0, "img_name": "a", "width": 16, "height": 12, "fx": 20.0, "fy": 20.0, **place}]
    (folder / "inria.json").write_text(json.dumps(listed))
    make_transforms(folder)
    make_cameras(folder)
    back = {"transform": np.eye(4)[:3].tolist(), "scale": 0.5}
    (folder / "dataparser_transforms.json").write_text(json.dumps(back))
    shutil.rmtree(folder / "images")


def load_srgb(folder: Path):
    return load_scene(folder, response="srgb")


def make_llff(folder: Path) -> None:
    write_llff(folder, 4, size=(16, 12))


def make_llff_seconds(folder: Path) -> None:
    make_llff(folder)
    (folder / "images").rename(folder / "input_images")
    for number, path in enumerate(sorted((folder / "input_images").iterdir())):
        path.rename(path.with_name(f"{number:03d}_0.png"))
    rows = np.load(folder / "poses_bounds.npy")
    np.save(folder / "poses_bounds_exps.npy", np.c_[rows, np.full(len(rows), 0.5)])


def make_opensfm(folder: Path) -> None:
    (folder / "images").mkdir()
    for name in ("a.jpg", "b.jpg"):
        Image.fromarray(pattern(16, 12)).save(folder / "images" / name)
    perspective = {"projection_type": "perspective", "width": 16, "height": 12, "focal": 0.8, "k1": 0.01, "k2": 0.0}
    shots = {
        name: {"camera": "c", "rotation": [0.1, 0.2, 0.3 * n], "translation": [0.5, 0.25, 2.0], "gps_dop": 5}
        for n, name in enumerate(("a.jpg", "b.jpg"))
    }
    points = {"1": {"coordinates": [1.0, 2.0, 3.0], "color": [255, 0, 0]}}
    model = {"cameras": {"c": perspective}, "shots": shots, "points": points}
    (folder / "reconstruction.json").write_text(json.dumps([model]))


def make_scan(folder: Path) -> None:
    write_scan(folder, "scanner")


def make_meshroom(folder: Path) -> None:
    write_meshroom(folder)


def make_chan(folder: Path) -> None:
    (folder / "own.chan").write_text("".join(f"{n} 0.5 1.5 {n}.0 10 20 30 45.5\n" for n in range(1, 5)))


READERS = {
    "colmap-binary": Reader(make_colmap(True), ("sparse/0/*.bin",), read_colmap, cost=3),
    "colmap-text": Reader(make_colmap(False), ("sparse/0/*.txt",), read_colmap, text=True, cost=3),
    "transforms": Reader(make_transforms, ("transforms.json",), read_transforms, text=True, cost=1.2),
    "hdr-nerf": Reader(make_hdr_nerf, ("*.json", "sparse/0/*"), read_hdr_nerf, text=True, cost=2),
    "exposures": Reader(make_exposures, ("exposures.json",), load_srgb, text=True, cost=5),
    "scene": Reader(make_transforms, ("transforms.json", "images/*"), load_srgb, text=True, cost=7),
    "llff": Reader(make_llff, ("poses_bounds.npy",), read_llff),
    "llff-seconds": Reader(make_llff_seconds, ("poses_bounds_exps.npy",), read_hdr_nerf_real),
    "ply-points": Reader(make_points, ("*.ply",), each(read_ply_points), text=True, cost=0.5),
    "cameras": Reader(make_cameras, ("*.json",), each(load_cameras), text=True, cost=0.5),
    "cameras-of-others": Reader(make_cameras_of_others, ("*.json",), each(load_cameras), text=True, cost=0.7),
    "opensfm": Reader(make_opensfm, ("reconstruction.json",), read_opensfm, text=True, cost=0.9),
    "meshroom": Reader(make_meshroom, ("cameras.sfm",), read_meshroom, text=True, cost=1),
    "scan": Reader(make_scan, ("*.json",), read_scan, text=True, cost=1),
    "chan": Reader(make_chan, ("*",), each(load_cameras), text=True, cost=1.4),
}
