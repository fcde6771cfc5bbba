"""OCIO configs and LUTs that were made to do harm."""

import zipfile

import pytest

from tests.ocio_config import ocio_config

from .hostile import tried

pytestmark = pytest.mark.trial


LUT_3D = "LUT_3D_SIZE 2\n" + "0 0 0\n" * 8
LAUGHS = '<?xml version="1.0"?><!DOCTYPE l [<!ENTITY a0 "ha">{}]>'
LAUGHS += '<ProcessList id="x"><Description>&a20;</Description></ProcessList>'
LAUGHS = LAUGHS.format("".join(f'<!ENTITY a{n} "{f"&a{n - 1};" * 10}">' for n in range(1, 21)))
LUT_FILES = {
    "cube of a million": ("a.cube", "LUT_3D_SIZE 1000000\n0 0 0\n"),
    "cube of minus one": ("a.cube", "LUT_3D_SIZE -1\n0 0 0\n"),
    "long line": ("a.cube", "LUT_1D_SIZE 1000000000\n0 0 0\n"),
    "numbers that are none": ("a.cube", LUT_3D.replace("0 0 0", "nan inf x")),
    "spi1d of 2^40": ("a.spi1d", "Version 1\nFrom 0 1\nLength 1099511627776\nComponents 1\n{\n0\n}\n"),
    "spi3d of 2^31": ("a.spi3d", "SPILUT 1.0\n3 3\n2147483647 2147483647 2147483647\n0 0 0 0 0 0\n"),
    "3dl": ("a.3dl", "3DMESH\nMesh 30 30\n0 1 2\n"),
    "csp": ("a.csp", "CSPLUTV100\n3D\n\n999999999\n0 1\n0 1\n"),
    "xml that grows": ("a.clf", LAUGHS),
    "ctf that grows": ("a.ctf", LAUGHS),
    "cdl that grows": ("a.cdl", LAUGHS),
    "xml of another file": (
        "a.clf",
        '<?xml version="1.0"?><!DOCTYPE l [<!ENTITY x SYSTEM "file:///etc/passwd">]><ProcessList id="&x;"/>',
    ),
    "hdl": ("a.lut", "Version 1\nFormat any\nType 3D\nFrom 0 1\nTo 0 1\nBlack 0\nWhite 1\nLength 9999999\nLUT:\n"),
    "zeros": ("a.cube", "\0" * 100_000),
    "icc": ("a.icc", "acsp" * 100),
}


def lut_config(file, search_path="."):
    """The text of a config whose view is a LUT."""
    return ocio_config(f"!<FileTransform> {{src: {file}}}", search_path)


VIEW_LINE = "render run --out seen --ocio own.ocio --view V --device cpu"


@pytest.mark.parametrize("name", LUT_FILES)
def test_luts_that_were_made(space, name):
    pytest.importorskip("PyOpenColorIO")
    file, text = LUT_FILES[name]
    (space / file).write_text(text)
    (space / "own.ocio").write_text(lut_config(file))
    ended = tried(space, VIEW_LINE)
    assert "root:" not in ended.err


CONFIGS = {
    "environment in a path": lut_config("$SECRET/a.cube", "$HOME:$PATH:."),
    "up and up": lut_config("etc/passwd", "../../..:/"),
    "url": lut_config("http://127.0.0.1:9/a.cube"),
    "version 99": lut_config("a.cube").replace("version: 2", "version: 99"),
    "yaml that grows": "a: &a [x, x, x]\n"
    + "".join(f"{chr(98 + n)}: &{chr(98 + n)} [{', '.join([f'*{chr(97 + n)}'] * 9)}]\n" for n in range(12)),
    "deep": "{a: " * 3000 + "1" + "}" * 3000,
    "python": "!!python/object/apply:os.system ['touch PWNED']",
    "empty": " ",
    "zeros": "\0" * 5000,
}


@pytest.mark.parametrize("name", CONFIGS)
def test_configs_that_were_made(space, name):
    pytest.importorskip("PyOpenColorIO")
    (space / "own.ocio").write_text(CONFIGS[name])
    ended = tried(space, VIEW_LINE, codes=(1,))
    assert "root:" not in ended.err


@pytest.mark.parametrize("name", ["no archive", "up", "bomb", "nothing in it"])
def test_archives_of_configs(space, name):
    pytest.importorskip("PyOpenColorIO")
    place = space / "own.ocioz"
    if name == "no archive":
        place.write_bytes(b"PK\3\4" + bytes(500))
    else:
        with zipfile.ZipFile(place, "w", zipfile.ZIP_DEFLATED) as archive:
            if name != "nothing in it":
                archive.writestr("config.ocio", lut_config("../a.cube" if name == "up" else "a.cube"))
            archive.writestr(
                "../a.cube" if name == "up" else "a.cube", "0 0 0\n" * (60_000_000 if name == "bomb" else 1)
            )
    tried(space, VIEW_LINE.replace("own.ocio", "own.ocioz"), codes=(1,))
