"""Give advice on a finished training in plain words, each with the command to type."""

import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any, NamedTuple

from ..runs.config_files import config_fields
from ..runs.config_flags import field_text
from ..runs.run import Run
from ..runs.scene_description import SFM_LAYOUTS
from ..runs.values import SCENE_OPTIONS, LoadArguments
from ..scene.pose_conventions import MISFIT
from ..subsets import first_names
from .plan import STEPS_PER_PHOTO

if TYPE_CHECKING:
    from .trainer import Trainer

STILL_RISING = 0.2  # dB that held-out photos gained in the last third of the steps, or since a resume, if too few
UNFINISHED = 0.5  # dB gained there from which blur explains what differs from the photos, not exposure or cameras
FALLING = 0.5  # dB that they lost since their best in a training that overfits; seeds differ by up to 0.3 dB
EXPOSURE_JUMP = 0.4  # Stops between a whole photo and the scene from which its exposure is not as stated
FAILED = 17.0  # dB of held-out photos below which the scene as a whole is wrong: sound captures have 19 to 35
_FEW_PHOTOS, _FEWEST_PHOTOS = 30, 5
_FEW_STEPS = 3  # Steps that the user set for each photo up to which nothing is known of the photos
_MANY_REGIONS = 5  # Unexplained regions for each photo, on average, that say that something moved
_MUCH_LIGHT = 0.5  # Share of the light in the photos from which it matters most that it is an estimate
_REGION_STOPS = 1.5  # Median difference of the worst regions from which things moved rather than blurred
_WRONG_STOPS, _WRONG_AREA = 2.5, 0.12  # Difference, and part of a photo that has it, if its camera is wrong
_DARK = 0.25  # Part of the median exposure up to which a photo was taken to measure lights
_FEW = 0.1  # Part of the photos up to which they are single ones


class Evaluation(NamedTuple):
    """PSNR of the held-out photos after an iteration, dB."""

    iteration: int
    psnr: float


def evaluations(metrics: Sequence[Mapping[str, Any]]) -> list[Evaluation]:
    """Return the evaluations of held-out photos in the lines of metrics.jsonl."""
    scores = [(line["iteration"], line.get("psnr_ldr")) for line in metrics if line.get("split", "test") == "test"]
    return [Evaluation(iteration, psnr) for iteration, psnr in scores if psnr is not None]


def best_if_overfitted(points: Sequence[Evaluation]) -> Evaluation | None:
    """Return the best evaluation if the last one is more than FALLING below it; else None."""
    best = max(points, key=lambda point: point.psnr, default=None)
    return best if best is not None and best.psnr - points[-1].psnr > FALLING else None


@dataclass(frozen=True)
class FinishedTraining:
    """Facts of a finished training that advice rests on."""

    path: Path  # Folder of the run
    summary: Mapping[str, Any]  # Run.summary() with the list of evaluations as "metrics"
    train_photos: int  # Number of photos that were trained on
    scene: str = "SCENE"  # Where the photos are, for the commands
    options: Sequence[str] = ()  # Words of the command line that the training had, for the commands: --max-size 240
    # Iteration at which the training was resumed, 0 if it was not. If held-out photos were evaluated there, as at the
    # end of a run that is given more steps, gains before it do not count.
    resumed_at: int = 0
    unplaced: int = 0  # Number of photos without a camera
    steps: int | None = None  # Iterations that the user set, for the commands; None if they were planned
    posed: str | None = None  # Folder of the photos, if the set states their cameras; None if they were found
    misfit: bool = False  # Whether a note says that the stated cameras do not fit the photos
    # Pixels of the training photos, by their names; without them no single camera is called wrong
    sizes: Mapping[str, int] = field(default_factory=dict)
    uncertain: Collection[str] = ()  # Names of the training photos that structure from motion placed by few points
    dark: Collection[str] = ()  # Names of the training photos that are much darker than most, to measure lights

    def _command(self, scene: str, steps: int | None = None) -> str:
        """Return the command that trains a scene with the options of this training."""
        words = ["sehdr-warp", "train", scene, "--out", str(self.path), *self.options, "--overwrite"]
        return shlex.join(words if steps is None else [*words, "--iterations", str(steps)])

    @property
    def _again(self) -> str:
        """The command that repeats this training."""
        return self._command(self.scene, self.steps)

    @property
    def _anew(self) -> str:
        """Photos to find the cameras anew from, and the command that does."""
        if self.posed is not None and Path(self.posed).resolve() != Path(self.scene).resolve():
            return f"from the photos alone: {self._command(self.posed)}"
        return f"from the photos in a folder PHOTOS of their own: {self._command('PHOTOS')}"

    def advice(self) -> list[str]:
        """Return lines of advice; none if nothing stands out."""
        summary, train_photos, again = self.summary, self.train_photos, self._again
        run, iterations = shlex.quote(str(self.path)), int(summary["iteration"])
        points, lines, gain = evaluations(summary["metrics"]), [], 0.0
        if self.misfit:
            return [f"the cameras that the set states do not fit its photos; find them anew {self._anew}"]
        if self.steps is not None and iterations <= _FEW_STEPS * train_photos:
            command = f"sehdr-warp train --resume --out {run} --iterations {STEPS_PER_PHOTO * train_photos}"
            return [f"{iterations} steps are too few to judge {train_photos} photos by: {command}"]
        if (share := summary.get("estimated_light") or 0.0) > _MUCH_LIGHT:
            remedy = "darker photos would measure it; for which lights, and by how many stops"
            estimated = f"{share:.0%} of the light is an estimate, because photos clip it"
            lines.append(f"{estimated}; {remedy}: sehdr-warp lights {run}")
        few_placed = 2 * self.unplaced >= train_photos
        if few_placed:
            between = f"photos from places between them and the {train_photos} others would help most"
            lines.append(f"{self.unplaced} photos have no camera and are not in the scene; {between}: {again}")
        is_long = iterations >= STEPS_PER_PHOTO * train_photos  # Blur has gone away, however few evaluations show it.
        if len(points) >= 3 or (points and is_long):
            since = iterations * 2 / 3 + 1
            if any(point.iteration == self.resumed_at for point in points):  # Its schedule had ended there.
                since = max(since, self.resumed_at)
            earlier = [point for point in points[:-1] if point.iteration <= since] or points[:1]
            before = max(earlier, key=attrgetter("psnr"))
            if before.iteration >= iterations / 3 or not is_long:
                gain = points[-1].psnr - before.psnr
            if gain < UNFINISHED and not few_placed and (best := max(point.psnr for point in points)) < FAILED:
                remedy = "photos from places between them would help most"
                remedy += f"; or find their cameras anew {self._anew}" if self.posed else f": {again}"
                likely = "photos overlap too little, show different light, or their cameras are wrong"
                problem = f"held-out photos reach {best:.1f} dB at best, so the scene as a whole does not fit"
                return [f"{problem}: {likely}; {remedy}"]
            if gain > STILL_RISING:
                command = f"sehdr-warp train --resume --out {run} --iterations {2 * iterations}"
                rise = f"held-out photos gained {gain:.1f} dB since iteration {before.iteration}"
                lines.append(f"{rise}; more steps help: {command}")
            elif best := best_if_overfitted(points):
                better = f"{best.psnr - points[-1].psnr:.1f} dB better at iteration {best.iteration}"
                remedy = f"add photos from other places, or stop there: {self._command(self.scene, best.iteration)}"
                lines.append(f"held-out photos were {better}: the scene overfits its {train_photos} photos; {remedy}")
            elif not few_placed and train_photos < _FEW_PHOTOS and points[-1].psnr < 25:
                nearer = "more from places between them, and nearer, would help most"
                lines.append(f"{train_photos} photos are few: {nearer}: {again}")
        if gain >= UNFINISHED:
            return lines
        if wrong := self._wrong_cameras():
            lines.append(wrong)
        elif is_long or len(points) not in (1, 2):  # Few do not show whether blur goes away.
            if jump := self._exposure_jump():
                lines.append(jump)
            elif not few_placed and not points and train_photos < _FEWEST_PHOTOS:  # Nothing tells blur from movement.
                lines.append(f"{train_photos} photos are few: more from places between them would help most: {again}")
            elif gain <= STILL_RISING:
                lines += self._movement()
        return lines

    def _exposure_jump(self) -> str | None:
        """Return advice on photos whose brightness differs from the scene's as a whole."""
        offsets: Mapping[str, float] = self.summary.get("brightness_offsets") or {}
        jumps = sorted(
            (name for name in offsets if abs(offsets[name]) >= EXPOSURE_JUMP), key=lambda n: -abs(offsets[n])
        )
        if not jumps:
            return None
        are_dark = all(name in self.dark for name in jumps)
        jumps = jumps if are_dark else [name for name in jumps if name not in self.dark]
        names = first_names([f"{name} {offsets[name]:+.1f}" for name in jumps])
        what = f"{len(jumps)} photo{'s are' if len(jumps) > 1 else ' is'} brighter or darker than the scene as a whole"
        if are_dark:
            reason = "where the response is wrong between dark and bright"
            remedy = "keep them, because they measure lights; `sehdr-warp calibrate` measures the response"
        elif 2 * len(jumps) > len(offsets):
            reason, remedy = "in photos of several days or cameras", "train on those of one day"
        else:
            reason = "where exposure or sun changed"
            remedy = "state their times in exposures.json beside the photos, or move these photos out of the folder"
        return f"{what} (stops: {names}), as {reason}: {remedy}: {self._again}"

    def _wrong_cameras(self) -> str | None:
        """Return advice on single photos that differ from the scene by stops over a large part, as no blur does.

        Photos that are brighter or darker as a whole are left to their exposure.
        """
        areas: dict[str, float] = {}
        offsets = self.summary.get("brightness_offsets") or {}
        for region in (self.summary.get("unexplained") or {}).get("worst", ()):
            photo, stops = region["photo"], abs(region["stops"])
            if photo in self.sizes and stops >= max(_WRONG_STOPS, 2 * abs(offsets.get(photo, 0.0))):
                areas[photo] = areas.get(photo, 0.0) + region["pixels"] / self.sizes[photo]
        names = [photo for photo, area in areas.items() if area >= _WRONG_AREA]
        if not 0 < len(names) <= _FEW * len(self.sizes):
            return None
        several = len(names) > 1
        what = f"the camera{'s' if several else ''} of {first_names(names, 10)} seem{'' if several else 's'} wrong"
        shows = "these photos alone show" if several else "this photo alone shows"
        reason = f"{shows} another scene over much of the picture"
        return f"{what}: {reason}; move {'them' if several else 'it'} out of the folder: {self._again}"

    def _movement(self) -> list[str]:
        """Return advice on masks or uncertain cameras, if photos differ from the scene in many places, not by blur."""
        unexplained: Mapping[str, Any] = self.summary.get("unexplained") or {}
        worst: Sequence[Mapping[str, Any]] = unexplained.get("worst", ())
        if not worst or unexplained["regions"] < _MANY_REGIONS * max(self.train_photos, 1):
            return []
        stops = sorted(abs(region["stops"]) for region in worst)
        if stops[len(stops) // 2] < _REGION_STOPS:
            return []
        photos = list(dict.fromkeys(region["photo"] for region in worst))
        text = "photos and scene differ in many places"
        if 2 * sum(region["photo"] in self.uncertain for region in worst) > len(worst):
            names = first_names([photo for photo in photos if photo in self.uncertain])
            remedy = "add photos from places between them and the others, or move them out of the folder"
            return [f"{text}, most in photos whose cameras are uncertain ({names}): {remedy}: {self._again}"]
        remedy = "make these black in the photos' masks, masks/PHOTO.png beside them"
        return [f"{text}, as where people or leaves move (worst in {first_names(photos)}): {remedy}: {self._again}"]


def advice_on(trainer: "Trainer", data: LoadArguments, options: dict[str, Any]) -> list[str]:
    """Return advice on a training, if it is finished; its commands repeat `data` and the other options by name."""
    run, scene = trainer.run, trainer.scene
    if trainer.iteration < trainer.total:
        return []
    place = data.get("path") or "SCENE"
    folders = {str(view.source.parent) for view in scene.views if view.source is not None}
    posed = None
    if folders and scene.format not in SFM_LAYOUTS:
        posed = folders.pop() if len(folders) == 1 else place  # No folder holds the photos of several alone.
    usual = median(view.exposure_time for view in scene.train_views)
    training = FinishedTraining(
        run.path,
        run.summary() | {"metrics": run.metrics()},
        len(scene.train_views),
        place,
        option_words({name: data.get(name) for name in SCENE_OPTIONS} | options),
        resumed_at=trainer.first_iteration,
        unplaced=scene.unplaced,
        steps=trainer.total if "schedule.iterations" in trainer.config.plan.keep else None,
        posed=posed,
        misfit=any(MISFIT in note for note in scene.notes),
        sizes={view.name: view.camera.pixel_count for view in scene.train_views},
        uncertain={view.name for view in scene.train_views if view.uncertain},
        dark={view.name for view in scene.train_views if view.exposure_time <= _DARK * usual},
    )
    return training.advice()


def option_words(options: Mapping[str, Any]) -> list[str]:
    """Return the words of a command line that state options, by their names, but for the number of steps."""
    values = {name: value for name, value in options.items() if value is not None and name != "schedule.iterations"}
    return [word for name, value in values.items() for word in ("--" + name.replace("_", "-"), str(value))]


def options_of_run(run: Run) -> dict[str, str]:
    """Return the fields that a run was started with: what differs from the default and was not planned."""
    decisions = run.decisions()
    planned = {name for decision in decisions for name in decision["fields"]} - set(run.config.plan.keep)
    if decisions:
        planned.add("plan.enabled")  # A plan that was made is turned off in the run's config.
    options = {}
    for name, item in config_fields():
        value = attrgetter(name)(run.config)
        if value != item.default and name not in planned and name != "plan.keep":
            options[name] = field_text(value)
    return options
