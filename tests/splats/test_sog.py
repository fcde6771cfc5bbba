"""SOG: extreme values, other versions, files in pieces."""

import json
import warnings
import zipfile
from dataclasses import replace

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.splats import read_gaussians, write_gaussians

from .samples import gaussians, natural


def test_harmonics_beyond_the_square_root_of_float32_do_not_end_the_program(tmp_path):
    original = natural()
    harmonics = original.harmonics.copy()
    harmonics[3:6, 1:] = 1e20, -3e38, 1e30
    write_gaussians(tmp_path / "a.sog", replace(original, harmonics=harmonics))
    read = read_gaussians(tmp_path / "a.sog")
    assert read.count == original.count and (np.abs(read.harmonics[:, 1:]).max(axis=(1, 2)) > 1e14).sum() == 3


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"version": None}, "is SOG of version 1"),
        ({"means": {"mins": [1e308] * 3, "maxs": [-1e308] * 3}}, "all of its Gaussians have values that are not"),
    ],
)
def test_other_versions_and_bounds_beyond_all_numbers_are_one_line_without_warnings(tmp_path, change, problem):
    write_gaussians(tmp_path / "a.sog", natural(64))
    with zipfile.ZipFile(tmp_path / "a.sog") as archive, zipfile.ZipFile(tmp_path / "b.sog", "w") as changed:
        meta = json.loads(archive.read("meta.json"))
        for field, value in change.items():
            meta[field] = meta[field] | value if isinstance(value, dict) else value
        changed.writestr("meta.json", json.dumps({field: value for field, value in meta.items() if value is not None}))
        for name in set(archive.namelist()) - {"meta.json"}:
            changed.writestr(name, archive.read(name))
    with warnings.catch_warnings(), pytest.raises(InputError, match=problem):
        warnings.simplefilter("error")
        read_gaussians(tmp_path / "b.sog")


def test_sog_in_pieces_and_in_a_folder(tmp_path):
    write_gaussians(tmp_path / "a.sog", gaussians(300, 1, "display"))
    with zipfile.ZipFile(tmp_path / "a.sog") as packed, zipfile.ZipFile(tmp_path / "b.sog", "w") as other:
        for name in packed.namelist():
            other.writestr(f"scene/{name}", packed.read(name))
        packed.extractall(tmp_path / "pieces")
    np.testing.assert_array_equal(read_gaussians(tmp_path / "b.sog").means, read_gaussians(tmp_path / "a.sog").means)
    with pytest.raises(InputError, match=r"is SOG in pieces; zip it and the pictures beside it as scene\.sog"):
        read_gaussians(tmp_path / "pieces" / "meta.json")
