"""Balls lit by maps and by lights, in Mitsuba."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.irradiance import LightMap, read_light, store_light
from sehdr_warp.errors import InputError
from sehdr_warp.model.lights import Light, LightShape
from sehdr_warp.output.lighting.environment_map import latlong, solid_angles
from sehdr_warp.scene import embedded_folder

PLACE = np.array([1.0, -2.0, 1.5])
PANEL = LightShape("rect", PLACE + np.array([0, 2, 0.5]), np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), (0.6, 0.4))
BY_THE_POLE = LightShape("sphere", PLACE + np.array([0.3, 2, 0.3]), np.eye(3), (0.4, 0.4))
BALL = LightShape("sphere", PLACE + np.array([0.5, 2, 0.2]), np.eye(3), (0.5, 0.5))


@pytest.fixture(scope="module")
def mi():
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    return mitsuba


def map_of(shape, radiance, columns):
    """A map of the place in which a shape shines, and all is dark beside it."""
    rays, image = latlong(256), np.zeros((128, 256, 3), np.float32)
    offset = shape.position - PLACE
    if shape.kind == "sphere":
        inside = rays @ offset > np.sqrt(offset @ offset - (shape.size[0] / 2) ** 2)
    else:
        distance = (offset @ shape.axes[2]) / np.minimum(rays @ shape.axes[2], -1e-9)
        at = (distance[..., None] * rays - offset) @ shape.axes[:2].T
        inside = (np.abs(at) < np.array(shape.size) / 2).all(2) & (rays @ shape.axes[2] < 0)
    image[inside] = radiance
    step, weight = 256 // columns, solid_angles(256, "latlong")[..., None]
    sums, weights = (
        each.reshape(columns // 2, step, columns, step, -1).sum((1, 3)) for each in (image * weight, weight)
    )
    return sums / weights


@pytest.mark.parametrize(("shape", "columns"), [(PANEL, 256), (BALL, 256), (BY_THE_POLE, 64)])
def test_an_emitter_lights_as_its_map_does(mi, shape, columns, monkeypatch):
    from benchmarks import relight

    monkeypatch.setattr(relight, "SIZE", 16)
    dark = np.zeros((columns // 2, columns, 3))
    place = LightMap(PLACE, dark, np.ones(dark.shape[:2]) * (latlong(columns)[..., 1] > -0.5))
    radiance = np.array([20.0, 10.0, 5.0])
    lit = relight.balls(mi, place, map_of(shape, radiance, columns), (), 64)
    ours = relight.balls(mi, place, dark, [(shape, radiance)], 64)
    # Of each ball the light, and where on the ball it is.
    for part in range(3):
        true, measured = (image[:, 16 * part : 16 * part + 16].mean(2) for image in (lit, ours))
        assert true.mean() > 0.001 and measured.mean() == pytest.approx(true.mean(), rel=0.2)
        middles = [
            np.average(np.mgrid[:16, :16], axis=(1, 2), weights=np.stack([each, each])) for each in (true, measured)
        ]
        assert middles[1] == pytest.approx(middles[0], abs=1.0)


class Stub:
    """A run with one light, which gives half of its light."""

    def clipped_share(self):
        return True

    def find_lights(self):
        return [Light(PANEL, np.full(3, 4.0), np.ones(3), None, 0.5, "members")]

    def render_directions(self, position, directions, without=(), **_):
        from types import SimpleNamespace

        import torch

        return SimpleNamespace(hdr=torch.full((*directions.shape[:2], 3), 1.0 if without else 2.0))


def test_stored_light_comes_back(tmp_path, monkeypatch):
    monkeypatch.setattr("benchmarks.irradiance.lights_as_received", lambda run, lights, center: lights)
    place = LightMap(PLACE, np.zeros((4, 8, 3)), np.ones((4, 8)))
    store_light(tmp_path / "light.npz", Stub(), [place, place], [], 3.0)
    measured = read_light(tmp_path / "light.npz")
    assert [each.shape for each in measured.maps] == [(4, 8, 3)] * 2 and (measured.maps[1] == 6).all()
    assert (measured.rest[0] == 3).all()
    ((shape, radiance),) = measured.lights
    assert shape.kind == "rect" and shape.size == PANEL.size and radiance.tolist() == [12, 12, 12]
    (tmp_path / "text.npz").write_text("{}")
    with pytest.raises(InputError, match=r"text\.npz"):
        read_light(tmp_path / "text.npz")


def test_jobs_are_compared_and_pictured(mi, tmp_path, monkeypatch):
    from benchmarks import relight
    from benchmarks.irradiance import read_light_maps

    folder = embedded_folder("embedded:lamps")
    maps = read_light_maps(folder)
    for method in ("default", "3dgs"):
        job = tmp_path / "jobs" / method
        job.mkdir(parents=True)
        names = {"method": method, "response": "known", "exposure": 2, "seed": 0, "sees_truth": False}
        (job / "result.json").write_text(json.dumps({"config": names | {"scene": {"name": "lamps"}}}))
        light = {f"map_{i}": 0.5 * each.radiance for i, each in enumerate(maps)}
        np.savez(job / "light.npz", lights=np.array("[]"), **light)
    monkeypatch.setattr(relight, "SIZE", 24)
    relight.main(tmp_path, json=tmp_path / "r.json", picture=tmp_path / "p.png", samples=4)
    rows = json.loads(Path(tmp_path / "r.json").read_text())["rows"]
    assert [(row["method"], row["by"]) for row in rows] == [("default", "map"), ("3dgs", "map")]
    assert all(
        row["energy"] == pytest.approx(0.5, rel=1e-3) and row["off"] == pytest.approx(0.5, rel=1e-3) for row in rows
    )
    assert (tmp_path / "p.png").stat().st_size > 100
