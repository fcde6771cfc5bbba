"""Variants that are timed in turn."""

import time
from itertools import pairwise

import torch

from benchmarks.timing import Variant, time_variants

CPU = torch.device("cpu")


def test_variants_take_turns_and_slow_ones_run_less_often():
    ran, prepared, seconds = [], [], {"fast": 0.0, "slow": 0.02}

    def variant(name):
        def run():
            assert prepared.pop() == name
            ran.append(name)
            time.sleep(seconds[name])

        return Variant(run, prepare=lambda: prepared.append(name))

    timings = time_variants({name: variant(name) for name in seconds}, CPU, repetitions=12, budget=0.11)
    assert timings["fast"]["repetitions"] == 12
    assert 3 <= timings["slow"]["repetitions"] <= 5 and timings["slow"]["median_ms"] >= 20
    assert sum(a != b for a, b in pairwise(ran)) >= 5
    assert timings["slow"]["min_ms"] <= timings["slow"]["median_ms"] <= timings["slow"]["p90_ms"]
