import json

import numpy as np
import pytest

from sehdr_warp.json_values import damage, description_of, json_list, json_object, number, numbers, text, whole_number

RAGGED = [[1, 2], [3]]


@pytest.mark.parametrize(
    "value, words",
    [(None, "null"), (True, "true"), (1.5, "1.5"), ("x", "'x'"), ([1, 2], "a list of 2"), ({"a": 1}, "an object")],
)
def test_values_are_called_as_json_writes_them(value, words):
    assert description_of(value) == words
    for read in (json_object, json_list):
        if not isinstance(value, dict if read is json_object else list):
            with pytest.raises(ValueError, match=f"^scale is {words}, not a"):
                read(value, "scale")


def test_numbers_texts_and_whole_numbers():
    values = json.loads('{"a": 1, "b": "2.5", "c": NaN, "d": 3.0, "e": "x"}')
    assert [number(values, name) for name in "abd"] == [1, 2.5, 3] and np.isnan(number(values, "c"))
    assert number(values, "z", 7.0) == 7 and text(values, "z", "y") == "y"
    assert (text(values, "a"), text(values, "e"), whole_number(values, "d")) == ("1", "x", 3)


@pytest.mark.parametrize("value", [None, True, "x", [], {}, RAGGED, 10**400])
def test_what_is_no_number_is_named(value):
    for read, kind in ((number, "a number"), (whole_number, "a whole number")):
        with pytest.raises(ValueError, match=f"^fx is .*, not {kind}$"):
            read({"fx": value}, "fx")
    with pytest.raises(KeyError, match="fy"):
        number({"fx": value}, "fy")


@pytest.mark.parametrize(
    "value, shape, words",
    [
        (None, (3,), "pose is null, not 3 numbers"),
        (RAGGED, (3,), "pose is a list of 2, not 3 numbers"),
        ([1, 2], (3, 3), "pose holds 2 numbers, not 3 x 3 numbers"),
        ([1, "x", 2], (3,), "pose holds 'x', not 3 numbers"),
        ([[1, {}], [2, 3]], (2, 2), "pose holds an object, not 2 x 2 numbers"),
        ([[1, 2], [3, 4]], (-1,), "pose is a list of 2, not one list of numbers"),
        ([1, 2, 3], (-1, 4), "pose is a list of 3, not rows of 4 numbers"),
    ],
)
def test_lists_that_do_not_fit_are_named(value, shape, words):
    with pytest.raises(ValueError, match=f"^{words}$"):
        numbers({"pose": value}, "pose", *shape)


def test_lists_of_lists_and_plain_lists_have_the_same_numbers():
    rows = np.arange(6.0).reshape(2, 3)
    for value in (rows.tolist(), rows.ravel().tolist()):
        np.testing.assert_array_equal(numbers({"m": value}, "m", 2, 3), rows)
        np.testing.assert_array_equal(numbers({"m": value}, "m", -1, 3), rows)
    assert np.isnan(numbers({"m": [None, 1]}, "m", -1)).tolist() == [True, False]


def test_damage_is_told_without_words_of_python():
    reads = {
        "count is missing": lambda: {}["count"],
        "a list is too short": lambda: ["x"][len("x")],
        "a value is of another type": lambda: float([]),
        "count 0": lambda: _raise(ValueError("count 0")),
        "cannot identify image file": lambda: _raise(OSError("cannot identify image file <_io.BytesIO object at 0x7>")),
    }
    reads |= {"it is nested too deeply": lambda: json.loads("[" * 100_000)}
    for words, read in reads.items():
        with pytest.raises(Exception) as caught:
            read()
        assert damage(caught.value) == words
    for wrong in ("x", RAGGED, [{}]):
        with pytest.raises((ValueError, TypeError)) as caught:
            np.array(wrong, np.float64).reshape(3, 3)
        assert damage(caught.value) == "a value is of another type"


def _raise(error):
    raise error
