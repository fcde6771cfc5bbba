"""DNG files as phones, drones and converters write them: each from light that the test knows."""

import json
import struct

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.response import response_by_name
from sehdr_warp.scene import load_scene
from sehdr_warp.scene.raw.decode import color_matrix, read_header, read_raw

from .dng_files import area, gain_map, jpeg_tiles, longs, mosaic, opcodes, rationals, shorts, write_tagged_dng

pytest.importorskip("rawpy")
TRUTH = np.array([0.1, 0.3, 0.2])
HEIGHT, WIDTH = 96, 128
EVEN = np.broadcast_to(TRUTH, (HEIGHT, WIDTH, 3))
Y, X = np.mgrid[:HEIGHT, :WIDTH]
XTRANS = np.array([[1, 2, 1, 1, 0, 1], [0, 1, 0, 2, 1, 2], [1, 2, 1, 1, 0, 1], [1, 0, 1, 1, 2, 1], [2, 1, 2, 0, 1, 0],
                   [1, 0, 1, 1, 2, 1]])  # fmt: skip


def light_of(path, oriented=False):
    return response_by_name("srgb").decode(read_raw(path, oriented=oriented).pixels / 65535)


def stored(light, black=512.0, white=15000.0):
    return np.rint(black + light * (white - black)).astype(np.uint16)


LEVELS = {50714: longs(512), 50717: longs(15000)}


def shading():
    """Light that falls to a quarter towards the corners, and the gains that undo it."""
    v, h = np.mgrid[:13, :17]
    gains = 1 + 3 * ((v / 12 - 0.5) ** 2 + (h / 16 - 0.5) ** 2) / 0.5
    return 1 / (1 + 3 * (((Y + 0.5) / HEIGHT - 0.5) ** 2 + ((X + 0.5) / WIDTH - 0.5) ** 2) / 0.5), gains


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


def test_opcodes_that_change_values(tmp_path):
    """Each undone by its inverse, which the test applies before it stores the samples."""
    size = (HEIGHT, WIDTH)
    rows = np.linspace(0.5, 1.5, HEIGHT)
    listed = struct.pack(">I", HEIGHT) + rows.astype(">f4").tobytes()
    polynomial = area(size) + struct.pack(">I2d", 1, 0.05, 0.8)
    cases = {
        "scale by row": (12, area(size) + listed, lambda v: v / rows[:, None]),
        "delta by row": (10, area(size) + listed, lambda v: v - rows[:, None] + 1),
        "polynomial": (8, polynomial, lambda v: (v - 0.05) / 0.8),
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


@pytest.mark.parametrize("size", [(80, 40), (WIDTH, HEIGHT)])
@pytest.mark.parametrize("meaning", ["polynomial", "table", "linear"])
def test_lossy_compression(tmp_path, size, meaning):
    """The codes' curve is the file's: LibRaw has one of its own for files without an opcode."""
    light = 0.5 + 0.4 * (X / WIDTH - Y / HEIGHT)[..., None] * [1.0, 0.5, 0.8]
    codes = np.rint(255 * (light if meaning == "linear" else np.sqrt(light / 0.95))).astype(np.uint8)
    tags = {258: shorts(8, 8, 8), 259: shorts(34892), 50717: longs(255, 255, 255)}
    tags |= {322: longs(size[0]), 323: longs(size[1])} if size[0] < WIDTH else {278: longs(2**32 - 1)}
    if meaning == "polynomial":
        curves = [(8, area((HEIGHT, WIDTH), plane=c) + struct.pack(">I3d", 2, 0, 0, 0.95)) for c in range(3)]
        tags[51009] = opcodes(*curves)
    if meaning == "table":
        squares = np.rint(0.95 * 65535 * (np.arange(256) / 255) ** 2).astype(int)
        tags |= {50712: shorts(*squares), 50717: longs(65535, 65535, 65535)}
    write_tagged_dng(tmp_path / "a.dng", codes, tags, pieces=jpeg_tiles(codes, size))
    error = np.abs(light_of(tmp_path / "a.dng") - light)
    assert error.max() < 0.03 and error.mean() < 0.005
    assert read_header(tmp_path / "a.dng")[0] == (WIDTH, HEIGHT)


def test_damaged_pictures_of_lossy_files_are_named(tmp_path):
    codes = np.full((HEIGHT, WIDTH, 3), 99, np.uint8)
    tags = {258: shorts(8, 8, 8), 259: shorts(34892), 322: longs(80), 323: longs(40)}
    tiles = jpeg_tiles(codes, (80, 40))
    cases = {
        "cannot be read as RAW": [tiles[0][:300], *tiles[1:]],
        "a JPEG picture in it is damaged .96 x": [*jpeg_tiles(codes[:, :96], (96, 40))[:1], *tiles[1:]],
        "5 tiles, not 6": tiles[:-1],
        "a tile of 2000000 bytes, more than 1067776": [tiles[0].ljust(2_000_000, b"\0"), *tiles[1:]],
        r"its DNG tags cannot be used: tag 324 is \(\)": [],
    }
    for match, pieces in cases.items():
        write_tagged_dng(tmp_path / "a.dng", codes, tags, pieces=pieces)
        with pytest.raises(InputError, match=match):
            read_raw(tmp_path / "a.dng", oriented=False)


def test_what_cannot_be_read_is_named(tmp_path):
    file = tmp_path / "a.dng"

    def refused(match, values=None, tags=None):
        write_tagged_dng(file, stored(mosaic(EVEN)) if values is None else values, LEVELS | (tags or {}))
        with pytest.raises(InputError, match=match):
            read_raw(file, oriented=False)

    refused("compressed as JPEG XL.*convert it with Adobe DNG Converter", tags={259: shorts(52546)})
    refused("compressed as Deflate.*convert it", tags={259: shorts(8)})
    refused("compressed as compression 77.*convert it", tags={259: shorts(77)})
    refused("color filter's samples are compressed with loss", tags={259: shorts(34892)})
    refused("floating-point samples", values=mosaic(EVEN).astype(np.float32), tags={50714: longs(0), 50717: longs(1)})
    refused("demands opcode 99", tags={51009: opcodes((99, b""))})
    refused(r"demands opcode 6 \(TrimBounds\)", tags={51022: opcodes((6, struct.pack(">4I", 8, 8, 64, 96)))})
    refused("list of DNG opcodes is damaged", tags={51009: (7, 6, b"\0\0\0\2xx")})
    refused("DNG opcode 9 is damaged", tags={51009: opcodes((9, b"\0" * 20))})
    refused("white level .* is not above black level", tags={50714: longs(20000)})
    refused("ActiveArea", tags={50829: longs(0, 0, HEIGHT, 2 * WIDTH)})
    refused("one channel", values=np.zeros((HEIGHT, WIDTH), np.uint16), tags={262: shorts(34892)})
    tifffile = pytest.importorskip("tifffile")
    tifffile.imwrite(
        file, stored(EVEN), bigtiff=True, photometric=34892, extratags=[(50706, 1, 4, bytes([1, 7, 0, 0]))]
    )
    with pytest.raises(InputError, match="form of a BigTIFF.*convert it"):
        read_raw(file, oriented=False)
    write_tagged_dng(file, stored(mosaic(EVEN)), LEVELS | {51009: opcodes((99, b""), optional=True)})
    np.testing.assert_allclose(light_of(file), EVEN, rtol=2e-3)


def test_light_above_white_stays_with_a_view_that_is_averaged(tmp_path):
    _, gains = shading()
    maps = [gain_map(gains, (HEIGHT, WIDTH), top, left) for top in (0, 1) for left in (0, 1)]
    for i in range(3):
        light = np.full((HEIGHT, WIDTH, 3), 0.5) + 0.1 * X[..., None] / WIDTH
        write_tagged_dng(tmp_path / f"{i}.dng", stored(mosaic(light)), LEVELS | {51009: opcodes(*maps)})
    frames = [{"file_path": f"{i}.dng", "transform_matrix": np.eye(4).tolist()} for i in range(3)]
    (tmp_path / "transforms.json").write_text(json.dumps({"w": WIDTH, "h": HEIGHT, "fl_x": 100, "frames": frames}))
    view = load_scene(tmp_path, max_size=WIDTH // 4).views[0]
    expected = 0.6 * gains[0, 0]
    assert view.light_above_white[0, -1] == pytest.approx(expected, rel=0.1)
    white = view.codes == 65535
    assert white.any() and not white.all()
    assert ((view.light_above_white >= 1) == white).all()
