"""A training on two ranks of the CPU, as processes that keep what each of them ends with."""

import logging
import os
import sys
import time
from pathlib import Path

import torch
import torch.multiprocessing as processes

RANKS = 2


def run_team(work, folder: Path, *arguments) -> None:
    """work(ranks, folder, *arguments) on each of RANKS ranks. Raises what ends one of them."""
    processes.start_processes(_rank, (work, folder, arguments), RANKS, start_method="spawn")


def _rank(rank: int, work, folder: Path, arguments: tuple) -> None:
    from sehdr_warp.training.launch import RankInfo
    from sehdr_warp.training.ranks import join_ranks

    os.environ |= {"WORLD_SIZE": str(RANKS), "SEHDR_RANKS": str(folder / "meeting"), "SEHDR_RANK_TIMEOUT": "60"}
    with join_ranks(RankInfo(rank, RANKS, rank, RANKS), torch.device("cpu")) as ranks:
        work(ranks, folder, *arguments)


def train_together(ranks, folder: Path, strategies: list[str], iterations: int) -> None:
    """Trains the toy scene with each strategy; each rank saves its state as <strategy>.<rank>."""
    from sehdr_warp.training.train import create_trainer
    from sehdr_warp.training.training_state import state_of
    from sehdr_warp.training.workers import train_as_worker

    from .toy import VARIANTS, toy_scene

    for strategy in strategies:
        if ranks.is_main_process:
            training = create_trainer(toy_scene(), folder / strategy, VARIANTS[strategy], device="cpu", ranks=ranks)
            for step in training:
                if step.iteration >= iterations:
                    training.stop()
            trainer = training
            ranks.store.delete_key("photos/0")
        else:
            trainer = train_as_worker(ranks)
        ranks.all_reduce_min(2)
        assert "torch._dynamo" not in sys.modules, "two seconds of every start"
        state = state_of(trainer)
        torch.save((state.tensors, state.values), folder / f"{strategy}.{ranks.rank}")


def differ(ranks, folder: Path) -> None:
    """Ranks whose tensors differ by a bit say so, all of them."""
    from sehdr_warp.errors import SehdrError

    ranks.check_equal({"means": torch.ones(3)}, 5)
    try:
        ranks.check_equal({"scales": torch.ones(3), "means": torch.tensor([1.0, 1.0 + ranks.rank * 2**-23])}, 5)
    except SehdrError as error:
        (folder / f"differ.{ranks.rank}").write_text(str(error))


def mixed(ranks, folder: Path) -> None:
    """Ranks of different versions say which."""
    import sehdr_warp
    from sehdr_warp.errors import SehdrError

    sehdr_warp.__version__ = f"1.{ranks.rank}"
    try:
        ranks._check_versions()
    except SehdrError as error:
        (folder / f"mixed.{ranks.rank}").write_text(str(error))


def fall_silent(ranks, folder: Path) -> None:
    """Rank 1 no longer answers, and rank 0 ends; what it says is kept."""
    if ranks.is_main_process:
        ranks._timeout = 2.0
        logging.getLogger("sehdr_warp").addHandler(logging.FileHandler(folder / "silent"))
        ranks.all_reduce_min(2)
    time.sleep(60)
