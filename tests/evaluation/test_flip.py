"""HDR-FLIP, where it is installed and where it is not."""

import sys

import pytest
import torch

from sehdr_warp.evaluation.evaluate import evaluate
from sehdr_warp.evaluation.flip import load_flip
from sehdr_warp.evaluation.table import format_table

from .test_evaluate import VIEWS, run, scene


def test_flip_is_zero_for_equal_images_and_grows_with_the_error():
    pytest.importorskip("flip_evaluator")
    distance, reason = load_flip()
    truth = torch.rand((24, 32, 3), generator=torch.Generator().manual_seed(0)) * 20
    assert reason is None and distance(truth, truth) == 0
    assert 0.01 < distance(truth * 1.2, truth) < distance(truth * 2, truth) < 1


def test_evaluate_gives_flip_under_each_protocols_scale():
    pytest.importorskip("flip_evaluator")
    result = evaluate(run(lambda hdr: hdr * 2), scene(VIEWS), flip=True)["protocol"]
    # A global factor is taken out by `aligned`, and by nothing else.
    assert result["aligned"]["hdr_flip"] < 0.01 < result["gt-max"]["hdr_flip"]
    assert "hdr_flip" not in evaluate(run(), scene(VIEWS))["protocol"]["gt-max"]


def test_without_the_package_flip_is_null_with_a_reason(monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    result = evaluate(run(), scene(VIEWS), flip=True)
    assert result["protocol"]["gt-max"]["hdr_flip"] is None
    assert "pip install sehdr-warp[flip]" in format_table(result)
