"""The schedule of changes: when they are due, and how many Gaussians there are then."""

import pytest

from sehdr_warp.runs.config_files import load_config
from sehdr_warp.training.strategies import make_strategy
from sehdr_warp.training.strategies.base import Schedule

from ..toy import VARIANTS


@pytest.mark.parametrize("iterations", [300, 1500, 30_000])
def test_a_training_of_any_length_reaches_its_budget(iterations):
    strategy = make_strategy(load_config("default", {"schedule.iterations": iterations}), 10**6)
    assert strategy.cap_max == 120_000
    count = 5000
    for iteration in range(1, iterations + 1):
        if strategy.is_due(iteration):
            growth = strategy.next_count(iteration, count) / count
            assert iterations < 30_000 or growth <= 1.05 + 1 / count
            count = strategy.next_count(iteration, count)
    assert count == 120_000


@pytest.mark.parametrize("start, stop, every", [(20, 80, 25), (0, 75, 25), (30, 76, 25), (90, 300, 25), (10, 30, 50)])
def test_a_schedule_is_over_where_no_refinement_follows(start, stop, every):
    schedule = Schedule(start, stop, every)
    due = [n for n in range(401) if schedule.is_due(n, 1)]
    assert [schedule.is_over(n) for n in range(400)] == [not any(each > n for each in due) for n in range(400)]
    assert [schedule.refinements_left(n) for n in due] == [*range(len(due), 0, -1)]


def test_a_refinement_at_most_doubles_the_count():
    strategy = make_strategy(load_config("default"), 10**6)
    last = max(iteration for iteration in range(1, 30_001) if strategy.is_due(iteration))
    assert strategy.next_count(last, 5000) == 10_000 and strategy.next_count(last, 100_000) == strategy.cap_max


@pytest.mark.parametrize("photos", [1, 2, 3, 8])
def test_each_change_happens_once_whatever_the_stride(photos):
    strategy = make_strategy(VARIANTS["default"], 1000)
    due = [n for n in range(photos, 91, photos) if strategy.is_due(n, photos)]
    assert [n // 25 for n in due] == [1, 2, 3] and (strategy.schedule.start, strategy.schedule.stop) == (20, 80)
