"""Opcodes of DNG, undone by their inverses."""

import struct

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.scene import load_scene
from sehdr_warp.scene.raw.decode import read_raw
from tests.make_scenes import write_frames

from .dng_files import (
    EVEN,
    HEIGHT,
    LEVELS,
    TRUTH,
    WIDTH,
    X,
    Y,
    area,
    gain_map,
    light_of,
    longs,
    mosaic,
    opcodes,
    shading,
    stored,
    write_tagged_dng,
)

pytest.importorskip("rawpy")


def test_a_gain_map_evens_the_corners_of_a_mosaic(tmp_path):
    shade, gains = shading()
    maps = [gain_map(gains, (HEIGHT, WIDTH), top, left) for top in (0, 1) for left in (0, 1)]
    write_tagged_dng(tmp_path / "a.dng", stored(mosaic(EVEN) * shade), LEVELS | {51009: opcodes(*maps)})
    np.testing.assert_allclose(light_of(tmp_path / "a.dng"), EVEN, rtol=0.02)


def test_a_gain_map_evens_linear_raw_and_differs_by_channel(tmp_path):
    shade, gains = shading()
    body = gain_map(gains, (HEIGHT, WIDTH), pitch=1)[1][32:]
    only_red = 9, area((HEIGHT, WIDTH), plane=0) + body
    light = EVEN * np.stack([shade, np.ones_like(shade), np.ones_like(shade)], 2)
    write_tagged_dng(
        tmp_path / "a.dng", stored(light), LEVELS | {50717: longs(15000, 15000, 15000), 51009: opcodes(only_red)}
    )
    np.testing.assert_allclose(light_of(tmp_path / "a.dng"), EVEN, rtol=0.02)


def test_light_above_white_behind_a_gain_map_is_known_where_the_sensor_did_not_clip(tmp_path):
    _, gains = shading()
    maps = [gain_map(gains, (HEIGHT, WIDTH), top, left) for top in (0, 1) for left in (0, 1)]
    light = np.full((HEIGHT, WIDTH, 3), 0.5)
    light[:, 40:] = 1.0  # Clipped: whatever the gain, nothing is known.
    write_tagged_dng(tmp_path / "a.dng", stored(mosaic(light)), LEVELS | {51009: opcodes(*maps)})
    photo = read_raw(tmp_path / "a.dng", oriented=False)
    corner = float(np.mean(photo.above_white[:2, :2].astype(float)))
    assert corner == pytest.approx(0.5 * 3.9, rel=0.05)
    assert (photo.pixels[:2, :2] == 65535).all() and photo.pixels[48, 20].max() < 65535
    assert (photo.above_white[:, 44:] == 0).all() and (photo.pixels[:, 44:] == 65535).all()
    assert 0 < photo.above_white_deviation < 0.1


def test_light_above_white_stays_with_a_view_that_is_averaged(tmp_path):
    _, gains = shading()
    maps = [gain_map(gains, (HEIGHT, WIDTH), top, left) for top in (0, 1) for left in (0, 1)]
    for i in range(3):
        light = np.full((HEIGHT, WIDTH, 3), 0.5) + 0.1 * X[..., None] / WIDTH
        write_tagged_dng(tmp_path / f"{i}.dng", stored(mosaic(light)), LEVELS | {51009: opcodes(*maps)})
    write_frames(tmp_path, [f"{i}.dng" for i in range(3)], (WIDTH, HEIGHT))
    view = load_scene(tmp_path, max_size=WIDTH // 4).views[0]
    expected = 0.6 * gains[0, 0]
    assert view.light_above_white[0, -1] == pytest.approx(expected, rel=0.1)
    white = view.codes == 65535
    assert white.any() and not white.all()
    assert ((view.light_above_white >= 1) == white).all()


def test_opcodes_that_change_values(tmp_path):
    """Each undone by its inverse, which the test applies before it stores the samples."""
    size = (HEIGHT, WIDTH)
    rows = np.linspace(0.5, 1.5, HEIGHT)
    listed = struct.pack(">I", HEIGHT) + rows.astype(">f4").tobytes()
    degree_1 = struct.pack(">I2d", 1, 0.05, 0.8)
    even_columns = struct.pack(">8I", 0, 0, *size, 0, 1, 1, 2)
    cases = {
        "scale by row": (12, area(size) + listed, lambda v: v / rows[:, None]),
        "delta by row": (10, area(size) + listed, lambda v: v - rows[:, None] + 1),
        "polynomial": (8, area(size) + degree_1, lambda v: (v - 0.05) / 0.8),
        "polynomial of even columns": (8, even_columns + degree_1, lambda v: np.where(X % 2, v, (v - 0.05) / 0.8)),
    }
    for name, (number, body, inverse) in cases.items():
        expected = EVEN + (1 if name == "delta by row" else 0)
        light = np.clip(inverse(mosaic(EVEN)), 0, 1)
        write_tagged_dng(tmp_path / "a.dng", stored(light), LEVELS | {51009: opcodes((number, body))})
        developed = light_of(tmp_path / "a.dng")
        np.testing.assert_allclose(developed, np.minimum(expected, 1), rtol=0.02, err_msg=name)


def test_bad_pixels_are_filled(tmp_path):
    values = stored(mosaic(EVEN))
    values[40, 60], values[20:24, 30:33] = 15000, 15000
    body = struct.pack(">3I", 0, 1, 1) + struct.pack(">2I", 40, 60) + struct.pack(">4I", 20, 30, 22, 32)
    values[22:24, 30:33] = stored(mosaic(EVEN))[22:24, 30:33]
    values[20:22, 32] = stored(mosaic(EVEN))[20:22, 32]
    write_tagged_dng(tmp_path / "a.dng", values, LEVELS | {51008: opcodes((5, body))})
    np.testing.assert_allclose(light_of(tmp_path / "a.dng"), EVEN, rtol=2e-3)


def test_pixels_of_a_constant_are_filled_and_no_others(tmp_path):
    values = stored(mosaic(EVEN), white=65535.0)
    values[40, 60], values[41, 61], values[2, 3] = 60000, 60000, 60000
    values[70, 90] = 60001
    tags = LEVELS | {50717: longs(65535), 51008: opcodes((4, struct.pack(">2I", 60000, 0)))}
    write_tagged_dng(tmp_path / "a.dng", values, tags)
    developed = light_of(tmp_path / "a.dng")
    assert developed[70, 90].max() > 0.8
    developed[64:76, 84:96] = TRUTH
    np.testing.assert_allclose(developed, EVEN, rtol=2e-3)


def test_a_table_maps_the_samples_of_an_area(tmp_path):
    """Samples beyond its end become what white becomes, so they count as clipped."""
    codes = np.arange(40000) / 65535
    table = struct.pack(">I", len(codes)) + np.rint(65535 * codes**2).astype(">u2").tobytes()
    light = np.sqrt(EVEN) * np.ones((HEIGHT, WIDTH, 1))
    light[:, 100:] = 0.75
    tags = LEVELS | {50717: longs(15000, 15000, 15000)}
    body = area((HEIGHT // 2, WIDTH), planes=3) + table
    write_tagged_dng(tmp_path / "a.dng", stored(light), tags | {51009: opcodes((7, body))})
    developed = light_of(tmp_path / "a.dng")
    np.testing.assert_allclose(developed[: HEIGHT // 2, :100], EVEN[: HEIGHT // 2, :100], rtol=2e-3)
    assert (developed[: HEIGHT // 2, 100:] == 1).all()
    np.testing.assert_allclose(developed[HEIGHT // 2 :], light[HEIGHT // 2 :], rtol=2e-3)
    empty = 7, area((HEIGHT, WIDTH)) + struct.pack(">I", 0)
    write_tagged_dng(tmp_path / "b.dng", stored(light), tags | {51009: opcodes(empty)})
    with pytest.raises(InputError, match=r"b.dng: its DNG opcode 7 is damaged \(no table\)"):
        light_of(tmp_path / "b.dng")


def test_vignetting_and_distortion_after_demosaicing(tmp_path):
    x, y = 0.3 * (WIDTH - 1), 0.6 * (HEIGHT - 1)  # The farthest corner from there has radius 1.
    squared = ((Y - y) ** 2 + (X - x) ** 2) / ((WIDTH - 1 - x) ** 2 + y**2)
    body = struct.pack(">7d", 1.5, 0, 0, 0, 0, 0.3, 0.6)
    write_tagged_dng(
        tmp_path / "a.dng", stored(mosaic(EVEN / (1 + 1.5 * squared)[..., None])), LEVELS | {51022: opcodes((3, body))}
    )
    np.testing.assert_allclose(light_of(tmp_path / "a.dng"), EVEN, rtol=0.03)
    # A barrel: the pixel at r is found at 0.9 r, so that a ramp becomes 0.9 times as steep.
    ramp = EVEN * (1 + (X - (WIDTH - 1) / 2) / WIDTH)[..., None]
    body = struct.pack(">I8d", 1, 0.9, 0, 0, 0, 0, 0, 0.5, 0.5)
    write_tagged_dng(tmp_path / "b.dng", stored(mosaic(ramp)), LEVELS | {51022: opcodes((1, body))})
    expected = EVEN * (1 + 0.9 * (X - (WIDTH - 1) / 2) / WIDTH)[..., None]
    np.testing.assert_allclose(light_of(tmp_path / "b.dng")[8:-8, 8:-8], expected[8:-8, 8:-8], rtol=0.01)


def test_distortion_by_a_polynomial_of_the_radius(tmp_path):
    """WarpRectilinear2: 0.9 as it is, or as the reciprocal of 1 / 0.9; beyond half of the radius as there."""
    ramp = EVEN * (1 + (X - (WIDTH - 1) / 2) / WIDTH)[..., None]
    expected = EVEN * (1 + 0.9 * (X - (WIDTH - 1) / 2) / WIDTH)[..., None]
    for reciprocal, first in ((0, 0.9), (1, 1 / 0.9)):
        body = struct.pack(">I21dI", 1, first, *[0] * 16, 0, 1, 0.5, 0.5, reciprocal)
        write_tagged_dng(tmp_path / "a.dng", stored(mosaic(ramp)), LEVELS | {51022: opcodes((14, body))})
        np.testing.assert_allclose(light_of(tmp_path / "a.dng")[8:-8, 8:-8], expected[8:-8, 8:-8], rtol=0.01)
    body = struct.pack(">I21dI", 1, 1, -0.4, *[0] * 15, 0, 0.5, 0.5, 0.5, 0)
    write_tagged_dng(tmp_path / "a.dng", stored(mosaic(ramp)), LEVELS | {51022: opcodes((14, body))})
    light, far = light_of(tmp_path / "a.dng")[HEIGHT // 2], slice(WIDTH - 12, WIDTH - 4)
    expected = TRUTH * (1 + 0.8 * (X[0, far, None] - (WIDTH - 1) / 2) / WIDTH)
    np.testing.assert_allclose(light[far], expected, rtol=0.01)


def test_distortion_of_a_fisheye(tmp_path):
    """The pixel at r is found at t (k0 + k1 t^2 + k2 t^4 + k3 t^6), t = atan r, by the terms of its plane."""
    terms = np.array([[0.9, 0.2, -0.3, 0.4], [1.1, -0.1, 0.2, -0.3], [1.0, 0.0, 0.0, 0.0]])
    middle = (WIDTH - 1) / 2, (HEIGHT - 1) / 2
    r = np.hypot(X - middle[0], Y - middle[1]) / np.hypot(*middle)
    t = np.arctan(r)[..., None]
    found = sum(terms[:, i] * t ** (2 * i + 1) for i in range(4)) / r[..., None]
    ramp, expected = (EVEN * (1 + factor * (X - middle[0])[..., None] / WIDTH) for factor in (1, found))
    body = struct.pack(">I14d", 3, *terms.ravel(), 0.5, 0.5)
    tags = LEVELS | {50717: longs(15000, 15000, 15000), 51022: opcodes((2, body))}
    write_tagged_dng(tmp_path / "a.dng", stored(ramp), tags)
    np.testing.assert_allclose(light_of(tmp_path / "a.dng")[8:-8, 8:-8], expected[8:-8, 8:-8], rtol=2e-3)
