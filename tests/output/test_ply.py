from types import SimpleNamespace

import numpy as np
import pytest
import torch
from plyfile import PlyData

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.field.color_models import color_model
from sehdr_warp.output import ply
from sehdr_warp.output.ply import (
    GaussianArrays,
    bake,
    evaluate_colors,
    export,
    harmonic_basis,
    hdr_gaussians,
    ldr_gaussians,
    sphere_directions,
    write_gaussians,
)
from sehdr_warp.splatting import spherical_harmonics

from .helpers import Entry, GammaResponse, camera, read_gaussians


def gaussians(count=50, degree=3, color_model="log", seed=0):
    random = np.random.default_rng(seed)
    harmonics = 0.3 * random.normal(size=(count, (degree + 1) ** 2, 3))
    harmonics[:, 0] -= 2
    shapes = ((count, 3), (count, 3), (count, 4), (count,))
    return GaussianArrays(
        *(random.normal(size=shape).astype(np.float32) for shape in shapes),
        harmonics.astype(np.float32),
        color_model,
        0.5,
    )


ARRAYS = ("means", "log_scales", "quaternions", "opacity_logits", "harmonics")


@pytest.mark.parametrize("color_model, degree", [("log", 0), ("linear", 1), ("display", 2), ("log", 3)])
def test_round_trip_is_exact(tmp_path, degree, color_model):
    written = gaussians(degree=degree, color_model=color_model)
    write_gaussians(tmp_path / "a.ply", written)
    read = read_gaussians(tmp_path / "a.ply")
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name))
    assert (read.color_model, read.base_time, read.degree) == (color_model, 0.5, degree)


def test_names_and_order_are_those_of_the_reference_release(tmp_path):
    written = gaussians()
    write_gaussians(tmp_path / "a.ply", written)
    vertex = PlyData.read(tmp_path / "a.ply")["vertex"]
    names = ["x", "y", "z", "nx", "ny", "nz"] + [f"f_dc_{i}" for i in range(3)] + [f"f_rest_{i}" for i in range(45)]
    names += ["opacity"] + [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
    assert [p.name for p in vertex.properties] == names
    # All of red's higher coefficients, then green's, then blue's.
    np.testing.assert_array_equal(vertex["f_rest_16"], written.harmonics[:, 2, 1])
    np.testing.assert_array_equal(vertex["rot_0"], written.quaternions[:, 0])


def test_nothing_is_replaced_and_nan_is_refused(tmp_path):
    write_gaussians(tmp_path / "a.ply", gaussians())
    with pytest.raises(InputError, match="exists already"):
        write_gaussians(tmp_path / "a.ply", gaussians())
    broken = gaussians()
    broken.harmonics[7, 3, 1] = np.nan
    with pytest.raises(InputError, match="f_rest_17 of 1 Gaussians is not finite, the first nan at 7"):
        write_gaussians(tmp_path / "b.ply", broken)
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


def test_basis_is_that_of_the_renderer():
    directions = sphere_directions(40)
    coefficients = gaussians(40).harmonics
    rendered = spherical_harmonics(
        3, torch.from_numpy(coefficients), torch.from_numpy(directions).float(), torch.zeros(3)
    )
    np.testing.assert_allclose(
        np.einsum("nk,nkc->nc", harmonic_basis(directions, 3), coefficients), rendered, atol=2e-5
    )


def test_bake_gives_back_what_harmonics_can_hold(monkeypatch):
    monkeypatch.setattr(ply, "_CHUNK", 16)
    start = gaussians(color_model="linear")
    start.harmonics[:, 0] += 20  # Positive in all directions: nothing is cut off.
    baked = bake(start, lambda radiance: 2 * radiance + 0.5, "display", camera_positions=np.ones((3, 3)))
    np.testing.assert_allclose(baked.harmonics, 2 * start.harmonics, atol=1e-4)


def test_bake_follows_the_cameras_where_harmonics_cannot_hold_all():
    start = gaussians(200, color_model="log")
    positions = np.array([[x, y, -8.0] for x in (-1, 0, 1) for y in (-1, 0, 1)])
    encode = GammaResponse().encode

    def wanted(radiance):
        return encode(radiance * 4)

    seen = start.means[:, None] - positions
    seen /= np.linalg.norm(seen, axis=2, keepdims=True)
    target = wanted(evaluate_colors(start, seen))
    errors = {}
    for name, given in (("cameras", positions), ("sphere", np.empty((0, 3)))):
        baked = bake(start, wanted, "display", camera_positions=given)
        assert baked.degree == 3 and baked.color_model == "display"
        errors[name] = np.abs(evaluate_colors(baked, seen) - target).mean()
    assert errors["cameras"] < 0.01
    assert errors["cameras"] < 0.5 * errors["sphere"]


class StoredRun:
    """A run as export sees it, with tensors."""

    response = GammaResponse()
    base_time = 0.25

    def __init__(self, radiance="log", fusion=None):
        self.arrays = gaussians(color_model=radiance)
        tensors = {name: torch.from_numpy(getattr(self.arrays, name)) for name in ARRAYS[:4]}
        harmonics = torch.from_numpy(self.arrays.harmonics)
        tensors |= {"harmonics_dc": harmonics[:, :1], "harmonics_rest": harmonics[:, 1:]}
        stored = SimpleNamespace(tensors=lambda: tensors, means=tensors["means"])
        model = color_model(radiance)
        self.model = SimpleNamespace(gaussians=stored, color_model=model, fusion=fusion)
        self.cameras = [Entry(str(i), "train", camera(position=(i, 0, -6))) for i in range(3)]

    def exposures(self, directions):
        return evaluate_colors(self.arrays, directions)


@pytest.mark.parametrize("radiance", ["log", "linear"])
def test_hdr_ply_is_the_radiance_exactly(tmp_path, radiance):
    run = StoredRun(radiance)
    assert export(run, tmp_path / "hdr.ply") == tmp_path / "hdr.ply"
    read = read_gaussians(tmp_path / "hdr.ply")
    assert read.color_model == radiance and read.base_time == 0.25
    directions = sphere_directions(20)
    np.testing.assert_allclose(
        evaluate_colors(read, directions), run.exposures(directions) / 0.25, rtol=1e-5, atol=1e-7
    )


def test_hdr_ply_of_fused_brackets_is_fitted_in_log_radiance():
    run = StoredRun(fusion=lambda logs: (0.8 * logs).exp() * 3)
    directions = sphere_directions(20)
    expected = 3 * run.exposures(directions) ** 0.8
    np.testing.assert_allclose(evaluate_colors(hdr_gaussians(run), directions), expected, rtol=1e-4)


def test_ldr_ply_shows_the_photo(tmp_path):
    run = StoredRun()
    export(run, tmp_path / "ldr.ply", kind="ldr", exposure_time=1.0)
    read = read_gaussians(tmp_path / "ldr.ply")
    assert read.color_model == "display" and read.degree == 3
    seen = run.arrays.means[:, None] - np.array([[1.0, 0, -6]])
    seen /= np.linalg.norm(seen, axis=2, keepdims=True)
    expected = GammaResponse().encode(run.exposures(seen) * 4)
    assert np.abs(evaluate_colors(read, seen) - expected).mean() < 0.01


def test_display_model_is_kept_as_it_is_at_its_own_exposure():
    run = StoredRun("display")
    np.testing.assert_array_equal(ldr_gaussians(run).harmonics, run.arrays.harmonics)
    assert hdr_gaussians(run).color_model == "log"


def test_unusable_requests(tmp_path):
    run = StoredRun()
    with pytest.raises(SehdrError, match="'sdr' is not one of hdr, ldr"):
        export(run, tmp_path / "a.ply", kind="sdr")
    with pytest.raises(SehdrError, match="exposure time 0 is not"):
        export(run, tmp_path / "a.ply", kind="ldr", exposure_time=0)
    with pytest.raises(SehdrError, match="has no exposure time"):
        export(run, tmp_path / "a.ply", exposure_time=1)
    assert list(tmp_path.iterdir()) == []
