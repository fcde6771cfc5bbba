"""Scenes and views."""

from sehdr_warp.scene import load_scene


def test_scenes_views_and_cameras_print_in_one_line():
    scene = load_scene("embedded", max_size=32)
    view = scene.views[0]
    assert repr(scene) == "Scene('embedded', hdr-nerf, 27 views of 32 x 32, 18 to train)"
    assert repr(view) == "View('train_r_0', 32 x 32, train, 0.5 s)"
    assert repr(view.camera).startswith("Camera(32 x 32, focal length 32.8") and "\n" not in repr(view.camera)
