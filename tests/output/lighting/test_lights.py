"""Files of lights: what they hold, read by OpenUSD, and that they light as the scene does."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from sehdr_warp.errors import InputError, SehdrError, UsageError
from sehdr_warp.model.baking import field_of
from sehdr_warp.output.commands import Lights, WorldOptions, run_lights
from sehdr_warp.output.lighting.environment_map import latlong, solid_angles, write_environment_map
from sehdr_warp.output.lighting.lights import lights_table, write_lights
from sehdr_warp.output.world_transform import world_transform
from sehdr_warp.runs.run import Splats
from sehdr_warp.scene import Camera, look_at
from sehdr_warp.scene.images.hdr_files import read_exr_channels, read_hdr
from sehdr_warp.splats import GaussianArrays

from ..helpers import LIGHTS, PANEL, Entry


@pytest.fixture
def run(lit):
    return lit


def test_json_has_every_figure(tmp_path, run):
    assert write_lights(run, tmp_path / "lights.json", axes="scene") == [tmp_path / "lights.json"]
    lights_file = json.loads((tmp_path / "lights.json").read_text())
    first, second = lights_file["lights"]
    assert first["position"] == [1.0, 0.5, 2.0] and first["size"] == [0.4, 0.2] and first["shape"] == "rect"
    assert first["radiance"] == pytest.approx([8, 4, 2]) and first["lower_bound"] == [1, 1, 1]
    assert first["deviation_stops"] == 0.4 and second["deviation_stops"] is None
    assert lights_file["lit_place"] == pytest.approx([0, 0, 0])
    assert (first["share_of_light"], second["shape"]) == (0.5, "sphere") and "Rec.709" in lights_file["units"]


def test_usd_lights_stand_and_shine_as_the_scene_s(tmp_path, run):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom, UsdLux

    run.scene_name = 'Café "1"'
    files = write_lights(run, tmp_path / "lights.usda", axes="scene")
    assert files == [tmp_path / "lights.usda", tmp_path / "lights_rest.exr"]
    stage = Usd.Stage.Open(str(files[0]))
    assert stage.GetRootLayer().customLayerData["sehdr:scene"] == run.scene_name
    panel = UsdLux.RectLight(stage.GetPrimAtPath("/Lights/light_0"))
    ball = UsdLux.SphereLight(stage.GetPrimAtPath("/Lights/light_1"))
    color = np.array(panel.GetColorAttr().Get()) * panel.GetIntensityAttr().Get()
    assert color == pytest.approx([8, 4, 2]) and not panel.GetNormalizeAttr().Get()
    assert (panel.GetWidthAttr().Get(), panel.GetHeightAttr().Get()) == pytest.approx((0.4, 0.2))
    assert ball.GetRadiusAttr().Get() == pytest.approx(0.15)
    matrix = np.array(UsdGeom.Xformable(panel).ComputeLocalToWorldTransform(0))
    assert matrix[3, :3] == pytest.approx([1, 0.5, 2])
    # USD's rectangles emit along -Z, and no light is mirrored.
    assert np.array([0, 0, -1, 0]) @ matrix == pytest.approx([0, 0, -1, 0])
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1)
    root = stage.GetDefaultPrim()
    assert root.GetAttribute("sehdr:units").Get() == "relative radiance, linear Rec.709"
    assert np.array(root.GetAttribute("sehdr:worldMatrix").Get()) == pytest.approx(np.eye(4))
    dome = UsdLux.DomeLight(stage.GetPrimAtPath("/Lights/Rest"))
    assert (
        dome.GetTextureFileAttr().Get().path == "./lights_rest.exr" and dome.GetTextureFormatAttr().Get() == "latlong"
    )


def test_the_map_of_the_rest_lacks_the_lights_and_nothing_else(tmp_path, run):
    write_lights(run, tmp_path / "lights.usda", axes="scene", unseen="black")
    image = read_hdr(tmp_path / "lights_rest.exr")
    run.find_lights = list
    write_lights(run, tmp_path / "a@b.usda", axes="scene", unseen="black")
    assert "= @@@./a@b_rest.exr@@@\n" in (tmp_path / "a@b.usda").read_text(), "paths with @ have their own quotes"
    whole = read_hdr(tmp_path / "a@b_rest.exr")
    directions = latlong(1024)
    for index, axis in enumerate(np.concatenate([np.eye(3), -np.eye(3)])[[0, 3, 1, 4, 2, 5]]):
        place = np.unravel_index(np.argmax(directions @ axis), directions.shape[:2])
        expected = 0 if index < 3 else whole[place]
        assert image[place] == pytest.approx(expected, abs=1e-3) and whole[place].max() > 1


def test_a_sphere_around_the_place_stays_in_the_map(tmp_path, run, logged):
    """A ceiling that clips becomes a sphere as wide as the room, which lights nothing within it."""
    inside = (0.0, 0.0, 2.9)
    write_lights(run, tmp_path / "all.usda", axes="scene", at=inside, unseen="black")
    line = "light_1: the place that is lit lies within the sphere: "
    assert f"{line}its light stays in the map of the rest" in logged
    text = (tmp_path / "all.usda").read_text()
    assert '"light_0"' in text and '"light_1"' not in text
    names = [row["name"] for row in rows_of(run, tmp_path / "all.json", at=inside)]
    assert names == ["light_0", "light_1"] and f"{line}a sphere lights nothing within" in logged
    run.find_lights = lambda: LIGHTS[:1]
    write_lights(run, tmp_path / "first.usda", axes="scene", at=inside, unseen="black")
    with_ball, first = (read_hdr(tmp_path / f"{name}_rest.exr") for name in ("all", "first"))
    assert with_ball.max() > 1
    np.testing.assert_array_equal(with_ball, first)


def test_unseen_directions_of_the_map_have_the_light_around_them(tmp_path, run, logged):
    write_lights(run, tmp_path / "lights.usda", axes="scene")
    channels, header = read_exr_channels(tmp_path / "lights_rest.exr")
    matrix = world_transform(run, "scene").matrix
    np.testing.assert_allclose(json.loads(header["sehdr:worldMatrix"]), matrix)
    filled, alpha = np.stack([channels[name] for name in "RGB"], axis=2), channels["A"]
    assert "photos cover 6 % of all directions; filled in: " in (line := logged[-1])
    share = float(re.search(r"sehdr:inpaintedShare = (\S+)", (tmp_path / "lights.usda").read_text())[1])
    assert f"{100 * share:.0f} % of the map's light" in line and share > 0.5
    write_lights(run, tmp_path / "dark.usda", axes="scene", unseen="black")
    dark = read_hdr(tmp_path / "dark_rest.exr")
    assert "sehdr:inpaintedShare = 0.0" in (tmp_path / "dark.usda").read_text()
    unseen, visible = alpha == 0, alpha > 0.98
    assert not dark[unseen].any() and filled[visible] == pytest.approx(dark[visible], rel=0.05, abs=0.2)
    # The three lamps that are lights are dark in the map, and do not darken what is filled in around them.
    lit = dark[dark.mean(2) > 1]
    assert filled[unseen].min() > 0.5 * lit.min() and filled[unseen].max() < 1.01 * lit.max()


def test_a_line_names_a_place_from_which_nothing_is_visible(tmp_path, run, monkeypatch, logged):
    monkeypatch.undo()
    write_lights(run, tmp_path / "a.json", axes="scene")
    assert "nothing of the scene" not in "\n".join(logged)
    assert re.fullmatch(
        r"from \(0, 0, 0\) only [1-9]\.\d % of all directions are seen: is it within the scene\?", logged[0]
    )
    write_lights(run, tmp_path / "b.json", axes="scene", at=(-1e-17, 0, 0), beyond=1e6)
    write_lights(run, tmp_path / "c.json", axes="scene", at=(1e5, 0, 0))
    near, far = (line for line in logged if "nothing of the scene is seen" in line)
    assert "from (0, 0, 0) " in near and near.endswith(" or a smaller --beyond")
    assert "from (1e+05, 0, 0) " in far and far.endswith("camera:NAME)")


def test_the_map_is_taken_where_an_object_stands(tmp_path, run):
    run.find_lights = list
    place = {"at": (0.5, 0.2, 1.0), "beyond": 4.3, "axes": "scene"}  # One lamp is nearer.
    write_lights(run, tmp_path / "lights.usda", unseen="black", **place)
    rest = read_hdr(tmp_path / "lights_rest.exr")
    write_environment_map(run, tmp_path / "env.exr", size=1024, **place)
    np.testing.assert_allclose(rest, read_hdr(tmp_path / "env.exr"), rtol=2e-3, atol=1e-4)
    headers = [read_exr_channels(tmp_path / name)[1] for name in ("lights_rest.exr", "env.exr")]
    for key in ("position", "axes", "beyond", "mapToWorld", "worldMatrix"):
        assert headers[0][f"sehdr:{key}"] == headers[1][f"sehdr:{key}"], key
    write_lights(run, tmp_path / "center.usda", unseen="black", axes="scene")
    assert np.abs(read_hdr(tmp_path / "center_rest.exr") - rest).max() > 1
    with pytest.raises(SehdrError, match=r"\.json has none; write \.usda"):
        write_lights(run, tmp_path / "lights.json", unseen="black")
    with pytest.raises(UsageError, match="--at, --beyond: set for a file"):
        run_lights(Lights(run=run.path, at="0,0,1", beyond=1.0))
    with pytest.raises(UsageError, match="--unseen: set for a file"):
        run_lights(Lights(run=run.path, unseen="black"))


def scene_of(tmp_path, places, light, widths):
    """Opaque Gaussians with radiance [N, 3] and standard deviations [N, 3], of which photos clip those above 1."""
    turns = np.tile(np.float32([1, 0, 0, 0]), (len(places), 1))
    harmonics = (light[:, None] / 0.28209479).astype(np.float32)
    opacity, scales = np.full(len(places), 6, np.float32), np.float32(np.log(widths))
    field = field_of(GaussianArrays(np.float32(places), scales, turns, opacity, harmonics, "linear", 1.0))
    # Photos from both sides of the origin.
    eyes = [(x, y, 0.0) for x in (-1.5, -1.0, 1.0, 1.5) for y in (-0.6, 0.6)]
    poses = [look_at(eye, (0, 0, 4), up=(0, -1, 0)) for eye in eyes]
    photos = [Camera(160, 120, 100.0, 100.0, 80.0, 60.0, pose) for pose in poses]
    run = Splats(tmp_path / "run", field, tuple(Entry(str(i), "train", each, 1.0) for i, each in enumerate(photos)))
    run.clipped_share = lambda: torch.from_numpy(np.float32(light[:, 0] > 1))
    return run


def rows_of(run, file, **options):
    """The lights that a file of a scene has."""
    write_lights(run, file, axes="scene", overwrite=True, **options)
    return json.loads(file.read_text())["lights"]


def test_lamps_that_a_sensor_clips_in_all_channels_are_white_in_files(tmp_path):
    run = scene_of(tmp_path, np.array([[2.0, 0, 4], [-2.0, 0, 4]]), np.full((2, 3), 300.0), np.full((2, 3), 0.06))
    run.color_matrix = np.linalg.inv([[0.5, 0.1, 0.0], [0.1, 0.8, 0.1], [0.0, 0.2, 0.4]])
    rows = rows_of(run, tmp_path / "lights.json", at=(0.0, 0.0, 0.0))
    for light, row in zip(run.find_lights(), rows, strict=True):
        assert row["radiance"] == pytest.approx(light.radiance, rel=0.03)
        assert row["radiance"] == pytest.approx([row["radiance"][0]] * 3, rel=1e-3)


def test_lights_nearer_than_beyond_give_nothing_wherever_they_face(tmp_path):
    panel = np.stack(np.meshgrid(np.arange(-0.3, 0.31, 0.1), np.arange(-0.2, 0.21, 0.1), [4.0]), 3).reshape(-1, 3)
    run = scene_of(tmp_path, panel, np.full(panel.shape, 300.0), np.tile([0.06, 0.06, 0.005], (len(panel), 1)))
    for place in ((0.0, 0.0, 3.0), (0.0, 0.0, 5.0)):  # Before and behind the panel
        (far,) = rows_of(run, tmp_path / "lights.json", at=place)
        (near,) = rows_of(run, tmp_path / "lights.json", at=place, beyond=2.0)
        assert far["shape"] == "rect" and far["radiance"] == pytest.approx([300] * 3, rel=0.1)
        assert near["radiance"] == near["lower_bound"] == [0, 0, 0]


def test_lights_and_rest_light_a_place_as_its_map_does(tmp_path):
    """Two lamps; a screen hides one from the place that is lit, though the photos show it."""
    screen = np.stack(np.meshgrid(np.arange(0.7, 1.5, 0.05), np.arange(-0.4, 0.4, 0.05), [2.0]), 3).reshape(-1, 3)
    places = np.concatenate([[[2.0, 0, 4]], [[-2.0, 0, 4]], screen])
    light = np.concatenate([np.full((2, 3), (300.0, 200.0, 100.0)), np.full(screen.shape, 0.2)])
    run = scene_of(tmp_path, places, light, np.where(light > 1, 0.06, 0.04))
    listed = run.find_lights()
    assert len(listed) == 2 and listed[0].shape.position[0] < 0 and listed[1].share < 0.05 * listed[0].share
    assert listed[1].radiance == pytest.approx(listed[0].radiance, rel=0.3)
    place = np.zeros(3)
    write_lights(run, tmp_path / "lights.json", axes="scene", at=(0.0, 0.0, 0.0))
    rows = json.loads((tmp_path / "lights.json").read_text())["lights"]
    angle = solid_angles(512, "latlong")[..., None] * 4 * np.pi / solid_angles(512, "latlong").sum()
    options = {"focal_length": 100.0, "pixel_angle": 2 * np.pi / 2048}
    directions = latlong(2048).astype(np.float32)
    for light, row in zip(listed, rows, strict=True):
        images = [
            run.render_directions(place, directions, without=members, **options).hdr.numpy()
            for members in ([], [light.members])
        ]
        lost = ((images[0] - images[1]).reshape(256, 4, 512, 4, 3).mean((1, 3)) * angle).sum((0, 1))
        assert (np.array(row["lower_bound"]) <= row["radiance"]).all()
        assert np.array(row["radiance"]) * light.shape.solid_angle(place) == pytest.approx(lost, rel=0.1, abs=1e-3)


@pytest.mark.parametrize("bound, remedy", [(1.0, "3 stops darker"), (4.0, "1 stop darker"), (9.0, "1 stop darker")])
def test_uncertain_lights_are_named_with_their_remedy(bound, remedy):
    """Photos so dark that the strongest lights, of up to 8, are below their white."""
    glint = replace(LIGHTS[1], deviation=3.0, share=0.01, radiance=np.full(3, 900.0))
    table = lights_table([replace(LIGHTS[0], deviation=0.6, lower_bound=np.full(3, bound)), LIGHTS[1], glint])
    assert table.splitlines()[-1].startswith("light_0, light_2: uncertain by more than 0.5 stops")
    assert f"three photos about {remedy} than the darkest that clip there" in table
    lamp = replace(LIGHTS[1], deviation=3.0, share=0.0, radiance=np.full(3, 64 * bound), lower_bound=np.full(3, bound))
    table = lights_table([replace(LIGHTS[0], deviation=0.6, lower_bound=np.full(3, bound)), lamp])
    assert "three photos about 6 stops darker than" in table, "a lamp that photos walk around is the one that is meant"
    table = lights_table([replace(light, deviation=0.6, measured=1.0) for light in LIGHTS])
    assert "three photos" not in table and "light_0, light_1: the scene differs by more than 0.5 stops" in table


def test_what_cannot_be_written_is_refused(tmp_path, run):
    with pytest.raises(SehdrError, match="choose a suffix"):
        write_lights(run, tmp_path / "lights.txt")
    with pytest.raises(SehdrError, match="unseen 'grey' is not one of inpaint, black"):
        write_lights(run, tmp_path / "lights.usda", unseen="grey")
    for beyond in (-1.0, np.nan):
        with pytest.raises(SehdrError, match=f"beyond {beyond:g} is not a distance"):
            write_lights(run, tmp_path / "lights.json", beyond=beyond)
        with pytest.raises(SehdrError, match=f"beyond {beyond:g} is not a distance"):
            run_lights(Lights(run=tmp_path / "no run", out=tmp_path / "lights.json", beyond=beyond))
    (tmp_path / "lights_rest.exr").write_text("mine")
    with pytest.raises(InputError, match="lights_rest.exr"):
        write_lights(run, tmp_path / "lights.usda")
    assert not (tmp_path / "lights.usda").exists()


def test_a_scene_without_lights_says_so(run, capsys, monkeypatch):
    monkeypatch.setattr("sehdr_warp.output.commands.open_run", lambda *_: run)
    run.find_lights = list
    run_lights(Lights(run=run.path))
    assert capsys.readouterr().out == "no lights: no area that photos clip emits light\n"


def test_lights_are_listed_where_files_have_them(run, capsys, monkeypatch):
    monkeypatch.setattr("sehdr_warp.output.commands.open_run", lambda *_: run)
    run_lights(Lights(run=run.path, world=WorldOptions(axes="scene")))
    table = capsys.readouterr().out
    assert "(1, 0.5, 2), 0.4 x 0.2" in table and "measure them" not in table
    write_lights(run, run.path.with_name("lights.json"))
    rows = json.loads(run.path.with_name("lights.json").read_text())["lights"]
    assert [line.split()[0] for line in table.splitlines()[1:]] == [row["name"] for row in rows]
    run_lights(Lights(run=run.path, world=WorldOptions(scale=10.0)))
    place = ", ".join(f"{value:.3g}" for value in world_transform(run, scale=10.0).points(PANEL.position))
    assert f"({place}), 4 x 2" in capsys.readouterr().out
