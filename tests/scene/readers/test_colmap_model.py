"""COLMAP's models: where they are found, and text as other tools write it."""

import shutil

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.scene.readers.colmap import read_colmap
from sehdr_warp.scene.readers.colmap_model import find_model
from tests.make_scenes import load, pattern, write_colmap, write_photos

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


def test_of_folders_with_the_names_of_a_model_the_one_with_fewest_others_counts(tmp_path):
    """Photos of several captures are all called 1.jpg, 2.jpg ..."""
    write_colmap(tmp_path, name="{:03d}.png")
    (tmp_path / "images").rename(tmp_path / "scene")
    for first, folder in enumerate(("another", "yet_another")):
        write_photos(tmp_path / folder, [f"{i:03d}.png" for i in range(first, 9)], (64, 48), 20 + first)
    assert {record.image.parent.name for record in read_colmap(tmp_path).records} == {"scene"}
    for photo in (tmp_path / "scene").iterdir():
        shutil.copy(photo, tmp_path)
    write_photos(tmp_path, ["cover.png"], (64, 48), 30)
    assert {record.image.parent for record in read_colmap(tmp_path).records} == {tmp_path}


def test_the_largest_model_is_used_and_the_others_are_named(tmp_path):
    write_colmap(tmp_path, 9, binary=True)
    (tmp_path / "sparse" / "0").rename(tmp_path / "sparse" / "1")
    write_colmap(tmp_path / "few", 3)
    shutil.move(tmp_path / "few" / "sparse" / "0", tmp_path / "sparse" / "0")
    assert find_model(tmp_path) == tmp_path / "sparse" / "1"
    scene = load(tmp_path)
    assert len(scene.views) == 9
    assert "sparse/1 is used, the largest model (9 images); not used: 0 (3 images)" in scene.notes


@pytest.mark.parametrize("file", ["points3D.txt", "points3D.bin", "points3D.ply"])
def test_an_empty_file_of_points_has_none(tmp_path, file):
    """COLMAP asks for one where poses are known and points are not."""
    write_colmap(tmp_path)
    for path in (tmp_path / "sparse" / "0").glob("points3D.*"):
        path.unlink()
    (tmp_path / "sparse" / "0" / file).write_bytes(b"")
    assert len(load(tmp_path).points) == 0


def test_points_whose_color_is_no_number_are_left_out(tmp_path, caplog):
    write_colmap(tmp_path)
    for path in (tmp_path / "sparse" / "0").glob("points3D.*"):
        path.unlink()
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "red", "green", "blue"))
    header = f"ply\nformat ascii 1.0\nelement vertex 2\n{properties}end_header\n"
    (tmp_path / "sparse" / "0" / "points3D.ply").write_text(f"{header}1 2 3 0.5 0.5 0.5\n4 5 6 nan 0 0\n")
    assert load(tmp_path).points.tolist() == [[1, 2, 3]]
    assert "1 of 2 points are not finite" in caplog.text


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


@pytest.mark.parametrize("lines", ["blank", "none", "mixed", "observations"])
def test_images_with_and_without_lines_of_observations(tmp_path, lines):
    write_colmap(tmp_path, 10)
    path = tmp_path / "sparse" / "0" / "images.txt"
    images = [line for line in path.read_text().splitlines() if line.endswith(".png")]
    second = {"blank": lambda i: "\n", "none": lambda i: "", "mixed": lambda i: "\n" * (i % 2),
              "observations": lambda i: "1.5 2.5 -1 3.25 4 7\n"}[lines]  # fmt: skip
    path.write_text("# comment\n" + "".join(f"{line}\n{second(i)}" for i, line in enumerate(images)))
    assert len(load(tmp_path).views) == 10


def test_text_models_as_other_tools_write_them(tmp_path):
    """Names with spaces and brackets, CRLF, a byte order mark, and exponents of three digits."""
    write_colmap(tmp_path, name="A DJI [1] ({:03d}).png")
    for file in (tmp_path / "sparse" / "0").glob("*.txt"):
        text = file.read_text().replace("e-1", "e-01").replace("e-0", "e-00").replace("\n", "\r\n")
        file.write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert len(load(tmp_path, holdout=0).views) == 6
