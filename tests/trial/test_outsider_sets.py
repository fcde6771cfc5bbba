"""Sets of photos of an outsider."""

import json

import pytest

from .hostile import SHORT, tried
from .outsider import DEEP, EITHER, FAR, NAN, case, put

pytestmark = pytest.mark.trial
OUTSIDE = ("/etc/passwd", "../../etc/passwd", "http://127.0.0.1:9/a.png", "/dev/zero", "a\0b", "x" * 5000, 5, None)
SETS = [
    *((("frames", 0, "file_path"), value) for value in OUTSIDE),
    *((("frames", 0, "transform_matrix"), value) for value in ("abc", [[NAN] * 4] * 4, [[FAR] * 4] * 4)),
    *((("frames",), value) for value in ({}, [], 5)),
    *((("camera_angle_x",), value) for value in (NAN, 0, "x", 7)),
    *((("w",), value) for value in (-1, 10**12)),
]


@pytest.mark.parametrize(
    ("place", "value", "codes"), [case(f"{place[-1]} = {value!s:.20}", place, value) for place, value in SETS]
)
def test_sets_of_an_outsider(space, place, value, codes):
    tree = at = json.loads((space / "photos" / "transforms.json").read_text())
    for name in ("fl_x", "fl_y") if place[0] == "camera_angle_x" else ():
        tree.pop(name, None)
    for key in place[:-1]:
        at = at[key]
    at[place[-1]] = value
    put(space / "photos" / "transforms.json", tree)
    either = place[0] == "w" or place[-1] == "transform_matrix" or str(value).startswith(("http", "/"))  # Left out
    tried(space, SHORT, EITHER if either else codes)


@pytest.mark.parametrize("name", ["transforms.json", "exposures.json", "images/r_1.png"])
@pytest.mark.parametrize("kind", ["fifo", "zero", "folder"])
def test_kinds_of_files_of_a_set_of_an_outsider(space, name, kind):
    put(space / "photos" / name, kind)
    tried(space, SHORT, EITHER if name.startswith("images") else (1,))


TIMES = (
    '{"r_0.png": NaN}',
    '{"r_0.png": 0}',
    '{"r_0.png": -1}',
    '{"r_0.png": "1/0"}',
    '{"r_0.png": [1]}',
    "[]",
    "null",
)
TIMES += (DEEP, '{"r_0.png": 1e999}', '{"r_0.png": ' + "9" * 5000 + "}", '{"\\u001b[31mq": -1}', "")


@pytest.mark.parametrize("number", range(len(TIMES)))
def test_times_of_an_outsider(space, number):
    put(space / "photos" / "exposures.json", TIMES[number])
    tried(space, SHORT, EITHER if TIMES[number] == "[]" else (1,))
