"""Masks, truth and times of a photo, matched by its path or its name alone."""

import json

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.scene.load import parse_dataset
from tests.make_scenes import load, said, write_colmap


def test_times_and_truth_are_by_path(tmp_path):
    import OpenEXR

    write_colmap(tmp_path, name="cam{}/0000.png")
    (tmp_path / "exposures.json").write_text(
        json.dumps({f"cam{i}/0000.png": 0.01 * 2**i for i in range(5)} | {"cam5\\0000": "0,32"})
    )
    (tmp_path / "hdr" / "cam3").mkdir(parents=True)
    plane = np.full((48, 64), 2, np.float32)
    for place in (tmp_path / "hdr" / "cam3" / "0000.exr", tmp_path / "hdr" / "0000.exr"):
        OpenEXR.File({"type": OpenEXR.scanlineimage}, {"R": plane, "G": plane, "B": plane}).write(str(place))
    scene = load(tmp_path, holdout=0)
    assert [view.exposure_time for view in scene.views] == pytest.approx([0.01 * 2**i for i in range(6)])
    assert [view.hdr is not None for view in scene.views] == [False, False, False, True, False, False]
    assert said(scene, "truth") == ["hdr/ holds 1 file that is the truth of no photo: 0000.exr"]
    (tmp_path / "exposures.json").write_text(json.dumps({"0000.png": 0.01}))
    scene = load(tmp_path, holdout=0)
    assert not scene.exposure_times_known
    (note,) = said(scene, "exposures.json")
    assert note.startswith("exposures.json: 1 name fits several photos, and needs its folder: 0000.png (images/cam0/")


def test_a_name_that_an_unused_photo_shares_is_of_no_photo(tmp_path):
    import OpenEXR

    write_colmap(tmp_path, name="cam{0}/{0}.png")
    images = tmp_path / "images"
    (images / "thumbnails").mkdir()
    # A copy beside its photo shares no name, nor does one in a folder of which no photo is used.
    for place, name in (("cam5", "0.jpg"), ("cam1", "1.jpg"), ("thumbnails", "1.png")):
        Image.open(images / "cam0" / "0.png").save(images / place / name)
    (tmp_path / "exposures.json").write_text(json.dumps({"0": 8} | {f"{i}": 0.5 for i in range(1, 6)}))
    for folder in ("masks", "hdr"):
        (tmp_path / folder).mkdir()
    for i in range(2):
        Image.new("L", (64, 48), 255).save(tmp_path / "masks" / f"{i}.png")
        planes = dict.fromkeys("RGB", np.full((48, 64), 2, np.float32))
        OpenEXR.File({"type": OpenEXR.scanlineimage}, planes).write(str(tmp_path / "hdr" / f"{i}.exr"))
    dataset = parse_dataset(tmp_path)
    matches = [(record.mask is not None, record.hdr is not None, record.time_known) for record in dataset.records]
    assert matches[:3] == [(False, False, False), (True, True, True), (False, False, True)]
    for count in ("masks/ holds 1 file", "hdr/ holds 1 file", "exposures.json: 1 name fits several photos"):
        assert said(dataset, count), dataset.notes
