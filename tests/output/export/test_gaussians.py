import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.model.baking import field_of, gaussians_of
from sehdr_warp.model.paged_field import PagedField
from sehdr_warp.output.export.gaussians import export
from sehdr_warp.output.images.display import display_gain, encode_srgb
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.run import Splats, load_splats
from sehdr_warp.scene import load_cameras
from sehdr_warp.splats import read_gaussians
from tests.splats.samples import LOSSY_SUFFIXES, gaussians, write_ply

from ..helpers import Entry, camera


@pytest.fixture
def run(tmp_path):
    cameras = [Entry(str(i), "train", camera(position=(i, 0, -6))) for i in range(3)]
    return Splats(tmp_path / "run", field_of(gaussians(degree=1)), tuple(cameras))


def test_suffix_and_kind_decide(tmp_path, run, logged):
    for name, kind, color_model in (("a.ply", None, "display"), ("b.ply", "hdr", "log"), ("c.glb", None, "display")):
        assert export(run, tmp_path / name, kind=kind, degree=3) == tmp_path / name
        read = read_gaussians(tmp_path / name)
        assert (read.color_model, read.degree, read.count) == (color_model, 3, 50)
    assert "b.ply: 50 Gaussians, harmonics of degree 3, scene-linear radiance" in logged
    assert "kept: 120.0 dB against the scene at 0 EV, 120.0 dB at -4 EV, in 3 views (no visible loss)" in logged
    assert sum(line.startswith("kept:") for line in logged) == 3


def test_exposure_of_display_colors(tmp_path, run, logged, device):
    run.field.to(device)
    export(run, tmp_path / "a.ply")
    export(run, tmp_path / "b.ply", exposure_time=2.0)
    shares = [float(line.split()[1]) for line in logged if line.startswith("kept:")]
    assert len(shares) == 2 and min(shares) > 30
    assert [read_gaussians(tmp_path / name).base_time for name in ("a.ply", "b.ply")] == [0.5, 2.0]
    means = [load_splats(tmp_path / name).render_ldr(camera()).mean() for name in ("a.ply", "b.ply")]
    expected = [run.render_ldr(camera(), time).mean() for time in (0.5, 2.0)]
    np.testing.assert_allclose(means, expected, rtol=0.05)
    export(run, tmp_path / "dark.ply", exposure_time=0.125)
    light = [each.render(camera()).hdr.mean() for each in (load_splats(tmp_path / "dark.ply"), run)]
    np.testing.assert_allclose(*light, rtol=0.1)


def test_own_display_colors_are_fitted_at_another_exposure(tmp_path, logged):
    cameras = [Entry(str(i), "train", camera(position=(i, 0, -6))) for i in range(3)]
    colors = gaussians(degree=1).with_colors(np.zeros((50, 4, 3), np.float32), "display")
    run = Splats(tmp_path / "run", field_of(colors), tuple(cameras))
    export(run, tmp_path / "a.ply", exposure_time=run.base_time)
    assert not any(line.startswith("fitting colors and opacities") for line in logged)
    export(run, tmp_path / "b.ply", exposure_time=4 * run.base_time)
    assert any(line.startswith("fitting colors and opacities") for line in logged)


def test_colors_of_other_primaries_are_shown_as_srgb(tmp_path, run, logged):
    """A clip in logarithmic codes and its own primaries: viewers take what is exported for sRGB in Rec.709."""
    run.color_matrix = np.array([[0.9, 0.1, 0], [0.05, 0.9, 0.05], [0, 0.1, 0.9]])
    run.field.response = run.response = response_by_name("colour:S-Log3")
    view = run.cameras[1].camera
    exported = load_splats(export(run, tmp_path / "a.ply", exposure_time=0.02))
    gain = display_gain(run.response)
    assert exported.base_time == pytest.approx(0.02 * gain) and not 0.9 < gain < 1.1
    light = encode_srgb(run.render(view).hdr.numpy() * 0.02 * gain)
    assert np.abs(exported.render_ldr(view).numpy() - light).mean() < 0.02
    assert exported.render(view).hdr.numpy().mean() == pytest.approx(run.render(view).hdr.numpy().mean(), rel=0.1)
    assert any("display colors of 1/50 s" in line for line in logged)
    baked = gaussians_of(run.field, "display", np.zeros((1, 3)), 0.02 * gain, run.color_matrix)
    assert np.abs(field_of(baked).render_ldr(view).numpy() - light).mean() < 0.05, "the fit starts from sRGB"


def test_cameras_beside_are_read_again(tmp_path, run):
    export(run, tmp_path / "a.ply", kind="hdr", cameras=True, axes="scene")
    first = json.loads((tmp_path / "a.ply.cameras.json").read_text())[1]
    assert set(first) == {"id", "img_name", "width", "height", "position", "rotation", "fy", "fx", "cx", "cy"}
    splats = load_splats(tmp_path / "a.ply")
    for entry, original in zip(splats.cameras, run.cameras, strict=True):
        np.testing.assert_allclose(entry.camera.world_to_camera, original.camera.world_to_camera, atol=1e-9)
        assert (entry.camera.cx, entry.camera.cy) == (original.camera.cx, original.camera.cy), "photos off center"
    assert [name for name, _ in load_cameras(tmp_path / "a.ply.cameras.json")] == ["0", "1", "2"]
    (tmp_path / "b.ply.cameras.json").write_text("mine")
    with pytest.raises(InputError, match=r"cameras.json: exists already"):
        export(run, tmp_path / "b.ply", cameras=True)
    assert not (tmp_path / "b.ply").exists()
    export(splats, tmp_path / "a.ply", overwrite=True, axes=None)
    assert len(load_splats(tmp_path / "a.ply").cameras) == 3, "a file that is edited in place keeps its cameras"
    export(run, tmp_path / "a.ply", overwrite=True)
    assert not (tmp_path / "a.ply.cameras.json").exists(), "these cameras would see other coordinates"
    (tmp_path / "a.ply.cameras.json").write_text("mine")
    export(run, tmp_path / "a.ply", overwrite=True)
    assert (tmp_path / "a.ply.cameras.json").read_text() == "mine"


def test_cameras_are_of_one_file_and_not_of_another_with_its_stem(tmp_path, run):
    """A PLY is turned over and a GLB is not: cameras of one would see the other upside down."""
    export(run, tmp_path / "a.ply", cameras=True)
    export(run, tmp_path / "a.glb")
    assert load_splats(tmp_path / "a.glb").cameras == () and len(load_splats(tmp_path / "a.ply").cameras) == 3


def test_a_scene_that_does_not_fit_into_the_device_is_exported_as_light_alone(tmp_path, run, logged):
    run.field = PagedField(run.field, torch.device("cpu"), 10**9)
    with pytest.raises(SehdrError, match="does not fit into cpu.* or kind hdr in a .ply"):
        export(run, tmp_path / "a.ply")
    export(run, tmp_path / "a.ply", kind="hdr")
    assert any(line.startswith("kept: 120.0 dB against the scene at 0 EV") for line in logged)


def test_panoramas_are_not_among_the_pinholes_beside_a_file(tmp_path, run, logged):
    panorama = replace(camera(64, 32), fx=1.0, fy=1.0, projection="equirectangular")
    run = Splats(run.path, run.field, (*run.cameras, Entry("around", "train", panorama)))
    export(run, tmp_path / "a.ply", cameras=True)
    assert [name for name, _ in load_cameras(tmp_path / "a.ply.cameras.json")] == ["0", "1", "2"]
    assert any("a.ply.cameras.json: without around" in line for line in logged)
    run.cameras = run.cameras[-1:]
    with pytest.raises(SehdrError, match="none that is a pinhole, to write"):
        export(run, tmp_path / "b.ply", cameras=True)
    assert not (tmp_path / "b.ply").exists()


def test_unusable_requests(tmp_path, run):
    for name, options, words in (
        ("a.ply", {"kind": "sdr"}, "'sdr' is not one of ldr, hdr"),
        ("a.ply", {"exposure_time": 0}, "exposure time 0 is not"),
        ("a.ply", {"exposure_time": "1/125"}, "exposure time '1/125' is not"),
        ("a.ply", {"edits": {"min_views": 2}}, "edits is a dict, expected SplatEdits"),
        ("a.ply", {"kind": "hdr", "exposure_time": 1}, "has no exposure time"),
        ("a.ply", {"degree": 4}, "degree 4"),
        ("a.glb", {"kind": "hdr"}, "knows display colors only"),
        ("a.usdc", {"kind": "ldr"}, "is tagged as scene-linear"),
        ("a.splat", {}, "a.splat: .splat is not read or written here: it holds 8 bits and no harmonics"),
    ):
        with pytest.raises((SehdrError, TypeError), match=words):
            export(run, tmp_path / name, **options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", LOSSY_SUFFIXES)
def test_what_a_small_file_loses_is_measured_on_the_file(tmp_path, run, logged, suffix):
    export(run, tmp_path / f"a{suffix}", exposure_time=0.25)
    [line] = [line for line in logged if line.startswith("compressed:")]
    size = (tmp_path / f"a{suffix}").stat().st_size
    assert "compared with the scene (" in line and line.endswith(f"{size / 1e6:.2f} MB")
    assert float(line.split()[1]) > 25


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".spz", ".sog", "/lod-meta.json"])
def test_the_mark_of_opacity_compensation_passes_through_a_conversion(tmp_path, suffix):
    for name, mode in (("mip", "mip"), ("common", "default")):
        scene = load_splats(write_ply(tmp_path / f"{name}.ply", [f"SplatRenderMode: {mode}"]))
        assert scene.field.antialiased == (mode == "mip")
        file = export(scene, tmp_path / f"{name}_new{suffix}")
        assert read_gaussians(file).antialiased == (mode == "mip")
