"""Readers in a process of their own: what they give, and that they end where files mislead them."""

import time

import numpy as np
import pytest

from sehdr_warp import sandbox
from sehdr_warp.errors import InputError
from sehdr_warp.splats import read_gaussians


def read_args(path):
    return {"read": np.frombuffer(path.read_bytes(), np.uint8), "word": "é"}


def fills_memory(path):
    return {"read": np.ones(4 << 30, np.uint8)}


def never_ends(path):
    time.sleep(60)


def test_bounds(tmp_path, monkeypatch):
    (tmp_path / "a").write_bytes(b"abc")
    (tmp_path / "numpy.py").write_text("raise SystemExit('a module of the folder was run')")
    monkeypatch.chdir(tmp_path)
    stored = sandbox.read_sandboxed(read_args, tmp_path / "a", "x", "y")
    assert bytes(stored["read"]) == b"abc" and str(stored["word"]) == "é"
    for read, seconds, message in (
        (fills_memory, sandbox.MOST_SECONDS, "a: cannot be read as x .*allocate"),
        (never_ends, 1, "not read after 1 s"),
    ):
        monkeypatch.setattr(sandbox, "MOST_SECONDS", seconds)
        with pytest.raises(InputError, match=message):
            sandbox.read_sandboxed(read, tmp_path / "a", "x", "y")


def test_a_stage_leads_to_no_other_folder(tmp_path):
    pytest.importorskip("pxr")
    (tmp_path / "in").mkdir()
    (tmp_path / "secret.usda").write_text('#usda 1.0\ndef Sphere "a" {}\n')
    (tmp_path / "in" / "a.usda").write_text("#usda 1.0\n(subLayers = [@../secret.usda@])\n")
    with pytest.raises(InputError, match="leads outside of its folder"):
        read_gaussians(tmp_path / "in" / "a.usda")
