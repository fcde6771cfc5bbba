"""Settings of the process during a training: undone at its end, and signals that wait for a step's end."""

import signal
import sys

import pytest
import torch

from sehdr_warp.training.process_settings import interruptible, machine_figures, torch_settings


@pytest.mark.parametrize("deterministic", [False, True])
def test_torchs_settings_are_those_of_before_also_after_an_error(deterministic):
    def settings():
        fills = torch.utils.deterministic.fill_uninitialized_memory
        return torch.get_num_threads(), torch.are_deterministic_algorithms_enabled(), fills, sys.getswitchinterval()

    torch.set_num_threads(threads := torch.get_num_threads() + 1)
    before = settings()
    with pytest.raises(ZeroDivisionError), torch_settings(deterministic):
        assert settings()[:2] == (1, deterministic) and settings()[3] < before[3]
        raise ZeroDivisionError
    assert settings() == before
    torch.set_num_threads(threads - 1)


def test_a_process_whose_torch_only_warned_of_other_sums_warns_again():
    torch.use_deterministic_algorithms(True, warn_only=True)
    try:
        with torch_settings(True):
            assert not torch.is_deterministic_algorithms_warn_only_enabled()
        assert torch.are_deterministic_algorithms_enabled() and torch.is_deterministic_algorithms_warn_only_enabled()
    finally:
        torch.use_deterministic_algorithms(False)


def test_trainings_that_take_turns_leave_the_settings_of_before_the_first():
    before = torch.get_num_threads(), sys.getswitchinterval()
    first, second = torch_settings(True), torch_settings(True)
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert torch.are_deterministic_algorithms_enabled() and torch.get_num_threads() == 1
    second.__exit__(None, None, None)
    assert not torch.are_deterministic_algorithms_enabled()
    assert (torch.get_num_threads(), sys.getswitchinterval()) == before


def test_figures_name_the_machine_and_its_memory():
    figures = machine_figures(torch.device("cpu"))
    assert figures["device"].startswith("cpu (") and figures["peak_memory_bytes"] > 1e7


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_the_first_signal_waits_for_the_end_of_the_block_and_the_second_does_not(number):
    class Ended(BaseException):
        pass

    def end(*_):
        raise Ended

    before, reached = signal.signal(number, end), []
    try:
        with pytest.raises(Ended), interruptible() as interrupted:
            signal.raise_signal(number)
            reached.append(interrupted.is_set())
        with pytest.raises(Ended), interruptible():
            signal.raise_signal(number)
            signal.raise_signal(number)
            reached.append("never")
        with pytest.raises(ValueError), interruptible():
            signal.raise_signal(number)
            raise ValueError
        signal.signal(number, signal.SIG_IGN)
        with interruptible() as interrupted:
            signal.raise_signal(number)
            reached.append(interrupted.is_set())
    finally:
        signal.signal(number, before)
    assert reached == [True, False]
