"""Pictures of Gaussians that do not fit into a device: the same, but for levels of detail far away."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sehdr_warp.errors import SehdrError
from sehdr_warp.evaluation.metrics import psnr
from sehdr_warp.model import paged_field
from sehdr_warp.model.confidence import gather_evidence
from sehdr_warp.model.gaussians import Gaussians
from sehdr_warp.model.lights import find_lights
from sehdr_warp.model.paged_field import PagedField, boxes_in_view
from sehdr_warp.model.pixel_filter import FocalRange
from sehdr_warp.model.radiance_field import RadianceField
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.run import on_device
from sehdr_warp.runs.run_folder import CameraEntry
from sehdr_warp.scene import Camera, View, look_at
from sehdr_warp.scene.normalization import Normalization
from sehdr_warp.splats.packing import compact_order

CPU = torch.device("cpu")


@pytest.fixture
def street(monkeypatch):
    """A street of 4,000 Gaussians along x, in cells of 100."""
    monkeypatch.setattr(paged_field, "CELL", 100)
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(0, 40, 4000), rng.uniform(-1, 1, 4000), rng.uniform(0, 0.1, 4000)])
    points = points[compact_order(points.astype(np.float32))]
    colors = torch.tensor(np.sin(points @ rng.normal(size=(3, 3)))).float() - 1
    means = torch.tensor(points, dtype=torch.float32)
    gaussians = Gaussians.from_points(means, colors, 1, opacity=0.9, scale=0.7)
    field = RadianceField(gaussians, response_by_name("srgb"), base_time=0.1, normalization=Normalization([5, 0, 0], 2))
    field.confidence = torch.linspace(0, 1, 4000)
    return field.requires_grad_(False)


def camera(x: float, ahead: float = 0.1, height: float = 1.5) -> Camera:
    pose = look_at((2 * x + 5, 0, 2 * height), (2 * (x + ahead) + 5, 0, 0), up=(1.0, 0.0, 0.0))
    return Camera(48, 32, 40.0, 40.0, 24.0, 16.0, pose)


def test_the_filter_of_a_file_stays_known(street):
    street.photo_filters = np.linspace(0.01, 0.02, 4000, dtype=np.float32)
    assert PagedField(street, CPU, budget=10**9).photo_filters is street.photo_filters


def test_pictures_are_those_of_the_whole(street):
    paged = PagedField(street, CPU, budget=10**9)
    for place in (camera(3), camera(30), camera(20, ahead=8)):
        cells = paged.levels(place, place.position)
        assert 0 < len(cells) < 30 and all(level == 0 for _, level in cells)
        whole, part = street.render(place), paged.render(place)
        for name in ("hdr", "alpha", "depth"):
            assert torch.equal(getattr(whole, name), getattr(part, name)), name
        assert torch.equal(street.render_ldr(place, 0.2), paged.render_ldr(place, 0.2))
        assert torch.equal(street.render_confidence(place), paged.render_confidence(place))
        part = paged.render(place, data={"confidence": paged.confidence})
        assert torch.equal(part.hdr, whole.hdr) and torch.equal(part.confidence, paged.render_confidence(place))
    away = replace(place, world_to_camera=look_at((0, 0, 3), (0.1, 0, 9), up=(1.0, 0.0, 0.0)))
    assert paged.levels(away, away.position) == [] and not paged.render(away).alpha.any()


def test_views_nearer_than_the_photos_are_those_of_the_whole(street):
    paged, view = PagedField(street, CPU, budget=10**9), camera(20, ahead=2)
    without = street.render(view).hdr
    for field in (street, paged):
        field.photo_cameras, field.photo_focals = [camera(20, ahead=2, height=12.0)], FocalRange(40.0, 40.0)
    whole, part = street.render(view).hdr, paged.render(view).hdr
    torch.testing.assert_close(whole, part)
    assert not torch.allclose(whole, without)


def test_an_entry_of_a_run_in_place_of_its_camera_is_named(street):
    paged, entry = PagedField(street, CPU, budget=10**9), CameraEntry("v", "train", camera(3), 0.1)
    for render in (paged.render, paged.render_ldr, paged.render_confidence):
        with pytest.raises(TypeError, match="camera is a CameraEntry, expected a Camera"):
            render(entry)


def test_directions_are_those_of_the_whole(street):
    paged = PagedField(street, CPU, budget=10**9)
    rays = torch.nn.functional.normalize(torch.randn(4, 6, 3, generator=torch.Generator().manual_seed(0)), dim=2)
    options = {"focal_length": 10.0, "pixel_angle": 0.1, "shares": torch.linspace(0, 1, 4000)}
    place = np.array([20.0, 0, 1])
    pictures = []
    for filters in (None, np.linspace(0.01, 0.5, 4000)):
        street.photo_filters = paged.photo_filters = filters
        for field in (street, paged):
            vars(field).pop("filters", None)
        whole, part = (field.render_directions(place, rays, **options) for field in (street, paged))
        for name in ("hdr", "alpha", "distance", "confidence", "clipped"):
            torch.testing.assert_close(getattr(whole, name), getattr(part, name))
        pictures.append(whole.hdr)
    assert not torch.allclose(*pictures)


def test_confidence_that_is_measured_between_two_pictures_is_in_the_second(street):
    confidence, street.confidence = street.confidence, None
    paged = PagedField(street, CPU, budget=10**9)
    rays = torch.nn.functional.normalize(torch.randn(4, 6, 3, generator=torch.Generator().manual_seed(0)), dim=2)
    options = {"position": np.array([20.0, 0, 1]), "directions": rays, "focal_length": 10.0, "pixel_angle": 0.1}
    assert paged.render_directions(**options).confidence is None
    street.confidence = paged.confidence = confidence
    second = paged.render_directions(**options).confidence
    torch.testing.assert_close(second, street.render_directions(**options).confidence)


def test_far_cells_are_taken_at_a_lower_level_of_detail(street):
    place = camera(1, ahead=6, height=1.0)
    visible = len(PagedField(street, CPU, 10**9).levels(place, place.position))
    row = PagedField(street, CPU, 0).row_bytes
    paged = PagedField(street, CPU, budget=row * 100 * visible // 2)
    cells = paged.levels(place, place.position)
    levels = [level for _, level in cells]
    assert len(cells) == visible and levels == sorted(levels) and 0 < sum(levels) < visible
    rows = sum(100 if level == 0 else 13 for level in levels)
    assert rows * row <= paged.budget
    whole = street.render_ldr(place)
    with_levels = psnr(paged.render_ldr(place), whole)
    paged.levels = lambda *_: [key for key in cells if key[1] == 0]
    assert with_levels > psnr(paged.render_ldr(place), whole) + 1, "better than leaving far cells out"
    with pytest.raises(SehdrError, match="out of memory: .* GB may be used"):
        PagedField(street, CPU, budget=row).render(place)


def test_a_coarser_surface_covers_the_same(street):
    """Seen from far away, an eighth of the Gaussians look nearly the same."""
    coarse = RadianceField(
        Gaussians(**paged_field.coarser(street.gaussians.tensors())),
        street.response,
        base_time=0.1,
        normalization=street.normalization,
    )
    assert coarse.gaussians.count == 500
    place = camera(20, height=60)
    whole, less = street.render(place), coarse.render(place)
    assert float(whole.alpha.sum()) == pytest.approx(float(less.alpha.sum()), rel=0.15)
    assert psnr(coarse.render_ldr(place), street.render_ldr(place)) > 25


def test_pages_stay_within_the_budget(street):
    paged = PagedField(street, CPU, budget=0)
    paged.budget = paged.row_bytes * 1500
    for x in range(2, 38, 3):
        assert torch.equal(paged.render(camera(x)).hdr, street.render(camera(x)).hdr)
        assert sum(len(page["means"]) for page in paged._pages.values()) <= 1500


def test_edits_of_gaussians_show(street):
    paged, place = PagedField(street, CPU, budget=10**9), camera(20)
    before = paged.render(place).hdr
    with torch.no_grad():
        street.gaussians.harmonics_dc.add_(0.5)  # In place, as the viewer does.
    after = paged.render(place).hdr
    assert torch.equal(after, street.render(place).hdr) and not torch.equal(before, after)


def test_only_fields_that_do_not_fit_are_paged(street, logged):
    assert on_device(street, CPU) is street
    row = PagedField(street, CPU, 0).row_bytes
    assert not isinstance(on_device(street, CPU, 4000 * row), PagedField)
    assert isinstance(on_device(street, CPU, 3000 * row), PagedField)
    assert "4000 Gaussians do not fit into" in logged[0]


def test_lights_and_confidence_are_those_of_the_whole(street, device):
    """Clipped shares lie on the device of pictures, the Gaussians on the CPU."""
    street.gaussians.harmonics_dc.data += 3
    paged = PagedField(street, torch.device(device), budget=10**9)
    places = [camera(x) for x in (3, 12, 21)]
    views = [(place, 10.0) for place in places]
    clipped = torch.ones(4000)
    whole, parts = find_lights(street, clipped, views), find_lights(paged, clipped.to(device), views)
    assert whole and len(parts) == len(whole)
    for one, other in zip(whole, parts, strict=True):
        np.testing.assert_allclose(other.radiance, one.radiance, rtol=1e-3)
        assert other.share == pytest.approx(one.share, rel=1e-3) and torch.equal(other.members, one.members)
    codes = np.full((32, 48, 3), 128, np.uint8)
    photos = [View(str(i), codes, place, 0.1, "train") for i, place in enumerate(places)]
    one, other = (gather_evidence(model, photos).confidence() for model in (street, paged))
    assert one.max() > 0 and other.device == CPU
    torch.testing.assert_close(other, one, rtol=1e-3, atol=1e-4)


def test_boxes_in_view():
    low = np.array([[-1, -1, -1], [50, 0, 0], [-1, -1, 20], [-1e3, -1e3, -1e3]], float)
    high = np.array([[1, 1, 0], [51, 1, 1], [1, 1, 21], [1e3, 1e3, 1e3]], float)
    in_view = boxes_in_view(
        Camera(40, 40, 40.0, 40.0, 20.0, 20.0, look_at((0, 0, 5), (0, 0, 0), up=(0, 1, 0))), low, high
    )
    assert in_view.tolist() == [True, False, False, True]
