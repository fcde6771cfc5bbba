"""HDR truth of photos: found by name in any layout, and named if it belongs to no photo."""

import numpy as np
import OpenEXR
import pytest

from sehdr_warp.errors import InputError
from tests.make_scenes import load, write_blender, write_colmap, write_llff


def write_truth(path, size=(64, 48), light=0.5, **fields):
    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION, **fields}
    OpenEXR.File(header, {"RGB": np.full((size[1], size[0], 3), light, np.float32)}).write(str(path))


@pytest.mark.parametrize("name", ["hdr/{}.exr", "exr/images/{}.exr", "HDR/{}.EXR", "images/{}.exr"])
@pytest.mark.parametrize("layout", [write_colmap, write_llff, write_blender])
def test_names_of_truth(tmp_path, layout, name):
    layout(tmp_path)
    size = (40, 30) if layout is write_blender else (64, 48)
    for photo in (tmp_path / "images").glob("*.png"):
        write_truth(tmp_path / name.format(photo.stem), size, float(photo.stem.removeprefix("r_")) + 1)
    scene = load(tmp_path, holdout=0)
    assert [float(view.hdr.mean()) for view in scene.views] == pytest.approx(range(1, 7))
    assert not any("in no view" in note or "left out" in note for note in scene.notes)


@pytest.mark.parametrize("fault", ["not finite", "cannot be read as OpenEXR", "HDR truth is 32 x 24", "negative"])
def test_truth_that_cannot_be_used_is_left_out_and_named(tmp_path, fault):
    write_colmap(tmp_path)
    for i in range(6):
        write_truth(tmp_path / "hdr" / f"{i:03d}.exr")
    odd = tmp_path / "hdr" / "003.exr"
    match fault:
        case "not finite":
            write_truth(odd, light=np.nan)
        case "cannot be read as OpenEXR":
            odd.write_bytes(odd.read_bytes()[:60])
        case "HDR truth is 32 x 24":
            write_truth(odd, (32, 24))
        case _:
            write_truth(odd, light=-1)
    scene = load(tmp_path, holdout=0)
    with_truth = [view.hdr is not None for view in scene.views]
    assert with_truth == [True] * 3 + [fault == "negative"] + [True] * 2
    notes = [note for note in scene.notes if "truth cannot be used" in note]
    assert len(notes) == (fault != "negative")
    assert all(note.startswith("1 of 6 files of truth cannot be used") and fault in note for note in notes)


def test_truth_of_another_size_than_all_photos_is_refused(tmp_path):
    write_colmap(tmp_path)
    for i in range(6):
        write_truth(tmp_path / "hdr" / f"{i:03d}.exr", (32, 24))
    with pytest.raises(InputError, match="HDR truth is 32 x 24, the photo 64 x 48"):
        load(tmp_path, holdout=0)


@pytest.mark.parametrize("place", ["exr", "images"])
def test_depth_is_no_truth(tmp_path, place):
    write_colmap(tmp_path)
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    (tmp_path / place).mkdir(exist_ok=True)
    OpenEXR.File(header, {"Z": np.ones((48, 64), np.float32)}).write(str(tmp_path / place / "000.exr"))
    scene = load(tmp_path, holdout=0)
    assert len(scene.views) == 6 and not any(view.hdr is not None for view in scene.views)
    assert any("000.exr" in note for note in scene.notes)


def test_what_render_wrote_beside_the_photos_is_no_truth(tmp_path):
    """A training would otherwise compare itself with the one before."""
    write_colmap(tmp_path)
    for i in range(6):
        write_truth(tmp_path / "hdr" / f"{i:03d}.exr", **{"sehdr:view": f"{i:03d}"} if i else {})
    scene = load(tmp_path, holdout=0)
    assert [view.hdr is not None for view in scene.views] == [True] + 5 * [False]
    note = "hdr/ holds 5 files that are the truth of no photo (5 rendered by sehdr-warp, or without color): 001.exr"
    assert any(line.startswith(note) for line in scene.notes)
