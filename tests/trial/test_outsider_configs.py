"""Presets, responses and color configs of an outsider."""

import os

import pytest

from .hostile import SHORT, tried
from .outsider import DEEP, RENDER, put

pytestmark = pytest.mark.trial
PRESETS = (
    "base = \n", "a = " + DEEP, "a = " + "{b=" * 3000, 'base = "p.toml"', 'base = "../../../etc/passwd"',
    'base = "/dev/zero"', 'base = "default"\n[loss]\nssim_weight = nan',
    'base = "default"\n[schedule]\niterations = inf',
    'base = "default"\n[schedule]\niterations = ' + "9" * 30,
    'base = "default"\n[schedule]\niterations = ' + "9" * 5000,
    'base = "default"\n"\\u001b[31mx" = 1', 'base = "default"\n[__class__]\nx = 1', "base".encode("utf-16"),
    'base = "default"\n[loss]\nssim_weight = 1979-05-27', "fifo", "zero", "folder",
)  # fmt: skip


@pytest.mark.parametrize("number", range(len(PRESETS)))
def test_presets_of_an_outsider(space, number):
    put(space / "p.toml", PRESETS[number])
    try:
        tried(space, "config p.toml", (1, 2))
    finally:
        os.rename(space / "p.toml", space.parent / "p.toml")


CURVES = {
    "words.csv": "a,b\nc,d\n", "nan.csv": "0,0\nnan,nan\n1,1\n", "falling.csv": "0,1\n1,0\n", "one.csv": "0,0\n",
    "bytes.csv": bytes(range(256)) * 50, "long.csv": "0," + "1" * 10_000_000 + "\n", "deep.json": DEEP,
    "words.json": '{"exposure": ["a"], "encoded": {}}', "huge.cube": "LUT_1D_SIZE 1000000000\n0 0 0\n",
    "nan.cube": "LUT_1D_SIZE 2\nnan nan nan\n1 1 1\n", "flat.cube": "LUT_1D_SIZE 2\n0 0 0\n0 0 0\n",
    "garbage.mat": b"MATLAB 5.0 MAT-file" + bytes(109) + b"\0\x01IM" + bytes(range(256)) * 4,
    "hdf5.mat": b"\x89HDF\r\n\x1a\n" + bytes(500), "pickle.npy": b"\x93NUMPY\x01\0v\0{'descr': '|O'}cos\nsystem\n",
    "pipe.csv": "fifo", "device.csv": "zero", "folder.csv": "folder",
}  # fmt: skip


@pytest.mark.parametrize("name", CURVES)
def test_responses_of_an_outsider(space, name):
    put(space / name, CURVES[name])
    try:
        tried(space, SHORT.replace("srgb", name), (1, 2))
    finally:
        os.rename(space / name, space.parent / name)


LUTS = {
    "none.cube": None, "pipe.cube": "fifo", "device.cube": "zero", "huge.cube": "LUT_3D_SIZE 1000000000\n0 0 0\n",
    "below.cube": "LUT_3D_SIZE -1\n",
    "long.spi1d": "Version 1\nFrom 0 1\nLength 1000000000000\nComponents 1\n{\n0\n}\n",
    "garbage.icc": "x" * 200, "broken.csp": "CSPLUTV100\n3D\n\n99999999\n", "pipe.clf": "fifo",
    "laughs.clf": '<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "' + "A" * 1000 + '">'
    + "".join(f'<!ENTITY a{i} "{f"&a{i - 1 if i else str()};" * 10}">' for i in range(9))
    + ']><ProcessList id="a" compCLFversion="3">&a8;</ProcessList>',
}  # fmt: skip


@pytest.mark.parametrize("name", LUTS)
def test_luts_of_an_outsider(space, name):
    if LUTS[name] is not None:
        put(space / name, LUTS[name])
    put(space / "c.ocio", _CONFIG.format(name=name))
    try:
        tried(space, f"{RENDER} --ocio c.ocio --view v", (1,))
    finally:
        if LUTS[name] is not None:
            os.rename(space / name, space.parent / name)


_CONFIG = """ocio_profile_version: 2
search_path: "."
roles: {{default: raw, scene_linear: raw, aces_interchange: raw}}
displays:
  d:
    - !<View> {{name: v, colorspace: c}}
colorspaces:
  - !<ColorSpace>
    name: raw
  - !<ColorSpace>
    name: c
    from_scene_reference: !<FileTransform> {{src: {name}}}
"""
