"""Several scenes as one: what it shows, in whose colors and coordinates."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sehdr_warp.errors import SehdrError
from sehdr_warp.output.export.gaussians import export
from sehdr_warp.output.export.splat_edits import SplatEdits
from sehdr_warp.output.merged_scene import merge_scenes
from sehdr_warp.output.scene_page import write_scene_page
from sehdr_warp.output.world_transform import world_transform
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.run import load_splats
from sehdr_warp.scene.dataparser import UNPLACED, PlacedPhoto
from sehdr_warp.scene.normalization import Normalization
from sehdr_warp.splats.arrays import HARMONIC_0

from .helpers import run_of, splats


@pytest.fixture
def run(tmp_path):
    return run_of(tmp_path, splats([(0, 0, 0), (1, 0, 0)], [0.9, 0.9]))


def other_of(tmp_path, color_model="display", value=0.5, **fields):
    gaussians = splats([(-1, 0, 0)], [0.9]).with_colors(np.full((1, 1, 3), value), color_model)
    return run_of(tmp_path, replace(gaussians, **fields), "other")


def test_both_scenes_are_rendered_as_they_were(tmp_path, run):
    other = other_of(tmp_path)
    merged, view = merge_scenes(run, other), run.cameras[1].camera
    assert merged.gaussian_count == 3 and [entry.name for entry in merged.cameras] == list("012012")
    alone = [each.render_ldr(view) for each in (run, other)]
    torch.testing.assert_close(merged.render_ldr(view), torch.maximum(*alone), atol=2e-3, rtol=0)


@pytest.mark.parametrize("color_model", ["log", "linear"])
def test_light_of_other_color_models_and_exposures_is_kept(tmp_path, run, color_model):
    other = other_of(tmp_path, color_model, 0.25, base_time=8.0)
    merged, view = merge_scenes(run, other), run.cameras[1].camera
    assert merged.base_time == run.base_time == 1
    left = torch.as_tensor(other.render(view).alpha) > 0.5
    of_merged, own = (torch.as_tensor(each.render(view).hdr)[left] for each in (merged, other))
    torch.testing.assert_close(of_merged, own, rtol=0.02, atol=1e-4)
    # Codes became light: sRGB's of 0.5 and the harmonic.
    light = ((0.5 + 0.5 * HARMONIC_0 + 0.055) / 1.055) ** 2.4
    fitted = torch.exp(HARMONIC_0 * merged.field.gaussians.harmonics_dc[:2])
    torch.testing.assert_close(fitted, torch.full_like(fitted, light), rtol=1e-3, atol=0)


def test_codes_of_two_responses_are_merged_as_light(tmp_path, run):
    other = other_of(tmp_path)
    other.field.response = other.response = response_by_name("gamma-2.2")
    merged = merge_scenes(run, other)
    assert merged.field.color_model.name == "log" and merged.response.name == run.response.name


def test_a_file_that_was_turned_upright_is_turned_back(tmp_path, run):
    part = run_of(tmp_path, splats([(-1, 0, 0), (0, 2, 0)], [0.9, 0.9]), "part")
    transform = world_transform(part, scale=3.0)
    export(part, tmp_path / "upright.ply", scale=3.0, cameras=True)
    upright = load_splats(tmp_path / "upright.ply")
    merged = merge_scenes(run, upright)
    np.testing.assert_allclose(merged.field.gaussians.means[2:], [(-1, 0, 0), (0, 2, 0)], atol=1e-5)
    np.testing.assert_allclose(merged.cameras[3].camera.position, part.cameras[0].camera.position, atol=1e-5)
    # And the other way round, all of it is where the file is.
    back = merge_scenes(upright, run)
    turned = transform.points(np.array([(1.0, 0, 0)])) * (-1, -1, 1)  # PLY has -Y up.
    np.testing.assert_allclose(back.field.gaussians.means[-1:], turned, atol=1e-5)


def test_the_first_scene_decides_what_is_up(tmp_path, run):
    other = other_of(tmp_path)
    other.cameras = run.cameras[:1]
    np.testing.assert_array_equal(world_transform(merge_scenes(run, other)).matrix, world_transform(run).matrix)


def test_confidence_and_clipping_are_joined_if_all_state_them(tmp_path, run):
    other = other_of(tmp_path)
    run.field.confidence, run.clipped_share = torch.tensor([0.5, 1.0]), lambda: torch.tensor([0.0, 1.0])
    merged = merge_scenes(run, other)
    assert merged.field.confidence is None and merged.clipped_share() is None
    with pytest.raises(SehdrError, match="what the photos clipped"):
        merged.find_lights()
    other.field.confidence, other.clipped_share = torch.tensor([0.25]), lambda: torch.tensor([0.75])
    merged = merge_scenes(run, other)
    assert merged.field.confidence.tolist() == [0.5, 1, 0.25] and merged.clipped_share().tolist() == [0, 1, 0.75]


def test_normalized_fields_meet_in_scene_coordinates(tmp_path, run):
    other = other_of(tmp_path)
    other.field.normalization = Normalization(np.array([4.0, 0, 0]), 2.0)
    np.testing.assert_allclose(merge_scenes(run, other).field.gaussians.means[2], (2, 0, 0), atol=1e-6)


def test_scenes_with_and_without_compensation_are_refused(tmp_path, run):
    other = other_of(tmp_path)
    other.field.antialiased = True
    with pytest.raises(SehdrError, match=r"s\.ply: is rendered without opacity compensation"):
        merge_scenes(other, run)


def test_views_of_all_scenes_count(tmp_path, run):
    other = other_of(tmp_path)
    other.cameras, run.cameras = run.cameras[:1], run.cameras[1:2]
    merged = merge_scenes(run, other)
    export(merged, tmp_path / "both.ply", axes="scene", edits=SplatEdits(min_views=2))
    assert load_splats(tmp_path / "both.ply").gaussian_count == 3


def test_a_page_holds_both(tmp_path, run, logged):
    write_scene_page(merge_scenes(run, other_of(tmp_path)), tmp_path / "both.html")
    assert any("both.html: 3 Gaussians" in line for line in logged)


@pytest.mark.parametrize("second, warned", [("same", False), ("turned", True), ("others", True), ("stated", False)])
def test_scenes_whose_cameras_were_found_apart_are_named(tmp_path, run, caplog, second, warned):
    """Each structure from motion has coordinates of its own, unless a photo is in the same place."""

    def placed(entry, file=None):
        pose = entry.camera.world_to_camera @ np.diag([-1.0, 1, -1, 1] if second == "turned" and file else [1.0] * 4)
        return replace(entry, placed=PlacedPhoto(file or entry.name, UNPLACED, pose, "train", 1.0))

    other = other_of(tmp_path)
    names = {entry.name: f"x{entry.name}" if second == "others" else entry.name for entry in run.cameras}
    other.cameras = run.cameras if second == "stated" else tuple(placed(each, names[each.name]) for each in run.cameras)
    run.cameras = tuple(placed(entry) for entry in run.cameras)
    merge_scenes(run, other)
    assert ("were found apart, so their coordinates differ" in caplog.text) == warned


def test_a_list_of_scenes_is_refused(run):
    with pytest.raises(
        TypeError, match=r"a list is not what sehdr_warp.load_run\(\) returns; pass its items one by one"
    ):
        merge_scenes([run, run])
