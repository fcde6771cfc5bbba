"""Responses by name."""

import pytest

from sehdr_warp.errors import SehdrError
from sehdr_warp.response import response_by_name, response_names


@pytest.mark.parametrize(
    "name",
    [
        "gamma-0", "gamma-0.5", "gamma-x", "gamma-nan", "sRGB-ish", "", "no/such/file.csv", "colour:S-Log9",
        "colour:DICOM GSDF",
    ],
)  # fmt: skip
def test_unknown_names_are_refused(name):
    with pytest.raises(SehdrError) as error:
        response_by_name(name)
    assert "\n" not in str(error.value) and name.split(":")[-1] in str(error.value)


def test_names_are_listed_with_what_they_stand_for():
    names = response_names()
    assert "hdr-nerf" in names and all(len(meaning) > 10 for meaning in names.values())
    assert response_by_name("reinhard-gamma").name == "hdr-nerf"
    with pytest.raises(SehdrError, match="'learned' comes from a training's photos"):
        response_by_name("learned")
    with pytest.raises(SehdrError, match="'Auto' is neither a file nor a known name"):
        response_by_name("Auto")
    with pytest.raises(SehdrError, match="did you mean filmic"):
        response_by_name("flimic")
