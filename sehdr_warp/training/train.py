"""Create trainers: from a scene, or from a run to resume; and train in one call."""

import logging
import time
from collections.abc import Iterator, Mapping
from contextlib import nullcontext
from dataclasses import replace
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import Any

import torch

from ..errors import InputError, path_of, require_loaded
from ..rasterizer.memory import TRAINING_REMEDY, oom_context
from ..runs.config import Config
from ..runs.config_files import as_config, config_fields, override_config, require_same_config, with_iterations_of
from ..runs.device import pick_device
from ..runs.field import field_from_checkpoint
from ..runs.run import Run, exposure_compensation
from ..runs.run_writer import RunWriter
from ..runs.scene_description import SFM_LAYOUTS, in_world_of_run
from ..runs.values import LoadArguments
from ..scene import Scene
from ..scene.normalization import Normalization, normalization_of
from .compensation import SharedDecisions, estimate_compensation, estimates_compensation
from .hdr_truth import check_scene_truth
from .initialization import check_views, depth_of_points, make_field, make_matcher, response_for_training
from .plan import check_fields, make_plan
from .process_settings import precompiling_planned, summary_writer
from .ranks import Ranks
from .run_output import RunOutput
from .scene_facts import PointFacts
from .seeding import brighten_clipped
from .trainer import Trainer, sizes_of
from .training_state import load_state, point_facts_of, state_of
from .workers import send_training, several_ranks_notes

log = logging.getLogger(__name__)


def train(
    scene: Scene,
    out: Path | str,
    config: Config | str | Path | Mapping[str, Any] | None = None,
    *,
    device: str | torch.device | None = None,
    resume: bool = False,
    overwrite: bool = False,
    tensorboard: bool = False,
    data: LoadArguments | None = None,
) -> Run:
    """Train a scene to the end.

    Args:
        scene: A scene from load_scene().
        out: Run folder.
        config: A Config, name or file of a preset, or fields that differ from the default one, such as
            {"schedule.iterations": 500}.
        device: "cpu", "cuda:0", ...; by default the first GPU, or the CPU if there is none.
        resume: Continue the run in `out`.
        overwrite: Replace the run in `out`.
        tensorboard: Write event files.
        data: Arguments with which the scene was loaded.

    Returns:
        The trained run.

    Raises:
        InputError: If scene, folder or config cannot be used.
        SehdrError: If the training diverges, or the disk or the memory is full.
        KeyboardInterrupt: After a checkpoint was written.
    """
    return create_trainer(
        scene, out, config, device=device, resume=resume, overwrite=overwrite, tensorboard=tensorboard, data=data
    ).train()


def create_trainer(
    scene: Scene,
    out: Path | str,
    config: Config | str | Path | Mapping[str, Any] | None = None,
    *,
    device: str | torch.device | None = None,
    resume: bool = False,
    overwrite: bool = False,
    tensorboard: bool = False,
    data: LoadArguments | None = None,
    ranks: Ranks | None = None,
    shared: SharedDecisions | None = None,
) -> Trainer:
    """Create the trainer of a scene, or of a run to resume.

    Args:
        scene: A scene from load_scene(); its test views are the held-out ones.
        out: Run folder.
        config: A Config, name or file of a preset, or fields that differ from the default preset, which the plan does
            not change; by default that preset or, if resuming, the config of the run.
        device: "cpu", "cuda:0", ...; by default the first GPU, or the CPU if there is none.
        resume: Continue the run in `out` from its newest complete checkpoint; on the CPU the result is that of an
            uninterrupted training, bit for bit. More `schedule.iterations`, in a Config or in fields, stretch its
            schedule; those of a preset do not.
        overwrite: Replace the run in `out`, once the new one has a checkpoint of its start.
        tensorboard: Write event files to out/tensorboard (needs the extra `tensorboard`).
        data: Arguments with which the scene was loaded, saved to load its photos again.
        ranks: Processes that train together, of which this one is the main process.
        shared: Decisions of a larger set that this scene is part of; by default they are made for this scene.

    Raises:
        InputError: If scene, folder or config cannot be used.
        SehdrError: If the disk or the memory is full.
    """
    require_loaded("load_scene", scene)
    states_iterations = isinstance(config, Config) or (
        isinstance(config, Mapping) and not config.keys().isdisjoint(("schedule", "schedule.iterations"))
    )
    device, config = pick_device(device), as_config(config)
    if tensorboard:
        summary_writer()
    folder = RunWriter(path_of(out, "out"))
    with oom_context(device, lambda: sizes_of(scene), TRAINING_REMEDY):
        has_run = folder.check_start(resume=resume, overwrite=overwrite)
        try:
            if has_run:
                if config is not None and not states_iterations:
                    config = with_iterations_of(folder.read_config(), config)
                trainer = _resumed_trainer(scene, config, device, ranks, folder)
                if data is not None and (path := data.get("path")):
                    folder.set_photo_path(path)
            else:
                config, data = config or Config(), data or LoadArguments()
                trainer = _new_trainer(scene, config, device, ranks, folder, data, shared, overwrite=overwrite)
            trainer.output = RunOutput(folder, trainer.config, tensorboard=tensorboard, is_block=shared is not None)
            if ranks is not None:
                send_training(ranks, trainer, folder.read_info())
        except BaseException:
            folder.unlock()
            raise
    response, count = trainer.field.response, trainer.field.gaussians.count
    use = " only of simulated photos, because the photos' light is known" if scene.light_known else ""
    log.info("response %s%s, %d Gaussians on %s", response.name, use, count, device)
    for line in (*response.notes, *_cap_notes(trainer), *several_ranks_notes(trainer)):
        log.info("%s", line)
    return trainer


def _new_trainer(
    scene: Scene,
    config: Config,
    device: torch.device,
    ranks: Ranks | None,
    folder: RunWriter,
    data: LoadArguments,
    shared: SharedDecisions | None,
    *,
    overwrite: bool,
) -> Trainer:
    """Plan, choose the response, compensate the photos, initialize the field, and begin the run folder.

    `scene` and, after the compensation, `photos` are in their own coordinates; normalized ones in the Gaussians'.
    """
    check_views(scene)
    normalization = normalization_of(scene)
    normalized_scene = normalization.scene(scene)
    requested = config
    plan = make_plan(normalized_scene, config, device) if config.plan.enabled else None
    if plan is None:
        check_fields(normalized_scene, config)  # As make_plan() does.
    else:
        config = plan.config
    check_scene_truth(scene, config.loss)  # Here, before the photos are matched; GradientStep repeats it.
    with precompiling_planned(config, requested) if device.type == "cpu" else nullcontext():
        response = response_for_training(scene, config)
        started = time.perf_counter()
        depth = depth_of_points(normalized_scene)
        compensation, matcher = None if shared is None else shared.compensation_of(scene.views), None
        if shared is None and plan is not None and estimates_compensation(scene, config, response):
            estimate = estimate_compensation(normalized_scene, config, response, device, depth)
            compensation, matcher = estimate.compensation, estimate.matcher
            plan = replace(plan, decisions=(*plan.decisions, estimate.decision))
        photos = scene if compensation is None else compensation.normalize_photos(scene, response)
        normalized_photos = normalization.scene(photos)
        # One matcher for compensation, initial points and seeds; made when it is needed, because it takes long.
        get_matcher = cache(lambda: matcher or make_matcher(normalized_photos, response, device, depth))
        field = make_field(photos, config, response, device, get_matcher, None if shared is None else shared.base_time)
        trainer = Trainer(
            photos, config, field, get_matcher=get_matcher, ranks=ranks, point_facts=PointFacts(median_depth=depth)
        )
        light = trainer.data_manager.clipped_light_targets  # Estimated once, for this and for the loss.
        if light is not None and not config.model.init_file:
            brighten_clipped(field, normalized_photos.train_views, light)
    trainer.seconds = time.perf_counter() - started
    # The folder is begun last, when the scene is known to be usable.
    plan_values, state = None if plan is None else plan.to_dict(), state_of(trainer)
    folder.begin(scene, config, field, data, plan_values, state, compensation=compensation, overwrite=overwrite)
    for line in plan.lines() if plan is not None else ():
        log.info("%s", line)
    return trainer


def _resumed_trainer(
    scene: Scene, config: Config | None, device: torch.device, ranks: Ranks | None, folder: RunWriter
) -> Trainer:
    """Create the trainer of a run's newest checkpoint; raise InputError if scene or config are not those of the run.

    More iterations stretch the schedule or, after its end, extend it (Config.continued_after); extension.json has them.
    """
    folder.lock()
    info, before, config = folder.read_info(), folder.read_config().schedule.iterations, resumed_config(folder, config)
    # The Gaussians are in the world that structure from motion found when the training began.
    cameras = {entry.name: entry.camera for entry in folder.read_cameras()} if scene.format in SFM_LAYOUTS else {}
    unit = Normalization.from_dict(info["normalization"]).unit
    scene = in_world_of_run(scene, cameras, unit, folder.path, scene.name)
    folder.check_same_scene(scene)
    checkpoint = folder.newest_checkpoint()
    field = field_from_checkpoint(checkpoint, config, info).to(device)
    compensation = exposure_compensation(info)
    scene = scene if compensation is None else compensation.normalize_photos(scene, field.response)
    finished_at = before if checkpoint.values["iteration"] >= before else folder.finished_at()
    longer = config.continued_after(finished_at)
    trainer = Trainer(scene, longer, field, ranks=ranks, point_facts=point_facts_of(checkpoint))
    try:
        load_state(trainer, checkpoint)
    except (LookupError, TypeError, ValueError, RuntimeError, AttributeError, OverflowError) as error:
        problem = f"its state does not fit ({error!r:.120})"
        raise InputError(checkpoint.path, problem, "remove it, or train again") from None
    if trainer.total > before:
        folder.extend(trainer.total, finished_at)
        text = "the schedule is stretched from %d to %d iterations: rates and densification are those of the longer one"
        if longer is not config:
            text = (
                "the finished training goes on from %d to %d iterations: positions learn slowly, no Gaussians are added"
            )
        log.info(text, before, trainer.total)
    folder.rewind_metrics(trainer.iteration)
    return trainer


def resumed_config(folder: RunWriter, config: Config | None) -> Config:
    """Return the config of a run to resume, with the iterations of `config` if these are more.

    Raises InputError if `config` differs otherwise. Fields that the run's plan decided count as the run has them, but
    for those in plan.keep: on another machine, the same config may be planned differently.
    """
    saved = folder.read_config()
    if config is None:
        return saved
    if config.plan.enabled:
        fields = {path: value for decision in folder.read_decisions() for path, value in decision["fields"].items()}
        fields |= {path: attrgetter(path)(saved) for path, _ in config_fields() if path in fields}
        plan_fields = {path: value for path, value in fields.items() if path not in config.plan.keep}
        config = override_config(config, plan_fields | {"plan.enabled": False}, folder.plan_file)
    iterations = max(saved.schedule.iterations, config.schedule.iterations)
    saved = override_config(saved, {"schedule.iterations": iterations})
    require_same_config(config, saved, folder.config_file, "resume with the run's own config, or train anew")
    return saved


def _cap_notes(trainer: Trainer) -> Iterator[str]:
    """Yield notes about a training with more initial points than its caps allow."""
    count, cap = trainer.field.gaussians.count, trainer.strategy.cap_max
    points, most = len(trainer.scene.points), trainer.config.densification.cap_max
    if trainer.iteration == 0 and points > most:
        yield f"{points} start points: {most} of them are used, for densification.cap_max = {most}"
    if count > cap:
        yield (
            f"{count} Gaussians are more than the cap of {cap} for these photos: they are relocated, and none are "
            "added; mcmc.cap_density=0 lets them grow to densification.cap_max"
        )
