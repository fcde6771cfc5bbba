"""COLMAP sets against pycolmap; test_bad_scenes and fuzz hold what damaged or hostile ones get."""

import shutil

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError
from sehdr_warp.scene.dataparser import reinhard_gamma
from sehdr_warp.scene.lens import CAMERA_MODELS
from sehdr_warp.scene.load import parse_dataset
from sehdr_warp.scene.readers.bare_photos import find_photos
from sehdr_warp.scene.readers.colmap import model_fits, read_colmap
from sehdr_warp.scene.readers.colmap_model import find_model
from tests.make_scenes import arc_poses, load, pattern, write_blender, write_colmap

pycolmap = pytest.importorskip("pycolmap")


@pytest.mark.parametrize("binary", [False, True])
def test_model_is_what_pycolmap_wrote(tmp_path, binary):
    write_colmap(tmp_path, binary=binary)
    oracle = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    scene = load(tmp_path)
    assert scene.format == "colmap" and [view.name for view in scene.views] == [f"{i:03d}" for i in range(6)]
    by_name = {image.name: image for image in oracle.images.values()}
    for view in scene.views:
        expected = np.eye(4)
        expected[:3] = by_name[f"{view.name}.png"].cam_from_world().matrix()
        np.testing.assert_allclose(view.camera.world_to_camera, expected, atol=1e-12)
        np.testing.assert_array_equal(view.camera.intrinsics, (50, 52, 30, 25))
        np.testing.assert_array_equal(view.image, pattern(64, 48, int(view.name)).astype(np.float32) / np.float32(255))
    cloud = {tuple(point.xyz): tuple(point.color) for point in oracle.points3D.values()}
    assert {tuple(p): tuple(np.round(c * 255)) for p, c in zip(scene.points, scene.point_colors, strict=True)} == cloud


@pytest.mark.parametrize(
    "place", ["sparse", "sparse/txt", "sparse_txt", "sparse_txt/0", "colmap/sparse/0", "dense/sparse"]
)
def test_models_are_found_where_people_keep_them(tmp_path, place):
    write_colmap(tmp_path, binary=False)
    model = (tmp_path / "sparse" / "0").rename(tmp_path / "model")
    (tmp_path / "sparse").rmdir()
    (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
    model.rename(tmp_path / place)
    assert find_model(tmp_path) == tmp_path / place and load(tmp_path).format == "colmap"


@pytest.mark.parametrize(
    "place, photos",
    [
        (".", "images"),
        (".", "Images"),
        ("model", "images"),
        ("model", "input"),
        ("Sparse/0", "images"),
        ("Sparse/0", "."),
    ],
)
def test_models_and_photos_are_found_in_other_folders_by_the_names_of_the_photos(tmp_path, place, photos):
    write_colmap(tmp_path, name="{:03d}.png")
    model = (tmp_path / "sparse" / "0").rename(tmp_path / "before")
    (tmp_path / "sparse").rmdir()
    images = (tmp_path / "images").rename(tmp_path / "photos_before")
    for source, target in ((model, tmp_path / place), (images, tmp_path / photos)):
        target.mkdir(parents=True, exist_ok=True)
        for file in source.iterdir():
            file.rename(target / file.name)
        source.rmdir()
    scene = load(tmp_path, holdout=0)
    assert scene.format == "colmap" and len(scene.views) == 6


def test_of_folders_with_the_names_of_a_model_the_one_with_fewest_others_counts(tmp_path):
    """Photos of several captures are all called 1.jpg, 2.jpg ..."""
    write_colmap(tmp_path, name="{:03d}.png")
    (tmp_path / "images").rename(tmp_path / "scene")
    for i in range(9):
        for folder in ("another", "yet_another")[: 2 if i else 1]:
            (tmp_path / folder).mkdir(exist_ok=True)
            Image.fromarray(pattern(64, 48, 20 + i)).save(tmp_path / folder / f"{i:03d}.png")
    assert {record.image.parent.name for record in read_colmap(tmp_path).records} == {"scene"}
    for photo in (tmp_path / "scene").iterdir():
        shutil.copy(photo, tmp_path)
    Image.fromarray(pattern(64, 48, 30)).save(tmp_path / "cover.png")
    assert {record.image.parent for record in read_colmap(tmp_path).records} == {tmp_path}


def test_a_model_that_names_none_of_the_photos_is_not_used_and_named(tmp_path):
    write_colmap(tmp_path / "old")
    (tmp_path / "old" / "images").rename(tmp_path / "elsewhere")
    for file in (tmp_path / "elsewhere").iterdir():
        file.rename(tmp_path / f"photo_{file.name}")
    (tmp_path / "elsewhere").rmdir()
    dataset = find_photos(tmp_path)
    assert dataset.notes == ("the COLMAP model in old/sparse/0 names none of these photos and is not used",)
    assert not model_fits(tmp_path, tmp_path / "old" / "sparse" / "0")


@pytest.mark.parametrize("place", ["sparse/0", "sparse"])
def test_a_model_without_cameras_is_named(tmp_path, place):
    write_colmap(tmp_path)
    (tmp_path / "sparse" / "0").rename(tmp_path / "model")
    (tmp_path / place).mkdir(parents=True, exist_ok=True)
    (tmp_path / "model" / "images.txt").rename(tmp_path / place / "images.txt")
    shutil.rmtree(tmp_path / "model")
    note = f"{place} is not read, because it has no cameras.bin or cameras.txt: cameras are found anew"
    assert find_photos(tmp_path).notes == (note,)


def test_a_model_without_its_photos_is_named(tmp_path):
    write_colmap(tmp_path)
    with pytest.raises(InputError, match="is a COLMAP model without photos; give the folder that holds it and images/"):
        load(tmp_path / "sparse" / "0")


def test_a_list_beside_the_model_states_the_held_out_photos(tmp_path):
    write_colmap(tmp_path)
    (tmp_path / "sparse" / "0" / "test.txt").write_text("004.png\r\n001.png\r\n\r\n")
    splits = {view.name: view.split for view in load(tmp_path).views}
    assert [name for name, split in splits.items() if split == "test"] == ["001", "004"] and len(splits) == 6
    assert {view.split for view in load(tmp_path, holdout=0).views} == {"train"}


def test_photos_of_a_kind_that_is_not_read_are_named_beside_a_model(tmp_path):
    write_colmap(tmp_path)
    for photo in (tmp_path / "images").iterdir():
        photo.rename(photo.with_suffix(".jxl"))
    with pytest.raises(
        InputError, match=r"none .* is here .*; files of kinds that are not read: 6 JXL \(000.jxl ...\)"
    ):
        load(tmp_path)


@pytest.mark.parametrize("file", ["points3D.txt", "points3D.bin", "points3D.ply"])
def test_an_empty_file_of_points_has_none(tmp_path, file):
    """COLMAP asks for one where poses are known and points are not."""
    write_colmap(tmp_path)
    for path in (tmp_path / "sparse" / "0").glob("points3D.*"):
        path.unlink()
    (tmp_path / "sparse" / "0" / file).write_bytes(b"")
    assert len(load(tmp_path).points) == 0


def test_text_models_of_scripts(tmp_path):
    """Indented comments, sizes and colors as floats, models in lower case."""
    write_colmap(tmp_path)
    images, cameras = (tmp_path / "sparse" / "0" / f"{name}.txt" for name in ("images", "cameras"))
    images.write_text("  # by a script\n" + images.read_text().replace(" ", "\t"))
    cameras.write_text("\t# by a script\n" + cameras.read_text().replace("PINHOLE 64 48", "pinhole 64.0 48.0"))
    points = tmp_path / "sparse" / "0" / "points3D.txt"
    before = load(tmp_path).point_colors
    points.write_text(points.read_text().replace(" 255 0 ", " 255.0 0.0 "))
    scene = load(tmp_path, holdout=0)
    assert [view.camera.width for view in scene.views] == [64] * 6 and np.array_equal(scene.point_colors, before)
    cameras.write_text(cameras.read_text().replace("64.0", "64.5"))
    with pytest.raises(InputError, match="line 4 is not a camera|line 5 is not a camera"):
        load(tmp_path)


def test_every_camera_model_has_pycolmaps_id_and_parameters():
    for number, (name, count) in CAMERA_MODELS.items():
        camera = pycolmap.Camera.create_from_model_name(1, name, 500.0, 64, 48)
        assert int(camera.model) == number and len(camera.params) == count


@pytest.mark.parametrize(
    "model, params, scale",
    [
        ("OPENCV", (50, 52, 30, 25, -0.1, 0.02, 1e-3, -2e-3), 1),
        ("SIMPLE_RADIAL", (50, 32, 24, -0.15), 1),
        ("SIMPLE_RADIAL", (500, 320, 240, -0.15), 8),
        ("FULL_OPENCV", (50, 52, 30, 25, -0.1, 0.02, 1e-3, -2e-3, 0.01, 0.02, 0, 0), 1),
        ("OPENCV_FISHEYE", (40, 40, 32, 24, 0.01, 0, 0, 0), 1),
        ("FOV", (50, 50, 32, 24, 0.4), 1),
    ],
)
def test_distortion_is_undone_where_pycolmap_projects(tmp_path, model, params, scale):
    """A photo that shows its own pixel places must, undistorted, show where pycolmap projects the rays: within
    the codes' precision, or within a quarter of a final pixel where it is averaged to an eighth before it is bent."""
    width, height = 64 * scale, 48 * scale
    write_colmap(tmp_path, model=model, params=params, size=(width, height))
    places = np.stack([*np.meshgrid(np.arange(width), np.arange(height)), np.zeros((height, width))], axis=2)
    step = 1 if scale == 1 else width / 255
    for i in range(6):
        Image.fromarray((places / step + 0.5).astype(np.uint8)).save(tmp_path / "images" / f"{i:03d}.png")
    view = load(tmp_path, max_size=None if scale == 1 else width // scale, response="linear").views[2]
    camera, lens = view.camera, pycolmap.Camera(model=model, width=width, height=height, params=list(params))
    rows, columns = np.mgrid[2 : camera.height - 2 : 3, 2 : camera.width - 2 : 3].reshape(2, -1)
    rays = np.stack([(columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy, 0 * rows + 1.0], 1)
    colors = view.image[rows, columns, :2] * 255 * step + 0.5
    np.testing.assert_allclose(colors, lens.img_from_cam(rays), atol=0.02 if scale == 1 else 2)
    pinhole = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), lens)
    if scale == 1:
        assert (camera.width, camera.height) == (pinhole.width, pinhole.height)
        np.testing.assert_allclose(camera.intrinsics, pinhole.params, rtol=1e-9)


def test_stored_pixels_or_turned_ones_as_the_camera_size_says(tmp_path):
    for name, size in (("stored", (64, 48)), ("turned", (48, 64))):
        write_colmap(tmp_path / name, size=size)
        for i in range(6):
            exif = Image.Exif()
            exif[0x0112] = 6
            Image.fromarray(pattern(64, 48, i)).save(tmp_path / name / "images" / f"{i:03d}.png", exif=exif)
    stored, turned = (load(tmp_path / name).views[1].image for name in ("stored", "turned"))
    np.testing.assert_array_equal(np.rot90(stored, -1), turned)


def test_images_of_another_shape_than_the_camera_are_left_out(tmp_path):
    write_colmap(tmp_path)
    for i in range(3):
        Image.fromarray(pattern(60, 48)).save(tmp_path / "images" / f"{3 + i:03d}.png")
    expected = "3 of 6 photos cannot be used and were left out (003.png: image is 60 x 48, its camera 64 x 48; "
    assert any(note.startswith(expected) for note in load(tmp_path).notes)
    Image.fromarray(pattern(60, 48)).save(tmp_path / "images" / "000.png")
    with pytest.raises(InputError, match=r"000.png: image is 60 x 48, its camera 64 x 48"):
        load(tmp_path)


def test_photos_are_not_looked_for_behind_links_out_of_the_set(tmp_path):
    write_colmap(tmp_path / "set")
    images = tmp_path / "set" / "images"
    images.rename(tmp_path / "private")
    images.mkdir()
    (images / "a").symlink_to(tmp_path / "private")
    with pytest.raises(InputError, match="none of the model's 6 images is here"):
        read_colmap(tmp_path / "set")


@pytest.mark.parametrize("size", [(26, 19), (200, 150)])
def test_images_of_any_size_with_the_shape_of_the_camera(tmp_path, size):
    write_colmap(tmp_path)
    for i in range(6):
        Image.fromarray(pattern(*size, i)).save(tmp_path / "images" / f"{i:03d}.png")
    camera = load(tmp_path).views[0].camera
    assert (camera.width, camera.height) == size
    assert camera.fx == pytest.approx(50 * size[0] / 64) and camera.cy == pytest.approx(25 * size[1] / 48)


@pytest.mark.parametrize("names, place", [("cam1/{:03d}.png", "."), ("{:03d}.png", "cam1")])
def test_photos_that_were_sorted_into_a_folder_or_out_of_it(tmp_path, names, place):
    """3DGS looks for file names alone, so its users' sets are without the folders of the model's names."""
    write_colmap(tmp_path, name=names)
    images = tmp_path / "images"
    (images / place).mkdir(exist_ok=True)
    (images / "masks").mkdir()
    for photo in sorted(images.rglob("*.png")):
        photo.rename(images / place / photo.name)
    dataset = read_colmap(tmp_path)
    assert [record.image for record in dataset.records] == [images / place / f"{i:03d}.png" for i in range(6)]
    model = tmp_path / "sparse" / "0" / "images.txt"
    model.write_text(model.read_text().replace("001.png", "other/000.png"))
    with pytest.raises(InputError, match="none of the model's 6 images is here"):
        read_colmap(tmp_path)  # Which of two photos of one name is there, nobody knows.


def test_files_of_a_model_of_two_kinds(tmp_path):
    write_colmap(tmp_path, binary=True)
    write_colmap(tmp_path / "text", binary=False)
    model = tmp_path / "sparse" / "0"
    (model / "images.bin").unlink()
    with pytest.raises(
        InputError, match=r"0: has cameras.bin, but no images.bin or images.txt; copy the whole model, or remove its"
    ):
        load(tmp_path)
    (tmp_path / "text" / "sparse" / "0" / "images.txt").rename(model / "images.txt")
    assert len(load(tmp_path, holdout=0).views) == 6


def test_photos_beside_undistorted_copies(tmp_path):
    """COLMAP's dense/ holds a model with its own images, gaussian-splatting issue 964 asks for them."""
    write_colmap(tmp_path)
    (tmp_path / "dense").mkdir()
    (tmp_path / "sparse" / "0").rename(tmp_path / "dense" / "sparse")
    (tmp_path / "images").rename(tmp_path / "dense" / "images")
    (tmp_path / "sparse").rmdir()
    (tmp_path / "images").mkdir()
    for i in range(6):
        Image.fromarray(pattern(70, 52, i)).save(tmp_path / "images" / f"{i:03d}.png")
    view = load(tmp_path, holdout=0).views[0]
    assert view.source == tmp_path / "dense" / "images" / "000.png" and view.camera.width == 64


def test_undistorted_copies_count_where_no_photos_lie_beside_the_model(tmp_path):
    """COLMAP's automatic_reconstructor leaves sparse/0 and dense/0 in its workspace, and the photos elsewhere."""
    write_colmap(tmp_path)
    shutil.copytree(tmp_path / "sparse" / "0", tmp_path / "dense" / "0" / "sparse")
    (tmp_path / "images").rename(tmp_path / "dense" / "0" / "images")
    scene = load(tmp_path, holdout=0)
    assert scene.views[0].source == tmp_path / "dense" / "0" / "images" / "000.png" and len(scene.views) == 6
    assert "sparse/0 has no photos; cameras are those of dense/0/sparse, and photos lie beside it" in scene.notes


@pytest.mark.parametrize("copies", [False, True])
def test_what_3dgs_convert_leaves_before_it_undistorts(tmp_path, copies):
    """Its convert.py keeps photos in input/ and their model in distorted/; images/ and sparse/0 may not be there."""
    write_colmap(tmp_path, model="SIMPLE_RADIAL", params=(50.0, 32.0, 24.0, 0.1))
    (tmp_path / "images").rename(tmp_path / "input")
    (tmp_path / "distorted").mkdir()
    (tmp_path / "sparse").rename(tmp_path / "distorted" / "sparse")
    if copies:  # Undistorted, of another size: the model is not theirs.
        (tmp_path / "images").mkdir()
        for i in range(6):
            Image.fromarray(pattern(58, 44, i)).save(tmp_path / "images" / f"{i:03d}.png")
    scene = load(tmp_path, holdout=0)
    assert scene.format == "colmap" and len(scene.points) == 5
    assert {view.source.parent.name for view in scene.views} == {"input"}


def test_undistorted_copies_of_3dgs_convert_are_used_if_they_are_whole(tmp_path):
    write_colmap(tmp_path)
    shutil.copytree(tmp_path / "sparse", tmp_path / "distorted" / "sparse")
    shutil.copytree(tmp_path / "images", tmp_path / "input")
    assert {view.source.parent.name for view in load(tmp_path, holdout=0).views} == {"images"}


def test_link_out_of_the_folder_is_refused(tmp_path):
    write_colmap(tmp_path / "set")
    secret = tmp_path / "secret.png"
    (tmp_path / "set" / "images" / "000.png").rename(secret)
    (tmp_path / "set" / "images" / "000.png").symlink_to(secret)
    with pytest.raises(InputError, match="by a link; copy what it links to"):
        load(tmp_path / "set")


def test_the_folder_of_photos_may_be_a_link(tmp_path):
    """Photos may lie on another disk; what the model names stays inside that folder."""
    write_colmap(tmp_path / "set")
    (tmp_path / "set" / "images").rename(tmp_path / "photos")
    (tmp_path / "set" / "images").symlink_to(tmp_path / "photos")
    assert len(load(tmp_path / "set").views) == 6


def test_hdr_gs_layout(tmp_path):
    write_colmap(tmp_path, name="{}_1.png")
    (tmp_path / "exr").mkdir()
    import OpenEXR

    truth = {}
    for i in range(6):
        truth[i] = np.random.default_rng(i).random((48, 64, 3)).astype(np.float32) + 0.1
        with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"RGB": truth[i]}) as file:
            file.write(str(tmp_path / "exr" / f"{i}.exr"))
        for k, seconds in enumerate((0.125, 0.5, 2, 8, 32)):
            code = (reinhard_gamma(truth[i] * seconds) * 255 + 0.5).astype(np.uint8)
            Image.fromarray(code).save(tmp_path / "images" / f"{i}_{k}.png")
    scene = load(tmp_path, exposure_index=3)
    assert scene.format == "hdr-gs" and [view.name for view in scene.test_views] == ["1", "3", "5"]
    assert {view.exposure_time for view in scene.views} == {8.0}
    for i, view in enumerate(scene.views):
        np.testing.assert_array_equal(view.hdr, truth[i])
        np.testing.assert_allclose(view.image, reinhard_gamma(truth[i] * 8), atol=0.5 / 255 + 1e-6)
        np.testing.assert_allclose(view.camera.world_to_camera, arc_poses(6)[i], atol=1e-12)


def test_a_model_elsewhere_makes_no_hdr_gs_set(tmp_path):
    write_blender(tmp_path)
    write_colmap(tmp_path / "other")
    (tmp_path / "other" / "sparse" / "0").rename(tmp_path / "model")
    shutil.rmtree(tmp_path / "other")
    (tmp_path / "exr").mkdir()
    for i in range(6):
        shutil.copy(tmp_path / "images" / f"r_{i}.png", tmp_path / "images" / f"v{i}_0.png")
        (tmp_path / "exr" / f"v{i}.exr").touch()
    assert parse_dataset(tmp_path).format == "transforms"


def test_alpha_keeps_pixels_out(tmp_path):
    write_colmap(tmp_path)
    alpha = np.full((48, 64, 1), 255, np.uint8)
    alpha[:12] = 0
    Image.fromarray(np.concatenate([pattern(64, 48, 1), alpha], 2)).save(tmp_path / "images" / "001.png")
    scene = load(tmp_path)
    assert scene.views[1].mask[:12].max() == 0 and scene.views[1].mask[12:].min() == 1
    np.testing.assert_array_equal(scene.views[1].image, pattern(64, 48, 1).astype(np.float32) / np.float32(255))
    assert scene.views[2].mask is None
    assert "transparency: 1 of 6 photos have transparent pixels, which are left out" in scene.notes
