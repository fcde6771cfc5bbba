"""Errors of estimated responses are measured."""

from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.response import CODES, bench_response, response_error
from sehdr_warp.response import response_by_name


def test_error_ignores_scale_and_nothing_else():
    srgb, gamma = response_by_name("srgb"), response_by_name("gamma-2.2")
    scaled = SimpleNamespace(decode=lambda values: 8 * srgb.decode(values))
    assert response_error(srgb, srgb) == 0 and response_error(scaled, srgb) == pytest.approx(0, abs=1e-9)
    stops = np.log2(((CODES / 255) ** 2.2) / srgb.decode(CODES / 255.0))
    assert response_error(gamma, srgb) == pytest.approx(np.std(stops), rel=1e-3)


def test_a_scene_is_exposed_by_each_curve_and_judged():
    result = bench_response(["embedded"], ["hdr-nerf", "srgb"], exposures=2, max_size=48)
    rows = {(row["curve"], row["method"]): row for row in result["rows"]}
    assert {method for _, method in rows} == {"always srgb", "always camera", "posterior", "paper"}
    assert rows["srgb", "always srgb"]["mean"] == 0 and rows["srgb", "always srgb"]["good"] == 2
    chosen, known = rows["all", "posterior"], rows["all", "always srgb"]
    assert chosen["trials"] == known["trials"] == 4 and chosen["mean"] <= chosen["worst"]
    assert chosen["aligned"] <= chosen["aligned_known"] + 0.1
    assert len(result["trials"]) == 2 * 2 * 4
