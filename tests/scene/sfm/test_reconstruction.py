"""Structure from motion: what its cache depends on, and how it places bare photos of all kinds."""

import os
import shutil
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from sehdr_warp.errors import InputError
from sehdr_warp.output.images.exr import rgb_channels, write_exr
from sehdr_warp.scene.color.primaries import linear_to_srgb, srgb_to_linear
from sehdr_warp.scene.dataparser import PointCloud
from sehdr_warp.scene.lens import Lens
from sehdr_warp.scene.load import parse_dataset
from sehdr_warp.scene.photos import brightened_codes
from sehdr_warp.scene.readers.colmap_model import ModelImage, SparseModel
from sehdr_warp.scene.sfm import pairs
from sehdr_warp.scene.sfm import reconstruction as sfm
from sehdr_warp.scene.sfm.reconstruction import (
    MOST_ERROR,
    Reconstruction,
    exif_device,
    image_name,
    reconstruct,
    write_photos,
)
from tests.make_scenes import load

from ..raw.dng_files import picture

# Of messages and of estimates of time
WITHOUT_EFFECT = {"MOST_ERROR", "_SURE", "_MOST_TURNED", "_NEAR", "_PAIR_COST", "_PLACE_COST"}
CONSTANTS = {
    name
    for module in (pairs, sfm)
    for name, value in vars(module).items()
    if name.isupper() and isinstance(value, int | float) and name not in WITHOUT_EFFECT
}


@pytest.fixture
def key(monkeypatch, tmp_path):
    """Return a function that returns the key under which photos are cached."""
    photos = [tmp_path / "a.jpg", tmp_path / "b.jpg"]
    for photo in photos:
        photo.write_bytes(photo.name.encode())

    def stop(cache, key, solve):
        raise InterruptedError(key)

    def compute(masks=()):
        with pytest.raises(InterruptedError) as stopped:
            sfm.reconstruct(photos, None, masks)
        return str(stopped.value)

    monkeypatch.setattr(sfm, "solved_folder", stop)
    return compute


def test_a_killed_process_leaves_no_copies_of_photos_in_the_cache(tmp_path):
    """The temporary folder is in that of the result, which the next process removes."""
    places = []

    def solve(work, result):
        places.append((work, result))
        (result / "facts.json").write_text("{}")

    folder = sfm.solved_folder(tmp_path / "cache", "k", solve)
    assert places[0][0].parent == places[0][1] and [file.name for file in folder.iterdir() if file.is_dir()] == []


def test_a_constant_that_changes_the_result_finds_cameras_anew(key, monkeypatch):
    before, brightening = key(), sfm.BRIGHTENING
    changes = [(name, getattr(sfm, name) + 1) for name in CONSTANTS]
    for index in range(len(brightening)):
        values = list(brightening)
        values[index] = 0.1
        changes.append(("BRIGHTENING", tuple(values)))
    for name, value in changes:
        with monkeypatch.context() as patch:
            patch.setattr(sfm, name, value)
            assert key() != before, (name, value)
    assert key() == before


def test_photos_masks_and_another_pycolmap_find_cameras_anew(key, monkeypatch, tmp_path):
    before, mask = key(), tmp_path / "mask.png"
    mask.write_bytes(b"1")
    masked = key([mask, None])
    mask.write_bytes(b"2")
    assert key([None, None]) == before and len({before, masked, key([mask, None]), key([None, mask])}) == 4
    monkeypatch.setattr(sfm, "distributions", lambda: [SimpleNamespace(name="pycolmap-cuda12", version="0")])
    assert key() != before
    monkeypatch.undo()
    assert sfm.cache_key("photos") != sfm.cache_key("panoramas")


def test_images_are_numbered_by_name_however_long_their_features_take(tmp_path):
    """The world has the axes of the image with the lower number, so another number is another world."""
    pycolmap, random = pytest.importorskip("pycolmap"), np.random.default_rng(0)
    (tmp_path / "images").mkdir()
    names = [f"{index:05d}.png" for index in range(8)]
    for index, name in enumerate(names):
        blocks = random.integers(0, 255, (60, 80), np.uint8)
        pixels = np.kron(blocks, np.ones((6, 6), np.uint8)) if index == 0 else np.full((360, 480), 99, np.uint8)
        Image.fromarray(pixels).save(tmp_path / "images" / name)
    sfm.extract_features(tmp_path / "database.db", tmp_path, names, (600.0, 240.0, 180.0, 0.0))
    with pycolmap.Database.open(tmp_path / "database.db") as opened:
        images = sorted(opened.read_all_images(), key=lambda image: image.image_id)
        assert [image.name for image in images] == names
        assert len({image.camera_id for image in images}) == 1 == opened.num_cameras()
        assert opened.num_keypoints_for_image(images[0].image_id) > 100


LOST = image_name(2)


def test_bare_photos_are_placed_undistorted_and_cached(tmp_path, castle_photos, caplog):
    """All are placed, EXIF times kept, and the second call reuses the cameras."""
    caplog.set_level("INFO", "sehdr_warp.scene")
    scene = load(castle_photos, max_size=200)
    assert scene.format == "photos" and len(scene.views) == 11 and len(scene.points) > 200
    assert len({view.exposure_time for view in scene.views}) > 1 and scene.exposure_times_known
    assert max(view.image.shape[1] for view in scene.views) == 200 and scene.views[0].camera.width == 200
    # Nearly every point lies inside every picture, which has its color there, unless something hides it.
    correlations = []
    for view in scene.views:
        x, y, z = view.camera.world_to_camera[:3, :3] @ scene.points.T + view.camera.world_to_camera[:3, 3:]
        column = view.camera.fx * x / z + view.camera.cx
        row = view.camera.fy * y / z + view.camera.cy
        inside = (z > 0) & (column > 0) & (column < view.camera.width) & (row > 0) & (row < view.camera.height)
        assert inside.mean() > 0.8
        colors = view.image[row[inside].astype(int), column[inside].astype(int)]
        correlations.append(np.corrcoef(colors.ravel(), scene.point_colors[inside].ravel())[0, 1])
    assert min(correlations) > 0.45 and np.mean(correlations) > 0.7  # With the next camera 0.37 and 0.18
    caplog.clear()
    again = load(shutil.copytree(castle_photos, tmp_path / "moved"), max_size=100)
    assert "using the cached result" in caplog.text
    np.testing.assert_array_equal(again.points, scene.points)
    assert not list(Path(os.environ["SEHDR_CACHE"]).glob("sehdr-sfm-*"))


def test_a_damaged_photo_is_named_and_not_sought_again(tmp_path, castle_photos, caplog):
    caplog.set_level("INFO", "sehdr_warp.scene")
    photos = sorted(shutil.copytree(castle_photos, tmp_path / "photos").iterdir())[:6]
    photos[5].write_bytes(photos[5].read_bytes()[:-2000])
    for _ in range(2):  # The second result is the cached one.
        notes = reconstruct(photos, tmp_path / "cache").notes(photos)
        damaged = [note for note in notes if "left out" in note]
        assert len(damaged) == 1
        assert damaged[0].startswith(f"1 of 6 photos cannot be used and were left out ({photos[5].name}: cannot be dec")
    assert "using the cached result" in caplog.text and "weaker conditions" not in caplog.text


def test_turned_photos_are_placed_upright(tmp_path, shared):
    """Photos stored on their side with an EXIF orientation give the scene of the upright ones."""
    for photo in sorted((shared / "data" / "castle").glob("*.JPG"))[4:8]:
        with Image.open(photo) as image:
            upright = image.reduce(6)
        exif = Image.Exif()
        exif[0x0112] = 6
        for folder, shot, tags in (("up", upright, Image.Exif()), ("side", upright.rotate(90, expand=True), exif)):
            (tmp_path / folder).mkdir(exist_ok=True)
            shot.save(tmp_path / folder / f"{photo.stem}.png", exif=tags)
    up, side = (load(tmp_path / folder, max_size=100) for folder in ("up", "side"))
    assert len(up.views) == len(side.views) == 4
    for a, b in zip(up.views, side.views, strict=True):
        assert a.image.shape == b.image.shape
        assert np.abs(a.image - b.image).mean() < 0.01


def test_photos_of_several_cameras_get_their_own_lenses(tmp_path, shared):
    """Photos of other sizes, and those of other devices."""
    photos = sorted((shared / "data" / "castle").glob("*.JPG"))[4:8]
    tags = Image.Exif()
    tags[0x0110] = "another"
    for i, photo in enumerate(photos):
        with Image.open(photo) as image:
            image.reduce(5 if i < 3 else 6).save(tmp_path / photo.name, quality=95, exif=tags if i < 1 else b"")
    reconstruction = reconstruct(sorted(tmp_path.glob("*.JPG")), tmp_path / "cache")
    lenses = [image.lens for image in reconstruction.model.images]
    assert {(lens.width, lens.height) for lens in lenses} == {(472, 355), (567, 426)}
    assert len({lens.params[0] for lens in lenses}) == 3
    assert 0 < reconstruction.error < MOST_ERROR and not reconstruction.notes(photos)


def test_dark_photos_are_placed_by_brightened_codes(tmp_path, shared):
    for photo in sorted((shared / "data" / "castle").glob("*.JPG"))[4:8]:
        with Image.open(photo) as image:
            light = srgb_to_linear(np.asarray(image.reduce(6)) / 255) / 32
        Image.fromarray(np.rint(255 * linear_to_srgb(light)).astype(np.uint8)).save(tmp_path / f"{photo.stem}.png")
    reconstruction = reconstruct(sorted(tmp_path.glob("*.png")), tmp_path / "cache")
    assert len(reconstruction.model.images) == 4 and not reconstruction.weak
    assert len(reconstruction.model.cloud.positions) > 300  # 83 without


def test_codes_of_bright_photos_stay_and_those_of_dark_ones_reach_a_midtone():
    bright = np.full((16, 16, 3), 100, np.uint8)
    assert brightened_codes(bright) is bright
    np.testing.assert_array_equal(brightened_codes(bright.astype(np.uint16) * 257), bright)
    assert abs(int(brightened_codes(np.full((16, 16, 3), 5000, np.uint16)).mean()) - 0.3 * 255) < 1
    assert not brightened_codes(np.zeros((16, 16, 3), np.uint8)).any()
    bright[:, 4:] = 1  # A black background with noise
    assert brightened_codes(bright) is bright


def test_an_object_that_turns_is_placed_by_its_masks(tmp_path, shared):
    tankard = shared / "data" / "tankard_turntable"
    known = {record.image.stem: record.world_to_camera for record in parse_dataset(tankard).records}
    for kind, suffix in (("images", "jpg"), ("masks", "png")):
        (tmp_path / kind).mkdir()
        for index in range(9669, 9677):
            with Image.open(tankard / kind / f"IMG_{index}.{suffix}") as image:
                small = image.convert("L" if kind == "masks" else "RGB").reduce(2)
            small.save(tmp_path / kind / f"IMG_{index}.png")
    views = load(tmp_path, max_size=100).views
    turns = [(view.camera.world_to_camera[:3, :3], known[view.name][:3, :3]) for view in views]
    assert len(views) >= 6
    for (a, true_a), (b, true_b) in pairwise(turns):
        difference = (b @ a.T) @ (true_b @ true_a.T).T
        assert np.degrees(np.arccos(np.clip((np.trace(difference) - 1) / 2, -1, 1))) < 2


def test_masks_that_keep_too_little_are_not_used_for_placing(tmp_path, shared, caplog):
    (tmp_path / "masks").mkdir()
    for photo in sorted((shared / "data" / "castle").glob("*.JPG"))[4:8]:
        with Image.open(photo) as image:
            image.reduce(6).save(tmp_path / photo.name, quality=95)
            mask = Image.new("L", image.reduce(6).size)
        mask.paste(255, (0, 0, 60, 60))
        mask.save(tmp_path / "masks" / f"{photo.stem}.png")
    assert len(load(tmp_path, max_size=100).views) == 4
    assert "masks leave too little to place half of the photos" in caplog.text


def test_many_photos_are_placed_by_their_likely_pairs(tmp_path, shared, monkeypatch, caplog):
    """And a photo that none is likely for is matched with all others before the second try."""
    monkeypatch.setattr(sfm, "EXHAUSTIVE_LIMIT", 3)
    for photo in sorted((shared / "data" / "castle").glob("*.JPG"))[3:8]:
        with Image.open(photo) as image:
            image.reduce(6).save(tmp_path / photo.name, quality=95)
    photos = sorted(tmp_path.glob("*.JPG"))
    caplog.set_level("INFO", "sehdr_warp.scene")
    assert len(reconstruct(photos, tmp_path / "cache").model.images) == 5
    assert "comparing photos: 5" in caplog.messages
    likely = sfm.likely_pairs
    monkeypatch.setattr(sfm, "likely_pairs", lambda database: [pair for pair in likely(database) if LOST not in pair])
    again = reconstruct(photos, tmp_path / "again")
    assert "matching pairs of photos that could not be placed: 4" in caplog.messages
    assert LOST in {image.name for image in again.model.images} and len(again.model.images) == 5


def test_more_is_matched_of_photos_without_a_place_before_the_second_try(tmp_path, shared, monkeypatch):
    """Photos far apart share tens of matches, too few to be placed by, and more along the epipolar lines of these."""
    pycolmap = pytest.importorskip("pycolmap")
    for photo in sorted((shared / "data" / "castle").glob("*.JPG"))[3:6]:
        with Image.open(photo) as image:
            image.reduce(6).save(tmp_path / photo.name, quality=95)
    counts = []

    def count_matches(database):
        with pycolmap.Database.open(database) as opened:
            counts.append(
                [len(opened.read_two_view_geometry(*pair).inlier_matches) for pair in ((1, 2), (1, 3), (2, 3))]
            )

    def run_mapper(database, *_, before_again):
        count_matches(database)
        before_again({sfm.image_name(0), sfm.image_name(1)})
        count_matches(database)
        raise InputError(tmp_path, "is not placed", "stop here")

    monkeypatch.setattr(sfm, "run_mapper", run_mapper)
    with pytest.raises(InputError, match="is not placed"):
        reconstruct(sorted(tmp_path.glob("*.JPG")), tmp_path / "cache")
    (placed, *before), (placed_again, *after) = counts
    assert placed_again == placed and np.greater(after, 1.1 * np.array(before)).all()


def test_poor_placement_is_named_with_its_photos(tmp_path):
    photos = [tmp_path / f"{index}.jpg" for index in range(8)]
    photos[7].write_text("damaged")
    lens = Lens("PINHOLE", 8, 6, (7.0, 7.0, 4.0, 3.0), Path("cameras.bin"))
    images = tuple(ModelImage(f"{index:05d}.png", lens, np.eye(4)) for index in (0, 1, 2, 3, 4, 6))
    model = SparseModel(images, PointCloud(np.zeros((0, 3)), np.zeros((0, 3), np.float32)))
    lost, weak, error = Reconstruction(model, 1.4, (2, 4)).notes(photos)
    assert lost == (
        "2 of 8 photos could not be placed and were left out: 5.jpg, 7.jpg; photos between these and the others help"
    )
    assert weak.startswith("2 photos share few points with others, so their places are uncertain: 2.jpg, 4.jpg;")
    assert "1.4 pixels" in error
    lost, _ = Reconstruction(SparseModel(images[:1], model.cloud), 0.5, (0,)).notes(photos)
    assert "7 of 8 photos could not be placed and were left out: 1.jpg to 7.jpg;" in lost
    damaged, lost = Reconstruction(model, 0.5, (), damaged=(7,)).notes(photos)
    assert damaged.startswith("1 of 8 photos cannot be used and were left out (7.jpg: is not a readable image")
    assert lost.startswith("1 of 8 photos could not be placed and was left out: 5.jpg;")
    _, weak, _ = Reconstruction(model, 1.4, (3,)).notes(photos)
    assert weak.startswith("1 photo shares few points with others, so its place is uncertain: 3.jpg;")


@pytest.mark.parametrize("step", [0.0, 8.0])
def test_photos_from_one_place_are_named(tmp_path, step):
    """A camera that stands still is not placed; one that turns is, at places that mean nothing."""
    noise = np.random.default_rng(0).uniform(0, 255, (80, 160)).astype(np.uint8)
    wall = Image.fromarray(noise).resize((1600, 800), Image.Resampling.BICUBIC)
    inverse = np.linalg.inv([[400.0, 0, 200], [0, 400.0, 150], [0, 0, 1]])
    for index in range(6):
        turn = Rotation.from_euler("y", step * (index - 2.5), degrees=True).as_matrix()
        pixels = np.array([[400.0, 0, 800], [0, 400.0, 400], [0, 0, 1]]) @ turn @ inverse
        photo = wall.transform((400, 300), Image.Transform.PERSPECTIVE, (pixels / pixels[2, 2]).ravel()[:8])
        codes = np.asarray(photo) + np.random.default_rng(index).normal(0, 2, (300, 400))
        Image.fromarray(codes.clip(0, 255).astype(np.uint8)).save(tmp_path / f"{index}.png")
    photos = sorted(tmp_path.glob("*.png"))
    try:
        message = reconstruct(photos, tmp_path / "cache").notes(photos)[-1]
    except InputError as error:
        message = str(error)
    assert ("as if the camera only turned" if step else "as if taken from one place") in message


def test_structure_from_motion_asks_linear_photos_for_no_exif(tmp_path):
    write_exr(tmp_path / "a.exr", rgb_channels(picture()))
    sizes, small = write_photos([tmp_path / "a.exr"], tmp_path / "copies")
    assert exif_device(tmp_path / "a.exr") == ("None",) * 4
    exif = Image.Exif()
    for name, exif[0x0110] in (("filled", "FC3682\0\0"), ("plain", "FC3682")):
        Image.new("RGB", (4, 4)).save(tmp_path / f"{name}.jpg", exif=exif)
        assert exif_device(tmp_path / f"{name}.jpg") == ("None", "FC3682", "None", "None")
    assert (sizes, small) == ([(32, 24)], [(32, 24)])
    copy = np.asarray(Image.open(tmp_path / "copies" / "00000.png"))
    assert copy.dtype == np.uint8 and 60 < copy.mean() < 180
