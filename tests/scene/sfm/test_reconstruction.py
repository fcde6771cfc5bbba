"""The cache of structure from motion: its key holds whatever changes a result."""

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.scene.sfm import pairs, reconstruction

WITHOUT_EFFECT = {"MOST_ERROR", "_PAIR_COST", "_PLACE_COST"}  # Of a message and of estimates of time
CONSTANTS = {
    name
    for module in (pairs, reconstruction)
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
            reconstruction.reconstruct(photos, None, masks)
        return str(stopped.value)

    monkeypatch.setattr(reconstruction, "solved_folder", stop)
    return compute


def test_a_killed_process_leaves_no_copies_of_photos_in_the_cache(tmp_path):
    """The temporary folder is in that of the result, which the next process removes."""
    places = []

    def solve(work, result):
        places.append((work, result))
        (result / "facts.json").write_text("{}")

    folder = reconstruction.solved_folder(tmp_path / "cache", "k", solve)
    assert places[0][0].parent == places[0][1] and [file.name for file in folder.iterdir() if file.is_dir()] == []


@pytest.mark.parametrize("name", sorted(CONSTANTS))
def test_a_constant_that_changes_the_result_finds_cameras_anew(name, key, monkeypatch):
    before = key()
    assert key() == before
    monkeypatch.setattr(reconstruction, name, getattr(reconstruction, name) + 1)
    assert key() != before


@pytest.mark.parametrize("field", reconstruction.BRIGHTENING._fields)
def test_another_brightening_finds_cameras_anew(field, key, monkeypatch):
    before, brightening = key(), reconstruction.BRIGHTENING
    monkeypatch.setattr(reconstruction, "BRIGHTENING", brightening._replace(**{field: 0.1}))
    assert key() != before


def test_photos_masks_and_another_pycolmap_find_cameras_anew(key, monkeypatch, tmp_path):
    before, mask = key(), tmp_path / "mask.png"
    mask.write_bytes(b"1")
    masked = key([mask, None])
    mask.write_bytes(b"2")
    assert key([None, None]) == before and len({before, masked, key([mask, None]), key([None, mask])}) == 4
    monkeypatch.setattr(reconstruction, "version", lambda name: f"{name} 0")
    assert key() != before
    monkeypatch.undo()
    assert reconstruction.cache_key("photos") != reconstruction.cache_key("panoramas")


def test_images_are_numbered_by_name_however_long_their_features_take(tmp_path):
    """The world has the axes of the image with the lower number, so another number is another world."""
    pycolmap, random = pytest.importorskip("pycolmap"), np.random.default_rng(0)
    (tmp_path / "images").mkdir()
    names = [f"{index:05d}.png" for index in range(8)]
    for index, name in enumerate(names):
        blocks = random.integers(0, 255, (60, 80), np.uint8)
        pixels = np.kron(blocks, np.ones((6, 6), np.uint8)) if index == 0 else np.full((360, 480), 99, np.uint8)
        Image.fromarray(pixels).save(tmp_path / "images" / name)
    reconstruction._extract(tmp_path / "database.db", tmp_path, names, "SIMPLE_RADIAL", (600.0, 240.0, 180.0, 0.0))
    with pycolmap.Database.open(tmp_path / "database.db") as opened:
        images = sorted(opened.read_all_images(), key=lambda image: image.image_id)
        assert [image.name for image in images] == names
        assert len({image.camera_id for image in images}) == 1 == opened.num_cameras()
        assert opened.num_keypoints_for_image(images[0].image_id) > 100
