import json
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import torch

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.model.baking import field_of
from sehdr_warp.output.images.exr import write_radiance
from sehdr_warp.output.lighting import environment_map
from sehdr_warp.output.lighting.environment_map import (
    cube,
    inpainted_light,
    latlong,
    render_map,
    solid_angles,
    write_environment_map,
)
from sehdr_warp.output.world_transform import WorldTransform, world_transform
from sehdr_warp.runs.run import Splats
from sehdr_warp.scene import look_at
from sehdr_warp.scene.images.hdr_files import read_exr_channels, read_hdr
from sehdr_warp.scene.wide_camera import steradians, typical_focal_length
from sehdr_warp.splats import GaussianArrays

from ..helpers import LIGHT, Entry, camera, lamps


def read(path):
    channels, header = read_exr_channels(path)
    return np.stack([channels[name] for name in "RGB"], axis=2), channels, header


def test_a_map_has_the_light_of_small_lamps_that_photos_have(tmp_path):
    """Wherever in the photos they are: pixels at the border see less, and lamps are smoothed to pixels."""
    lamp = lamps(0.002).rows(np.array([4]))
    wide = replace(camera(size := 96, size), fx=70.0, fy=70.0, cx=size / 2, cy=size / 2)
    targets = [(x, y, 1.0) for x in np.linspace(-0.6, 0.6, 6) for y in np.linspace(-0.6, 0.6, 6)]
    cameras = [replace(wide, world_to_camera=look_at((0, 0, 0), target, up=(0, -1, 0))) for target in targets]
    run = Splats(tmp_path / "run", field_of(lamp), tuple(Entry(str(i), "train", c) for i, c in enumerate(cameras)))
    photos = [float((run.render(each).hdr[..., 2].numpy() * steradians(each)).sum()) for each in cameras]
    whole = render_map(run, np.zeros(3), 1024, "latlong", np.eye(3), typical_focal_length(cameras))
    weight = solid_angles(1024, "latlong")
    light = float((whole.hdr[..., 2] * weight).sum() * 4 * np.pi / weight.sum())
    assert light == pytest.approx(np.mean(photos), rel=0.05) and max(photos) > 1.8 * min(photos)


def test_a_map_has_openexrs_orientation(tmp_path, run):
    import OpenEXR

    write_environment_map(run, tmp_path / "env.exr", at=(0, 0, 0), size=128, axes="scene", pixel="float")
    image, channels, header = read(tmp_path / "env.exr")
    assert image.shape == (64, 128, 3) and header["envmap"] == OpenEXR.Envmap.ENVMAP_LATLONG and header["expTime"] == 1
    rows, columns = (32, 32, 0, 63, 32, 32), (32, 96, 64, 64, 64, 0)
    np.testing.assert_allclose(image[rows, columns], 0.967 * LIGHT, rtol=0.015)
    with OpenEXR.File(str(tmp_path / "env.exr"), separate_channels=True) as file:
        np.testing.assert_allclose(file.channels(1)["distance.Z"].pixels[rows, columns], 5, rtol=1e-3)
        assert file.header(1)["colorInteropID"] == "data"
    assert channels["A"][32, 48] < 0.01 and channels["A"][32, 32] > 0.93
    # Neither the wrap nor the poles show: what lies beside the edge goes on behind it.
    np.testing.assert_allclose(image[:, 0], image[:, -1], atol=1e-5)
    assert np.ptp(image[0], axis=0).max() < 1e-4


@pytest.mark.parametrize("suffix", [".exr", ".hdr"])
def test_white_is_an_exposure_that_the_file_states(tmp_path, run, suffix):
    pixel = {"pixel": "float"} if suffix == ".exr" else {}
    for name, white in (("plain", None), ("exposed", 4.0)):
        path = tmp_path / f"{name}{suffix}"
        write_environment_map(run, path, at=(0, 0, 0), size=64, reference_white=white, **pixel)
    if suffix == ".hdr":
        radiance, again = (read_hdr(tmp_path / f"{name}.hdr") for name in ("plain", "exposed"))
        head = (tmp_path / "exposed.hdr").read_bytes()[:100].decode("latin-1")
        assert float(head.split("\nEXPOSURE=")[1].split()[0]) == pytest.approx(2)
        np.testing.assert_allclose(again, radiance, rtol=0.01, atol=0.01)
    else:
        (radiance, _, _), (exposed, _, header) = (read(tmp_path / f"{name}.exr") for name in ("plain", "exposed"))
        assert header["expTime"] == pytest.approx(4 * run.base_time) == 2
        np.testing.assert_allclose(exposed, radiance * header["expTime"], rtol=1e-6)
    with pytest.raises(SehdrError, match="white 0.0 is not between"):
        write_environment_map(run, tmp_path / f"none{suffix}", reference_white=0.0)


def test_upright_maps_look_ahead_with_up_above(tmp_path, run):
    """The cameras look along +Z with -Y up, as COLMAP's often do."""
    write_environment_map(run, tmp_path / "env.exr", at="camera:1", size=128)
    image, _, header = read(tmp_path / "env.exr")
    ahead, above, left = (image[place] for place in ((32, 64), (0, 64), (32, 32)))
    np.testing.assert_allclose([ahead, above, left], 0.967 * LIGHT[[4, 3, 1]], rtol=0.015)
    np.testing.assert_allclose(json.loads(header["sehdr:mapToWorld"]), np.diag([-1.0, -1, 1]), atol=1e-9)
    world = WorldTransform.from_matrix(json.loads(header["sehdr:worldMatrix"]))
    np.testing.assert_allclose(json.loads(header["sehdr:position"]), world.points(np.zeros(3)), atol=1e-9)


def test_a_point_is_in_the_coordinates_of_exported_files(tmp_path, run):
    """A map at a place that a program measured in an exported scene, and beyond a distance in its meters."""
    import OpenEXR

    write_environment_map(run, tmp_path / "scene.exr", at=(0.4, 0.2, 1), size=64, axes="scene", beyond=0.5)
    world = world_transform(run, scale=2.0)
    at = tuple(world.points(np.array([0.4, 0.2, 1])))
    write_environment_map(run, tmp_path / "file.exr", at=at, size=64, scale=2.0, beyond=1.0)
    own, header = read(tmp_path / "scene.exr")[0], read(tmp_path / "file.exr")[2]
    np.testing.assert_allclose(json.loads(header["sehdr:position"]), at, atol=1e-9)
    assert float(header["sehdr:beyond"]) == 1
    weight = solid_angles(64, "latlong")[..., None]
    light = [(image * weight).sum(axis=(0, 1)) for image in (own, read(tmp_path / "file.exr")[0])]
    np.testing.assert_allclose(light[1], light[0], rtol=0.02)  # The same light, turned
    farthest = []
    for name in ("scene.exr", "file.exr"):
        with OpenEXR.File(str(tmp_path / name), separate_channels=True) as file:
            distance = file.channels(1)["distance.Z"].pixels
            farthest.append(distance[np.isfinite(distance)].max())
    assert farthest[1] == pytest.approx(2 * farthest[0], rel=1e-3)


def looked_at(oiio, file, directions):
    textures, options, still = oiio.TextureSystem(), oiio.TextureOpt(), (0, 0, 0)
    return np.array([textures.environment(str(file), options, ray, still, still, 3) for ray in directions.tolist()])


def decibels(one, other):
    return -10 * np.log10(np.mean(np.square(one - other)))


def test_openexrs_converter_and_openimageio_see_the_same(tmp_path, run):
    """Faces made of our lat-long by exrenvmap are our cube's, none turned or mirrored."""
    random = np.random.default_rng(0)
    places = random.normal(size=(60, 3)).astype(np.float32)
    shape = np.full((60, 3), -1.0, np.float32), random.normal(size=(60, 4)).astype(np.float32)
    colors = random.uniform(0, 3, (60, 1, 3)).astype(np.float32)
    places *= 3 / np.linalg.norm(places, axis=1, keepdims=True)
    run.field = field_of(GaussianArrays(places, *shape, np.ones(60, np.float32), colors, "linear", 0.5))
    options = {"at": (0, 0, 0), "axes": "scene", "pixel": "float"}
    write_environment_map(run, tmp_path / "env.exr", size=512, **options)
    write_environment_map(run, tmp_path / "cube.exr", size=128, layout="cube", **options)
    ours = read(tmp_path / "cube.exr")[0]
    oiio = pytest.importorskip("OpenImageIO")
    radiances = looked_at(oiio, tmp_path / "env.exr", cube(128).reshape(-1, 3)[::17])
    assert decibels(radiances, ours.reshape(-1, 3)[::17]) > 40
    if shutil.which("exrenvmap") is None:
        pytest.skip("exrenvmap is not installed")
    subprocess.run(["exrenvmap", "-c", "-w", "128", tmp_path / "env.exr", tmp_path / "theirs.exr"], check=True)
    theirs = read(tmp_path / "theirs.exr")[0].reshape(6, 128, 128, 3)
    for i, face in enumerate(ours.reshape(6, 128, 128, 3)):
        turned = [other for k in range(4) for other in (np.rot90(face, k), np.rot90(face, k)[::-1])][1:]
        others = [decibels(other, theirs[i]) for other in [*turned, *np.delete(theirs, i, axis=0)]]
        assert decibels(face, theirs[i]) > 40 > 24 > max(others)


def test_radiance_files_keep_seven_bits(tmp_path):
    image = np.float32(10.0) ** np.random.default_rng(0).uniform(-6, 6, (5, 7, 1)) * np.float32([1, 0.3, 0])
    write_radiance(tmp_path / "a.hdr", image)
    read_back = read_hdr(tmp_path / "a.hdr")
    assert (np.abs(read_back - image) <= image.max(2, keepdims=True) / 128).all()
    with pytest.raises(InputError, match="not finite"):
        write_radiance(tmp_path / "b.hdr", np.full((2, 2, 3), np.nan))


def test_radiance_files_state_their_primaries(tmp_path, run):
    for space in ("rec709", "acescg"):
        write_environment_map(run, tmp_path / f"{space}.hdr", at=(0, 0, 0), size=32, axes="scene", colorspace=space)
    plain, converted = (read_hdr(tmp_path / f"{space}.hdr") for space in ("rec709", "acescg"))
    np.testing.assert_allclose(converted, plain, atol=0.02 * plain.max())
    with pytest.raises(SehdrError, match=r"leave it out, or write \.exr"):
        write_environment_map(run, tmp_path / "a.hdr", pixel="float")


def test_unseen_directions_are_inpainted_on_request(tmp_path, run, logged):
    write_environment_map(run, tmp_path / "env.exr", at=(0, 0, 0), size=64, axes="scene")
    write_environment_map(run, tmp_path / "fill.exr", at=(0, 0, 0), size=64, axes="scene", inpaint=True)
    (plain, channels, _), (full, again, _) = read(tmp_path / "env.exr"), read(tmp_path / "fill.exr")
    np.testing.assert_array_equal(channels["A"], again["A"])
    added = (full - plain) / np.maximum(1 - channels["A"], 1e-3)[..., None]
    assert added[channels["A"] < 0.99].min() > 0.9 and added.max() < 9.1
    assert plain.min() < 1e-3 and full.min() > 0.4 and full.max() < 9.1
    share = (channels["A"] * solid_angles(64, "latlong")).sum() / solid_angles(64, "latlong").sum()
    line = f"photos cover {100 * share:.0f} % of all directions"
    assert f"env.exr: {line}; the rest is black, --inpaint" in "\n".join(logged)
    assert f"fill.exr: {line}" in logged


def test_a_lamp_beyond_what_photos_show_floods_nothing_but_a_window_lights_what_is_beside_it():
    """Photos show a wall of 1 below, and a light of 1000 alone in the upper half or at its border."""
    directions, weight = latlong(256), solid_angles(256, "latlong")
    x, y, z = np.moveaxis(directions, 2, 0)
    lamp = (x**2 + (y - 0.1) ** 2 < 0.05**2) & (z > 0)
    window = (np.abs(np.arctan2(x, z)) < 0.6) & (np.abs(y) < 0.3)
    for lit, least, most in ((lamp, 1, 40), (window, 100, 1000)):
        alpha = (lit | (y < 0)).astype(float)
        light = np.where(lit, 1000.0, 1.0)[..., None] * np.ones(3)
        filled = inpainted_light(light, alpha, directions, weight)[alpha == 0]
        assert least < filled.max() < most and filled.min() > 0.9


def test_points_and_options_that_cannot_be(tmp_path, run, logged):
    for options, words in (
        ({"at": "camera:x"}, r"'x' is not one of the scene's \(0, 1, 2"),
        ({"at": "1,2"}, "neither x,y,z nor camera:NAME nor center"),
        ({"at": "1,2,nan"}, "neither"),
        ({"at": "1e6,2e6,3e6", "scale": 2.0}, r"from \(1e\+06, 2e\+06, 3e\+06\) nothing of the scene is seen"),
        ({"size": 7}, "size 7 is not usable"),
        ({"size": "64"}, "size '64' is not usable"),
        ({"layout": "ball"}, "is not one of latlong, cube"),
        *(({"beyond": beyond}, "not a distance") for beyond in (-1.0, np.inf, np.nan)),
    ):
        with pytest.raises(SehdrError, match=words):
            write_environment_map(run, tmp_path / "a.exr", **{"size": 64, **options})
    with pytest.raises(SehdrError, match="one of .exr, .hdr"):
        write_environment_map(run, tmp_path / "a.png")
    assert list(tmp_path.iterdir()) == []
    write_environment_map(run, tmp_path / "a.exr", size=64)
    assert any("is it within the scene?" in line for line in logged)
    with pytest.raises(InputError, match="exists already"):
        write_environment_map(run, tmp_path / "a.exr", size=64)


def test_a_point_inside_of_something_is_warned_of(tmp_path, run, logged):
    """Lamps as wide as they are far, at a five hundredth of what the cameras went."""
    run.field = field_of(lamps(1.5))
    run.cameras = tuple(Entry(str(x), "train", camera(position=(x, 0, 0), target=(x, 0, 9))) for x in (-2e3, 2e3))
    write_environment_map(run, tmp_path / "a.exr", at=(0, 0, 0), size=64)
    assert any("inside of something" in line for line in logged)


def test_beyond_leaves_out_what_is_nearer(tmp_path, run):
    import OpenEXR

    near, far = lamps(), lamps()
    near.means[:] *= 0.2
    both = {name: np.concatenate([getattr(a, name) for a in (near, far)]) for name in ("means", "log_scales")}
    both["log_scales"][:6] += np.log(0.2)
    both |= {name: np.concatenate([getattr(far, name)] * 2) for name in ("quaternions", "opacity_logits", "harmonics")}
    scene = Splats(tmp_path / "run", field_of(replace(far, **both)), run.cameras)
    for name, beyond in (("all", 0.0), ("far", 2.0)):
        write_environment_map(scene, tmp_path / f"{name}.exr", at=(0, 0, 0), size=64, axes="scene", beyond=beyond)
    _, channels, header = read(tmp_path / "far.exr")
    with OpenEXR.File(str(tmp_path / "far.exr"), separate_channels=True) as file:
        distance = file.channels(1)["distance.Z"].pixels
    assert distance[channels["A"] > 0.5] == pytest.approx(5, rel=1e-3) and header["sehdr:beyond"] == "2.0"
    with OpenEXR.File(str(tmp_path / "all.exr"), separate_channels=True) as file:
        assert file.channels(1)["distance.Z"].pixels[16, 16] < 2.5


def test_directions_of_a_whole_map_are_computed_for_inpainting_alone(tmp_path, run, monkeypatch):
    """They are float64: 13 GB of a map of 32768 pixels."""
    whole, real = [], environment_map.latlong

    def latlong(size, rows=slice(None)):
        if rows == slice(None):
            whole.append(size)
        return real(size, rows)

    monkeypatch.setattr(environment_map, "latlong", latlong)
    write_environment_map(run, tmp_path / "a.exr", size=256)
    assert not whole
    write_environment_map(run, tmp_path / "b.exr", size=256, inpaint=True)
    assert 256 in whole


@pytest.mark.parametrize("layout", ["latlong", "cube"])
def test_a_small_lamp_of_hidden_gaussians_has_its_light_in_maps_of_any_size(tmp_path, layout):
    """Ten opaque Gaussians in one place, seen by photos whose pixels are much finer than the map's."""
    places = np.array([0.0, 0.0, 4.0]) + np.random.default_rng(0).normal(size=(10, 3)) * 0.01
    shape = np.full((10, 3), np.log(0.008), np.float32), np.tile(np.float32([1, 0, 0, 0]), (10, 1))
    harmonics = np.full((10, 1, 3), 1 / 0.28209479, np.float32)
    stack = GaussianArrays(places.astype(np.float32), *shape, np.full(10, 3, np.float32), harmonics, "linear", 1.0)
    scene = Splats(tmp_path / "run", field_of(stack), ())
    light = []
    for size in (512, 128, 64):
        weight = solid_angles(size, layout)
        pixels = render_map(scene, np.zeros(3), size, layout, np.eye(3), 240.0)
        light.append(float((pixels.hdr.mean(2) * weight).sum() / weight.sum()))
        assert pixels.distance.max() == pytest.approx(4, rel=0.01) and pixels.hdr.shape == (*weight.shape, 3)
    assert light[1:] == pytest.approx([light[0]] * 2, rel=0.05)


@pytest.mark.parametrize("layout", ["latlong", "cube"])
def test_maps_of_both_layouts_are_equally_fine_by_default(tmp_path, run, layout, monkeypatch):
    assert environment_map.LAYOUTS["latlong"] == 4 * environment_map.LAYOUTS["cube"]
    monkeypatch.setattr(environment_map, "LAYOUTS", {"latlong": 64, "cube": 16})
    write_environment_map(run, tmp_path / "a.exr", layout=layout)
    assert read(tmp_path / "a.exr")[0].shape[:2] == {"latlong": (32, 64), "cube": (96, 16)}[layout]


@pytest.mark.parametrize("layout", ["latlong", "cube"])
def test_bands_make_the_same_map(run, layout, monkeypatch):
    whole = render_map(run, np.zeros(3), 32, layout, np.eye(3), 20.0)
    monkeypatch.setattr(environment_map, "BAND_PIXELS", 1000)
    parts = render_map(run, np.zeros(3), 32, layout, np.eye(3), 20.0)
    for name in ("hdr", "alpha", "distance"):
        np.testing.assert_allclose(getattr(parts, name), getattr(whole, name), rtol=1e-5, atol=1e-6)
    assert whole.hdr.max() > 1


def test_shares_of_light_do_not_depend_on_the_size_of_the_map(tmp_path):
    """A coarse pixel holds a lamp and the dark beside it, whose mean may lie below the photos' white."""
    cameras = tuple(Entry(str(i), "train", camera(position=(0.1 * i, 0, 0), target=(0, 0, 9))) for i in range(3))
    run = Splats(tmp_path / "run", field_of(lamps(0.1)), cameras)
    run.clipped_share = lambda: torch.ones(6)
    shares = []
    for size in (32, 512):
        write_environment_map(run, tmp_path / f"{size}.exr", size=size, at=(0, 0, 0), axes="scene")
        shares.append(json.loads(read(tmp_path / f"{size}.exr")[2]["sehdr:lightShares"]))
    assert shares[1]["estimated"] > 0.1
    for name in ("measured", "bound", "estimated"):
        assert shares[0][name] == pytest.approx(shares[1][name], abs=0.06)
