"""Structure from motion through pycolmap: poses and points of bare photos.

pycolmap reads only images that this module writes under its own names, and its models are read by the package's own
reader. Results are cached under a key of everything that they depend on: see cache_key().
"""

import contextlib
import hashlib
import itertools
import json
import logging
import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import distributions
from operator import methodcaller
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ...errors import InputError, SehdrError
from ...parallel import preserve_signals, run_interruptibly
from ...progress import Stage, stage, track_progress
from ...subsets import all_names, counted
from ..cached_folder import cached_folder, file_digest
from ..images.exif import exif_texts
from ..images.ldr_files import LDR_SUFFIXES, PILLOW_ERRORS, exif_of, open_image
from ..masks import write_reduced
from ..photo_names import photo_labels
from ..photos import BRIGHTENING, brightened_codes, decoding_problems, read_photo, unusable_notes
from ..readers.colmap_model import SparseModel, read_model
from .pairs import FEATURES, MOST_GUIDED, PARTNERS, RATIO, from_one_place, likely_pairs, pairs_with, remove_matches
from .progress import counted_rows

_log = logging.getLogger("sehdr_warp.scene")

# SIFT finds little more above this size, and extraction time grows with the area.
MAX_SIDE = 1200
SEED = 0
FEWEST_SHARED = 60  # Points of a photo with fewer shared ones place it badly; sound photos have hundreds
MOST_ERROR = 1.0  # Pixels; sound sets have 0.2 to 0.8
_VERSION = 6  # Raised with every change of results that no constant of cache_key() states
# Up to so many photos all pairs are matched; in larger sets likely ones; in still larger ones neighbors by name.
EXHAUSTIVE_LIMIT, COMPARED_LIMIT = 30, 150
OVERLAP = 20  # Neighbors on each side with which a photo of a larger set is matched, and as many powers of two
_PAIR_COST, _PLACE_COST = 0.1, 0.45  # Time to match a pair and to place a photo, as parts of that of a photo's features


@dataclass(frozen=True)
class Reconstruction:
    """Result of structure from motion."""

    model: SparseModel  # Cameras, poses and points; `00003.png` is photos[3], photos not placed are missing
    error: float  # Mean reprojection error in pixels, at photos of at most MAX_SIDE pixels
    weak: tuple[int, ...]  # Indices of the photos that share fewer than FEWEST_SHARED points with others
    one_place: bool = False  # See from_one_place()
    damaged: tuple[int, ...] = ()  # Indices of the photos that cannot be decoded

    @property
    def sure(self) -> int:
        """Number of photos that are placed by enough points."""
        return len(self.model.images) - len(self.weak)

    def notes(self, photos: Sequence[Path]) -> tuple[str, ...]:
        """Return a line for each reason not to trust the places of the cameras, with the photos concerned."""
        placed_or_damaged = {*self.damaged, *(int(Path(image.name).stem) for image in self.model.images)}
        unregistered = [i for i in range(len(photos)) if i not in placed_or_damaged]
        notes = unusable_notes(decoding_problems([photos[i] for i in self.damaged]), len(photos))
        names = photo_labels(photos)
        if unregistered:
            were = f"photos could not be placed and {'was' if len(unregistered) == 1 else 'were'} left out"
            count, names_left_out = f"{len(unregistered)} of {len(photos)}", all_names(names, unregistered)
            notes.append(f"{count} {were}: {names_left_out}; photos between these and the others help")
        if self.weak:
            shared = "few points with others, so"
            one, several = f"photo shares {shared} its place is", f"photos share {shared} their places are"
            few = counted(len(self.weak), one, several)
            notes.append(f"{few} uncertain: {all_names(names, self.weak)}; more photos in between help")
        if self.one_place:
            turned = "the photos match as if the camera only turned on the spot, which shows no depth"
            notes.append(f"{turned}: views from elsewhere will be wrong; take photos from different places")
        if self.error > MOST_ERROR:
            uncertain = f"camera positions are uncertain: the mean reprojection error is {self.error:.1f} pixels"
            notes.append(f"{uncertain}; sharper photos, less motion in the scene and one lens and zoom help")
        return tuple(notes)


def reconstruct(
    photos: Sequence[Path], cache: Path | str | None = None, masks: Sequence[Path | None] = ()
) -> Reconstruction:
    """Find cameras (SIMPLE_RADIAL, at the photos' oriented size), poses and points of photos.

    Args:
        photos: the files.
        masks: of the photos, None for a photo without one; pixels below a half give no features. Empty: no masks.
        cache: a folder for results, None for the user's; the same photos are solved once, wherever they lie.

    Returns:
        The model and how far it can be trusted.

    Raises:
        InputError: if fewer than two photos can be placed.
    """
    digests = [(photo.name, file_digest(photo)) for photo in photos]
    key = cache_key("photos", digests, [mask and file_digest(mask) for mask in masks if any(masks)])

    def solve(work: Path, result: Path) -> None:
        sizes, small = write_photos(photos, work / "images")
        if any(masks):
            (work / "masks").mkdir()
            for i, mask in enumerate(masks):
                if all(small[i]):  # pycolmap finds nothing in an image without a mask of this name.
                    write_reduced(mask, small[i], work / "masks" / f"{image_name(i)}.png")
        database = work / "database.db"
        groups: dict[tuple, list[int]] = {}  # One set of intrinsics for a size, a device and a focal length.
        for i, photo in enumerate(photos):
            if all(small[i]):  # It has a copy.
                groups.setdefault((sizes[i], small[i], exif_device(photo)), []).append(i)
        count = sum(len(group) for group in groups.values())
        with (
            stage("finding features in photos", count, _log) as progress,
            counted_rows(database, "keypoints", partial(_show_features, progress)),
        ):
            for (_, (width, height), device), group in groups.items():
                params = (_focal_prior(device[-1], width, height), width / 2, height / 2, 0.0)
                names = [image_name(i) for i in group]
                extract_features(database, work, names, params)
            photo_seconds = progress.seconds / count
            progress.update(count)
        _match(database, count, photo_seconds)
        names = {image_name(i) for group in groups.values() for i in group}
        again = partial(_match_missing, database, names) if len(photos) <= COMPARED_LIMIT else None
        model = run_mapper(database, work, count, photos[0].parent, before_again=again)
        model.write_binary(result)
        placed = [model.images[i] for i in model.reg_image_ids()]
        weak = sorted(int(Path(image.name).stem) for image in placed if image.num_points3D < FEWEST_SHARED)
        facts = {"sizes": sizes, "weak": weak, "one_place": from_one_place(database, model)}
        facts["error"] = float(model.compute_mean_reprojection_error())
        (result / "facts.json").write_text(json.dumps(facts))

    folder = solved_folder(cache, key, solve)
    model, facts = read_model(folder), {"one_place": False} | json.loads((folder / "facts.json").read_text())
    sized = zip(model.images, (facts["sizes"][int(Path(image.name).stem)] for image in model.images), strict=True)
    images = tuple(replace(image, lens=image.lens.resized(*size)) for image, size in sized)
    damaged = tuple(i for i, size in enumerate(facts["sizes"]) if not all(size))
    others = tuple(facts["weak"]), facts["one_place"], damaged
    return Reconstruction(replace(model, images=images), facts["error"], *others)


def solved_folder(cache: Path | str | None, key: str, solve: Callable[[Path, Path], None]) -> Path:
    """Return the cached folder of a result, as cached_folder() does; solve(work, result) writes it.

    `work` is a temporary folder in that of the result, whose leftovers after a kill are removed by the next call.
    """

    def fill(result: Path) -> None:
        with tempfile.TemporaryDirectory(prefix="sehdr-sfm-", dir=result) as work:
            solve(Path(work), result)

    return cached_folder(cache, f"sfm-{key}", "cameras by structure from motion", fill)


def cache_key(*parts) -> str:
    """Name a result by all it depends on: `parts` (for JSON), constants here and of pairs, and pycolmap's version."""
    pairing = (EXHAUSTIVE_LIMIT, COMPARED_LIMIT, MOST_GUIDED, OVERLAP, FEATURES, PARTNERS, RATIO)
    builds = sorted({each.version for each in distributions() if str(each.name).startswith("pycolmap")})  # -cuda12, too
    key = [_VERSION, *builds, MAX_SIDE, SEED, FEWEST_SHARED, pairing, BRIGHTENING, *parts]
    return hashlib.sha256(json.dumps(key).encode()).hexdigest()[:16]


def image_name(index: int) -> str:
    """Return the name of a photo in what pycolmap reads."""
    return f"{index:05d}.png"


def write_photos(photos, folder: Path) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Write oriented 8-bit copies of at most MAX_SIDE pixels; photos that cannot be decoded have none.

    Returns:
        The oriented full sizes and the copies' sizes, (0, 0) without a copy.

    Raises:
        InputError: if most photos cannot be decoded, or none shows anything.
    """
    folder.mkdir()
    sizes, small, problems, visible = [], [], [], False
    for i, photo in track_progress("reading photos", photos, _log):
        try:
            codes = read_photo(photo, oriented=True).pixels
        except InputError as error:
            problems.append(error)
            sizes.append((0, 0))
            small.append((0, 0))
            continue
        image = Image.fromarray(brightened_codes(codes))
        image.thumbnail((MAX_SIDE, MAX_SIDE), Image.Resampling.BOX)
        sizes.append(codes.shape[1::-1])
        small.append(image.size)
        values = np.asarray(image)
        visible |= bool(((values > 2) & (values < 253)).mean() > 1e-3)
        image.save(folder / image_name(i), compress_level=1)
    unusable_notes(problems, len(photos))  # Raises if these are most of them; Reconstruction.notes() has the line.
    if not visible:
        problem = "the photos are all black or all white"
        raise InputError(photos[0].parent, problem, "expose them so that the scene shows")
    return sizes, small


def _focal_prior(equivalent: str, width: int, height: int) -> float:
    """Return pixels from EXIF's 35 mm equivalent (whose diagonal is 43.27 mm), or COLMAP's 1.2 longest sides."""
    with contextlib.suppress(ValueError):
        if 4 <= float(equivalent) <= 2000:
            return float(equivalent) / 43.27 * math.hypot(width, height)
    return 1.2 * max(width, height)


def exif_device(photo: Path) -> tuple[str, ...]:
    """Return EXIF's maker, model, focal length and its 35 mm equivalent as text, "None" if EXIF does not state them.

    RAW and float photos have "None" for all, because a set of them has one camera.
    """
    if photo.suffix.lower() in LDR_SUFFIXES:
        with open_image(photo) as image, contextlib.suppress(*PILLOW_ERRORS):
            exif = exif_of(image)
            lens = exif.get_ifd(0x8769)
            return exif_texts(exif.get(0x010F), exif.get(0x0110), lens.get(0x920A), lens.get(0xA405))
    return ("None",) * 4


def extract_features(database: Path, work: Path, names: list[str], params) -> None:
    """Extract the features of images, in images/ and where masks/ keeps them, that share one camera."""
    import pycolmap

    camera_params = ",".join(f"{value:.17g}" for value in params)
    reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL", camera_params=camera_params)
    if (work / "masks").exists():
        reader.mask_path = work / "masks"
    for start in range(0, len(names), 8):  # Eight photos at a time, one on each core.
        part = names[start : start + 8]
        with quiet_colmap():
            # By name: threads would number images as they end, and the world has the axes of one with a low number.
            with pycolmap.Database.open(database) as opened:
                pycolmap.import_images(database, work / "images", pycolmap.CameraMode.SINGLE, part, reader)
                reader.existing_camera_id = max(image.camera_id for image in opened.read_all_images())
            options = (database, work / "images", part, pycolmap.CameraMode.SINGLE, reader)
            run_interruptibly(partial(pycolmap.extract_features, *options, device=pycolmap.Device.cpu))


def _show_features(progress: Stage, done: int) -> None:
    """Show how many photos have features, and estimate when the training starts from the time that they took."""
    if done:
        count, seconds = progress.total, progress.seconds / done
        progress.later = seconds * (_PAIR_COST * len(_pairs(count)) + _PLACE_COST * count)
        progress.update(done)


def _pairs(count: int) -> set[tuple[int, int]]:
    """Return about so many pairs of photos as are matched: all, or neighbors by name at some distances."""
    if count <= EXHAUSTIVE_LIMIT:
        return set(itertools.combinations(range(count), 2))
    steps = {*range(1, OVERLAP + 1), *(2**power for power in range(OVERLAP))}
    if count <= COMPARED_LIMIT:
        steps = set(range(1, 9))  # Of likely pairs there are about eight for each photo.
    return {(i, i + step) for i in range(count) for step in steps if i + step < count}


def matching_options() -> dict[str, Any]:
    """Return the options of COLMAP's matchers that make a result repeatable."""
    import pycolmap

    options = {"verification_options": pycolmap.TwoViewGeometryOptions(), "device": pycolmap.Device.cpu}
    options["verification_options"].ransac.random_seed = SEED
    return options


def _match(database: Path, count: int, photo_seconds: float) -> None:
    """Match features between photos; those of a photo took `photo_seconds`, from which later stages are estimated."""
    import pycolmap

    options, total = matching_options(), len(_pairs(count))
    match = partial(pycolmap.match_exhaustive, database, **options)
    if EXHAUSTIVE_LIMIT < count <= COMPARED_LIMIT:
        pairs = likely_pairs(database)
        match, total = partial(_match_pairs, database, pairs), len(pairs)
    elif count > COMPARED_LIMIT:
        pairing = pycolmap.SequentialPairingOptions(overlap=OVERLAP, quadratic_overlap=True)
        match = partial(pycolmap.match_sequential, database, pairing_options=pairing, **options)
    with quiet_colmap(), stage("matching pairs of photos", total, _log) as progress:
        progress.later = photo_seconds * _PLACE_COST * count
        with counted_rows(database, "two_view_geometries", progress.update):
            run_interruptibly(match)
        progress.update(progress.total)


def _match_pairs(database: Path, pairs: Sequence[tuple[str, str]], guided: bool = False) -> None:
    """Match features between pairs of images by their names; `guided` matches a second time along epipolar lines."""
    import pycolmap

    options, file = pycolmap.FeatureMatchingOptions(guided_matching=guided), database.with_name("pairs.txt")
    file.write_text("".join(f"{first} {second}\n" for first, second in pairs), encoding="utf-8")
    pairing = pycolmap.ImportedPairingOptions(match_list_path=str(file))
    pycolmap.match_image_pairs(database, matching_options=options, pairing_options=pairing, **matching_options())


def _match_missing(database: Path, names: set[str], placed: set[str]) -> None:
    """Match photos that could not be placed with all others, up to MOST_GUIDED pairs along epipolar lines."""
    pairs = pairs_with(names - placed, database)
    if guided := len(pairs) <= MOST_GUIDED:
        remove_matches(pairs, database)
    with quiet_colmap(), stage("matching pairs of photos that could not be placed", len(pairs), _log):
        run_interruptibly(partial(_match_pairs, database, pairs, guided=guided))


def run_mapper(
    database: Path,
    work: Path,
    count: int,
    source: Path,
    *,
    name: str = "photo",
    views: int = 1,
    before_again: Callable[[set[str]], None] | None = None,
):
    """Return the largest reconstruction, after a second try with weaker conditions if photos are missing from it.

    Args:
        database: COLMAP's database, with matched features.
        work: folder with `images`, for the models.
        count: number of photos.
        source: folder to name in the error.
        name: of one photo, in messages.
        views: of each photo, which form a rig; if there are several, their lenses and places in the rig are known.
        before_again: called before the second try with the names of the images that were placed.

    Raises:
        InputError: if fewer than two photos can be placed.
    """
    import pycolmap

    best: Any = None
    placed = methodcaller("num_reg_images" if views == 1 else "num_reg_frames")
    for patient in (False, True):
        options = pycolmap.IncrementalPipelineOptions(min_model_size=2)
        options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = SEED
        for part in ("focal_length", "principal_point", "extra_params", "sensor_from_rig") if views > 1 else ():
            setattr(options, f"ba_refine_{part}", False)
        if patient:
            options.min_num_matches = 10
            options.mapper.init_min_tri_angle = 4.0
            options.mapper.init_min_num_inliers = 50
            options.mapper.abs_pose_min_num_inliers = 15
            if before_again is not None:
                before_again(set() if best is None else {best.images[i].name for i in best.reg_image_ids()})
            _log.info("estimating cameras of the %ss again with weaker conditions", name)
        output = work / f"model{int(patient)}"
        output.mkdir()
        stage_name = f"placing {name}s" if views == 1 else f"placing views of {name}s"
        with quiet_colmap(), stage(stage_name, count * views, _log) as progress:
            progress.later = 0.0
            counter = itertools.count(3)
            place: Any = partial(pycolmap.incremental_mapping, database, work / "images", output, options)
            models = run_interruptibly(
                partial(place, next_image_callback=lambda: progress.update(next(counter)))  # noqa: B023
            )
        best = max([*([] if best is None else [best]), *models.values()], key=placed, default=None)
        if best is not None and placed(best) == count:
            return best
    if best is None or placed(best) < 2:
        remedy = "take sharp, bright photos that overlap by two thirds" if views == 1 else "take them closer together"
        problem = f"none of the {count} {name}s could be placed by structure from motion"
        if views == 1 and from_one_place(database):
            problem += ": they match as if taken from one place"
            remedy = "take them from different places, as one place shows no depth"
        raise InputError(source, problem, f"{remedy}, or bring poses")
    return best


@contextlib.contextmanager
def quiet_colmap():
    """Suppress pycolmap's log on the terminal except fatal errors."""
    with preserve_signals():  # Its log would end the process with a trace of its stack.
        import pycolmap

    level, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, int(pycolmap.logging.FATAL)
    try:
        yield
    except (RuntimeError, ValueError) as error:
        raise SehdrError(f"structure from motion failed ({str(error).splitlines()[0] if str(error) else error!r}); "
                         "check that the photos are sharp and overlap") from None  # fmt: skip
    finally:
        pycolmap.logging.minloglevel = level
