"""Load sets: splits, names, responses, the embedded scene and folders of photos."""

import os
import subprocess
import sys

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.scene.load import holdout_indices
from sehdr_warp.synth.expose import write_radiance
from tests.make_scenes import load, write_blender, write_colmap, write_photos, write_ply


def test_layouts_without_a_protocol_hold_out_the_middle_of_each_block(tmp_path):
    write_blender(tmp_path, 13, ply_file_path="p.ply")
    write_ply(tmp_path / "p.ply", [(0, 0, 0)])
    scene = load(tmp_path)
    assert [view.name for view in scene.test_views] == ["r_4"], "not the last of the arc"
    assert "1 of 13 views is held out for testing: r_4" in scene.notes
    (tmp_path / "images" / "r_4.png").rename(tmp_path / "images" / "r 4 (2).png")
    content = (tmp_path / "transforms.json").read_text()
    (tmp_path / "transforms.json").write_text(content.replace("r_4", "r 4 (2)"))
    scene = load(tmp_path)
    named = scene.test_views[0].name  # As files, --at camera:NAME and summary.json have it.
    assert f"1 of 13 views is held out for testing: {named}" in scene.notes and " " not in named
    assert [view.name for view in load(tmp_path, holdout=4).test_views] == ["r_2", "r_6", "r_10"]
    for count, held in ((5, {2}), (6, {4}), (9, {4}), (16, {4, 12}), (4, set())):
        assert holdout_indices(count, None, None) == held
    assert holdout_indices(9, None, (8, 0)) == {0, 8} and holdout_indices(6, None, (2, 1)) == {1, 3, 5}
    assert not holdout_indices(20, 0, (8, 0))
    # Of a block whose middle view has an uncertain camera, the nearest other view is held out.
    assert holdout_indices(20, None, None, {3, 4, 5, 11}) == {2, 12}
    assert holdout_indices(8, None, None, set(range(7))) == {4} and holdout_indices(5, None, None, {2}) == {1}
    assert holdout_indices(13, 5, None, {6, 7, 8}) == {2, 5}


@pytest.mark.parametrize("max_size", [0, -5, "800", float("nan")])
def test_a_size_that_no_photo_has_is_named(tmp_path, max_size):
    write_blender(tmp_path)
    with pytest.raises(InputError, match=f"longest side of {max_size!r} pixels asked for; give at least 1 pixel"):
        load(tmp_path, max_size=max_size)


def test_the_package_and_the_room_are_light():
    """Without poses to check and lenses that distort, nothing of structure from motion is needed."""
    heavy = "{'torch', 'warp', 'pycolmap', 'OpenEXR', 'scipy', 'matplotlib', 'colour'}"
    code = f"import sys, sehdr_warp.scene as s; print(sorted({heavy} & set(sys.modules)))\n"
    code += "s.load_scene('embedded', max_size=16, response='srgb'); print('pycolmap' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["[]", "False"]


def test_splits(tmp_path):
    write_colmap(tmp_path, 9)
    assert [view.name for view in load(tmp_path).test_views] == ["000", "008"]
    assert [view.name for view in load(tmp_path, holdout=4).test_views] == ["000", "004", "008"]
    assert not load(tmp_path, holdout=0).test_views
    with pytest.raises(InputError, match=r"9 views, 0 for training.*holdout 8, or 0 for none"):
        load(tmp_path, holdout=1)
    write_colmap(tmp_path / "few", 4)
    few = load(tmp_path / "few")
    assert not few.test_views and "no views are held out for testing" in few.notes


@pytest.mark.skipif(os.name == "nt", reason="links need rights")
@pytest.mark.parametrize("name", ["images/000.png", "masks/000.png", "hdr/000.exr"])
def test_a_photo_mask_or_truth_that_leads_out_of_the_set_is_refused(tmp_path, name):
    write_colmap(tmp_path / "set")
    file, secret = tmp_path / "set" / name, tmp_path / name.replace("/", "_")
    if file.suffix == ".exr":
        write_radiance(secret, np.ones((48, 64, 3), np.float32))
    else:
        write_photos(tmp_path, [secret.name], (64, 48))
    file.parent.mkdir(exist_ok=True)
    file.unlink(missing_ok=True)
    file.symlink_to(secret)
    with pytest.raises(InputError, match="leads outside the data folder by a link; copy what it links to"):
        load(tmp_path / "set")
