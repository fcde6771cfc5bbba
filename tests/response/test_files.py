"""Curves from files: published layouts, one's own tables, refusals."""

import json

import numpy as np
import pytest
from PIL import Image
from scipy.io import loadmat, savemat

from sehdr_warp.errors import InputError
from sehdr_warp.response import Response, response_by_name, responses_in_file
from sehdr_warp.response.table import FLAT_TILT, ChannelResponse


def dorf_text(curves: dict[str, np.ndarray]) -> str:
    text = ""
    for name, values in curves.items():
        exposures, levels = (" ".join(map(str, column)) for column in (np.linspace(0, 1, len(values)), values))
        text += f"{name}\n{name} graph\nI =\n{exposures}\nB =\n{levels}\n"
    return text


def test_dorf_matlab_file(shared, tmp_path):
    path = shared / "crf" / "201_CRF_data.mat"
    stored = loadmat(path)
    curves = responses_in_file(path)
    assert len(curves) == 201
    for index, curve in [*enumerate(curves)][::10]:
        exposures, values = stored["I"][index].astype(float), stored["B"][index].astype(float)
        assert abs(curve.encode(exposures) - values).max() <= FLAT_TILT + 1e-12
        exposures = np.linspace(1e-3, curve.clip_exposure, 301)
        np.testing.assert_allclose(curve.decode(curve.encode(exposures)), exposures, rtol=1e-6)
    assert response_by_name(f"{path}:17").name == "dorf:17"
    few = tmp_path / "few.mat"  # Each name reads the file again.
    savemat(few, {name: stored[name][:2] for name in "BI"})
    for wrong in (str(few), f"{few}:2", f"{few}:agfa", f"{few}:-1"):
        with pytest.raises(InputError, match=r"few\.mat"):
            response_by_name(wrong)


def test_emor(shared):
    path, inverse = (shared / "crf" / name for name in ("emor.txt", "invemor.txt"))

    def stored(file):
        numbers = [line for line in file.read_text().splitlines() if "=" not in line]
        return np.array(" ".join(numbers).split(), float).reshape(-1, 1024)

    rows = stored(path)
    assert len(rows) == 27
    mean, bent = response_by_name(path), response_by_name(f"{path}:0.3,-0.1")
    np.testing.assert_allclose(mean.encode(rows[0]), rows[1], atol=FLAT_TILT + 1e-12)
    np.testing.assert_allclose(bent.encode(rows[0]), rows[1] + 0.3 * rows[2] - 0.1 * rows[3], atol=FLAT_TILT + 1e-12)
    values, exposures, *_ = stored(inverse)
    np.testing.assert_allclose(response_by_name(inverse).encode(exposures), values, atol=5e-4)
    for wrong in ("1e", "nan", ",".join("0" * 26)):
        with pytest.raises(InputError, match="emor.txt"):
            response_by_name(f"{path}:{wrong}")


def test_dorf_text_file(tmp_path):
    ramp = np.linspace(0, 1, 1024)
    path = tmp_path / "dorfCurves.txt"
    path.write_text(dorf_text({"film-Red": ramp**0.5, "film-Green": ramp**0.4}))
    assert [curve.name for curve in responses_in_file(path)] == ["film-Red", "film-Green"]
    np.testing.assert_allclose(response_by_name(f"{path}:film-green").encode(ramp), ramp**0.4, atol=1e-6)
    np.testing.assert_allclose(response_by_name(f"{path}:0").encode(ramp), ramp**0.5, atol=1e-6)
    path.write_text(dorf_text({"film-Red": ramp})[:-30] + "\nextra")
    with pytest.raises(InputError):
        responses_in_file(path)


@pytest.mark.parametrize("separator", [",", ";", " ", "\t"])
def test_table_file(tmp_path, separator):
    path = tmp_path / "camera.csv"
    rows = [("exposure", "value"), (0, 0), (0.25, 0.5), (1, 1), (1.5, 1)]
    path.write_text("# measured\n" + "".join(f"{x}{separator}{value}\n" for x, value in rows))
    curve = response_by_name(path)
    assert curve.name == "camera.csv" and curve.clip_exposure == pytest.approx(1.0)
    np.testing.assert_allclose(curve.encode([0, 0.25, 1]), [0, 0.5, 1], atol=1e-4)


def test_json_file(tmp_path):
    path = tmp_path / "curve.json"
    path.write_text(json.dumps({"exposures": [0, 1, 2], "values": [0, 0.6, 1], "name": "mine"}))
    curve = response_by_name(path)
    assert curve.name == "mine" and curve.encode(1.0) == pytest.approx(0.6, abs=1e-4)
    path.write_text(json.dumps(curve.to_dict()))
    np.testing.assert_array_equal(response_by_name(path).encode([0.3, 1.7]), curve.encode([0.3, 1.7]))


BAD_TABLES = {
    "empty": "",
    "one column": "1\n2\n3\n",
    "three columns": "0 0 0\n1 1 1\n2 2 2\n",
    "nan": "0 0\n0.5 nan\n1 1\n",
    "infinite": "0 0\ninf 0.5\n1 1\n",
    "words later": "0 0\nhalf way\n1 1\n",
    "codes": "0 0\n0.5 128\n1 255\n",
    "negative value": "0 -0.1\n0.5 0.5\n1 1\n",
    "negative exposure": "-1 0\n0.5 0.5\n1 1\n",
    "constant": "0 0.5\n0.5 0.5\n1 0.5\n",
    "falling": "0 1\n0.5 0.5\n1 0\n",
    "binary": "\x00\x01\x02\n",
}
BAD_JSON = (
    "{",
    "[1, 2]",
    '{"exposures": [0, 1]}',
    '{"exposures": "a", "values": [1]}',
    '{"kind": "table"}',
    '{"kind": ["table"]}',
    "[" * 100000,
)
BAD_FILES = [("csv", text) for text in BAD_TABLES.values()] + [("json", text) for text in BAD_JSON]


BAD_FILES.append(("npy", "\x93NUMPY\x01\x00"))


BAD_IDS = [*BAD_TABLES, *(f"json {number}" for number in range(len(BAD_JSON))), "pickled array"]


@pytest.mark.parametrize("suffix, text", BAD_FILES, ids=BAD_IDS)
def test_bad_files_are_refused_in_one_line(tmp_path, suffix, text):
    path = tmp_path / f"bad.{suffix}"
    path.write_text(text)
    with pytest.raises(InputError) as error:
        response_by_name(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_damaged_matlab_files_end_no_more_than_their_reader(tmp_path):
    path = tmp_path / "bad.mat"
    savemat(path, {"B": np.array([["a", "b"]]), "I": np.eye(2)})
    cut = b"MATLAB 5.0 MAT-file" + b" " * 105 + b"\x00\x01IM\x0e\x00\x00\x00"
    for content in (path.read_bytes(), cut, b"\xff" * 300):
        path.write_bytes(content)
        with pytest.raises(InputError, match="bad.mat: cannot be read as DoRF") as error:
            response_by_name(f"{path}:0")
        assert "\n" not in str(error.value)


def channel_csv(path):
    """Three gammas as a table of four columns."""
    exposures = np.r_[0.0, np.geomspace(1e-4, 1, 400)]
    rows = np.column_stack([exposures, *(exposures ** (1 / gamma) for gamma in (1.8, 2.2, 2.6))])
    path.write_text("exposure,red,green,blue\n" + "\n".join(",".join(map(str, row)) for row in rows))
    return path


def test_a_curve_for_each_channel(tmp_path):
    response = response_by_name(str(channel_csv(tmp_path / "camera.csv")))
    codes = np.repeat(np.arange(0, 256, 5, dtype=np.uint8)[:, None, None], 3, axis=2)
    shared = response.to_shared(codes)
    assert shared.dtype == np.uint16 and (shared[-1] == 65535).all()
    light = response.decode(shared / 65535)
    for channel, gamma in enumerate((1.8, 2.2, 2.6)):
        np.testing.assert_allclose(light[2:, 0, channel], (codes[2:, 0, 0] / 255) ** gamma, rtol=5e-3)
    again = Response.from_dict(json.loads(json.dumps(response.to_dict())))
    np.testing.assert_array_equal(again.to_shared(codes), shared)
    (tmp_path / "bad.csv").write_text("0,0,0\n1,1,1\n")
    with pytest.raises(InputError, match="has 3 columns; give two, exposure and value, or four"):
        response_by_name(str(tmp_path / "bad.csv"))


def test_photos_of_a_camera_whose_channels_differ(tmp_path):
    """A grey scene comes out grey, in the light of the camera's own curves."""
    from tests.make_scenes import load, write_colmap

    write_colmap(tmp_path)
    light = np.tile(np.linspace(0.02, 0.9, 64)[None, :, None], (48, 1, 3))
    codes = np.stack([light[..., c] ** (1 / gamma) for c, gamma in enumerate((1.8, 2.2, 2.6))], axis=2)
    for i in range(6):
        Image.fromarray((codes * 255).round().astype(np.uint8)).save(tmp_path / "images" / f"{i:03d}.png")
    scene = load(tmp_path, response=str(channel_csv(tmp_path / "camera.csv")))
    for size in (None, 32):
        scene = load(tmp_path, response=scene.response, max_size=size)
        decoded_light = scene.response.decode(scene.views[0].image.astype(float))
        row = decoded_light[decoded_light.shape[0] // 2, 4:-4:8]
        np.testing.assert_allclose(row, row[:, 1:2].repeat(3, 1), rtol=0.03)


def cube(path, table, domain=(0, 1), size="LUT_1D_SIZE"):
    low, high = (" ".join([str(value)] * 3) for value in domain)
    rows = "".join(" ".join(map(str, row)) + "\n" for row in table)
    path.write_text(f'TITLE "a camera"\n{size} {len(table)}\nDOMAIN_MIN {low}\nDOMAIN_MAX {high}\n{rows}')
    return str(path)


def test_cube_luts_from_light_to_codes_and_back(tmp_path):
    light = np.linspace(0, 4, 400)
    values = np.log1p(20 * light) / np.log1p(80)
    encodes = response_by_name(cube(tmp_path / "a.cube", np.stack([values] * 3, 1), (0, 4)))
    np.testing.assert_allclose(encodes.encode(light), values, atol=1e-4)
    codes = np.linspace(0, 1, 500)
    decoded = np.expm1(codes * np.log1p(80)) / 20
    decodes = response_by_name(cube(tmp_path / "b.cube", np.stack([decoded] * 3, 1)) + ":decode")
    np.testing.assert_allclose(decodes.decode(values[5:-5]), light[5:-5], rtol=5e-3)
    assert not isinstance(decodes, ChannelResponse) and (encodes.name, decodes.name) == ("a.cube", "b.cube")


def test_cube_luts_of_channels_that_differ(tmp_path):
    light = np.linspace(0, 1, 64)
    response = response_by_name(cube(tmp_path / "a.cube", np.stack([light**p for p in (0.4, 0.5, 0.6)], 1)))
    assert isinstance(response, ChannelResponse) and response.name == "a.cube"
    np.testing.assert_allclose(response.curves[2].encode(light), light**0.6, atol=0.01)


@pytest.mark.parametrize("options, words", [
    ({"size": "LUT_3D_SIZE"}, "is a LUT of three dimensions, which mixes channels; give a LUT of one dimension"),
    ({"table": [[0, 0, 0], [2, 2, 2], [3, 3, 3]]}, r"value 3 is outside \[0, 1\]"),
    ({"table": [[0.0, 0.0, "x"]] * 3}, "cannot be read as a .cube LUT"),
])  # fmt: skip
def test_cube_luts_that_are_no_response(tmp_path, options, words):
    with pytest.raises(InputError, match=words):
        response_by_name(cube(tmp_path / "a.cube", **{"table": np.eye(3) * 0.5, **options}))


def test_colour_encoding_is_colour_science():
    import colour

    exposures = np.geomspace(1e-4, 30, 500)
    encoded = response_by_name("colour:slog3").encode(exposures)
    # The encoding's two branches meet in a kink, which the samples round off by a hundredth of an 8-bit code.
    np.testing.assert_allclose(encoded, colour.models.log_encoding_SLog3(exposures), atol=5e-5)
