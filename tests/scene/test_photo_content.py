"""Checks of the codes of all photos together."""

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError
from sehdr_warp.scene import load_scene
from sehdr_warp.scene.photo_content import frame_notes
from tests.make_scenes import load, pattern, write_colmap


def unused_bits(scene):
    return [note for note in scene.notes if "bits" in note]


@pytest.mark.parametrize("response", ["srgb", "linear"])
@pytest.mark.parametrize("bits", [12, 14, 16])
def test_codes_of_fewer_bits_in_files_of_16_are_named(tmp_path, bits, response):
    tifffile = pytest.importorskip("tifffile")
    write_colmap(tmp_path)
    for i in range(6):
        (tmp_path / "images" / f"{i:03d}.png").unlink()
        codes = pattern(64, 48, i).astype(np.uint16) * 257 >> 16 - bits
        codes[0, 0] = 2**bits - 1
        tifffile.imwrite(tmp_path / "images" / f"{i:03d}.tif", codes, photometric="rgb")
    notes = unused_bits(load(tmp_path, response=response))
    if bits == 16:
        assert notes == []
    else:
        (note,) = notes
        largest, factor = 2**bits - 1, 2 ** (16 - bits)
        assert note.startswith(f"no code of the 16-bit photos is above {largest}: if they hold {bits} bits")
        assert note.endswith(f"multiply their codes by {factor}")


@pytest.mark.parametrize(("inner", "is_named"), [(1.0, True), (0.6, False), (2.0, False)])
def test_circles_in_black_frames_are_named(tmp_path, inner, is_named):
    """An object before a black backdrop is no circle to its border."""
    radius = np.hypot(*np.meshgrid(np.linspace(-4 / 3, 4 / 3, 320), np.linspace(-1, 1, 240)))
    photos = [tmp_path / f"{i}.jpg" for i in range(3)]
    for i, photo in enumerate(photos):
        codes = np.maximum(pattern(320, 240, i), 60) * (radius < inner)[..., None]
        Image.fromarray(codes.astype(np.uint8)).save(photo)
    assert [note[:32] for note in frame_notes(photos)] == ["photos are circles in black fram"] * is_named


@pytest.mark.parametrize(("top", "left", "bars"), [(30, 0, "top, bottom"), (0, 40, "right, left"), (2, 2, "")])
@pytest.mark.parametrize("color", ["black", "white"])
def test_bars_are_named(tmp_path, color, top, left, bars):
    """Frames of wide films have them; a backdrop around an object ends elsewhere in each photo."""
    bar = 255 if color == "white" else 0
    photos = [tmp_path / f"{i}.jpg" for i in range(3)]
    for i, photo in enumerate(photos):
        codes = np.full((240, 320, 3), bar, np.uint8)
        codes[top : 240 - top, left : 320 - left] = np.clip(pattern(320 - 2 * left, 240 - 2 * top, i), 60, 195)
        Image.fromarray(codes).save(photo)
    notes = frame_notes(photos)
    assert [note.split(")")[0] for note in notes] == [f"photos have {color} bars ({bars}"] * bool(bars)
    assert not frame_notes(photos, masked=True)
    codes[: top + 20] = codes[220 - top :] = codes[:, : left + 20] = codes[:, 300 - left :] = bar
    Image.fromarray(codes).save(photo)
    assert not frame_notes(photos)


def test_photos_that_are_nearly_opaque_everywhere_show_something(tmp_path):
    """Editors that blend layers leave alpha at 254; it once made the photos black for the choice of the response."""
    write_colmap(tmp_path)
    for i in range(6):
        alpha = np.full((48, 64, 1), 254, np.uint8)
        Image.fromarray(np.concatenate([pattern(64, 48, i), alpha], 2)).save(tmp_path / "images" / f"{i:03d}.png")
    scene = load_scene(tmp_path, holdout=0)
    assert scene.views[0].codes.max() == 255 and scene.views[0].mask.min() > 0.99


@pytest.mark.parametrize("value", [0, 255])
def test_photos_that_show_nothing_are_refused(tmp_path, value):
    write_colmap(tmp_path)
    for path in (tmp_path / "images").iterdir():
        Image.new("RGB", (64, 48), (value,) * 3).save(path)
    with pytest.raises(InputError, match=rf"black or white in 100\.0 % \(mean {value / 255:.3f}\)"):
        load_scene(tmp_path)
    with pytest.raises(InputError, match="the photo that the response is chosen from is black or white") as refused:
        load_scene(tmp_path, method="paper")
    assert str(refused.value).startswith(str(tmp_path))
