"""Store cameras that structure from motion found in scene.json, and find their photos again."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.runs.run_folder import RunFolder
from sehdr_warp.runs.scene_description import (
    changed_photos,
    describe_scene,
    in_world_of_run,
    photo_signature,
    scene_difference,
)
from sehdr_warp.scene.lens import Lens

from ..found_cameras import TURN, in_other_world
from ..training.toy import toy_scene


def test_photos_of_one_name_in_several_folders_stay_apart():
    """Cameras number photos anew in each folder of a card, as DCIM/100CANON and DCIM/101CANON."""
    scene = toy_scene(3, 8)
    files = ("100CANON/IMG_1.JPG", "101CANON/IMG_1.JPG", "101CANON/IMG_2.JPG")
    lens = Lens("SIMPLE_PINHOLE", 8, 8, (8.0, 4.0, 4.0), Path("photos"))
    views = [replace(v, source=Path("DCIM", f), lens=lens) for v, f in zip(scene.views, files, strict=True)]
    described = describe_scene(replace(scene, views=tuple(views), format="photos"))
    assert [view["lens"]["file"] for view in described["views"]] == [*files]


def test_cameras_that_differ_by_rounding_are_the_same():
    """Processors invert matrices with other last digits, and a run is resumed on another machine."""
    scene = toy_scene(3, 8)
    saved = describe_scene(scene)

    def moved(part):
        first, *others = scene.views
        pose = first.camera.world_to_camera.copy()
        pose[:3, 3] *= 1 + part
        view = replace(first, camera=replace(first.camera, world_to_camera=pose))
        return describe_scene(replace(scene, views=(view, *others)))

    assert moved(1e-15) != saved and scene_difference(saved, moved(1e-15)) is None
    assert scene_difference(saved, moved(1e-9)).what == "cameras"
    del saved["views"][0]["camera"]["world_to_camera"]
    assert scene_difference(saved, describe_scene(scene)).what == "cameras"


def test_a_world_that_is_turned_moved_and_scaled_as_a_whole_gets_the_poses_of_the_run():
    """Structure from motion turns the world by chance; one camera that moved, turned or zoomed is named."""
    scene = toy_scene(6, 8)
    cameras = {view.name: view.camera for view in scene.views}
    views = [replace(view, camera=in_other_world(view.camera)) for view in scene.views]
    points = 3 * scene.points @ TURN.T + [1, 2, 3]
    other_world = replace(scene, views=tuple(views), points=points)
    aligned = in_world_of_run(other_world, cameras, 4.0, "run", "photos")
    for view in aligned.views:
        np.testing.assert_array_equal(view.camera.world_to_camera, cameras[view.name].world_to_camera)
    np.testing.assert_allclose(aligned.points, scene.points, atol=1e-12)
    assert in_world_of_run(scene, cameras, 4.0, "run", "photos") is scene
    del cameras[scene.views[-1].name]  # A photo that was added since is placed in the world of the run.
    added = in_world_of_run(other_world, cameras, 4.0, "run", "photos").views[-1].camera
    np.testing.assert_allclose(added.world_to_camera, scene.views[-1].camera.world_to_camera, atol=1e-12)
    first = views[0].camera
    moved, turned = first.world_to_camera.copy(), first.world_to_camera.copy()
    moved[:3, 3] += 0.5
    turned[:3, :3] = turned[:3, :3] @ TURN
    turned[:3, 3] = -turned[:3, :3] @ first.position
    zoom = {"fx": 1.01 * first.fx, "fy": 1.01 * first.fy}
    zoomed = replace(scene.views[0], camera=replace(scene.views[0].camera, **zoom))  # In the world of the run
    problem, remedy = "1 of 5 photos have other cameras than run was trained with: v_0", "cameras and max_size of then"
    with pytest.raises(InputError, match=f"{problem}; use the photos, {remedy}"):
        in_world_of_run(replace(scene, views=(zoomed, *scene.views[1:])), cameras, 4.0, "run", "photos")
    changes = [{"world_to_camera": moved}, {"world_to_camera": turned}, zoom]
    for change in changes:
        changed = replace(views[0], camera=replace(first, **change))
        with pytest.raises(InputError, match="of 5 photos have other cameras than run was trained with: v_0"):
            in_world_of_run(replace(scene, views=(changed, *views[1:])), cameras, 4.0, "run", "photos")


def test_photos_that_were_changed_are_noticed(run):
    scene = toy_scene(2, 8)
    folder = RunFolder(run)
    folder.check_same_scene(scene)
    changed = [view.codes.copy() for view in scene.views]
    changed[0][:3, :3] = 255 - changed[0][:3, :3]
    views = tuple(replace(view, codes=codes) for view, codes in zip(scene.views, changed, strict=True))
    with pytest.raises(
        InputError, match=f"photos or masks were changed since the training began: {scene.views[0].name};"
    ):
        folder.check_same_scene(replace(scene, views=views))


@pytest.mark.parametrize("part, change", [("splits", {"split": "test"}), ("exposure times", {"exposure_time": 9.0})])
def test_what_differs_from_the_scene_of_a_run_is_named(run, part, change):
    scene = toy_scene(2, 8)
    changed = replace(scene, views=(replace(scene.views[0], **change), *scene.views[1:]))
    with pytest.raises(InputError, match=f"its {part} differ.* if another version decided"):
        RunFolder(run).check_same_scene(changed)


def test_masks_that_were_changed_are_noticed(run):
    scene = toy_scene(2, 8)
    mask = np.ones(scene.views[0].codes.shape[:2], np.float32)
    masked = replace(scene, views=tuple(replace(view, mask=mask) for view in scene.views))
    with pytest.raises(InputError, match="photos or masks were changed"):
        RunFolder(run).check_same_scene(masked)
    ones, half = (photo_signature(scene.views[0].codes, mask * part) for part in (1, 0.5))
    assert changed_photos({"a": ones}, {"a": half}) == ["a"] and not changed_photos({"a": ones}, {"a": ones})


def test_a_signature_forgives_rounding_alone():
    rng = np.random.default_rng(3)
    for shape, kind in (((31, 45, 3), np.uint8), ((3, 2, 3), np.uint8), ((300, 20, 3), np.uint16)):
        codes = rng.integers(0, np.iinfo(kind).max, shape).astype(kind)
        other = np.clip(codes.astype(int) + rng.integers(-1, 2, shape), 0, np.iinfo(kind).max).astype(kind)
        assert not changed_photos({"a": photo_signature(codes)}, {"a": photo_signature(other)})
        assert changed_photos({"a": photo_signature(codes)}, {"a": photo_signature(codes[::-1])}) == ["a"]
    assert changed_photos({"a": "no digits", "b": "00"}, {"a": "00", "c": "00"}) == ["a"]
