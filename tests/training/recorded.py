"""Whole trainings on a GPU, with recorded steps and with launched ones."""

from sehdr_warp.runs.config_files import override_config
from sehdr_warp.training.run_output import evaluate_views
from sehdr_warp.training.trainer import Trainer

from .toy import make_trainer


def captured(trainer: Trainer):
    """The CUDA graph that the next step with the same key replays; None if there is none."""
    runner = trainer.step_runner._graph
    return None if runner is None else runner._graph


def train_on_gpu(scene, config, *, recorded: bool = True, iterations: int | None = None) -> tuple[Trainer, int]:
    """The trainer after its iterations, and how many of them were replayed."""
    config = override_config(config, {"schedule.use_cuda_graph": recorded})
    trainer = make_trainer(scene, config, "cuda:0")
    replays = 0
    for _ in range(iterations or config.schedule.iterations):
        trainer.step()
        replays += captured(trainer) is not None
    assert trainer.skipped_steps == 0
    return trainer, replays


def check_recorded_like_launched(scene, config, least_replays: int) -> list[Trainer]:
    """Trains both ways: held-out photos come out alike. The trainers, recorded first."""
    (first, replays), (second, none) = (train_on_gpu(scene, config, recorded=recorded) for recorded in (True, False))
    assert replays > least_replays and none == 0
    scores = [
        evaluate_views(trainer.field, scene.test_views, trainer.degree)["psnr_ldr"] for trainer in (first, second)
    ]
    assert abs(scores[0] - scores[1]) < 1.5
    return [first, second]
