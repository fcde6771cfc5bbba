"""Captures beside gsplat: what needs no GPU."""

from benchmarks.captures import seconds_until


def test_seconds_until_the_first_score_of_a_level():
    scores = [(1.0, 17.5), (2.5, 19.0), (4.0, 18.2), (6.0, 20.1)]
    assert seconds_until(scores, 18.0) == 2.5
    assert seconds_until(scores, 20.0) == 6.0
    assert seconds_until(scores, 20.2) is None
