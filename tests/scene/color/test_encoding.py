"""Colors that photos state, against LittleCMS and colour-science; and damaged statements, which are named."""

import struct
import zlib

import colour
import numpy as np
import pytest
from PIL import Image, ImageCms

from sehdr_warp.errors import InputError
from sehdr_warp.response import response_by_name
from sehdr_warp.scene import load_scene
from sehdr_warp.scene.color.encoding import encoding_of, encoding_of_profile
from sehdr_warp.scene.color.icc import xyz_to_rec709
from sehdr_warp.scene.color.primaries import REC709, srgb_to_linear
from sehdr_warp.scene.images.ldr_files import EncodedImage, open_image, read_ldr
from tests.make_scenes import load, pattern, png_of, write_colmap

SPACES = {"sRGB": ("sRGB", None), "Display P3": ("Display P3", None), "Adobe RGB": ("Adobe RGB (1998)", 563 / 256),
          "ProPhoto": ("ProPhoto RGB", 1.8), "Rec.2020": ("ITU-R BT.2020", 2.4), "ACEScg": ("ACEScg", 2.2),
          "ACES AP0": ("ACES2065-1", 2.2)}  # fmt: skip
PATCHES = np.array([[230, 60, 40], [40, 200, 60], [30, 60, 220], [128, 128, 128], [250, 240, 10], [3, 7, 20]])


def s15(values):
    return b"".join(struct.pack(">i", round(float(value) * 65536)) for value in values)


def icc_profile(space: str, gamma: float | None = None, *, name="test", curve: bytes | None = None) -> bytes:
    """A matrix profile of a space of colour-science; gamma None is sRGB's curve."""
    d50 = np.array([0.9642, 1, 0.8249])
    colourspace = colour.RGB_COLOURSPACES[space].copy()
    colourspace.use_derived_transformation_matrices(True)
    white = colour.xy_to_XYZ(colourspace.whitepoint)
    adapt = colour.adaptation.matrix_chromatic_adaptation_VonKries(white, d50, "Bradford")
    matrix = adapt @ colourspace.matrix_RGB_to_XYZ
    if curve is None:
        numbers = (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
        curve = b"para\0\0\0\0" + (struct.pack(">HH", 0, 0) + s15([gamma]) if gamma else b"\0\3\0\0" + s15(numbers))
    text = name.encode() + b"\0"
    tags = [(b"desc", b"desc\0\0\0\0" + struct.pack(">I", len(text)) + text + b"\0" * 78),
            (b"wtpt", b"XYZ \0\0\0\0" + s15(d50)),
            *((tag, b"XYZ \0\0\0\0" + s15(column)) for tag, column in zip((b"rXYZ", b"gXYZ", b"bXYZ"), matrix.T)),
            *((tag, curve) for tag in (b"rTRC", b"gTRC", b"bTRC"))]  # fmt: skip
    offset, table, data = 132 + 12 * len(tags), struct.pack(">I", len(tags)), b""
    for tag, value in tags:
        value += b"\0" * (-len(value) % 4)
        table += tag + struct.pack(">II", offset + len(data), len(value))
        data += value
    body = table + data
    head = struct.pack(">I4sI", 128 + len(body), b"test", 0x04000000) + b"mntrRGB XYZ " + b"\0" * 12 + b"acsp"
    return (head + b"\0" * 28 + s15(d50)).ljust(128, b"\0") + body


def rec709_of(space, gamma, codes):
    value = codes / 255
    light = value**gamma if gamma else srgb_to_linear(value)
    colourspace = colour.RGB_COLOURSPACES[space].copy()
    colourspace.use_derived_transformation_matrices(True)
    target = colour.RGB_COLOURSPACES["ITU-R BT.709"].copy()
    target.use_derived_transformation_matrices(True)
    return light @ colour.matrix_RGB_to_RGB(colourspace, target, "Bradford").T


def light_of(view, scene):
    """Linear light of a view, with what is known above white."""
    light = scene.response.decode(view.image.astype(np.float64))
    if view.light_above_white is None:
        return light
    return np.where(view.light_above_white > 0, view.light_above_white, light)


def write_set(folder, save):
    """A COLMAP set whose photos hold patches, saved by save(image, path without suffix)."""
    write_colmap(folder)
    for i in range(6):
        pixels = pattern(64, 48, i).copy()
        for k, patch in enumerate(PATCHES):
            pixels[8:24, 8 * k : 8 * k + 8] = patch
        (folder / "images" / f"{i:03d}.png").unlink()
        save(Image.fromarray(pixels), folder / "images" / f"{i:03d}")
    model = folder / "sparse" / "0" / "images.txt"
    suffix = next((folder / "images").iterdir()).suffix
    model.write_text(model.read_text().replace(".png", suffix))
    return folder


def save_as(kind, profile):
    """Return a function that saves an image with a profile, for write_set(): "jpg", "tif 16", ..."""

    def save(image, path):
        suffix, _, deep = kind.partition(" ")
        path = path.with_suffix(f".{suffix}")
        codes = np.asarray(image).astype(np.uint16) * 257
        if deep and suffix == "tif":
            pytest.importorskip("tifffile").imwrite(path, codes, photometric="rgb", iccprofile=profile)
        elif deep:
            png16(path, codes / 65535, _iccp(profile))
        elif suffix == "heic":
            heif = pytest.importorskip("pillow_heif").from_pillow(image)
            heif.info["icc_profile"] = profile
            heif.save(path, quality=100, chroma=444, icc_profile=profile)
        else:
            options = {"jpg": {"quality": 100, "subsampling": 0}, "webp": {"lossless": True}, "avif": {"quality": 100}}
            image.save(path, icc_profile=profile, **options.get(suffix, {}))

    return save


FORMATS = ("png", "png 16", "tif", "tif 16", "webp", "jpg", "heic", "avif")


@pytest.mark.parametrize("kind", FORMATS)
def test_every_space_in_every_format(tmp_path, kind):
    for space, (name, gamma) in SPACES.items():
        patches = Image.fromarray(np.kron(PATCHES, np.ones((8, 8, 1))).astype(np.uint8).reshape(8, -1, 3))
        path = tmp_path / f"a.{kind.partition(' ')[0]}"
        save_as(kind, icc_profile(name, gamma, name=space))(patches, path.with_suffix(""))
        photo = read_ldr(path)
        with open_image(path) as image:
            light, clipped = encoding_of(image).to_linear(photo.pixels)
        expected = rec709_of(name, gamma, photo.pixels * (255 / photo.levels))  # Of the codes as they are decoded
        assert (np.abs(light - expected) <= 0.005 * expected.max(2, keepdims=True) + 1e-4)[~clipped].all(), space


@pytest.mark.parametrize("kind, space", [
    *(("png 16", space) for space in SPACES), *((kind, "Display P3") for kind in FORMATS if kind != "png 16")
])  # fmt: skip
def test_patches_through_every_format(tmp_path, space, kind):
    name, gamma = SPACES[space]
    scene = load(write_set(tmp_path, save_as(kind, icc_profile(name, gamma, name=space))), holdout=0)
    light, suffix = light_of(scene.views[0], scene), f".{kind.partition(' ')[0]}"
    # Of the codes as they are decoded, because some formats change them.
    decoded = read_ldr(tmp_path / "images" / f"000{suffix}")
    for k in range(len(PATCHES)):
        codes = decoded.pixels[16, 8 * k + 4]
        assert np.abs(codes * (255 / decoded.levels) - PATCHES[k]).max() < 8
        expected = np.maximum(rec709_of(name, gamma, codes * (255 / decoded.levels)), 0)
        error = np.abs(light[16, 8 * k + 4] - expected)
        clipped = codes == decoded.levels
        assert (error <= 0.005 * expected.max() + 1e-4)[~clipped].all(), (codes, expected, light[16, 8 * k + 4])
    words = [note for note in scene.notes if note.startswith("colors: ")]
    line = f"colors: 6 of 6 photos are in {space} (ICC profile) and converted to Rec.709 (000{suffix} ...)"
    assert words == ([] if space == "sRGB" else [line])


def test_colors_beyond_the_gamut_keep_their_light_above_white():
    codes = np.array([[[250, 10, 10], [255, 10, 10], [255, 255, 255], [128, 128, 128]]], np.uint8)
    image = encoding_of_profile(icc_profile("Display P3")).convert(EncodedImage(codes, None))
    light = rec709_of("Display P3", None, np.array([250, 10, 10]))
    assert image.pixels[0, 0, 0] == 65535 and image.above_white[0, 0, 0] == pytest.approx(light[0], rel=2e-3)
    assert image.above_white_deviation > 0
    clipped = image.pixels[0, 1, 0], image.above_white[0, 1, 0]
    assert clipped == (65535, 0), "a clipped channel has no known light"
    assert (image.pixels[0, 2] == 65535).all() and not image.above_white[0, 2:].any()
    assert np.ptp(image.pixels[0, 3]) <= 16


@pytest.mark.parametrize("space", ["Display P3", "ProPhoto RGB"])
def test_colors_beyond_the_gamut_agree_with_littlecms_in_floating_point(space):
    imagecodecs = pytest.importorskip("imagecodecs")
    profile = icc_profile(space, *([1.8] if space == "ProPhoto RGB" else []))
    codes = np.random.default_rng(0).integers(0, 256, (50, 60, 3), dtype=np.uint8)
    xyz = imagecodecs.cms_transform(
        codes,
        profile,
        imagecodecs.cms_profile("xyz"),
        colorspace="rgb",
        outcolorspace="xyz",
        outdtype="float64",
        intent=1,
    )
    expected = xyz_to_rec709(xyz)
    light, _ = encoding_of_profile(profile).to_linear(codes)
    assert expected.min() < -0.1 and expected.max() > 1.1
    assert (np.abs(light - expected) <= 0.005 * np.abs(expected).max(-1, keepdims=True) + 1e-4).all()


@pytest.mark.parametrize("kind", ["jpg", "tif 16"])
@pytest.mark.parametrize("response", ["srgb", "hdr-nerf"])
def test_photos_that_are_reduced_have_the_mean_light_of_their_converted_pixels(tmp_path, kind, response):
    folder = write_set(tmp_path, save_as(kind, icc_profile("Display P3", name="P3")))
    whole, half = (load(folder, response, holdout=0, max_size=size).views[0] for size in (None, 32))
    curve = response_by_name(response)
    light = curve.decode(whole.image.astype(np.float64))
    above = 0 if whole.light_above_white is None else whole.light_above_white.astype(np.float64)
    light = np.where(above > 0, above * curve.decode(1.0), light)
    clipped = ((whole.codes == 65535) & (above == 0)).reshape(24, 2, 32, 2, 3).mean((1, 3))
    expected = np.asarray(curve.encode(light.reshape(24, 2, 32, 2, 3).mean((1, 3)))) * 65535
    below = (clipped == 0) & (expected < 65000)
    assert below.mean() > 0.5 and np.abs(half.codes - expected)[below].max() <= 0.002 * 65535
    assert (half.codes[clipped >= 0.5] == 65535).all()


def test_srgb_profiles_leave_codes_as_they_are(tmp_path):
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    scene = load(write_set(tmp_path, lambda image, path: image.save(path.with_suffix(".png"), icc_profile=profile)))
    assert scene.views[0].codes.dtype == np.uint8 and not any("colors" in note for note in scene.notes)


def png16(path, values, *chunks):
    """A 16-bit PNG of values in [0, 1] with chunks of color before the pixels."""
    codes = np.rint(values * 65535).astype(">u2")
    rows = b"".join(b"\0" + row.tobytes() for row in codes)
    head = struct.pack(">IIBBBBB", values.shape[1], values.shape[0], 16, 2, 0, 0, 0)
    path.write_bytes(png_of((b"IHDR", head), *chunks, (b"IDAT", zlib.compress(rows)), (b"IEND", b"")))


def _iccp(profile):
    return b"iCCP", b"x\0\0" + zlib.compress(profile)


LIGHT = {
    "gAMA 1": ((b"gAMA", struct.pack(">I", 100_000)), lambda x: x, "linear light, gAMA 1"),
    "linear profile": (_iccp(icc_profile("sRGB", 1.0, name="lin")), lambda x: x, "linear light, lin (ICC"),
    "cICP linear": ((b"cICP", bytes([1, 8, 0, 1])), lambda x: x, "linear light, cICP 1/8"),
    "cICP PQ": ((b"cICP", bytes([1, 16, 0, 1])), lambda x: colour.eotf_inverse(x * 800, "ST 2084"), "PQ light"),
    "cICP HLG": ((b"cICP", bytes([1, 18, 0, 1])), lambda x: colour.models.oetf_BT2100_HLG(x), "HLG light, cICP 1/18"),
    "cICP log": ((b"cICP", bytes([1, 9, 0, 1])), lambda x: 1 + np.log10(np.maximum(x, 0.01)) / 2, "log light"),
}  # fmt: skip


@pytest.mark.parametrize("case", LIGHT)
def test_stated_light_wins_over_a_guess(tmp_path, case):
    chunk, encode, words = LIGHT[case]
    steps = np.array([0.05, 0.2, 0.8])
    write_colmap(tmp_path)
    for i in range(6):
        light = 0.02 + 0.9 * srgb_to_linear(pattern(64, 48, i) / 255)
        light[:16, :48] = np.repeat(steps, 16)[None, :, None]
        png16(tmp_path / "images" / f"{i:03d}.png", encode(light), chunk)
    scene = load_scene(tmp_path)
    assert scene.light_known and any(words in note and "no response is guessed" in note for note in scene.notes)
    light = light_of(scene.views[0], scene)[8, 8:48:16, 0]
    np.testing.assert_allclose(np.diff(np.log2(light)), 2, atol=0.01)
    with pytest.raises(InputError, match="their light is known, and response gamma-2.2 does not apply"):
        load_scene(tmp_path, response="gamma-2.2")


def test_gamma_and_primaries_of_png(tmp_path):
    red, _, blue, white = np.array(REC709).reshape(4, 2)
    places = np.r_[white, red, (0.21, 0.71), blue] * 100_000
    chunks = (b"gAMA", struct.pack(">I", 55_556)), (b"cHRM", struct.pack(">8I", *np.rint(places).astype(int)))
    png16(tmp_path / "a.png", np.full((2, 2, 3), 0.5), *chunks)
    with open_image(tmp_path / "a.png") as image:
        encoding = encoding_of(image)
    assert encoding.name == "gAMA 0.55556 and cHRM" and not encoding.light
    light, _ = encoding.to_linear(np.full((1, 1, 3), 32768, np.uint16))
    np.testing.assert_allclose(light, 0.5**1.8, rtol=2e-3)
    # 2.2 is how tools write sRGB; FFmpeg writes 1.961 or code points for the curves of video cameras.
    video = [(b"cICP", bytes([1, curve, 0, 1])) for curve in (1, 4, 6, 7, 11, 12, 14, 15)]
    for chunk in [*((b"gAMA", struct.pack(">I", gamma)) for gamma in (45_455, 50_994)), *video]:
        png16(tmp_path / "b.png", np.full((2, 2, 3), 0.5), chunk)
        with open_image(tmp_path / "b.png") as image:
            assert encoding_of(image).is_srgb, chunk
    png16(tmp_path / "c.png", np.full((2, 2, 3), 0.5), chunks[1])
    with open_image(tmp_path / "c.png") as image:
        alone = encoding_of(image)
    assert alone.name.startswith("cHRM, without a curve") and not alone.curves and alone.to_rec709 is not None, (
        "primaries without a gamma"
    )


def test_photos_of_one_name_in_several_folders_are_counted_each(tmp_path):
    write_colmap(tmp_path, name="cam{}/0000.png")
    for path in (tmp_path / "images").rglob("*.png"):
        Image.open(path).save(path, icc_profile=icc_profile("Display P3", name="P3"))
    notes = [note for note in load(tmp_path, holdout=0).notes if note.startswith("colors")]
    assert notes == ["colors: 6 of 6 photos are in P3 (ICC profile) and converted to Rec.709 (0000.png ...)"]


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
@pytest.mark.parametrize("table", [{0xA001: 2}, {0xA001: 0xFFFF, 0xA005: {1: "R03"}}])
def test_adobe_rgb_of_exif(tmp_path, table, suffix):
    exif = Image.Exif()
    exif[271] = "camera"  # Pillow writes no EXIF whose first table is empty.
    exif.get_ifd(0x8769).update(table)
    path = tmp_path / f"a{suffix}"
    Image.fromarray(np.full((8, 8, 3), PATCHES[0], np.uint8)).save(path, exif=exif, quality=100)
    with open_image(path) as image:
        encoding = encoding_of(image)
    light, _ = encoding.to_linear(np.array([[PATCHES[0]]], np.uint8))
    np.testing.assert_allclose(light[0, 0], rec709_of("Adobe RGB (1998)", 563 / 256, PATCHES[0]), rtol=2e-3)


def lab_profile():
    return ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes()


BAD_PROFILES = {
    "nothing": (b"no profile at all" * 20, "is damaged"),
    "cut": (icc_profile("Display P3")[:300], "is damaged"),
    "Lab": (lab_profile(), "is of Lab, not RGB"),
    "gamma 0": (icc_profile("Display P3", curve=b"curv\0\0\0\0\0\0\0\1\0\0\0\0"), "is damaged"),
    "falling curve": (icc_profile("sRGB", curve=b"curv\0\0\0\0\0\0\0\2\xff\xff\0\0"), "has a curve that does not rise"),
}


@pytest.mark.parametrize("case", BAD_PROFILES)
def test_bad_profiles_are_named_and_count_as_srgb(tmp_path, case):
    profile, words = BAD_PROFILES[case]
    scene = load(write_set(tmp_path, lambda image, path: image.save(path.with_suffix(".png"), icc_profile=profile)))
    assert scene.views[0].codes.dtype == np.uint8
    assert [note for note in scene.notes if f"its ICC profile {words}" in note and "count as sRGB" in note]


@pytest.mark.parametrize("kind", ["half of it", "not packed"])
def test_profiles_that_pillow_cannot_join_are_named(tmp_path, kind):
    """A JPEG with one of two parts of its profile, and a PNG whose profile does not unpack."""
    if kind == "half of it":
        file = tmp_path / "a.jpg"
        Image.fromarray(np.full((8, 8, 3), 90, np.uint8)).save(file)
        part = b"ICC_PROFILE\0\1\2" + icc_profile("Display P3")[:300]
        data = file.read_bytes()
        file.write_bytes(data[:2] + b"\xff\xe2" + struct.pack(">H", len(part) + 2) + part + data[2:])
    else:
        file = tmp_path / "a.png"
        png16(file, np.full((2, 2, 3), 0.5), (b"iCCP", b"x\0\0no zlib"))
    with open_image(file) as image:
        encoding = encoding_of(image)
    assert encoding.problem == "its ICC profile is damaged" and encoding.is_srgb


def test_names_of_profiles_fit_a_line(tmp_path):
    profile = icc_profile("Display P3", name="n\n" * 20_000)
    Image.fromarray(np.full((8, 8, 3), 90, np.uint8)).save(tmp_path / "a.png", icc_profile=profile)
    with open_image(tmp_path / "a.png") as image:
        encoding = encoding_of(image)
    assert len(encoding.name) < 200 and "\n" not in encoding.name


def test_bad_gamma_and_primaries_of_png_are_named(tmp_path):
    line = struct.pack(">8I", 31270, 32900, 10000, 10000, 20000, 20000, 30000, 30000)
    for chunk, words in (((b"gAMA", bytes(4)), "its gAMA is 0"),
                         ((b"cHRM", line), "its cHRM (primaries) spans no colors"),
                         ((b"cICP", bytes([77, 1, 0, 1])), "its cICP 77/1 is not known")):  # fmt: skip
        png16(tmp_path / "a.png", np.full((2, 2, 3), 0.5), chunk)
        with open_image(tmp_path / "a.png") as image:
            encoding = encoding_of(image)
        assert encoding.problem == words and encoding.is_srgb


def test_a_profile_that_unpacks_to_much_is_one_line(tmp_path):
    bomb = b"iCCP", b"x\0\0" + zlib.compress(bytes(200 << 20))
    png16(tmp_path / "a.png", np.full((2, 2, 3), 0.5), bomb)
    with pytest.raises(InputError, match="is not a readable image"), open_image(tmp_path / "a.png"):
        pass


def test_narrow_range_and_unstated_code_points(tmp_path):
    encodings = []
    for code_points in ([1, 13, 0, 0], [2, 2, 0, 1], [1, 13, 0, 1]):
        png16(tmp_path / "a.png", np.full((2, 2, 3), 0.5), (b"cICP", bytes(code_points)))
        with open_image(tmp_path / "a.png") as image:
            encodings.append(encoding_of(image))
    narrow, unstated, rec709 = encodings
    light, _ = narrow.to_linear(np.array([[[16, 126, 235]]], np.uint8))
    np.testing.assert_allclose(light[0, 0], srgb_to_linear(np.array([0, 110 / 219, 1])), atol=2e-3)
    assert unstated.is_srgb and rec709.is_srgb
