"""Levels, crops and turns of DNG."""

import numpy as np
import pytest

from sehdr_warp.scene.raw.decode import color_matrix, read_header, read_raw

from .dng_files import (
    EVEN,
    HEIGHT,
    LEVELS,
    TRUTH,
    WIDTH,
    X,
    Y,
    light_of,
    longs,
    mosaic,
    rationals,
    shorts,
    stored,
    write_tagged_dng,
)

pytest.importorskip("rawpy")

XTRANS = np.array([[1, 2, 1, 1, 0, 1], [0, 1, 0, 2, 1, 2], [1, 2, 1, 1, 0, 1], [1, 0, 1, 1, 2, 1], [2, 1, 2, 0, 1, 0],
                   [1, 0, 1, 1, 2, 1]])  # fmt: skip


def test_linear_raw_of_three_channels(tmp_path):
    write_tagged_dng(tmp_path / "a.dng", stored(EVEN, 528, 4095), {50714: longs(528), 50717: longs(4095, 4095, 4095)})
    np.testing.assert_allclose(light_of(tmp_path / "a.dng"), EVEN, rtol=2e-3)
    np.testing.assert_allclose(color_matrix([tmp_path / "a.dng"]) @ [0.5, 1, 0.7], 1, atol=1e-3)


def test_white_levels_by_channel_of_linear_raw(tmp_path):
    values = np.rint(EVEN * [4000, 6000, 8000]).astype(np.uint16)
    values[:, 64:] = [4000, 6000, 8000]
    write_tagged_dng(tmp_path / "a.dng", values, {50717: longs(4000, 6000, 8000)})
    light = light_of(tmp_path / "a.dng")
    np.testing.assert_allclose(light[:, :60], EVEN[:, :60], rtol=2e-3)
    assert (read_raw(tmp_path / "a.dng", oriented=False).pixels[:, 64:] == 65535).all()


def test_black_levels_by_channel_of_a_mosaic(tmp_path):
    black = np.array([[512, 600], [560, 700]])
    levels = np.tile(black, (HEIGHT // 2, WIDTH // 2))
    tags = {50713: shorts(2, 2), 50714: longs(*black.ravel()), 50717: longs(15000)}
    light = np.array(mosaic(EVEN))
    write_tagged_dng(tmp_path / "a.dng", stored(light, levels), tags)
    np.testing.assert_allclose(light_of(tmp_path / "a.dng"), EVEN, rtol=1e-3)
    light[np.tile([[False, False], [False, True]], (HEIGHT // 2, WIDTH // 2))] = 1.0
    write_tagged_dng(tmp_path / "b.dng", stored(light, levels), tags)
    codes = read_raw(tmp_path / "b.dng", oriented=False).pixels
    assert (codes[..., 2] == 65535).all() and (codes[..., :2] < 65535).all()


def test_black_levels_by_row_and_column(tmp_path):
    rows, columns = np.arange(HEIGHT) * 2.0, np.arange(WIDTH) * 3.0
    black = 100 + rows[:, None] + columns
    tags = {50714: longs(100), 50717: longs(15000), 50715: rationals(*columns), 50716: rationals(*rows)}
    write_tagged_dng(tmp_path / "a.dng", stored(mosaic(EVEN), black), tags)
    np.testing.assert_allclose(light_of(tmp_path / "a.dng"), EVEN, rtol=2e-3)


def test_x_trans(tmp_path):
    light = np.broadcast_to(TRUTH, (516, 516, 3))  # LibRaw takes none smaller than 512.
    write_tagged_dng(tmp_path / "a.dng", stored(mosaic(light, XTRANS)), LEVELS, XTRANS)
    np.testing.assert_allclose(light_of(tmp_path / "a.dng")[20:-20, 20:-20], light[20:-20, 20:-20], rtol=2e-3)


@pytest.mark.parametrize("top, left", [(0, 0), (1, 0), (3, 5)])
def test_active_area_and_crop(tmp_path, top, left):
    """The filter's pattern begins at the active area, and the crop is counted from it."""
    gradient = EVEN * (0.5 + X / WIDTH)[..., None]
    inner = mosaic(gradient[: HEIGHT - 8, : WIDTH - 8])
    whole = np.zeros((HEIGHT, WIDTH))
    whole[top : top + HEIGHT - 8, left : left + WIDTH - 8] = inner
    tags = LEVELS | {50829: longs(top, left, top + HEIGHT - 8, left + WIDTH - 8)}
    tags |= {50719: longs(10, 6), 50720: longs(80, 60)}
    write_tagged_dng(tmp_path / "a.dng", stored(whole), tags)
    header = read_header(tmp_path / "a.dng")
    assert header.size == header.upright_size == (80, 60)
    np.testing.assert_allclose(light_of(tmp_path / "a.dng"), gradient[6:66, 10:90], rtol=0.01)


@pytest.mark.parametrize("orientation, turn", [
    (3, lambda a: a[::-1, ::-1]), (6, lambda a: np.rot90(a, -1)), (8, np.rot90), (5, lambda a: a.swapaxes(0, 1)),
])  # fmt: skip
def test_orientation(tmp_path, orientation, turn):
    gradient = EVEN * (0.5 + X / WIDTH + Y / HEIGHT)[..., None]
    write_tagged_dng(tmp_path / "a.dng", stored(mosaic(gradient)), LEVELS | {274: shorts(orientation)})
    upright, turned = light_of(tmp_path / "a.dng"), light_of(tmp_path / "a.dng", oriented=True)
    np.testing.assert_array_equal(turned, turn(upright))
    assert read_header(tmp_path / "a.dng").upright_size == turned.shape[1::-1]


def test_pixels_that_are_not_square(tmp_path):
    gradient = EVEN * (0.5 + Y / HEIGHT)[..., None]
    write_tagged_dng(tmp_path / "a.dng", stored(mosaic(gradient)), LEVELS | {50718: rationals(1, 2)})
    assert read_header(tmp_path / "a.dng")[0] == (WIDTH, 2 * HEIGHT)
    light = light_of(tmp_path / "a.dng")
    assert light.shape == (2 * HEIGHT, WIDTH, 3)
    expected = TRUTH * (0.5 + ((np.arange(2 * HEIGHT) + 0.5) / 2 - 0.5) / HEIGHT)[:, None]
    np.testing.assert_allclose(light[4:-4, 64], expected[4:-4], rtol=0.01)
