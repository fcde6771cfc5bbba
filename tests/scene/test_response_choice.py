"""Choice of a response for a set of photos."""

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.scene import load_scene
from sehdr_warp.scene.response_choice import select_for_codes
from tests.make_scenes import load, pattern, write_colmap
from tests.response.mosaics import mosaic, photograph


def test_a_response_that_is_a_guess_is_noted(tmp_path):
    write_colmap(tmp_path, name="{:03d}.png")
    for path in (tmp_path / "images").iterdir():
        with Image.open(path) as photo:
            ramp = np.linspace(30, 220, photo.width).astype(np.uint8)
            Image.fromarray(np.broadcast_to(ramp[None, :, None], (photo.height, photo.width, 3)).copy()).save(path)
    notes = load_scene(tmp_path).notes
    assert sum("is a guess: curves that explain the photos as well differ" in note for note in notes) == 1
    assert not any("is a guess" in note for note in load_scene(tmp_path, response="srgb").notes)


@pytest.mark.parametrize(
    ("cameras", "notes"),
    [
        (
            ("NIKON D70\0\0", "PENTAX 67", "NIKON D70"),
            ["photos of 2 cameras get one response, which fits some of them better: NIKON D70 (2), PENTAX 67 (1)"],
        ),
        (("NIKON D70\0\0", "NIKON D70"), []),
    ],
)
def test_photos_of_several_cameras_are_named(tmp_path, cameras, notes):
    write_colmap(tmp_path)
    for number, camera in enumerate(cameras):
        path, tags = tmp_path / "images" / f"{number:03d}.png", Image.Exif()
        tags[0x0110] = camera
        Image.fromarray(pattern(64, 48, number)).save(path, exif=tags)
    assert [note for note in load(tmp_path).notes if "cameras get" in note] == notes


def test_the_response_is_chosen_from_codes_as_photographed():
    """Photos of any size are judged at one size, as smaller ones tell too little; another curve develops otherwise."""
    candidates = "srgb", "camera", "rec709", "filmic"
    scenes = [load_scene("embedded", max_size=size, candidates=candidates) for size in (None, 40)]
    for scene in scenes:
        assert scene.response.name == "filmic" and scene.chosen_by == ("posterior", candidates)
        assert not any("is a guess" in note for note in scene.notes)
    assert scenes[0].views[0].codes.dtype == np.uint8 and scenes[1].views[0].codes.dtype == np.uint16
    named = load_scene("embedded", max_size=40, response="camera")
    assert named.chosen_by is None and named.response.name == "camera"
    assert np.abs(named.views[0].image - scenes[1].views[0].image).max() > 1e-3
    assert load_scene("embedded", max_size=40, response=named.response).response is named.response


def test_a_guess_is_logged():
    ramp = np.rint(255 * np.linspace(0.1, 0.9, 64)[None, :, None] * np.ones((64, 1, 3))).astype(np.uint8)
    note = select_for_codes([ramp], [None], "posterior", ()).note
    assert "is a guess: curves that explain the photos as well differ from it by" in note
    codes = [np.rint(255 * photograph("srgb", mosaic(seed))).astype(np.uint8) for seed in range(4)]
    assert select_for_codes(codes, [None] * 4, "posterior", ()).note is None
    assert select_for_codes(codes, [None] * 4, "paper", ()).note is None
