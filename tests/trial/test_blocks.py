"""Plans of trainings in blocks that were made to do harm."""

import json
import os
import pickle

import pytest

from .hostile import MARKUP, tried

pytestmark = pytest.mark.trial

PLAN = {
    "format": 1,
    "scene": "photos",
    "data": {"path": "photos", "exposure_index": None, "max_size": None, "holdout": None},
    "response": {"kind": "analytic", "name": "hdr-nerf"},
    "base_time": 1.0,
    "normalization": {"center": [0, 0, 0], "unit": 1.0},
    "exposure_compensation": None,
    "exposure_times": {"r_0": 1.0},
    "config": {"schedule": {"iterations": 2}},
    "axes": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "blocks": [
        {
            "name": "block_0",
            "views": ["r_0"],
            "fraction": 1.0,
            "low": [None] * 3,
            "high": [None] * 3,
            "margin": [0.1] * 3,
        }
    ],
}
BLOCK = PLAN["blocks"][0]
BLOCKS = {
    "empty": "",
    "a list": "[]",
    "deep": "[" * 100_000,
    "no blocks": {"blocks": []},
    "100,000 blocks": {"blocks": [BLOCK | {"name": f"block_{number}"} for number in range(100_000)]},
    "a block above": {"blocks": [BLOCK | {"name": "../../precious"}]},
    "markup": {"scene": MARKUP, "response": {"kind": MARKUP, "name": MARKUP}},
    "photos of others": {"data": PLAN["data"] | {"path": "/etc"}},
    "axes of zeros": {"axes": [[0, 0, 0]] * 3},
    "a base time of 1e-320": {"base_time": 1e-320},
    "a base time of 1e400": {"base_time": "@1e400"},
    "a response of a file": {"response": {"kind": "table", "path": "/etc/passwd"}},
    "options of none": {"config": PLAN["config"] | {"model": {"init_file": "/dev/zero"}}},
    "times of 1e400": {"exposure_times": {"r_0": "@1e400"}},
    "times of others": {"exposure_times": {"nobody": 1.0}},
    "views of nobody": {"blocks": [BLOCK | {"views": ["nobody", "r_0", "r_0"]}]},
    "a share of 1e-320": {"blocks": [BLOCK | {"fraction": 1e-320}]},
    "walls of nan": {"blocks": [BLOCK | {"low": ["@NaN"] * 3}]},
    "a margin of 1e308": {"blocks": [BLOCK | {"margin": [1e308] * 3}]},
    "a unit of 1e-320": {"normalization": {"center": [1e308] * 3, "unit": 1e-320}},
    "bytes of 10^30": {"photo_bytes": {"r_0": 10**30}},
    "two of a name": {"blocks": [BLOCK] * 2},
    "a number of 9 digits": {"blocks": [BLOCK | {"name": "block_999999999"}]},
    "steps of 10^18": {"config": {"schedule": {"iterations": 10**18}}},
}


@pytest.mark.parametrize("name", BLOCKS)
def test_plans_of_blocks(space, name):
    """Resume a run with pickled values where submitit would put its own: nobody reads them."""
    (space / "precious").mkdir()
    (space / "precious" / "a.txt").write_text("mine")
    logs = space / "new" / "blocks" / "logs"
    logs.mkdir(parents=True)
    for file in ("0_0_result.pkl", "0_submitted.pkl", "20261126-000000-aaaaaaaa/1_0_result.pkl"):
        (logs / file).parent.mkdir(exist_ok=True)
        (logs / file).write_bytes(pickle.dumps(_Harm(str(space / "PWNED"))))
    text = BLOCKS[name] if isinstance(BLOCKS[name], str) else json.dumps(PLAN | BLOCKS[name])
    (space / "new" / "blocks.json").write_text(text.replace('"@1e400"', "1e400").replace('"@NaN"', "NaN"))
    ended = tried(space, "train photos --resume --out new --device cpu -q", seconds=100)
    assert "root:" not in ended.err and not (space / "PWNED").exists()


class _Harm:
    def __init__(self, path: str):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (self.path,)
