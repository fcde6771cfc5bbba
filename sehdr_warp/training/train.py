"""A whole training: folder, steps, reports, held-out tests, checkpoints, and a tidy end however it comes."""

import math
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from ..errors import InputError, SehdrError
from ..field.gaussians import Gaussians
from ..files import write_json
from ..response import Response
from ..scene import Scene
from ..splatting.memory import memory_told
from ..splatting.threads import thread_count
from .checkpoint import first_not_finite, newest_checkpoint, write_checkpoint
from .confidence import measure_confidence, write_confidence
from .config import Config
from .config_files import config_to_dict, load_config, read_config_json
from .heldout import evaluate_views
from .initialization import choose_response, make_field
from .plan import PLAN, apply_plan, format_plan, read_plan
from .prediction import predicted_scene
from .progress import Progress
from .relocation import Relocation
from .run import (
    CHECKPOINTS,
    CONFIG,
    SUMMARY,
    Run,
    append_metrics,
    check_folder,
    check_same_scene,
    clear_folder,
    field_from_checkpoint,
    load_run,
    read_run_info,
    rewind_metrics,
    write_start,
)
from .trainer import Trainer


def train(
    scene: Scene,
    out: Path | str,
    config: Config | None = None,
    *,
    device: str | torch.device | None = None,
    resume: bool = False,
    overwrite: bool = False,
    quiet: bool = False,
    tensorboard: bool = False,
    data: dict | None = None,
) -> Run:
    """Trains a scene and returns the trained run, whose folder is `out`.

    scene: of load_scene; its training views are trained on, its test views are the held-out ones.
    config: by default the default preset, or, resuming, the run's own.
    device: "cpu", "cuda:0", ...; by default the first GPU if there is one.
    resume: continue the run in `out` from its newest complete checkpoint; with the same scene and config the result
        is, on the CPU, bit for bit that of an uninterrupted training. A folder without a run starts one.
    overwrite: replace the run in `out`.
    quiet: no progress on standard error. tensorboard: event files in out/tensorboard (needs the extra `tensorboard`).
    data: how load_scene made the scene ("path", "exposure_index", "max_size"), saved so that it can be loaded again.

    Raises InputError for a scene, folder or config that cannot be used, SehdrError if the training diverges or the
    disk or the memory is full, KeyboardInterrupt after an interrupt; a usable checkpoint is left then.
    """
    out, device = Path(out), pick_device(device)
    make_writer = _summary_writer() if tensorboard else None
    with memory_told(device, lambda: _sizes(scene)):
        scene, trainer, seconds = _start(
            scene, out, config, device, resume=resume, overwrite=overwrite, data=data or {}
        )
    loop = _Loop(scene, out, trainer, seconds, make_writer and make_writer(str(out / "tensorboard")))
    with (
        memory_told(device, lambda: _sizes(scene, trainer)),
        Progress(trainer.config.schedule.iterations, enabled=not quiet) as progress,
        _torch_settings(trainer.config),
    ):
        progress.note(f"response {trainer.field.response.name}, {trainer.field.gaussians.count} Gaussians on {device}")
        for line in (*trainer.field.response.notes, *_crowded(scene, trainer)):
            progress.note(line)
        if plan := read_plan(out):
            progress.note(format_plan(plan))
        loop.run(progress)
        run = load_run(out, device=device)
        write_confidence(run, measure_confidence(run, scene))
    return run


def _start(scene, out, config, device, *, resume, overwrite, data) -> tuple[Scene, Trainer, float]:
    """The scene as the loss sees it, the trainer and the seconds it has already trained."""
    if check_folder(out, resume=resume, overwrite=overwrite):
        return scene, *_continue(scene, out, config, device)
    config, plan = apply_plan(scene, config or load_config())
    response = choose_response(scene, config)
    scene = with_predictions(scene, config, response)
    field = make_field(scene, config, response, device)
    trainer = Trainer(scene, config, field)
    # Nothing is made or removed before the scene is known to be good.
    clear_folder(out)
    (out / PLAN).unlink(missing_ok=True)
    if plan is not None:
        write_json(out / PLAN, plan.to_dict())
    write_start(out, scene, config, field, data)
    return scene, trainer, 0.0


def _sizes(scene: Scene, trainer: Trainer | None = None) -> tuple[int, int, int]:
    """Gaussians, and width and height of the largest photo."""
    camera = max((view.camera for view in scene.views), key=lambda camera: camera.width * camera.height)
    return len(scene.points) if trainer is None else trainer.field.gaussians.count, camera.width, camera.height


def _crowded(scene: Scene, trainer: Trainer) -> Iterator[str]:
    """What to know of a training with more start points than it may have, or may add to."""
    count, strategy, config = trainer.field.gaussians.count, trainer.densification, trainer.config
    most = config.densification.max_gaussians
    if trainer.iteration == 0 and len(scene.points) > most:
        yield f"{len(scene.points)} start points: drawn from, for densification.max_gaussians = {most}"
    if isinstance(strategy, Relocation) and count > strategy.most:
        yield (
            f"{count} Gaussians are more than relocation's budget of {strategy.most} for these photos: they move, and "
            "none are added; densification.budget=0 lets them grow to densification.max_gaussians"
        )


def with_predictions(scene: Scene, config: Config, response: Response) -> Scene:
    """The scene as the loss may see it: where loss.predictor names one, its predictions stand in for the truth of the
    training views, unless they are predictions already."""
    if not config.loss.predictor or scene.predictor is not None:
        return scene
    return predicted_scene(scene, config.loss.predictor, response)


def pick_device(device: str | torch.device | None) -> torch.device:
    """The device a user named, by default the first GPU or else the CPU; raises InputError if it is not there."""
    if device is None:
        return torch.device("cuda:0" if torch.cuda.is_available() else "cpu")
    if not str(device).startswith(("cpu", "cuda")):
        raise InputError(f"device {device}", "is neither a CPU nor a CUDA GPU", "use cpu or cuda:N")
    try:
        made = torch.device(device)
        torch.empty(0, device=made)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"device {device}", f"cannot be used ({reason})", "use cpu, or cuda:N of a GPU that torch sees"
        ) from None
    return torch.device("cuda", made.index or 0) if made.type == "cuda" else made


def _continue(scene: Scene, out: Path, config: Config | None, device) -> tuple[Trainer, float]:
    """Trainer and training seconds as the newest checkpoint has them; from the start where there is none yet."""
    saved, info = read_config_json(out / CONFIG), read_run_info(out)
    if config is not None and (config := apply_plan(scene, config)[0]) != saved:
        raise InputError(
            out / CONFIG, _first_difference(saved, config), "resume with the run's own config, or train anew"
        )
    scene = with_predictions(scene, saved, Response.from_dict(info["response"]))
    check_same_scene(out, scene)
    checkpoint = newest_checkpoint(out / CHECKPOINTS)
    if checkpoint is None:
        rewind_metrics(out, 0)
        return Trainer(scene, saved, make_field(scene, saved, choose_response(scene, saved), device)), 0.0
    trainer = Trainer(scene, saved, field_from_checkpoint(checkpoint, saved, info).to(device))
    try:
        trainer.load_state(checkpoint.tensors, checkpoint.values)
    except (KeyError, TypeError, ValueError, RuntimeError, AttributeError, OverflowError, IndexError) as error:
        raise InputError(
            checkpoint.path, f"its state cannot be taken up ({error!r:.120})", "remove it, or train again"
        ) from None
    rewind_metrics(out, trainer.iteration)
    return trainer, checkpoint.values["seconds"]


def _first_difference(saved: Config, given: Config) -> str:
    old, new = config_to_dict(saved), config_to_dict(given)
    for part, values in old.items():
        if isinstance(values, dict):
            for name, value in values.items():
                if new[part][name] != value:
                    return f"{part}.{name} = {value!r}, but {new[part][name]!r} was asked for"
        elif new[part] != values:
            return f"{part} = {values!r}, but {new[part]!r} was asked for"
    return "the config differs"


class _Loop:
    """The steps of one process's part of a training."""

    def __init__(self, scene: Scene, out: Path, trainer: Trainer, seconds: float, writer):
        self.scene, self.out, self.trainer = scene, out, trainer
        self.schedule = trainer.config.schedule
        self.evaluate_at = {trainer.config.scaled(n) for n in self.schedule.evaluate_at} | {self.schedule.iterations}
        self.checkpoint_every = trainer.config.scaled(self.schedule.checkpoint_every)
        self.seconds = seconds
        self.first_iteration, self.first_seconds = trainer.iteration, seconds
        self.writer = writer

    def run(self, progress: Progress) -> None:
        trainer, total = self.trainer, self.schedule.iterations
        with _interruptible() as interrupted:
            started = time.perf_counter()
            while not self._is_done() and not interrupted.is_set():
                trainer.step()
                iteration = trainer.iteration
                if progress.is_due(iteration):
                    self._report(progress, self.seconds + time.perf_counter() - started)
                evaluate = iteration in self.evaluate_at
                save = iteration % self.checkpoint_every == 0
                if evaluate or save:
                    self._stop_clock(started)
                    if evaluate:
                        self._evaluate(progress)
                    if save and iteration < total:
                        self._checkpoint(progress)
                    started = time.perf_counter()
            self._stop_clock(started)
            trainer.check()
            self._checkpoint(progress)
            self._summarise()
        if self.writer is not None:
            self.writer.close()
        if interrupted.is_set() and not self._is_done():
            progress.note(f"stopped at iteration {trainer.iteration}; continue with --resume")
            raise KeyboardInterrupt

    def _is_done(self) -> bool:
        return self.trainer.iteration >= self.schedule.iterations

    def _stop_clock(self, started: float) -> None:
        """Adds the seconds since `started`, in which steps ran, to the training's; the device finishes first."""
        if self.trainer.device.type == "cuda":
            torch.cuda.synchronize(self.trainer.device)
        self.seconds += time.perf_counter() - started

    def _report(self, progress: Progress, seconds: float) -> None:
        trainer, gaussians = self.trainer, self._gaussians()
        per_step = (seconds - self.first_seconds) / max(1, trainer.iteration - self.first_iteration)
        left = per_step * (self.schedule.iterations - trainer.iteration)
        loss, psnr = trainer.loss, trainer.psnr()
        progress.update(trainer.iteration, loss=loss, psnr=psnr, count=gaussians.count, seconds_left=left)
        self._log("train", trainer.iteration, {"loss": loss, "psnr": psnr, "gaussians": gaussians.count})

    def _evaluate(self, progress: Progress) -> None:
        trainer, views = self.trainer, self.scene.test_views
        if not views:
            return
        scores = evaluate_views(trainer.field, views, trainer.degree)
        line = {
            "iteration": trainer.iteration,
            "seconds": round(self.seconds, 3),
            "split": "test",
            **{name: round(value, 4) for name, value in scores.items()},
            "gaussians": self._gaussians().count,
        }
        append_metrics(self.out, line)
        self._log("test", trainer.iteration, scores)
        figures = "  ".join(f"{name} {value:.2f} dB" for name, value in scores.items())
        progress.note(f"iteration {trainer.iteration}  held-out {figures}  after {self.seconds:.1f} s")

    def _checkpoint(self, progress: Progress) -> None:
        """Saves the state, unless the training has diverged: the last good checkpoint then stays the newest.

        Raises SehdrError if a parameter or the optimizer's state is not finite: no later step can mend that.
        """
        iteration = self.trainer.iteration
        tensors, values = self.trainer.state()
        if (name := first_not_finite(tensors)) is not None:
            raise SehdrError(
                f"iteration {iteration}: {name} is not finite and was not saved; --resume goes back to the last good "
                "checkpoint; if it happens again, lower the learning rates or check photos and cameras"
            )
        if iteration > self.first_iteration and not math.isfinite(loss := self.trainer.loss):
            progress.note(f"iteration {iteration}: the loss is {loss}; no checkpoint is written, the last one stays")
            return
        values = values | {"seconds": self.seconds}
        write_checkpoint(self.out / CHECKPOINTS, tensors, values, kept=self.schedule.checkpoints_kept)

    def _summarise(self) -> None:
        trainer, plan = self.trainer, read_plan(self.out)
        write_json(
            self.out / SUMMARY,
            {
                "iteration": trainer.iteration,
                "finished": self._is_done(),
                "plan": plan and {decision["name"]: decision["choice"] for decision in plan["decisions"]},
                "train_seconds": round(self.seconds, 3),
                "gaussians": self._gaussians().count,
                "skipped_steps": trainer.skipped_steps,
                "steps_without_room": trainer.steps_without_room,
                "device": device_name(trainer.device),
                **peak_memory(trainer.device),
            },
            overwrite=True,
        )

    def _log(self, split: str, iteration: int, figures: dict[str, float]) -> None:
        if self.writer is not None:
            for name, value in figures.items():
                self.writer.add_scalar(f"{split}/{name}", value, iteration)

    def _gaussians(self) -> Gaussians:
        return self.trainer.field.gaussians


def device_name(device: torch.device) -> str:
    """What runs the training, for a report."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else f"cpu ({thread_count()} threads)"


def peak_memory(device: torch.device) -> dict[str, int]:
    """Largest memory so far, bytes: of this process, and on a GPU of torch's tensors there."""
    peaks = {}
    if sys.platform != "win32":
        import resource

        unit = 1 if sys.platform == "darwin" else 1024
        peaks["peak_memory_bytes"] = unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    if device.type == "cuda":
        peaks["peak_gpu_memory_bytes"] = torch.cuda.max_memory_allocated(device)
    return peaks


@contextmanager
def _torch_settings(config: Config):
    """torch on one thread: its sums then do not depend on the machine's cores, and a CPU training repeats bit for bit.
    It costs nothing: the work is in the kernels, which have threads of their own, and torch's would stand in their way.

    With config.deterministic, also torch's sums on a GPU in a fixed order.
    """
    threads, ordered = torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()
    filled = torch.utils.deterministic.fill_uninitialized_memory
    torch.set_num_threads(1)
    if config.deterministic:
        # cuBLAS repeats itself only with a workspace of its own; it reads this when it is first used.
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
        torch.use_deterministic_algorithms(True)
        torch.utils.deterministic.fill_uninitialized_memory = False
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        torch.use_deterministic_algorithms(ordered)
        torch.utils.deterministic.fill_uninitialized_memory = filled


@contextmanager
def _interruptible():
    """An event that the first interrupt sets, so that a step is never cut in two; a second interrupt stops at once."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    previous = signal.getsignal(signal.SIGINT)

    def on_interrupt(*_):
        event.set()
        signal.signal(signal.SIGINT, previous)

    signal.signal(signal.SIGINT, on_interrupt)
    try:
        yield event
    finally:
        signal.signal(signal.SIGINT, previous)


def _summary_writer() -> type:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise SehdrError("TensorBoard is not installed; run `pip install sehdr-warp[tensorboard]`") from None
    return SummaryWriter
