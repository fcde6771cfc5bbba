"""Gain maps from files that the test writes: light behind white against the light they were made of."""

import logging
import struct

import colour
import numpy as np
import pytest
from PIL import Image

from sehdr_warp.scene import load_scene
from sehdr_warp.scene.color.primaries import matrix_to_rec709
from sehdr_warp.scene.images.gain_map import light_of, read_gain_map
from sehdr_warp.scene.images.ldr_files import read_ldr
from tests.make_scenes import write_frames

from ..color.test_encoding import icc_profile
from .gain_map_files import (
    HEIGHT,
    STOPS,
    WIDTH,
    encoded,
    hdrgm,
    iso_metadata,
    iso_segment,
    jpeg_bytes,
    linear,
    pair,
    scene,
    write_heif_pair,
    write_jpeg_pair,
    xmp_segment,
)


def decoded(path):
    return read_gain_map(path).light(linear(read_ldr(path).pixels))


def assert_light(result, expected, channels=1):
    """Within 3 %, where the map was not averaged over the edge of what is clipped."""
    channel = slice(None) if channels == 3 else slice(0, 1)
    error = np.abs(result / expected - 1)[..., channel]
    assert np.percentile(error[8:-8, 8:-8], 98) < 0.03, np.percentile(error, [50, 90, 98, 100])
    assert result[..., 0].max() == pytest.approx(expected[..., 0].max(), rel=0.03)


OTHER_PREFIX = 0xFFE1, hdrgm()[1].replace(b"hdrgm:", b"gm:").replace(b"xmlns:hdrgm", b"xmlns:gm")


@pytest.mark.parametrize("segment", [iso_segment(), hdrgm(), OTHER_PREFIX], ids=["iso", "xmp", "xmp by another prefix"])
def test_gain_maps_in_jpeg(tmp_path, segment):
    light, base, gain = pair()
    write_jpeg_pair(tmp_path / "a.jpg", base, gain, [segment])
    assert read_gain_map(tmp_path / "a.jpg") is not None
    assert_light(decoded(tmp_path / "a.jpg"), light)
    assert read_gain_map(tmp_path / "a.jpg").headroom == pytest.approx(STOPS, abs=0.05)


def colorful_pair():
    """Light of strong colors in Rec.709, the photo of it, and gains of three channels between them in Display P3."""
    light = scene() * [1.0, 0.3, 0.05]
    base = np.rint(255 * encoded(light)).astype(np.uint8)
    to_p3 = np.linalg.inv(matrix_to_rec709((0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.3290)))
    ratio = (light @ to_p3.T + 1 / 64) / (linear(base) @ to_p3.T + 1 / 64)
    return light, base, np.rint(255 * np.clip((np.log2(ratio) + 1) / (STOPS + 1), 0, 1)).astype(np.uint8)


@pytest.mark.parametrize("suffix", [".jpg", ".heic"])
def test_gains_in_the_colors_of_the_alternate_rendition(tmp_path, suffix):
    light, base, gain = colorful_pair()

    def error(base_colors):
        options = {"minimum": -1.0, "channels": 3, "base_colors": base_colors}
        path = tmp_path / f"a{suffix}"
        if suffix == ".jpg":
            segments = [iso_segment(**options), (0xFFE2, b"ICC_PROFILE\0\1\1" + icc_profile("Display P3", 2.2))]
            write_jpeg_pair(path, base, gain, segments)
        else:
            files = saved(tmp_path / "b.heic", base), saved(tmp_path / "g.heic", gain)
            nclx = b"nclx" + struct.pack(">3HB", 12, 13, 0, 0x80)
            write_heif_pair(path, *files, iso=iso_metadata(STOPS, **options), colr=nclx)
        return np.abs(decoded(path) / light - 1)[8:-8, 8:-8, 0]

    assert np.percentile(error(base_colors=False), 95) < 0.03
    assert np.percentile(error(base_colors=True), 95) > 0.1


@pytest.mark.parametrize("gamut, space", [("BT_2100", "ITU-R BT.2020"), ("BT_709", "ITU-R BT.709")])
def test_libultrahdr_writes_light_of_other_primaries_beside_display_p3(tmp_path, gamut, space):
    imagecodecs = pytest.importorskip("imagecodecs")
    light = scene() * [1.0, 0.4, 0.1]
    pixels = np.concatenate([light, np.ones((HEIGHT, WIDTH, 1))], 2).astype(np.float16)
    encoded_file = imagecodecs.ultrahdr_encode(pixels, level=97, gamut=getattr(imagecodecs.ULTRAHDR.CG, gamut))
    (tmp_path / "a.jpg").write_bytes(encoded_file)
    assert (read_gain_map(tmp_path / "a.jpg").to_alternate is not None) == (gamut == "BT_2100")
    spaces = colour.RGB_COLOURSPACES
    to_p3 = colour.matrix_RGB_to_RGB(spaces[space], spaces["Display P3"], None)
    expected = np.maximum(light @ to_p3.T, 0)
    error = np.abs(decoded(tmp_path / "a.jpg") - expected) / np.maximum(expected, 0.02)
    median, high = np.percentile(error[4:-4, 4:-4], [50, 90])
    assert median < 0.015 and high < 0.035


@pytest.mark.parametrize("states_headroom", ["xmp", "maker note"])
def test_apples_gain_map_in_jpeg(tmp_path, states_headroom):
    light, base, gain = pair(apple=True)
    fields = {"HDRGainMapVersion": "131072"}
    exif = Image.Exif()
    if states_headroom == "xmp":
        fields["HDRGainMapHeadroom"] = str(2**STOPS)
    else:  # 2.5 stops: -70 x + 3 with x = 1 / 140
        exif.get_ifd(0x8769)[0x927C] = apple_note(1.01, 1 / 140)
    segment = xmp_segment(fields, "HDRGainMap", "http://ns.apple.com/HDRGainMap/1.0/")
    write_jpeg_pair(tmp_path / "a.jpg", base, gain, [segment], exif=exif.tobytes())
    assert_light(decoded(tmp_path / "a.jpg"), light)


def apple_note(bright, gain):
    """Apple's maker note with tags 33 and 48: signed fractions behind a directory at byte 14."""
    head = b"Apple iOS\0\0\1MM" + struct.pack(">H", 2)
    at = 14 + 2 + 24 + 4
    head += struct.pack(">HHII", 33, 10, 1, at) + struct.pack(">HHII", 48, 10, 1, at + 8) + bytes(4)
    return head + struct.pack(">4i", round(bright * 10**6), 10**6, round(gain * 10**6), 10**6)


def saved(path, pixels, **options):
    if path.suffix == ".avif":
        Image.fromarray(pixels).save(path, quality=95, **options)
    else:
        pytest.importorskip("pillow_heif").from_pillow(Image.fromarray(pixels)).save(path, quality=95, **options)
    return path


@pytest.mark.parametrize("suffix", [".heic", ".avif"])
def test_iso_gain_maps_in_heif_and_avif(tmp_path, suffix):
    light, base, gain = pair()
    files = saved(tmp_path / f"b{suffix}", base), saved(tmp_path / f"g{suffix}", np.repeat(gain[..., None], 3, 2))
    write_heif_pair(tmp_path / f"a{suffix}", *files, iso=iso_metadata(STOPS))
    assert read_gain_map(tmp_path / f"a{suffix}") is not None and read_gain_map(files[0]) is None
    assert_light(decoded(tmp_path / f"a{suffix}"), light)


def test_apples_gain_map_in_heic_is_turned_with_its_photo(tmp_path):
    light, base, gain = pair(apple=True)
    exif = Image.Exif()
    exif[0x0112] = 6
    stored = saved(tmp_path / "b.heic", base, exif=exif.tobytes())
    other = saved(tmp_path / "g.heic", np.repeat(gain[..., None], 3, 2))
    _, body = xmp_segment({"HDRGainMapHeadroom": str(2**STOPS)}, "HDRGainMap", "http://ns.apple.com/HDRGainMap/1.0/")
    write_heif_pair(tmp_path / "a.heic", stored, other, apple_xmp=body.partition(b"\0")[2])
    result = decoded(tmp_path / "a.heic")
    assert result.shape == (WIDTH, HEIGHT, 3)
    assert_light(result, np.rot90(light, -1))


def test_photos_without_a_gain_map(tmp_path):
    _, base, gain = pair()
    Image.fromarray(base).save(tmp_path / "a.jpg")
    write_jpeg_pair(tmp_path / "stereo.jpg", base, base, [])
    write_jpeg_pair(tmp_path / "hdr_base.jpg", base, gain, [iso_segment(base_headroom=STOPS + 1)])
    for name in ("a.jpg", "stereo.jpg", "hdr_base.jpg"):
        assert read_gain_map(tmp_path / name) is None


def test_a_second_picture_without_metadata_is_no_gain_map(tmp_path):
    """Depth maps and previews come so: the photo's own XMP, which announces a gain map, does not describe it."""
    _, base, gain = pair()
    xmp = hdrgm()[1].partition(b"\0")[2].replace(b" hdrgm:Version", b"\nhdrgm:Version")
    write_jpeg_pair(tmp_path / "a.jpg", base, gain, [], xmp=xmp)
    with Image.open(tmp_path / "a.jpg") as image:
        assert image.format == "MPO" and b"hdrgm:" in image.info["xmp"]
    assert read_gain_map(tmp_path / "a.jpg") is None


def test_damaged_gain_maps_of_a_set_are_named_in_one_note(tmp_path, caplog):
    _, base, gain = pair()
    write_set(tmp_path)
    for i in (1, 3):
        write_jpeg_pair(tmp_path / f"{i}.jpg", base, gain, [hdrgm(Gamma="0")])
    for response in ("auto", "gamma-2.2"):
        notes = [note for note in load_scene(tmp_path, response=response).notes if "damaged" in note]
        assert notes == ["gain maps of 2 photos are damaged and not used: 1.jpg, 3.jpg (gamma [0.0, 0.0, 0.0])"]
    assert "damaged" not in caplog.text


def test_a_map_of_more_pixels_than_its_photo_counts_as_none(tmp_path, caplog):
    """A photo that was cut or scaled down leaves its map so."""
    _, base, gain = pair()
    write_jpeg_pair(tmp_path / "a.jpg", base[:8, :8], gain, [iso_segment()])
    with caplog.at_level(logging.WARNING, "sehdr_warp.scene"):
        assert read_gain_map(tmp_path / "a.jpg") is None
    assert (
        f"a.jpg: its gain map is damaged (it has {WIDTH // 2} x {HEIGHT // 2} pixels, the photo 8 x 8)" in caplog.text
    )


def write_set(folder, segment=None, channels=1, **options):
    """Four posed photos with gain maps, all of one scene."""
    light, base, gain = pair(channels=channels)
    names = [f"{i}.jpg" for i in range(4)]
    for name in names:
        write_jpeg_pair(folder / name, base, gain, [segment or iso_segment(channels=channels)], **options)
    write_frames(folder, names, (WIDTH, HEIGHT))
    return light


@pytest.mark.parametrize(
    "edit", [lambda photo: photo[:64], lambda photo: np.rot90(photo).copy()], ids=["cut", "turned"]
)
def test_a_map_of_another_shape_than_its_photo_is_named(tmp_path, caplog, edit):
    """Programs that know nothing of gain maps crop or turn the photo, and keep the second picture as it was."""
    _, base, gain = pair()
    write_jpeg_pair(tmp_path / "a.jpg", edit(base), gain, [hdrgm()])
    assert read_gain_map(tmp_path / "a.jpg") is None
    read_gain_map(tmp_path / "a.jpg")
    assert "it has 64 x 48 pixels, which is not the shape of" in caplog.text


def test_a_set_with_gain_maps_has_their_light(tmp_path):
    light = write_set(tmp_path)
    scene = load_scene(tmp_path)
    assert scene.light_known and scene.response.name == "gain-map"
    assert any("4 of 4 photos have a gain map: light is taken from it, up to 2.5 stops" in note for note in scene.notes)
    view = scene.views[0]
    # As if exposed 2.5 stops shorter: nothing is clipped.
    assert view.exposure_time == pytest.approx(0.97 * 2**-2.5, rel=0.02) and view.codes.max() < 65535
    assert_light(linear(view.codes) / view.exposure_time, light)
    for response in (scene.response.name, scene.response):  # As runs and blocks load their photos again.
        np.testing.assert_array_equal(load_scene(tmp_path, response=response).views[0].codes, view.codes)


def test_a_named_response_keeps_the_codes_and_has_the_light_of_white_ones(tmp_path):
    light = write_set(tmp_path)
    view = load_scene(tmp_path, response="gamma-2.2").views[0]
    assert view.codes.dtype == np.uint8
    clipped = view.codes == 255
    inside = clipped & (light > 1.3)
    assert ((view.light_above_white > 0) == clipped).all()
    error = np.abs(view.light_above_white[..., 0] / light[..., 0] - 1)[inside[..., 0]]
    assert np.percentile(error, 90) < 0.03 and view.light_above_white_deviation > 0


def test_a_gain_map_is_turned_with_its_photo(tmp_path):
    light, base, gain = pair()
    exif = Image.Exif()
    exif[0x0112] = 8
    write_jpeg_pair(tmp_path / "a.jpg", base, gain, [iso_segment()], exif=exif.tobytes())
    photo = light_of(read_ldr(tmp_path / "a.jpg", oriented=True), read_gain_map(tmp_path / "a.jpg", oriented=True))
    result = np.where(photo.pixels == 65535, photo.above_white, linear(photo.pixels))
    assert_light(result, np.rot90(light))


def test_light_of_a_display_p3_photo_ends_in_rec709(tmp_path):
    """A profile states the primaries of photo and map; its curve is that of sRGB."""
    colour = pytest.importorskip("colour")
    light = write_set(tmp_path, channels=3, icc_profile=icc_profile("Display P3"))
    view = load_scene(tmp_path).views[0]
    spaces = colour.RGB_COLOURSPACES
    matrix = colour.matrix_RGB_to_RGB(spaces["Display P3"], spaces["sRGB"])
    assert_light(linear(view.codes) / view.exposure_time, light @ matrix.T, channels=3)


def test_a_photo_without_a_map_in_such_a_set_is_clipped_at_white(tmp_path):
    write_set(tmp_path)
    _, base, _ = pair()
    Image.fromarray(base).save(tmp_path / "3.jpg", quality=100, subsampling=0)
    with_map, without = (load_scene(tmp_path, holdout=0).views[i] for i in (0, 3))
    assert (with_map.exposure_time, without.exposure_time) == (pytest.approx(0.97 * 2**-2.5, rel=0.02), 1)
    clipped = without.codes == 65535
    assert clipped.mean() > 0.2
    dark = linear(with_map.codes)[~clipped] / with_map.exposure_time
    np.testing.assert_allclose(linear(without.codes)[~clipped].mean(), dark.mean(), rtol=0.03)


@pytest.mark.parametrize("stops", [0.0, 9.0])
def test_maps_of_no_and_of_many_stops(tmp_path, stops):
    """Beyond four stops light lies beside codes, so that 16 bits keep the dark."""
    write_set(tmp_path, hdrgm(GainMapMax=str(stops)))
    assert load_scene(tmp_path).views[0].exposure_time == pytest.approx(0.97 * 2 ** -min(stops, 4))


@pytest.mark.parametrize("behind", [b"", b"a film" * 50], ids=["alone", "motion photo"])
def test_a_gain_map_without_a_multi_picture_index(tmp_path, behind):
    """Editors leave such files: the map's place is in the photo's XMP alone."""
    light, base, gain = pair()
    second = jpeg_bytes(gain, [hdrgm()])
    items = [("Primary", 0), ("GainMap", len(second)), *([("MotionPhoto", len(behind))] if behind else [])]
    listing = "".join(
        f'<rdf:li><Container:Item Item:Mime="image/jpeg" Item:Semantic="{semantic}" Item:Length="{length}"/></rdf:li>'
        for semantic, length in items
    )
    segment = 0xFFE1, b"http://ns.adobe.com/xap/1.0/\0" + f"<rdf:Seq>{listing}</rdf:Seq>".encode()
    (tmp_path / "a.jpg").write_bytes(jpeg_bytes(base, [segment]) + second + behind)
    assert read_gain_map(tmp_path / "a.jpg") is not None
    assert_light(decoded(tmp_path / "a.jpg"), light)
    (tmp_path / "cut.jpg").write_bytes((tmp_path / "a.jpg").read_bytes()[: -len(second) // 2])
    assert read_gain_map(tmp_path / "cut.jpg") is None
