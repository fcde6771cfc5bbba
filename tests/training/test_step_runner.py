"""Room for pairs: enough for what was seen, not much more, and mended where it was not."""

from contextlib import nullcontext

import pytest
import torch

from sehdr_warp.errors import SehdrError
from sehdr_warp.rasterizer.ops.step_updates import decide_step
from sehdr_warp.training.step_runner import HEADROOM, MIN_CAPACITY, MIN_SHRINK, GraphCapacity

from .recorded import check_recorded_like_launched, train_on_gpu
from .toy import VARIANTS, make_trainer, quick, toy_scene

MANY = 10 * MIN_CAPACITY


def counters(device):
    return torch.zeros(3, dtype=torch.int64, device=device)


def replay(capacity, pairs):
    """Recorded steps that need so many pairs each; the capacity that they were given."""
    loss = torch.zeros((), device=capacity.step_counters.device)
    for needed in pairs:
        fixed_capacity, needed = capacity.for_next_step(), torch.tensor(needed, device=loss.device)
        decide_step(loss, loss[None], needed > fixed_capacity, capacity.step_counters, needed)
    return fixed_capacity


def test_room_follows_the_most_pairs_seen(device):
    capacity = GraphCapacity(counters(device))
    assert capacity.for_next_step() is None
    capacity.record(MANY)
    assert capacity.for_next_step() is not None
    most = MANY * 6 // 5
    assert replay(capacity, [MANY, most, MANY]) == HEADROOM * MANY
    assert capacity.poll() == (0, False)
    assert not capacity.rescale(1.0, same_memory=False)
    assert replay(capacity, [MANY] * 2) == HEADROOM * most
    assert not capacity.rescale(1.1, same_memory=False)
    assert replay(capacity, [MANY]) == pytest.approx(HEADROOM * MIN_SHRINK * most, abs=3)
    assert not capacity.rescale(2.5, same_memory=True)
    assert replay(capacity, [MANY]) == pytest.approx(HEADROOM * 2.5 * MANY, abs=3)


def test_a_lack_of_room_is_noticed_and_mended(device):
    capacity = GraphCapacity(counters(device))
    capacity.record(MANY)
    replay(capacity, [MANY, 5 * MANY, MANY])
    assert int(capacity.step_counters[2]) == 1
    assert capacity.poll() == (0, True)
    assert replay(capacity, [5 * MANY]) == HEADROOM * 5 * MANY
    assert capacity.poll() == (0, False)


def test_room_stays_while_it_is_enough(device):
    capacity = GraphCapacity(counters(device))
    capacity.record(MANY)
    fixed_capacity = replay(capacity, [MANY])
    assert capacity.rescale(1.05, same_memory=True) and capacity.for_next_step() == fixed_capacity
    assert replay(capacity, [MANY * 21 // 20]) == fixed_capacity
    assert capacity.rescale(1.05, same_memory=True)
    replay(capacity, [MANY * 11 // 10])
    assert not capacity.rescale(1.1, same_memory=True)
    assert capacity.for_next_step() == pytest.approx(HEADROOM * 1.1 * 1.1 * MANY, abs=3)


def test_looks_that_do_not_wait_tell_what_the_one_before_asked_for(device):
    capacity, nan = GraphCapacity(counters(device)), torch.full((1,), float("nan"), device=device)
    capacity.record(MANY)
    pairs = torch.tensor(5 * MANY, device=device)
    decide_step(nan[0], nan, pairs > capacity.for_next_step(), capacity.step_counters, pairs)
    late = [capacity.poll(wait=False) for _ in range(2)]
    assert late[-1 if capacity.step_counters.is_cuda else 0] == (1, True)
    assert int(capacity.step_counters[2]) == 1


def test_few_pairs_get_the_least_room(device):
    capacity = GraphCapacity(counters(device))
    capacity.record(1)
    assert replay(capacity, [1]) == MIN_CAPACITY


def test_a_step_that_cannot_be_recorded_ends_the_training_with_a_way_out(scene, monkeypatch):
    class BrokenRunner:
        def on_capture_stream(self):
            return nullcontext()

        def run(self, key, function):
            raise RuntimeError("operation not permitted when stream is capturing\nmore")

    config = quick()
    trainer = make_trainer(scene, config)
    trainer.step_runner._graph = BrokenRunner()
    monkeypatch.setattr(trainer.step_runner, "can_replay", lambda *_: trainer.iteration > 1)
    trainer.step()
    with pytest.raises(SehdrError, match=r"iteration 2: .*not permitted.*schedule.use_cuda_graph = False"):
        trainer.step()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="CUDA graphs need a GPU")
@pytest.mark.parametrize("variant", ["default", "adc", "dropout"])
def test_recorded_steps_train_like_launched_ones(variant):
    check_recorded_like_launched(toy_scene(), VARIANTS[variant], 60)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="CUDA graphs need a GPU")
@pytest.mark.parametrize("name", ["hdr-gs-truth", "gauss-hdr", "truth"])
def test_rivals_are_recorded_on_a_gpu(scene, name):
    _, replays = train_on_gpu(scene, VARIANTS[name], iterations=90)
    assert replays > 50
