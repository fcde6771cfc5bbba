"""EXIF as cameras and tools write it, and photos that state no time among others that do."""

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from PIL.TiffImagePlugin import IFDRational

from sehdr_warp.scene.images.exif import ExifExposure, exif_exposure, parse_number
from tests.make_scenes import load, write_colmap

TIME, NUMBER, ISO, SHUTTER, APERTURE, INDEX = 33434, 33437, 34855, 37377, 37378, 34866


def photo(path, tags, first=None):
    exif = Image.Exif()
    for tag, value in (first or {}).items():
        exif[tag] = value
    for tag, value in tags.items():
        exif.get_ifd(0x8769)[tag] = value
    Image.fromarray(np.full((8, 8, 3), 90, np.uint8)).save(path, exif=exif)
    return path


CASES = {
    "plain": ({TIME: 0.01, ISO: 200, NUMBER: 2.8}, ExifExposure(0.01, 200, 2.8)),
    "0/0": ({TIME: IFDRational(0, 0), NUMBER: 2.8}, ExifExposure(None, None, 2.8)),
    "0/1 beside APEX": ({TIME: IFDRational(0, 1), SHUTTER: 6.65}, ExifExposure(2**-6.65)),
    "unknown": ({TIME: IFDRational(4294967295, 1), ISO: 100}, ExifExposure(None, 100)),
    "APEX alone": ({SHUTTER: 3.0, APERTURE: 4.0}, ExifExposure(0.125, None, 4.0)),
    "f-number 0": ({TIME: 0.5, NUMBER: 0.0}, ExifExposure(0.5)),
    "f-number 0 beside APEX": ({TIME: 0.5, NUMBER: 0.0, APERTURE: 2.0}, ExifExposure(0.5, None, 2.0)),
    "ISO above 16 bits": ({TIME: 0.5, ISO: 65535, INDEX: 102_400}, ExifExposure(0.5, 102_400)),
    "ISO of 16 bits full": ({TIME: 0.5, ISO: 65535}, ExifExposure(0.5)),
    "ISO twice": ({TIME: 0.5, ISO: (400, 400)}, ExifExposure(0.5, 400)),
}


@pytest.mark.parametrize("case", CASES)
def test_exposures(tmp_path, case):
    tags, expected = CASES[case]
    exposure = exif_exposure(photo(tmp_path / "a.jpg", tags))
    assert [None if a is None else pytest.approx(a, rel=1e-4) for a in expected] == list(exposure)


def test_tags_in_the_first_table(tmp_path):
    exposure = exif_exposure(photo(tmp_path / "a.tif", {}, first={TIME: 0.25, NUMBER: 4.0}))
    assert exposure[::2] == pytest.approx((0.25, 4.0))


XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description exif:ExposureTime="1/60" exif:FNumber="28/10">'
    "<exif:ISOSpeedRatings><rdf:Seq><rdf:li>400</rdf:li></rdf:Seq></exif:ISOSpeedRatings></rdf:Description></x:xmpmeta>"
)


def test_exposures_in_xmp_alone_and_beside_exif(tmp_path):
    text = PngInfo()
    text.add_itxt("XML:com.adobe.xmp", XMP)
    Image.new("RGB", (8, 8)).save(tmp_path / "a.png", pnginfo=text)
    Image.new("RGB", (8, 8)).save(tmp_path / "a.webp", xmp=XMP.encode())
    for name in ("a.png", "a.webp"):
        assert exif_exposure(tmp_path / name)[:3] == pytest.approx((1 / 60, 400, 2.8))
    exif = Image.Exif()
    exif.get_ifd(0x8769)[TIME] = 0.25
    Image.new("RGB", (8, 8)).save(tmp_path / "a.jpg", exif=exif, xmp=XMP.encode())
    assert exif_exposure(tmp_path / "a.jpg").time == 0.25


@pytest.mark.parametrize(
    ("text", "number"), [("1/125", 0.008), ("0,04", 0.04), (" 1/60 s", 1 / 60), ("x", None), ("1/0", None)]
)
def test_numbers_as_people_write_them(text, number):
    assert parse_number(text) == (None if number is None else pytest.approx(number))


def exposed(folder, factors):
    """One scene from several places, exposed by factors; points lie on its photos at known colors."""
    write_colmap(folder, len(factors), name="{:03d}.jpg", exif={i: {TIME: 0.01 * f} for i, f in enumerate(factors)})
    for i, factor in enumerate(factors):
        light = np.full((48, 64, 3), 0.2) * factor
        codes = 255 * np.clip(light, 0, 1) ** (1 / 2.2)
        exif = Image.Exif()
        if i != 2:
            exif.get_ifd(0x8769)[TIME] = 0.01 * factor
        Image.fromarray(codes.round().astype(np.uint8)).save(folder / "images" / f"{i:03d}.jpg", exif=exif, quality=100)
    return folder


@pytest.mark.parametrize("points", [0, 300])
def test_a_photo_without_time_gets_it_from_light_that_it_shares(tmp_path, points):
    folder = exposed(tmp_path, [1, 2, 0.5, 1, 2, 1])
    places = np.random.default_rng(0).uniform(-0.7, 0.7, (points, 3))
    lines = [f"{i + 1} {x} {y} {z} 9 9 9 0.5" for i, (x, y, z) in enumerate(places)]
    (folder / "sparse" / "0" / "points3D.txt").write_text("\n".join(["#", *lines, ""]))
    scene = load(folder, response="gamma-2.2", holdout=0)
    times = [view.exposure_time for view in scene.views]
    assert times == pytest.approx([0.01, 0.02, 0.005, 0.01, 0.02, 0.01], rel=0.03)
    (note,) = (note for note in scene.notes if note.startswith("002 does not state its exposure: "))
    assert ("points that other photos show too" in note) == bool(points)
    assert scene.exposure_times_known


def test_photos_with_flash_are_named(tmp_path):
    flash = {0: 0x19, 1: 0x18, 2: 0x10, 3: 1}  # Fired, auto and not fired, off, fired
    exif = {i: {TIME: 0.01, 37385: value} for i, value in flash.items()} | {i: {TIME: 0.01} for i in (4, 5)}
    write_colmap(tmp_path, 6, name="{:03d}.jpg", exif=exif)
    notes = [note for note in load(tmp_path, holdout=0).notes if "flash" in note]
    assert notes == ["the flash fired in 2 of 6 photos, so their light is not the scene's: 000.jpg, 003.jpg"]


def test_few_times_among_many_photos_are_not_counted(tmp_path):
    write_colmap(tmp_path, 6, name="{:03d}.jpg", exif={0: {TIME: 0.01, ISO: 100}, 1: {TIME: 0.02, ISO: 200}})
    scene = load(tmp_path)
    assert not scene.exposure_times_known and {view.exposure_time for view in scene.views} == {1.0}
    text = " ".join(scene.notes)
    assert "most photos state no exposure time" in text and "times of 2 are not counted" in text
    assert "ISO" not in text
