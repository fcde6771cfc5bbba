"""Store cameras that structure from motion found in scene.json, and find their photos again."""

from dataclasses import replace
from pathlib import Path

from sehdr_warp.runs.scene_description import describe_scene
from sehdr_warp.scene.lens import Lens

from ..training.toy import toy_scene


def test_photos_of_one_name_in_several_folders_are_told_apart():
    """Cameras number photos anew in each folder of a card, as DCIM/100CANON and DCIM/101CANON."""
    scene = toy_scene(3, 8)
    files = ("100CANON/IMG_1.JPG", "101CANON/IMG_1.JPG", "101CANON/IMG_2.JPG")
    lens = Lens("SIMPLE_PINHOLE", 8, 8, (8.0, 4.0, 4.0), Path("photos"))
    views = [replace(v, source=Path("DCIM", f), lens=lens) for v, f in zip(scene.views, files, strict=True)]
    described = describe_scene(replace(scene, views=tuple(views), format="photos"))
    assert [view["lens"]["file"] for view in described["views"]] == [*files]
