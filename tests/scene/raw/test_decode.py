import shutil

import numpy as np
import pytest
import torch
from PIL import Image

from sehdr_warp.errors import InputError
from sehdr_warp.model.baking import field_of
from sehdr_warp.model.color_models import rec709_of
from sehdr_warp.output.images.exr import rgb_channels, write_exr
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.run import Splats
from sehdr_warp.scene import load_scene
from sehdr_warp.scene.photos import usable_photos
from sehdr_warp.scene.raw.decode import color_matrix, linear_codes, read_header, read_raw
from sehdr_warp.scene.raw.dng import read_dng
from sehdr_warp.scene.readers.bare_photos import find_photos
from sehdr_warp.synth.expose import SensorNoise, noisy
from tests.splats.samples import gaussians

from ...make_scenes import edited_json
from ...output.helpers import camera
from ..raw.dng_files import picture, posed
from .dng_files import TO_CAMERA, write_dng

BALANCE = np.array([0.5, 1.0, 0.7])


def test_what_clips_in_a_noisy_sensor_is_clipped():
    random = np.random.default_rng(0)
    samples = np.array(noisy(np.full((64, 64, 3), 3.0), 1.0, SensorNoise(), random))
    codes = linear_codes(np.rint(samples * 16383) / 16383)
    assert (samples < 1).mean() > 0.3 and (codes == 65535).all()


def test_raw_files_clip_by_channel_in_the_sensors_colors(tmp_path):
    pytest.importorskip("rawpy")
    # A surface from dark to three times white: green clips first.
    light = BALANCE * np.linspace(0.02, 3, 96)[None, :, None] * np.ones((64, 1, 1))
    write_dng(tmp_path / "a.dng", light, balance=BALANCE)
    codes = read_raw(tmp_path / "a.dng", oriented=False).pixels
    decoded, expected = np.zeros(codes.shape), np.clip(light, 0, 1)
    decoded = np.where(codes / 65535 <= 0.04045, codes / 65535 / 12.92, ((codes / 65535 + 0.055) / 1.055) ** 2.4)
    inside = slice(4, -4), slice(4, -4)
    np.testing.assert_allclose(decoded[inside], expected[inside], rtol=0.03)
    assert ((codes == 65535) == (expected >= 0.99))[inside].mean() > 0.999
    assert read_header(tmp_path / "a.dng").exposure_time == pytest.approx(1 / 60, rel=1e-4)
    matrix = color_matrix([tmp_path / "a.dng"])
    np.testing.assert_allclose(matrix @ BALANCE, 1, atol=1e-3)
    # A color in the sensor's own comes back as what it is in Rec.709.
    to_rec709 = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
    assert np.sign(matrix).tolist() == np.sign(to_rec709 @ np.linalg.inv(TO_CAMERA)).tolist()


@pytest.mark.parametrize("clips", [15892, 13000])
def test_what_piles_up_below_the_stated_white_is_clipped(tmp_path, clips):
    """Some cameras state a white level for their number of bits alone."""
    pytest.importorskip("rawpy")
    light = np.random.default_rng(0).uniform(0.02, 1, (128, 96, 1)) * [0.9, 1, 0.8]
    light[:, 70:] *= 3
    write_dng(tmp_path / "a.dng", light, white=clips, stated=16383)
    clipped = read_raw(tmp_path / "a.dng", oriented=False).pixels == 65535
    write_dng(tmp_path / "b.dng", light / 4, white=clips, stated=16383)
    assert clipped[:, 74:].mean() > 0.4 and clipped[:, :66].mean() < 0.02
    assert read_raw(tmp_path / "b.dng", oriented=False).pixels.max() < 65535


@pytest.mark.parametrize("suffix, maker, white", [
    (".nef", ("NIKON CORPORATION", "NIKON D850"), 65535),
    (".cr2", ("Canon", "Canon EOS 5D Mark IV"), 65535),
    (".arw", ("SONY", "ILCE-7M3"), 16383),
])  # fmt: skip
def test_cameras_whose_colors_libraw_knows(tmp_path, suffix, maker, white):
    """Bare files of these makers, without compression and notes, so without a matrix and white balance."""
    rawpy = pytest.importorskip("rawpy")
    file, light = tmp_path / f"a{suffix}", BALANCE * np.linspace(0.02, 0.9, 96)[None, :, None] * np.ones((64, 1, 1))
    write_dng(file, light, black=0, white=white, maker=maker)
    decoded = response_by_name("srgb").decode(read_raw(file, oriented=False).pixels / 65535)
    np.testing.assert_allclose(decoded[4:-4, 4:-4], light[4:-4, 4:-4], rtol=0.03)
    with rawpy.imread(str(file)) as raw:
        daylight = np.array(raw.daylight_whitebalance[:3])
    matrix = color_matrix([file])
    np.testing.assert_allclose(matrix @ (1 / daylight) * daylight.min(), 1, atol=2e-3)
    assert (np.diag(matrix) > 0.5).all()


def test_photos_of_another_kind_than_most_are_left_out(tmp_path):
    folder = posed(tmp_path, lambda path, i: write_exr(path, rgb_channels(picture(i))), ".exr")
    with edited_json(folder / "transforms.json") as values:
        odd = values["frames"][1]["file_path"].replace(".exr", ".png")
        (folder / values["frames"][1]["file_path"]).unlink()
        Image.fromarray(np.zeros((24, 32, 3), np.uint8)).save(folder / odd)
        values["frames"][1]["file_path"] = odd
    scene = load_scene(folder)
    assert len(scene.views) == len(values["frames"]) - 1 and scene.light_known
    assert any(odd.split("/")[-1] in note and "photos of one set are of one kind" in note for note in scene.notes)


def test_raw_beside_jpegs_of_the_same_shots_is_named_with_what_to_give(tmp_path):
    pytest.importorskip("rawpy")
    for i in range(3):
        write_dng(tmp_path / f"{i}.dng", np.full((64, 64, 3), 0.5 + 0.1 * i))
        Image.fromarray(np.full((64, 64, 3), 90 + 40 * i, np.uint8)).save(tmp_path / f"{i}.jpg")
    photos, kind, (note,) = usable_photos(find_photos(tmp_path).records)
    assert kind == "encoded" and [photo.image.suffix for photo in photos] == [".jpg"] * 3
    assert "because as many are JPEG and similar photos" in note and note.endswith("give a folder of RAW alone")


def test_raw_photos_of_two_cameras_are_refused_before_they_are_matched(tmp_path, monkeypatch):
    pytest.importorskip("rawpy")
    monkeypatch.setattr("sehdr_warp.scene.readers.bare_photos.reconstruct", lambda *_: pytest.fail("matched"))
    for i, matrix in enumerate((TO_CAMERA, TO_CAMERA, TO_CAMERA[::-1])):
        write_dng(tmp_path / f"{i}.dng", np.full((64, 64, 3), 0.5 + 0.1 * i), to_camera=matrix)
    with pytest.raises(InputError, match=r"2.dng: is of another camera than 0.dng"):
        load_scene(tmp_path)


def test_files_that_are_no_photos_of_a_camera(tmp_path, shared, capfd):
    pytest.importorskip("rawpy")
    (tmp_path / "a.nef").write_bytes(b"II*\0" + bytes(100))
    write_dng(tmp_path / "b.dng", np.ones((64, 64, 3)))
    (tmp_path / "c.dng").write_bytes((tmp_path / "b.dng").read_bytes()[:3000])
    for name in ("a.nef", "c.dng"):
        with pytest.raises(InputError, match="cannot be read as RAW"):
            read_raw(tmp_path / name, oriented=False)
    assert capfd.readouterr().err == ""
    folder = shared / "data" / "raw"
    with pytest.raises(InputError, match="not a photo through a filter of three colors"):
        read_raw(folder / "Nikon_uncompressed.nef", oriented=False)
    shutil.copy(folder / "RAW_KODAK_DC50.KDC", tmp_path / "d.dng")
    with pytest.raises(InputError, match="states no color matrix"):
        color_matrix([tmp_path / "d.dng"])
    matrix = color_matrix([folder / "Blackmagic.dng"])
    np.testing.assert_allclose(matrix @ (1 / np.array([2.2060447, 1.0, 1.8867925])), 1, atol=0.02)


def test_raw_and_its_developed_jpeg_show_the_same_light(tmp_path, shared):
    """Compare to 2 % after one matrix, in means over 32 x 32 pixels that the JPEG exposes well.

    Pixel by pixel, two demosaicings and 8 bits differ by more."""
    rawpy = pytest.importorskip("rawpy")
    file = shared / "data" / "raw" / "Blackmagic.dng"
    with rawpy.imread(str(file)) as raw:
        options = {"gamma": (2.4, 12.92), "no_auto_bright": True, "use_camera_wb": True, "user_flip": 0}
        left, top, width, height = map(int, read_dng(file).crop)
        developed = raw.postprocess(**options)[top : top + height, left : left + width]
        Image.fromarray(developed).save(tmp_path / "a.jpg", quality=95, subsampling=0)
    codes = [read_raw(file, oriented=False).pixels / 65535, np.asarray(Image.open(tmp_path / "a.jpg")) / 255]
    blocks = [c[:2144, :4096].reshape(67, 32, 128, 32, 3).swapaxes(1, 2) for c in codes]
    well = (blocks[1].min((2, 3, 4)) > 0.1) & (blocks[1].max((2, 3, 4)) < 0.92)
    ours, theirs = (response_by_name("srgb").decode(block[well]).mean((1, 2)) for block in blocks)
    ours = ours @ color_matrix([file]).T
    level = theirs.mean(1, keepdims=True)
    matrix = np.linalg.lstsq(ours / level, theirs / level, rcond=None)[0]
    error = np.abs(ours @ matrix / theirs - 1)
    assert well.sum() > 5000 and np.percentile(error, 95) < 0.02 and np.median(error) < 0.005


def test_what_is_clipped_in_a_sensor_is_neutral_or_keeps_the_color_it_shows():
    matrix = np.diag(1 / BALANCE)
    light = torch.tensor([[1.0, 1, 1], [0.4, 0.2, 0.1], [0.6, 1.0, 0.7], [0.1, 1.0, 0.1]], dtype=torch.float64)
    # All clipped: white. None: as it is. Green alone, beside brighter ones: as bright. A green lamp: green.
    expected = [[2, 2, 2], [0.8, 0.2, 0.1 / 0.7], [1.2, 1.2, 1], [0.2, 1, 0.1 / 0.7]]
    for white in (4.0, 100.0):
        np.testing.assert_allclose(rec709_of(light * white, matrix, white), np.array(expected) * white, rtol=1e-9)


def test_a_scene_in_a_sensors_colors_is_rendered_in_rec709(tmp_path):
    scene = Splats(tmp_path, field_of(gaussians()), ())
    plain = scene.render(camera()).hdr.numpy()
    scene.color_matrix = np.array([[2, 0, 0], [0, 1, 0], [0, -1, 3.0]])
    dark = plain.max(axis=2) < 0.74 / scene.base_time
    expected = np.maximum(plain @ scene.color_matrix.T, 0)
    assert dark.mean() > 0.5
    np.testing.assert_allclose(scene.render(camera()).hdr.numpy()[dark], expected[dark], rtol=1e-5)
    options = {"focal_length": 50.0, "pixel_angle": 0.0}
    samples = scene.render_directions(np.zeros(3), np.array([[[0.0, 0, 1]]]), **options)
    assert samples.hdr.shape == (1, 1, 3)
    scene.field.response = response_by_name("colour:S-Log3")  # White is far above an exposure of 1
    light = np.array([8.0, 2, 6])
    np.testing.assert_allclose(scene.in_rec709(torch.tensor(light)), scene.color_matrix @ light, rtol=1e-6)


def test_a_set_of_raw_files_becomes_a_scene(tmp_path):
    pytest.importorskip("rawpy")

    def write(path, i):
        write_dng(path, np.clip(picture(i) / 20, 0, 2) * BALANCE, balance=BALANCE)

    scene = load_scene(posed(tmp_path, write, ".dng"))
    assert scene.response.name == "srgb" and scene.light_known
    np.testing.assert_allclose([view.exposure_time for view in scene.views], 1 / 60, rtol=1e-4)
    np.testing.assert_allclose(scene.color_matrix @ BALANCE, 1, atol=1e-3)
    codes = [np.array(view.codes) for view in scene.views]
    assert 0.01 < np.mean([(c == 65535).mean() for c in codes]) < 0.6
