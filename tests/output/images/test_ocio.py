"""Previews through OpenColorIO, and its names of color spaces."""

import os
import zipfile

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.output.images.colorspace import SPACES, from_rec709
from sehdr_warp.output.images.display import display_gain
from sehdr_warp.output.images.ocio import ocio_view
from sehdr_warp.output.render_views import render_views
from tests.ocio_config import ocio_config

from ..helpers import AnalyticRun

OCIO = pytest.importorskip("PyOpenColorIO")
CONFIG = "ocio://default"


def test_previews_are_the_view(tmp_path):
    run = AnalyticRun()
    render_views(run, tmp_path, ocio=CONFIG, view="Un-tone-mapped")
    preview = np.asarray(Image.open(tmp_path / "preview" / "t_0.png")) / 255
    light = run.render(run.cameras[3].camera).hdr.numpy() * run.base_time * display_gain(run.response)
    # Without a tone map this view is sRGB's curve.
    expected = np.clip(light, 0, 1)
    expected = np.where(expected <= 0.0031308, 12.92 * expected, 1.055 * expected ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(preview, expected, atol=1.5 / 255)
    other = ocio_view(CONFIG, "Display P3 - Display/ACES 2.0 - SDR 100 nits (P3 D65)")(np.full((1, 1, 3), 1e6))
    assert 0.9 < other.min() <= other.max() <= 1


def test_what_a_config_lacks_is_named(tmp_path):
    with pytest.raises(InputError, match="has no view 'x'.*Un-tone-mapped"):
        ocio_view(CONFIG, "x")
    with pytest.raises(InputError, match="has no display 'x'"):
        ocio_view(CONFIG, "x/Raw")
    (tmp_path / "a.ocio").write_text("no config")
    for name, problem in (("a.ocio", "is not an OpenColorIO config"), ("b.ocio", "file not found")):
        with pytest.raises(InputError, match=problem):
            ocio_view(str(tmp_path / name), "Raw")
    (tmp_path / "raw.ocio").write_text(OCIO.Config.CreateRaw().serialize())
    with pytest.raises(InputError, match="has no role aces_interchange"):
        ocio_view(str(tmp_path / "raw.ocio"), "Raw")
    with pytest.raises(SehdrError, match="need ocio, a config, and view.*; camera chooses"):
        render_views(AnalyticRun(), tmp_path / "out", view="Raw")


def test_color_spaces_have_the_names_and_matrices_of_openexr():
    """colorInteropID is an identifier of the Color Interop Forum, which OpenColorIO's own spaces state."""
    config = OCIO.Config.CreateFromFile(CONFIG)
    names = {space.getInteropID(): space.getName() for space in config.getColorSpaces()}
    for space in (space for space in SPACES if space.interop_id):
        to = config.getProcessor(names["lin_rec709_scene"], names[space.interop_id]).getDefaultCPUProcessor()
        for light in np.eye(3):
            np.testing.assert_allclose(to.applyRGB(light.tolist()), from_rec709(light, space.name), atol=2e-5)


def config_of(folder, transform):
    """A config whose one view is a transform."""
    (folder / "own.ocio").write_text(ocio_config(transform, "luts:."))
    return str(folder / "own.ocio")


def test_luts_beside_a_config_are_read(tmp_path, monkeypatch):
    (tmp_path / "luts").mkdir()
    rows = (f"{r / 2} {g / 4} {b / 8}" for b in (0, 1) for g in (0, 1) for r in (0, 1))
    (tmp_path / "luts" / "a.cube").write_text("LUT_3D_SIZE 2\n" + "\n".join(rows) + "\n")
    config = config_of(tmp_path, "!<FileTransform> {src: a.cube, interpolation: linear}")
    monkeypatch.chdir(tmp_path)
    light = np.full((1, 1, 3), 0.4)
    expected = from_rec709(light, "aces2065-1") / [2, 4, 8]
    for name in (config, "own.ocio"):
        np.testing.assert_allclose(ocio_view(name, "V")(light), expected, atol=1e-5)
    (tmp_path / "luts" / "a.cube").write_text("LUT_3D_SIZE 2\n" + "0.5 0.5 0.5\n" * 8)
    np.testing.assert_allclose(ocio_view(config, "V")(light), 0.5, atol=1e-5)


@pytest.mark.parametrize(
    "kind", ["missing", "damaged", "no lut", "cycle", "pipe", "device", "folder", "sparse", "empty", "not text"]
)
def test_luts_that_cannot_be_read_are_named_in_a_line(tmp_path, kind):
    lut = tmp_path / "x.cube"
    if kind == "pipe":
        os.mkfifo(lut)
    elif kind == "folder":
        lut.mkdir()
    elif kind != "missing":
        lut.write_text("" if kind == "empty" else "LUT_3D_SIZE 2\n0 0 0\n")
    if kind == "sparse":
        os.truncate(lut, 4 << 30)
    source = {"no lut": "/etc/passwd", "device": "/dev/zero"}.get(kind, "x.cube")
    transform = f"!<FileTransform> {{src: {source}}}"
    if kind == "cycle":
        transform = "!<ColorSpaceTransform> {src: out, dst: raw}"
    if kind == "not text":
        lut.write_bytes(b"LUT_3D_SIZE \xff\n0 0 0\n")
    with pytest.raises(InputError) as error:
        ocio_view(config_of(tmp_path, transform), "V")
    assert "\n" not in str(error.value) and len(str(error.value)) < 900


@pytest.mark.parametrize("kind", ["no archive", "large"])
def test_archives_that_cannot_be_read_are_named_in_a_line(tmp_path, kind):
    file = tmp_path / "own.ocioz"
    file.write_bytes(b"PK" + bytes(100))
    if kind == "large":
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("a.cube", "w") as lut:
            for _ in range(5):
                lut.write(bytes(60_000_000))
    with pytest.raises(InputError, match="is not an archive of a config|unpacks to 300000000 bytes"):
        ocio_view(str(file), "V")
