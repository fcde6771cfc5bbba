"""Bare panoramas: recognized, and placed by structure from motion."""

from contextlib import nullcontext

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError
from sehdr_warp.scene import load_scene
from sehdr_warp.scene.sfm.panoramas import are_panoramas

from ..panorama_room import camera_at, light, walls

pytest.importorskip("pycolmap")


def photos(folder, count, width=512, options=None):
    random, painted, cameras = np.random.default_rng(1), walls(), []
    for i in range(count):
        cameras.append(camera_at(random.uniform(-0.35, 0.35, 3), random.uniform(-1, 1), width))
        codes = np.rint(255 * light(cameras[-1], painted) ** (1 / 2.2)).astype(np.uint8)
        Image.fromarray(codes).save(folder / f"{i}.png", **(options or {}))
    return cameras


def test_panoramas_are_recognized_by_size_and_seam(tmp_path):
    photos(tmp_path, 2, 128)
    files = sorted(tmp_path.glob("*.png"))
    assert are_panoramas(files)
    image = np.asarray(Image.open(files[0]))
    # Cut from a wider picture: twice as wide as high, and its ends have nothing to do with each other.
    random = np.random.default_rng(0).integers(0, 255, (8, 5, 3), np.uint8)
    cut = Image.fromarray(random).resize((128, 64), Image.Resampling.BICUBIC)
    (tmp_path / "cut").mkdir()
    for i in range(3):
        cut.save(tmp_path / "cut" / f"{i}.png")
    assert not are_panoramas(sorted((tmp_path / "cut").glob("*.png")))
    Image.fromarray(image[:, :100]).save(tmp_path / "c.png")
    assert not are_panoramas([*files, tmp_path / "c.png"])


def test_stated_projections_win(tmp_path):
    random = np.random.default_rng(0).integers(0, 255, (8, 5, 3), np.uint8)
    cut = Image.fromarray(random).resize((128, 64), Image.Resampling.BICUBIC)
    for kind, expected in (("equirectangular", True), ("cylindrical", False)):
        text = f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><a GPano:ProjectionType="{kind}"/></x:xmpmeta>'
        cut.save(tmp_path / f"{kind}.jpg", xmp=text.encode())
        assert are_panoramas([tmp_path / f"{kind}.jpg"]) == expected


def test_ends_that_are_even_are_no_seam(tmp_path):
    rows, columns = np.mgrid[:64, :128]
    object_before_white = (np.abs(rows - 32) < 20) & (np.abs(columns - 64) < 40)
    two_circles = np.minimum(np.hypot(rows - 32, columns - 32), np.hypot(rows - 32, columns - 96)) < 31
    for inside, outside in ((object_before_white, 250), (two_circles, 0)):
        noise = np.random.default_rng(3).integers(0, 255, (64, 128, 3), np.uint8)
        Image.fromarray(np.where(inside[..., None], noise, outside).astype(np.uint8)).save(tmp_path / "a.png")
        assert not are_panoramas([tmp_path / "a.png"])


@pytest.mark.parametrize(
    ("size", "cropped", "expected"),
    [((128, 64), 300, "shows a part of a panorama: 300 of 512"), ((128, 50), 512, "is 128 x 50"), ((128, 64), 512, "")],
)
def test_parts_of_panoramas_are_refused(tmp_path, size, cropped, expected):
    """A reduced copy of a whole panorama keeps the numbers of the original."""
    text = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description GPano:ProjectionType="equirectangular"'
        f' GPano:CroppedAreaImageWidthPixels="{cropped}"><GPano:FullPanoWidthPixels>512</GPano:FullPanoWidthPixels>'
        "</rdf:Description></x:xmpmeta>"
    )
    Image.new("RGB", size).save(tmp_path / "a.jpg", xmp=text.encode())
    with pytest.raises(InputError, match=expected) if expected else nullcontext():
        assert are_panoramas([tmp_path / "a.jpg"])


def test_bare_panoramas_are_placed(tmp_path):
    (tmp_path / "set").mkdir()
    cameras = photos(tmp_path / "set", 4, 384)
    scene = load_scene(tmp_path / "set", response="srgb", cache=tmp_path / "cache", holdout=0, max_size=128)
    assert len(scene.views) == 4 and len(scene.points) > 100
    assert all(view.camera.projection == "equirectangular" for view in scene.views)
    positions = np.stack([view.camera.position for view in scene.views])
    truth = np.stack([camera.position for camera in cameras])
    # Equal up to a similarity (Umeyama 1991).
    a, b = positions - positions.mean(0), truth - truth.mean(0)
    u, values, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ sign @ vt
    scale = (values * sign.diagonal()).sum() / (a**2).sum()
    assert np.abs(scale * a @ rotation.T - b).max() < 0.02
    for view, camera in zip(scene.views, cameras, strict=True):
        turn = view.camera.world_to_camera[:3, :3] @ rotation.T @ camera.world_to_camera[:3, :3].T
        assert np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))) < 1
