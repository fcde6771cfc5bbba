"""Files of cameras that take much, are no files, or have harmful names. Damaged ones are tests of their readers."""

import os

import pytest

from .hostile import CAMERA, EITHER, case, put, tried

pytestmark = pytest.mark.trial
CAMERAS = [
    *(
        case(f"name {value!r:.20}", "cams.json", {"cameras": [CAMERA | {"name": value}]}, codes=EITHER)
        for value in ("\x1b[2J", "\u202egpj", " ", ".hidden", "a\nb", "\ud800", 5, None, ["x"])
    ),
    *(case(kind, "cams.json", kind) for kind in ("fifo", "zero", "folder")),
    case("10,000 of one name", "cams.json", {"cameras": [CAMERA] * 10_000}),
    case("a number of 100,000 digits", "cams.json", '{"cameras": ' + "9" * 10**5 + "}"),
    case("300,000 keys, one twice", "cams.json", "{" + ", ".join(f'"{i % 299_999}": 0' for i in range(300_000)) + "}"),
    case("300,000 frames", "x.chan", "1 0 0 4 0 0 0 50\n" * 300_000),
    case("times to 10^12", "c.usda", """#usda 1.0
        (\n startTimeCode = 0\n endTimeCode = 1e12\n)
        def Camera "c" {\n float focalLength.timeSamples = {0: 30, 1e12: 40}\n}\n"""),
]  # fmt: skip


@pytest.mark.parametrize(("name", "content", "codes"), CAMERAS)
def test_cameras(space, name, content, codes):
    put(space / name, content)
    tried(space, f"render files/a.glb --cameras {name} --out new --device cpu", codes)


@pytest.mark.parametrize("kind", ["fifo", "zero"])
@pytest.mark.parametrize("name", ["cameras.bin", "images.bin"])
def test_models(space, name, kind):
    model = space / "model"
    for each in ("cameras.bin", "images.bin"):
        put(model / "sparse" / "0" / each, kind if each == name else b"")
    try:
        tried(space, "render files/a.glb --cameras model --out new --device cpu", (1,))
    finally:
        os.rename(model, space.parent / "model")  # Nobody else waits for its pipe.
