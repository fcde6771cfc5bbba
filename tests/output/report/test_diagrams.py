"""Diagrams of the page."""

import re

from sehdr_warp.output.report.diagrams import training_svg


def test_times_of_a_short_training_are_at_their_places():
    chart = training_svg([{"psnr_ldr": 20.0 + time, "seconds": time} for time in (1.0, 10.0)])
    assert re.findall(r">([\d.]+ s)<", chart) == ["0 s", "2 s", "4 s", "6 s", "8 s", "10 s"]


def test_levels_of_a_chart_differ_and_fit_beside_it():
    for figures in ([20.3], [24.1, 24.31], [20.0, 22.4], [9.0, 39.0]):
        chart = training_svg([{"psnr_ldr": decibels, "seconds": 5.0} for decibels in figures])
        levels = [float(level) for level in re.findall(r'x="0"[^>]*>(\d+) dB<', chart)]
        assert levels == sorted(set(levels)) and 3 <= len(levels) <= 8
        assert levels[0] <= min(figures) and max(figures) <= levels[-1]
