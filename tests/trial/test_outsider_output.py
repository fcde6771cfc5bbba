"""Ranks and output of an outsider's command lines."""

import os

import pytest

from .hostile import SHORT, tried
from .outsider import case, put

pytestmark = pytest.mark.trial
ALONE = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "29931", "SEHDR_RANK_TIMEOUT": "1", "LOCAL_WORLD_SIZE": "2"}
RANKS = [
    *({"RANK": rank, "WORLD_SIZE": "2"} for rank in ("x", "5", "-1", "", "1e3", "9" * 5000)),
    *({"RANK": "0", "WORLD_SIZE": count} for count in ("0", "-1", "x", "1000000000", "99999999999999999999")),
    *({"RANK": "0", "WORLD_SIZE": "2", "MASTER_PORT": port} for port in ("99999", "x", "0", "-1", "9" * 5000)),
    *({"RANK": "0", "WORLD_SIZE": "2", "SEHDR_RANK_TIMEOUT": time} for time in ("nan", "-1", "x", "inf", "1e300")),
    *({"RANK": "0", "WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": count} for count in ("0", "-2", "4")),
    *({"RANK": "0", "WORLD_SIZE": "2", "LOCAL_RANK": rank} for rank in ("2", "-1")),
    {"RANK": "0", "WORLD_SIZE": "2"},  # The other never comes.
]


@pytest.mark.parametrize("number", range(len(RANKS)))
def test_ranks_of_an_outsider(space, number):
    ended = tried(space, SHORT, (1,), prepare=lambda: os.environ.update(ALONE | RANKS[number]), seconds=30)
    assert "set" in ended.err or any(name in ended.err for name in (*ALONE, *RANKS[number])), ended.err


OUTPUTS = [
    *(
        case(f"list of the folder: {kind}", kind, "export run --out new.ply --kind hdr --overwrite")
        for kind in ("fifo", "zero", "folder")
    ),
    case("a flag of 100,000 letters", None, "render run --" + "x" * 100_000),
    *(
        case(f"to {place}", None, f"export run --kind hdr --overwrite --out {place}")
        for place in ("/dev/full", "/dev/null", "/proc/x.ply", "a" * 300 + ".ply", "a/" * 2500 + "x.ply", "run", "..")
    ),
    case("10^6 x 10^6 pixels", None, "render run --out new --size 1000000x1000000"),
    case("10^18 views", None, "render run --out new --cameras orbit --count 1000000000000000000"),
    case("10^9 pixels around", None, "envmap run --out new.exr --size 1000000000"),
    case("10^6 voxels", None, "mesh run --out new.obj --resolution 1000000"),
    case("a film of a URL", None, "render run --video http://127.0.0.1:9/o.mp4"),
    case("a film to a device", None, "render run --video /dev/full"),
    case("10^-300 frames a second", None, "render run --video new.mp4 --fps 1e-300"),
    case("stops of NaN", None, "render run --video new.mp4 --ev-ramp=nan:4"),
]


@pytest.mark.parametrize(("kind", "line", "codes"), OUTPUTS)
def test_output_of_an_outsider(space, kind, line, codes):
    mine = space / ".sehdr-warp"
    if kind is not None:
        put(mine, kind)
    try:
        tried(space, f"{line} --device cpu" if " --xx" not in line else line, codes)
    finally:
        if kind is not None:
            os.rename(mine, space.parent / "list")
