"""Files hold the low-pass filter of the photos in their sizes, so that lamps keep their light in other programs."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sehdr_warp.errors import InputError
from sehdr_warp.model.baking import field_of
from sehdr_warp.model.pixel_filter import FocalRange, photo_axes
from sehdr_warp.output.export.gaussians import export
from sehdr_warp.output.merged_scene import merge_scenes
from sehdr_warp.runs.run import Splats, load_splats
from sehdr_warp.splats import read_gaussians, write_gaussians
from tests.output.helpers import splats
from tests.splats.samples import LOSSY_SUFFIXES

from ..output.helpers import Entry, camera

VIEW = camera(96, 72)
LOSSLESS_SUFFIXES = (".ply", ".glb", ".usdc")
COLORS = {".usdc": "linear"}


@pytest.fixture
def run(tmp_path):
    """Lamps of a fifth of a pixel, of photos of 96 x 72 pixels."""
    places = np.random.default_rng(0).uniform(-1, 1, (60, 3)) * (0.9, 0.6, 0.5)
    lamps = replace(splats(places, np.full(60, 0.6), scale=0.012), color_model="display", photo_focals=(40.0, 40.0))
    lamps.harmonics[:, 0] = 0.9
    entries = tuple(Entry(str(x), "train", camera(96, 72, position=(x, 0, -3))) for x in (-0.5, 0.0, 0.5))
    return Splats(tmp_path / "run", field_of(lamps), entries)


def as_other_programs_read(path, monkeypatch):
    """Return what a file holds for a program that does not know of the filter."""
    with monkeypatch.context() as patch:
        patch.setattr("sehdr_warp.splats.arrays.GaussianArrays.without_filter", lambda gaussians, _: gaussians)
        return replace(read_gaussians(path), photo_focals=None, filters=None)


def light(gaussians, scale, antialiased):
    field = field_of(replace(gaussians, antialiased=antialiased))
    return float(field.render_ldr(VIEW.resized(round(96 * scale), round(72 * scale))).mean())  # Viewers add colors


@pytest.mark.parametrize("suffix", [".ply", ".glb", *LOSSY_SUFFIXES])
def test_lamps_keep_their_light_in_other_programs(tmp_path, run, monkeypatch, suffix):
    file = export(run, tmp_path / f"lamps{suffix}", axes="scene")
    gaussians = as_other_programs_read(file, monkeypatch)
    gaussians = replace(gaussians, base_time=run.base_time)  # SPZ does not state it.
    trained = float(run.render_ldr(VIEW).mean())
    plain = replace(read_gaussians(export(run, tmp_path / "plain.ply", axes="scene")), photo_focals=None)
    assert light(plain, 4, antialiased=False) < 0.2 * trained, "what happens without"
    for scale in (1, 2, 4):
        assert light(gaussians, scale, antialiased=True) == pytest.approx(trained, rel=0.06)
    assert light(gaussians, 2, antialiased=False) == pytest.approx(1.25 * trained, rel=0.06)
    assert light(gaussians, 4, antialiased=False) == pytest.approx(trained, rel=0.08)


@pytest.mark.parametrize("suffix", [*LOSSLESS_SUFFIXES, ".sog"])
def test_the_program_reads_the_gaussians_of_the_training(tmp_path, run, suffix):
    scene = load_splats(export(run, tmp_path / f"a{suffix}", axes="scene"))
    assert scene.field.photo_focals == FocalRange(40.0, 40.0) and not scene.field.antialiased
    sizes, trained = (each.field.gaussians.log_scales.numpy() for each in (scene, run))
    np.testing.assert_allclose(sizes, trained, atol=1e-3)
    if suffix not in COLORS:
        picture, of_run = (each.render_ldr(VIEW).clamp(0, 1) for each in (scene, run))
        assert float((picture - of_run).square().mean()) < 1e-5, "50 dB"
    again = load_splats(export(scene, tmp_path / "again.ply", axes=None))  # Without cameras
    np.testing.assert_allclose(again.field.gaussians.log_scales.numpy(), trained, atol=1e-3)
    np.testing.assert_allclose(again.field.photo_filters, scene.field.photo_filters, rtol=1e-4)


def test_a_file_that_another_program_scales_is_read_alike(tmp_path, run, monkeypatch):
    file = export(run, tmp_path / "a.ply", axes="scene")
    scaled = as_other_programs_read(file, monkeypatch).transformed(np.diag([10.0, 10, 10, 1]))
    shares = replace(read_gaussians(file)).with_filter().filter_shares
    np.testing.assert_allclose(np.exp(scaled.without_filter(shares).log_scales), 0.12, rtol=1e-3)


def test_strange_focal_lengths_are_refused(tmp_path, run):
    file = export(run, tmp_path / "a.ply", axes="scene")
    data = file.read_bytes()
    file.write_bytes(data.replace(b"photo_focals [40.0,40.0]", b"photo_focals [40.0,0.00]"))
    with pytest.raises(InputError, match="focal lengths of the photos are .* not two positive numbers"):
        read_gaussians(file)


def test_gaussians_of_compensated_trainings_are_written_as_they_are(tmp_path, run):
    run.field.antialiased = True
    read = read_gaussians(export(run, tmp_path / "a.ply", axes="scene"))
    assert read.antialiased and read.filters is None
    np.testing.assert_allclose(np.exp(read.log_scales), 0.012, rtol=1e-4)


def test_a_small_file_and_a_run_are_merged_with_the_filter_of_both(tmp_path, run):
    small = load_splats(export(run, tmp_path / "small.compressed.ply", axes="scene"))
    merged = merge_scenes(run, small)
    assert merged.field.antialiased and merged.gaussian_count == 120
    sizes = merged.field.gaussians.log_scales.exp()
    np.testing.assert_allclose(np.sort(sizes[:60], axis=0), np.sort(sizes[60:], axis=0), rtol=0.05)


def test_files_without_known_photos_are_written_as_they_are(tmp_path, run):
    write_gaussians(tmp_path / "a.ply", splats([(0, 0, 0)], [0.6], scale=0.012))
    converted = read_gaussians(export(load_splats(tmp_path / "a.ply"), tmp_path / "b.glb", axes=None))
    assert converted.filters is None and not converted.antialiased
    np.testing.assert_allclose(np.exp(converted.log_scales), 0.012, rtol=1e-4)


@pytest.mark.parametrize("suffix", LOSSLESS_SUFFIXES)
def test_a_small_file_keeps_its_mark_in_a_large_one(tmp_path, run, suffix):
    """Lamps, whose sizes include the filter, would otherwise be shown with up to twice their light."""
    small = read_gaussians(export(run, tmp_path / "a.compressed.ply", axes="scene"))
    write_gaussians(tmp_path / f"b{suffix}", small.with_colors(small.harmonics, COLORS.get(suffix, "display")))
    large = read_gaussians(tmp_path / f"b{suffix}")
    assert large.antialiased and large.filters is None
    np.testing.assert_allclose(large.log_scales, small.log_scales, atol=1e-5)


def test_filters_of_other_gaussians_are_refused(tmp_path, run):
    """A program that does not know of the filter removes Gaussians from a stage."""
    Usd = pytest.importorskip("pxr.Usd")
    file = export(run, tmp_path / "a.usda", axes="scene")
    stage = Usd.Stage.Open(str(file))
    stage.GetDefaultPrim().GetAttribute("sehdr:filter").Set([0.5, 0.5])
    stage.Save()
    with pytest.raises(InputError, match="its sehdr:filter has 2 values, not 60"):
        read_gaussians(file)


def test_views_nearer_than_the_photos_have_all_light_where_cameras_lie_beside(tmp_path, run):
    file = export(run, tmp_path / "a.ply", axes="scene", cameras=True)
    near = camera(96, 72, position=(0, 0, -1.5))
    expected, read = (float(scene.render(near).hdr.mean()) for scene in (run, load_splats(file)))
    assert read == pytest.approx(expected, rel=0.01)
    file.with_name("a.ply.cameras.json").unlink()
    assert float(load_splats(file).render(near).hdr.mean()) < 0.7 * expected


def test_merged_scenes_keep_their_photos_cameras(tmp_path, run):
    near, other = camera(96, 72, position=(0, 0, -1.5)), load_splats(export(run, tmp_path / "a.ply", axes="scene"))
    alone, merged = (float(scene.render(near).hdr.mean()) for scene in (run, merge_scenes(run)))
    assert merged == pytest.approx(alone, rel=0.01)
    assert len(merge_scenes(run, run).field.photo_cameras) == 6
    assert not merge_scenes(run, other).field.photo_cameras, "those of one of them are not known"


def test_maps_of_files_with_compensated_opacities_have_the_order_of_the_photos(tmp_path, run):
    run.field.antialiased, axes = True, photo_axes(run.field)
    read = load_splats(export(run, tmp_path / "a.ply", axes="scene", cameras=True)).field
    assert read.antialiased and torch.equal(photo_axes(read), axes) and read.filters is None
