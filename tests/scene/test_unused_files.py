"""What a set holds and does not use is named: frames, models, photos, kinds of files; and names that tools write."""

import json
import os
import shutil

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError
from sehdr_warp.scene import load_scene
from sehdr_warp.scene.load import parse_dataset
from sehdr_warp.scene.readers.colmap_model import find_model
from tests.make_scenes import edited_json, load, pattern, write_blender, write_colmap


def said(scene, word):
    return [note for note in scene.notes if word in note]


def test_photos_in_no_view_and_unread_kinds_are_named(tmp_path):
    write_colmap(tmp_path)
    for name in ("a.png", "b.jpg"):
        Image.fromarray(pattern(64, 48)).save(tmp_path / "images" / name)
    for name in ("clip.xyz", "clip2.xyz", "film.mov", "notes.txt", ".hidden.gif", "IMG.xmp"):
        (tmp_path / "images" / name).write_bytes(b"x")
    scene = load(tmp_path)
    assert said(scene, "in no view") == ["2 photos of images are in no view: a.png, b.jpg"]
    assert said(scene, "not read") == [
        "not used, as files of kinds that are not read: 1 MOV (film.mov), 2 XYZ (clip2.xyz ...)"
    ]
    for i in range(9):  # More than in the model, which was not found for all
        Image.fromarray(pattern(64, 48)).save(tmp_path / "images" / f"c{i}.png")
    remedy = f"; to find cameras of all photos anew, give {tmp_path / 'images'}"
    assert said(load(tmp_path), "in no view") == [
        "11 photos of images are in no view: a.png, b.jpg, c0.png ..." + remedy
    ]
    write_colmap(tmp_path / "folders", name="left/{:03d}.png")
    shutil.copytree(tmp_path / "folders/images/left", tmp_path / "folders/images/right")
    assert said(load(tmp_path / "folders"), "in no view")[0].startswith(
        "6 photos of images/right are in no view: 000.png"
    )
    shutil.copytree(tmp_path / "folders/images/left", tmp_path / "folders/images/right/more")
    (note,) = said(load(tmp_path / "folders"), "in no view")  # Not all photos lie there.
    assert note.startswith("12 photos of images/right") and "anew" not in note
    (tmp_path / "plain").mkdir()
    write_colmap(tmp_path / "plain")
    assert not said(load(tmp_path / "plain"), "in no view") and not said(load(tmp_path / "plain"), "not read")


def test_photos_that_were_not_placed_are_named_in_input_and_beside_images(tmp_path):
    write_colmap(tmp_path, name="{:03d}.png")
    for place, names in ((tmp_path, ["cover"]), (tmp_path / "input", ["000", "005", "100", "101"])):
        place.mkdir(exist_ok=True)
        for name in names:
            Image.fromarray(pattern(64, 48)).save(place / f"{name}.JPG", format="JPEG")
    note = f"2 photos of input are in no view: 100.JPG, 101.JPG; to find cameras of all anew, give {tmp_path / 'input'}"
    assert said(load(tmp_path), "in no view") == [note]
    Image.fromarray(pattern(64, 48)).save(tmp_path / "102.png")
    beside = f"2 photos of {tmp_path.name} are in no view: 102.png, cover.JPG"
    assert said(load(tmp_path), "in no view") == [beside, note]


def test_pictures_of_depth_and_normals_are_named(tmp_path):
    write_colmap(tmp_path)
    for name in ("Depth", "normals", "hdr"):
        (tmp_path / name).mkdir()
    assert not said(load(tmp_path), "alone")
    for name in ("Depth/000.png", "Depth/001.png", "normals/000.png"):
        Image.fromarray(pattern(64, 48)).save(tmp_path / name)
    assert said(load(tmp_path), "alone") == [
        "not used, because depth and normals come from the photos alone: pictures of Depth (2), normals (1)"
    ]


def test_files_of_cameras_beside_photos_are_named(tmp_path):
    write_colmap(tmp_path)
    (tmp_path / "gt_cameras").mkdir()
    (tmp_path / "gt_cameras" / "000.png.camera").write_text("64 0 32\n0 64 24\n0 0 1\n0 0 0\n")
    (tmp_path / "images" / "K.txt").write_text("64 0 32\n0 64 24\n0 0 1\n")
    note = "files of cameras that are not read: K.txt, 000.png.camera"
    assert said(load(tmp_path), "cameras that") == [note]
    assert not said(load(tmp_path), "control points")
    (tmp_path / "gcp_list.txt").write_text("EPSG:32633\n400 500 90 32 24 000.png\n")
    note = "ground control points are not read: gcp_list.txt; `view` can set scale and up"
    assert said(load(tmp_path), "control points") == [note]


@pytest.mark.parametrize(("count", "others"), [(1, 9), (2, 9), (3, 31)])
def test_cameras_of_too_few_photos_of_a_folder_name_the_folder(tmp_path, count, others):
    write_colmap(tmp_path, count)
    for i in range(others):
        Image.fromarray(pattern(64, 48)).save(tmp_path / "images" / f"c{i}.png")
    problem = f"cameras of {count} of {count + others} photos; give {tmp_path / 'images'} to"
    with pytest.raises(InputError, match=problem):
        load(tmp_path)
    if count > 2:
        (tmp_path / "images" / "c0.png").unlink()  # Ten times as many may be what was meant.
        assert len(load(tmp_path).views) == count
        return
    write_blender(tmp_path, 7)  # Its split, and not a search for cameras, leaves few to train on.
    with edited_json(tmp_path / "transforms.json") as values:
        names = [frame["file_path"] for frame in values["frames"]]
        values |= {"train_filenames": names[:2], "val_filenames": [], "test_filenames": names[2:]}
    shutil.rmtree(tmp_path / "sparse")
    assert len(load(tmp_path).train_views) == 2


def test_the_largest_model_is_used_and_the_others_are_named(tmp_path):
    write_colmap(tmp_path, 9, binary=True)
    (tmp_path / "sparse" / "0").rename(tmp_path / "sparse" / "1")
    write_colmap(tmp_path / "few", 3)
    shutil.move(tmp_path / "few" / "sparse" / "0", tmp_path / "sparse" / "0")
    assert find_model(tmp_path) == tmp_path / "sparse" / "1"
    scene = load(tmp_path)
    assert len(scene.views) == 9
    assert "sparse/1 is used, the largest model (9 images); not used: 0 (3 images)" in scene.notes


@pytest.mark.parametrize("lines", ["blank", "none", "mixed", "observations"])
def test_images_with_and_without_lines_of_observations(tmp_path, lines):
    write_colmap(tmp_path, 10)
    path = tmp_path / "sparse" / "0" / "images.txt"
    images = [line for line in path.read_text().splitlines() if line.endswith(".png")]
    second = {"blank": lambda i: "\n", "none": lambda i: "", "mixed": lambda i: "\n" * (i % 2),
              "observations": lambda i: "1.5 2.5 -1 3.25 4 7\n"}[lines]  # fmt: skip
    path.write_text("# comment\n" + "".join(f"{line}\n{second(i)}" for i, line in enumerate(images)))
    assert len(load(tmp_path).views) == 10


def test_frames_without_photos_are_left_out_and_named(tmp_path):
    """As in the published fox set: 17 of 67 frames have no photo."""
    write_blender(tmp_path, 9)
    for i in (1, 4, 8):
        (tmp_path / "images" / f"r_{i}.png").unlink()
    scene = load(tmp_path)
    assert len(scene.views) == 6
    assert "3 of 9 frames have no photo and were left out: ./images/r_1, ./images/r_4, ./images/r_8" in scene.notes
    (tmp_path / "images").rename(tmp_path / "My Photos")
    remedy = "photos of these names are in My Photos: rename it to images"
    with pytest.raises(InputError, match=f"image file not found, nor any of 9 frames; {remedy}"):
        load(tmp_path)


def test_an_exr_folder_beside_numbered_photos_is_not_hdr_gs(tmp_path):
    write_colmap(tmp_path, name="IMG_{:03d}.png")
    (tmp_path / "exr").mkdir()
    (tmp_path / "exr" / "probe.exr").write_bytes(b"x")
    assert parse_dataset(tmp_path).format == "colmap"


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


@pytest.mark.skipif(os.name == "nt", reason="names are bytes on POSIX alone")
@pytest.mark.parametrize("binary", [False, True])
def test_names_of_windows_and_in_latin_1(tmp_path, binary):
    write_colmap(tmp_path, 6, name="cam/{:03d}.png", binary=binary)
    path = tmp_path / "sparse" / "0" / f"images.{'bin' if binary else 'txt'}"
    content = path.read_bytes().replace(b"cam/000.png", b"cam\\000.png").replace(b"001.png", b"\xe901.png")
    path.write_bytes(content)
    images = os.fsencode(tmp_path / "images" / "cam")
    os.rename(images + b"/001.png", images + b"/\xe901.png")
    scene = load(tmp_path, holdout=0)
    assert len(scene.views) == 6 and not said(scene, "missing")
    os.rename(images + b"/\xe901.png", images + "/é01.png".encode())
    assert len(load(tmp_path, holdout=0).views) == 6


@pytest.mark.parametrize("suffix, stored", [(".PNG", ".png"), (".jpg", ".png"), (".jpg", ".exr")])
def test_photos_under_another_suffix_than_the_model_states(tmp_path, suffix, stored):
    """As after a conversion, or structure from motion on JPEGs of an OpenEXR set."""
    import OpenEXR

    write_colmap(tmp_path)
    if stored == ".exr":
        for file in list((tmp_path / "images").iterdir()):
            planes = np.moveaxis(np.asarray(Image.open(file)).astype(np.float32) / 255, 2, 0).copy()
            file.unlink()
            channels = dict(zip("RGB", planes, strict=True))
            OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(str(file.with_suffix(".exr")))
    path = tmp_path / "sparse" / "0" / "images.txt"
    path.write_text(path.read_text().replace(".png", suffix))
    scene = load_scene(tmp_path, response="auto" if stored == ".exr" else "srgb", holdout=0)
    note = f"6 photos have another suffix than the set states: 000{suffix} is 000{stored}"
    assert len(scene.views) == 6 and said(scene, "another suffix") == [note] * (suffix != ".PNG")


@pytest.mark.parametrize("before", ["/home/other/sets/room/", "C:\\sets\\room\\", ""])
def test_absolute_names_of_a_copied_set(tmp_path, before):
    write_blender(tmp_path)
    with edited_json(tmp_path / "transforms.json") as values:
        for frame in values["frames"]:
            name = frame["file_path"].removeprefix("./")
            frame["file_path"] = (before or f"{tmp_path}/") + (name.replace("/", "\\") if "\\" in before else name)
    assert len(load(tmp_path, holdout=0).views) == 6
    files = sorted((tmp_path / "images").iterdir())
    files[0].unlink()
    assert len(load(tmp_path, holdout=0).views) == 5, "one photo that is missing stops no set"
    for file in files[1:]:
        file.unlink()
    with pytest.raises(InputError, match="image file not found, nor any of 6 frames; copy the whole set"):
        load(tmp_path)


def test_photos_that_are_listed_twice_count_once(tmp_path):
    write_blender(tmp_path)
    with edited_json(tmp_path / "transforms.json") as values:
        values["frames"] += values["frames"][1:3]
    scene = load(tmp_path, holdout=0)
    assert len(scene.views) == 6
    assert said(scene, "more than once") == ["2 photos are listed more than once, and counted once: r_1.png, r_2.png"]


@pytest.mark.parametrize("sides, problem", [((1, 1, -1), "mirrors the scene"), ((2, 2, 1), r"stretch \[2.0, 2.0, 1.0")])
def test_poses_that_are_no_rotations_are_refused(tmp_path, sides, problem):
    write_blender(tmp_path)
    with edited_json(tmp_path / "transforms.json") as values:
        for frame in values["frames"]:
            frame["transform_matrix"] = np.diag([*sides, 1.0]).tolist()
    with pytest.raises(InputError, match=problem):
        load(tmp_path)


def test_the_scale_of_a_camera_is_left_out(tmp_path):
    """Blender scales cameras as it shows them, and matrix_world has that scale."""
    write_blender(tmp_path)
    plain = load(tmp_path)
    with edited_json(tmp_path / "transforms.json") as values:
        for frame in values["frames"]:
            frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ np.diag([0.4, 0.4, 0.4, 1])).tolist()
    for view, scaled in zip(plain.views, load(tmp_path).views, strict=True):
        np.testing.assert_allclose(scaled.camera.world_to_camera, view.camera.world_to_camera, atol=1e-9)


def test_links_to_files_that_are_gone_are_named(tmp_path):
    write_colmap(tmp_path)
    for name in ("x.png", "y.png"):
        (tmp_path / "images" / name).symlink_to("gone.png")
    assert said(load(tmp_path), "links lead") == ["2 links lead to no file: x.png, y.png"]


def test_transposed_poses_are_refused(tmp_path):
    """ARKit and USD keep matrices by columns: all photos would be at one place."""
    write_blender(tmp_path)
    with edited_json(tmp_path / "transforms.json") as values:
        for frame in values["frames"]:
            frame["transform_matrix"] = np.array(frame["transform_matrix"]).T.tolist()
    with pytest.raises(InputError, match=r"r_0' has the last row \[.*, 1.0\], not 0 0 0 1; transpose the matrix"):
        load(tmp_path)


def test_text_models_as_other_tools_write_them(tmp_path):
    """Names with spaces and brackets, CRLF, a byte order mark, and exponents of three digits."""
    write_colmap(tmp_path, name="A DJI [1] ({:03d}).png")
    for file in (tmp_path / "sparse" / "0").glob("*.txt"):
        text = file.read_text().replace("e-1", "e-01").replace("e-0", "e-00").replace("\n", "\r\n")
        file.write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert len(load(tmp_path, holdout=0).views) == 6


@pytest.mark.parametrize("stored", ["GRÖßE_{}.PNG", "Größe_{}.jpg"])
@pytest.mark.parametrize("folder", ["", "images/", "cam/"])
def test_case_and_forms_of_accents_do_not_matter(tmp_path, stored, folder):
    """Windows and macOS take such names for the same; a set may also name photos from the folder above."""
    write_colmap(tmp_path, name=("cam/" if folder == "cam/" else "") + "größe_{}.png")
    text = (tmp_path / "sparse" / "0" / "images.txt").read_text()
    if folder == "images/":
        (tmp_path / "sparse" / "0" / "images.txt").write_text(text.replace("größe", "images/größe"))
    place = tmp_path / "images" / ("cam" if folder == "cam/" else ".")
    for i in range(6):
        (place / f"größe_{i}.png").rename(place / stored.format(i))
    scene = load(tmp_path, holdout=0)
    assert [view.source.name for view in scene.views] == [stored.format(i) for i in range(6)]


def test_a_photo_of_a_kind_that_is_not_read_is_named_as_what_it_is(tmp_path):
    write_blender(tmp_path)
    with edited_json(tmp_path / "transforms.json") as values:
        for i, frame in enumerate(values["frames"]):
            (tmp_path / "images" / f"r_{i}.png").rename(tmp_path / "images" / f"r_{i}.jxl")
            (tmp_path / "images" / f"r_{i}.jxl").write_bytes(b"\xff\x0a" + bytes(100))
            frame["file_path"] += ".jxl"
    with pytest.raises(InputError, match="r_0.jxl: is JPEG XL, which is not read as a photo; export it as RGB or grey"):
        load(tmp_path)


def test_names_without_a_suffix_may_have_dots(tmp_path):
    """Metashape labels cameras like that."""
    write_colmap(tmp_path, name="frame.{:04d}.png")
    images = tmp_path / "sparse" / "0" / "images.txt"
    images.write_text(images.read_text().replace(".png", ""))
    assert len(load(tmp_path, holdout=0).views) == 6


@pytest.mark.parametrize(
    "name", ["../images/r_{}.png", "../../data/set/images/r_{}.png", "../frames\\r_{}.png", "r_{}.png", "r_{}"]
)
def test_names_from_another_folder(tmp_path, name):
    """Relative to where a script ran, or without the folder."""
    write_blender(tmp_path)
    with edited_json(tmp_path / "transforms.json") as values:
        for i, frame in enumerate(values["frames"]):
            frame["file_path"] = name.format(i)
    assert len(load(tmp_path, holdout=0).views) == 6
    (tmp_path.parent / "r_0.png").write_bytes((tmp_path / "images" / "r_0.png").read_bytes())
    shutil.rmtree(tmp_path / "images")
    try:
        with pytest.raises(InputError, match="image file not found"):
            load(tmp_path)
    finally:
        (tmp_path.parent / "r_0.png").unlink()
