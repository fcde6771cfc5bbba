"""Stages of long work: log lines, estimates, and displays."""

import logging

import pytest

from sehdr_warp import progress

LOG = logging.getLogger("sehdr_warp.scene")


@pytest.fixture
def clock(monkeypatch):
    """Return a list whose only item is the time, in seconds."""
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_log_lines_are_ten_seconds_apart(clock, logged):
    for _ in progress.track_progress("placing photos", range(57), LOG):
        clock[0] += 1.0
    assert logged[0] == "placing photos: 57" and len(logged) == 6
    assert logged[1] == "placing photos: 10 of 57, 0:47 left"


def test_the_start_of_the_training_is_estimated(clock):
    with progress.stage("finding features", 20, LOG) as features:
        assert features.seconds_left is None and features.training_in is None
        clock[0], features.later = 30.0, 90.0
        features.update(10)
        assert features.seconds_left == 30 and features.training_in == 120
        assert features.line() == "finding features: 10 of 20, 0:30 left; training starts in about 2:00"


def test_a_display_replaces_lines(logged):
    fractions = []
    with progress.display_stages(lambda stage: fractions.append((stage.done, stage.ended))):
        for _ in progress.track_progress("reading photos", range(2), LOG):
            pass
    assert fractions == [(0, False), (1, False), (2, False), (2, True)] and logged == []


def test_quiet_shows_nothing():
    before, fractions = LOG.level, []
    LOG.setLevel(logging.WARNING)
    try:
        with progress.display_stages(fractions.append), progress.stage("reading photos", 2, LOG) as reading:
            reading.update(1)
    finally:
        LOG.setLevel(before)
    assert fractions == []


@pytest.mark.parametrize("seconds,text", [(None, "-:--"), (5, "0:05"), (63.4, "1:03"), (3723, "1:02:03")])
def test_seconds_are_minutes_and_hours(seconds, text):
    assert progress.format_seconds(seconds) == text


@pytest.mark.parametrize(
    "seconds, text", [(5, "5 s"), (119, "119 s"), (130, "2.2 min"), (3 * 3600, "3.0 h"), (30 * 86400, "30 days")]
)
def test_durations_have_one_unit(seconds, text):
    assert progress.format_duration(seconds) == text
