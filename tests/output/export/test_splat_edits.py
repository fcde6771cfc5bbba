from dataclasses import replace

import numpy as np
import pytest

from sehdr_warp.errors import SehdrError
from sehdr_warp.model.visibility import mask_shares
from sehdr_warp.output.export.gaussians import export
from sehdr_warp.output.export.splat_edits import Box, Sphere, SplatEdits, read_region, without_strays
from sehdr_warp.output.scene_page import write_scene_page
from sehdr_warp.scene import Camera, View
from sehdr_warp.scene.wide_camera import solid_angles
from sehdr_warp.splats import read_gaussians

from ..helpers import camera, run_of, splats

UTM = np.array([5e5, 5.4e6, 100.0])


@pytest.fixture
def run(tmp_path):
    """Return a run with Gaussians in view of three cameras (in the middle, at the side, faint) and one behind them."""
    return run_of(tmp_path, splats([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, -20)], [0.9, 0.9, 0.002, 0.9]))


def export_means(run, path, **edits):
    export(run, path, axes="scene", edits=SplatEdits(**edits))
    return sorted(map(tuple, read_gaussians(path).means.round(3).tolist()))


def test_what_no_program_draws_is_left_out(tmp_path, run, logged):
    assert len(export_means(run, tmp_path / "a.ply")) == 3
    assert "left out: 1 Gaussians (25 %) too faint for any program to draw" in logged
    assert len(export_means(run, tmp_path / "b.ply", min_opacity=0)) == 4


def test_regions(tmp_path, run):
    assert export_means(run, tmp_path / "a.ply", crop="sphere:0,0,0,0.5") == [(0, 0, 0)]
    assert export_means(run, tmp_path / "b.ply", cut="box:-0.5,-0.5,-0.5,0.5,0.5,0.5") == [(0, 0, -20), (1, 0, 0)]
    crop, cut = "box:-2,-2,-2,2,2,2", "sphere:1,0,0,0.1"
    assert export_means(run, tmp_path / "c.ply", crop=crop, cut=cut) == [(0, 0, 0)]
    box, sphere = read_region("box:1,0,0,-1,2,3"), read_region("sphere:0,0,0,2")
    assert isinstance(box, Box) and box.low.tolist() == [-1, 0, 0] and box.high.tolist() == [1, 2, 3]
    assert isinstance(sphere, Sphere)
    assert sphere.contains(np.array([[0, 0, 1.9], [0, 0, 2.1]])).tolist() == [True, False]
    wrong = ["box:1,2,3", "sphere:0,0,0,-1", "sphere:0,0,0,nan", "ball:0,0,0,1", "box:0,0,0,0,1,1", "1,2,3", "9," * 999]
    for text in wrong:
        with pytest.raises(SehdrError, match="^region .{,90} is not box:x0,y0,z0,x1,y1,z1 or sphere"):
            SplatEdits(crop=text)


def test_the_most_visible_are_kept_and_refitted(tmp_path, logged):
    """One of two Gaussians in one place stays and becomes denser; a far one that hardly shows goes."""
    run = run_of(tmp_path, splats([(0, 0, 0), (0, 0, 0.01), (0, 0, -20)], [0.5, 0.4, 0.9], scale=0.3))
    assert export_means(run, tmp_path / "a.ply", max_gaussians=1) == [(0, 0, 0)]
    assert read_gaussians(tmp_path / "a.ply").opacities[0] > 0.55
    assert any(line.startswith("left out: 2 Gaussians that make") for line in logged)
    [page] = [write_scene_page(run, tmp_path / "a.html", edits=SplatEdits(max_gaussians=1))]
    assert page.stat().st_size < write_scene_page(run, tmp_path / "b.html").stat().st_size
    assert len(export_means(run, tmp_path / "b.ply", max_gaussians=3)) == 3
    with pytest.raises(SehdrError, match="max_gaussians 0 is below 1; give 1 or more"):
        SplatEdits(max_gaussians=0)
    run.cameras = ()
    with pytest.raises(SehdrError, match="no training cameras to measure"):
        export_means(run, tmp_path / "c.ply", max_gaussians=1)


def test_a_page_has_the_colors_of_rec709(tmp_path):
    """A run in sensor RGB, here with red and blue exchanged, gives the page of the same scene in Rec.709."""
    pages = []
    for name, colors, matrix in (
        ("sensor", (0.2, 0.4, 0.8), np.eye(3)[::-1].copy()),
        ("rec709", (0.8, 0.4, 0.2), None),
    ):
        gaussians = replace(splats([(0, 0, 0)], [0.9]), harmonics=np.float32([[colors]]))
        folder = tmp_path / name
        folder.mkdir()
        run = run_of(folder, gaussians)
        run.color_matrix = matrix
        pages.append(write_scene_page(run, folder / "s.html").read_bytes())
    assert pages[0] == pages[1]


def test_crops_are_in_upright_coordinates(tmp_path, run):
    """-Y is up in the photos, so what lies at y = 0 and x = 1 of the scene is turned about the axis of view."""
    export(run, tmp_path / "a.glb", edits=SplatEdits(crop="sphere:-1,0,0,0.3"), scale=1.0)
    [mean] = read_gaussians(tmp_path / "a.glb").means
    np.testing.assert_allclose(mean, (-1, 0, 0), atol=0.2)


def test_views_that_show_a_gaussian_are_counted(tmp_path, run, logged):
    assert export_means(run, tmp_path / "a.ply", min_views=1) == [(0, 0, 0), (1, 0, 0)]
    assert any("shown by fewer than 1 cameras" in line for line in logged)
    run.cameras = ()
    with pytest.raises(SehdrError, match="has no training cameras"):
        export(run, tmp_path / "b.ply", edits=SplatEdits(min_views=1))


def test_what_masks_show_is_kept(tmp_path, run, logged):
    """Two photos, one of them with a mask, which keeps its side of one of the two Gaussians in sight."""
    photo = run.cameras[2].camera
    places = np.array([(0, 0, 0), (1, 0, 0)]) @ photo.world_to_camera[:3, :3].T + photo.world_to_camera[:3, 3]
    columns = photo.fx * places[:, 0] / places[:, 2] + photo.cx
    nearer = np.abs(np.arange(photo.width) + 0.5 - columns[0]) < np.abs(np.arange(photo.width) + 0.5 - columns[1])
    mask = np.tile(nearer.astype(np.float32), (photo.height, 1))
    codes = np.zeros((*mask.shape, 3), np.uint8)
    views = [View(str(i), codes, photo, 1.0, "train", mask if i else None) for i in range(2)]
    assert export_means(run, tmp_path / "a.ply", mask_views=views) == [(0, 0, 0)]
    assert any("outside of the masks" in line for line in logged)
    with pytest.raises(SehdrError, match="no photo has a mask that leaves out pixels; paint masks/PHOTO.png"):
        SplatEdits(mask_views=views[:1])


def test_the_pixels_of_a_panorama_are_no_mask(tmp_path):
    """They count by solid angle; what lies overhead or below stays unless a painted mask leaves it out."""
    places = [(0, 5, 0), (0, -5, 0), (5, 0, 0), (0, 0, -5)]
    scene = run_of(tmp_path, splats(places, [0.98] * 4, scale=0.5))
    lens = Camera(128, 64, 20.4, 20.4, 64.0, 32.0, np.eye(4), "equirectangular")
    angles = solid_angles(lens)
    photo = View("a", np.zeros((64, 128, 3), np.uint8), lens, 1.0, "train", angles)
    with pytest.raises(SehdrError, match="no photo has a mask"):
        SplatEdits(mask_views=[photo])
    ahead = np.float32(np.arange(128) >= 64)  # Right of the axis
    painted = replace(photo, mask=angles * np.maximum(ahead, np.float32(np.arange(64) < 16)[:, None]))
    # Up is -y of the camera, and behind is half left of the axis.
    np.testing.assert_allclose(mask_shares(scene.field, [painted]), [0.5, 1, 1, 0.5], atol=0.05)


def test_edits_that_leave_nothing_say_where_the_scene_is_before_colors_are_fitted(tmp_path, run, logged):
    with pytest.raises(
        SehdrError, match=r"leave no Gaussian; the scene lies at .* in the coordinates of these regions"
    ):
        export(run, tmp_path / "a.ply", edits=SplatEdits(crop="sphere:99,0,0,1"))
    with pytest.raises(SehdrError, match="leave no Gaussian"):
        export(run, tmp_path / "a.ply", exposure_time=9.0, edits=SplatEdits(cut="box:-99,-99,-99,99,99,99"))
    assert not (tmp_path / "a.ply").exists() and not any(line.startswith("fitting") for line in logged)
    export(run, tmp_path / "a.ply", exposure_time=9.0)
    assert any(line.startswith("fitting") for line in logged)
    for options in ({"min_opacity": 1.0}, {"min_opacity": -0.1}, {"min_views": -1}):
        with pytest.raises(SehdrError, match=next(iter(options))):
            SplatEdits(**options)


def test_strays_come_near_or_go(logged):
    cameras = [camera(position=(i - 1, 0, -6)) for i in range(3)]
    original = splats([(0, 0, 0), (0, 0, 1e5), (0, 1e6, 0)], [0.9, 0.9, 0.007], scale=10.0)
    result = without_strays(original, cameras)
    assert result.count == 2 and np.abs(result.means).max() < 700
    # As seen from the middle camera it has the size and the place that it had.
    offset = result.means[1] - cameras[1].position
    assert np.exp(result.log_scales[1, 0]) / np.linalg.norm(offset) == pytest.approx(10 / 1e5, rel=1e-3)
    assert any("2 Gaussians beyond" in line and "1 faint ones left out, 1 moved" in line for line in logged)
    # In UTM coordinates float32 would move every Gaussian by up to 0.25 m.
    utm = replace(original, means=original.means + UTM)
    there = [camera(position=UTM + np.array((i - 1, 0, -6)), target=UTM) for i in range(3)]
    moved = without_strays(utm, there).means - UTM
    np.testing.assert_allclose(moved[0], 0, atol=1e-9)
    np.testing.assert_allclose(moved[1], result.means[1], rtol=1e-6)
    near = splats([(0, 0, 0), (5, 5, 5)], [0.9, 0.9])
    assert without_strays(near, cameras) is near and without_strays(original, []) is original
