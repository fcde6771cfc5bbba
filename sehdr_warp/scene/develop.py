"""From shots to views: decode, orient, undistort and scale, every average taken over light by one response."""

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import InputError
from ..parallel import made_ahead
from .camera import Camera
from .capture import Capture, Shot, reinhard_gamma
from .hdr_files import hdr_size, read_hdr
from .images import EncodedImage
from .lens import Lens, Undistortion, area_average
from .linear_photos import float_codes, kind_of, linear_codes
from .masks import mask_note, read_mask
from .names import unique_names
from .photo_file import PhotoKeeper
from .photos import photo_sizes, read_photo
from .types import Scene, View, codes_of

if TYPE_CHECKING:
    from ..response import Response

_log = logging.getLogger("sehdr_warp.scene")
_LEAST_CLIPPED = 0.05  # Part of a pixel's area that may be clipped for its light above white to be known
_PIXELS_AT_ONCE = 64_000_000  # Of the photos that are read side by side


def develop(capture: Capture, response: "Response", max_size: int | None = None, photos: str = "auto") -> Scene:
    """The scene of a capture: each photo undistorted and averaged to size, in the light that `response` decodes.

    max_size: longest side of the views in pixels, None keeps the photos'. A photo that is neither bent nor averaged
    keeps its codes; others become uint16. photos: where views stay, see PhotoKeeper.
    Raises InputError where a file is damaged, sizes disagree, or the photos show nothing but black or white.
    """
    developer, names = _Developer(max_size, response, capture.alpha), unique_names(capture.shots)
    keeper = PhotoKeeper(photos, len(names), sum(shot.lens.width * shot.lens.height for shot in capture.shots))
    # Some copies of a photo are made on its way. While OpenEXR and LibRaw read, nobody's words reach the terminal.
    quiet = any(shot.hdr is not None or kind_of(shot.image) != "encoded" for shot in capture.shots)
    most = 1 if quiet else _PIXELS_AT_ONCE // max(shot.lens.width * shot.lens.height for shot in capture.shots)
    shots = ((shot, names[i]) for i, shot in told("reading views", capture.shots))
    views = [keeper.kept(view) for view in made_ahead(lambda given: developer.view(*given), shots, most)]
    deque(with_content(((view.codes, view.mask) for view in views if view.split == "train"), capture.folder), maxlen=0)
    notes = *capture.notes, *mask_note(list(developer.mask_shares.values())), *([keeper.note] if keeper.note else [])
    stated = *capture.cloud, capture.times_known, notes
    return Scene(capture.name, capture.format, tuple(views), *stated, response=response)


def with_content(photos: Iterable[tuple[np.ndarray, np.ndarray | None]], folder: Path) -> Iterator[np.ndarray]:
    """The codes of photos, one by one; then refuses sets that show nothing: fewer than one sample in a thousand between
    black and white.

    photos: codes and mask of each. Large photos are looked at on a grid of about a million pixels.
    """
    shown = total = 0
    light = 0.0
    for codes, mask in photos:
        step = max(1, round((codes.shape[0] * codes.shape[1] / 1e6) ** 0.5))
        values, white = codes[::step, ::step], np.iinfo(codes.dtype).max
        values = values if mask is None else values[mask[::step, ::step] > 0.5]
        shown += int(((values > white * 1.5 / 255) & (values < white * (1 - 1.5 / 255))).sum())
        total, light = total + values.size, light + float(values.sum(dtype=np.float64)) / white
        yield codes
        del codes, values  # Before the next is read: they may be large.
    if shown < total * 1e-3 or total == 0:
        mean = light / max(total, 1)
        state = "masked out" if total == 0 else f"black or white in {100 - 100 * shown / total:.1f} % (mean {mean:.3f})"
        remedy = "expose them so that the scene shows, or choose another exposure index"
        raise InputError(folder, f"the training photos are {state}", remedy)


def told(doing: str, items: Sequence) -> Iterator[tuple[int, Any]]:
    """enumerate(items), with a line to the log before every tenth."""
    for i, item in enumerate(items):
        if i % 10 == 0:
            _log.info("%s %d to %d of %d", doing, i + 1, min(i + 10, len(items)), len(items))
        yield i, item


def as_photographed(shot: Shot, *, oriented: bool = False) -> EncodedImage:
    """A shot's codes before anything is undistorted or averaged; of a set of truth alone, HDR-NeRF's photo of it."""
    if not shot.derived and kind_of(shot.image) == "float":
        return EncodedImage(float_codes(read_hdr(shot.image), shot.seconds), None)
    if not shot.derived:
        read = read_photo(shot.image, oriented=oriented)
        return EncodedImage(linear_codes(read.pixels / read.levels), read.alpha) if shot.linear else read
    return EncodedImage(codes_of(reinhard_gamma(read_hdr(shot.image) * shot.seconds), 8), None)


class _Developer:
    def __init__(self, max_size: int | None, response: "Response", alpha: str):
        self.max_size, self.response, self.alpha = max_size, response, alpha
        self._tables: dict[int, np.ndarray] = {}
        self._last: tuple[Lens, Undistortion] | None = None
        self.mask_shares: dict[str, float | None] = {}  # By view: the mean of its mask file
        self._alone = threading.Lock()  # For what photos share; responses work on all cores by themselves

    def view(self, shot: Shot, name: str) -> View:
        lens, oriented = (shot.lens, False) if shot.derived else fitted_lens(shot)
        working, undistortion, full = lens, None, lens.pinhole(shot.world_to_camera)
        if not (lens.is_pinhole or shot.derived):
            # Distortion is smooth: undone at twice the final size or more it is right to a fraction of a final pixel.
            factor = 1 if self.max_size is None else max(lens.width, lens.height) // (2 * self.max_size)
            if factor > 1:
                working = lens.resized(round(lens.width / factor), round(lens.height / factor))
            # Sets mostly share one lens, whose map is as large as an image.
            with self._alone:
                if self._last is None or self._last[0] != working:
                    self._last = working, Undistortion(working)
                undistortion = self._last[1]
            full = undistortion.camera(shot.world_to_camera)
        camera = full.within(self.max_size)

        def warped(image: np.ndarray, values: Callable[[slice], np.ndarray] | None = None) -> np.ndarray:
            """[H, W] or [H, W, C] at the photo's size -> float32 at the camera's, undistorted; see area_average."""
            if not undistortion:
                return _shrunk(image, camera, values)
            return _shrunk(undistortion.apply(_shrunk(image, working, values)), camera)

        hdr = None if shot.hdr is None else warped(_read_truth(shot.hdr, lens, camera, undistortion is not None))
        stated = camera, shot.seconds, shot.split or "train"
        stored = None if shot.mask is None else _fitted_mask(shot.mask, lens, oriented)
        self.mask_shares[name] = None if stored is None else float(stored.mean())
        if shot.derived and hdr is not None:  # HDR-NeRF's photo of the truth, at the final size.
            mask = None if stored is None else warped(stored)
            return View(name, codes_of(reinhard_gamma(hdr * shot.seconds), 8), *stated, mask, hdr, shot.image)
        encoded = as_photographed(shot, oriented=oriented)
        codes, alpha, above = encoded.pixels, encoded.alpha, encoded.above_white
        masks = [] if undistortion is None or undistortion.inside is None else [_shrunk(undistortion.inside, camera)]
        if stored is not None:
            masks.append(warped(stored))
        if alpha is not None and self.alpha == "mask":
            masks.append(warped(alpha))
            alpha = None
        if undistortion or alpha is not None or (camera.width, camera.height) != (lens.width, lens.height):
            codes, above = self._averaged(codes, alpha, above, warped)
        mask = np.clip(np.prod(masks, axis=0), 0, 1).astype(np.float32) if masks else None
        mask = None if mask is None or mask.min() >= 1 - 1e-6 else mask
        return View(name, codes, *stated, mask, hdr, shot.image, above, encoded.above_white_deviation)

    def _averaged(
        self, codes: np.ndarray, alpha: np.ndarray | None, above: np.ndarray | None, warped: Callable
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the codes of the mean light, and the light above white that is left of `above` in it."""
        levels = int(np.iinfo(codes.dtype).max)
        with self._alone:
            if levels not in self._tables:
                light = self.response.decode(np.arange(levels + 1, dtype=np.float64) / levels)
                self._tables[levels] = np.maximum(light, 0.0).astype(np.float32)

        def seen(values: np.ndarray, rows: slice) -> np.ndarray:
            return values if alpha is None else values * alpha[rows, :, None]

        def light_of(rows: slice) -> np.ndarray:
            light = self._tables[levels][codes[rows]]
            return light if above is None else np.where(above[rows] > 0, above[rows] * white, light)

        def clipped_in(rows: slice) -> np.ndarray:
            clipped = codes[rows] == levels
            return (clipped if above is None else clipped & (above[rows] == 0)).astype(np.float32)

        white = self._tables[levels][levels]
        light = warped(codes, lambda rows: seen(light_of(rows), rows))
        clipped = warped(codes, lambda rows: seen(clipped_in(rows), rows))
        with self._alone:
            encoded = self.response.encode(light)
        # A mean over clipped samples is a lower bound: with half of the area clipped, white is the honest value.
        averaged = codes_of(np.where(clipped >= 0.5, np.float32(1.0), encoded), 16)
        if above is not None:
            known = (averaged == 65535) & (clipped < _LEAST_CLIPPED)
            above = np.where(known, np.maximum(light / white, 1), 0).astype(np.float16) if known.any() else None
        return averaged, above


def _shrunk(image: np.ndarray, to: Lens | Camera, values: Callable[[slice], np.ndarray] | None = None) -> np.ndarray:
    return area_average(image, to.width, to.height, values)


def _read_truth(path: Path, lens: Lens, camera: Camera, bent: bool) -> np.ndarray:
    size = hdr_size(path)
    # Truth may be rendered larger than the photos (HDR-NeRF's evaluation averages it down); never smaller.
    larger = size[0] >= camera.width and size[1] >= camera.height and _same_aspect(size, lens)
    if size != (lens.width, lens.height) and (bent or not larger):
        problem = f"HDR truth is {size[0]} x {size[1]}, the photo {lens.width} x {lens.height}"
        raise InputError(path, problem, "render the truth at the photo's size, or remove it")
    return read_hdr(path)


def fitted_lens(shot: Shot) -> tuple[Lens, bool]:
    """The lens at the file's size, and whether the pixels are to be turned as EXIF says.

    COLMAP ignores the EXIF orientation, other tools follow it: the size that agrees with the camera's tells which,
    and stored pixels win where both do. Whole-number reductions of the camera's size (images_2 ...) are taken.
    """
    lens = shot.lens
    stored, turned = photo_sizes(shot.image)
    choices = [(stored, False), (turned, True)] if shot.oriented is None else [(turned, True)]
    for factor in range(1, 17):
        for (width, height), oriented in choices:
            if factor == 1 and (width, height) == (lens.width, lens.height):
                return lens, oriented
            if factor > 1 and abs(lens.width / factor - width) < 1 and abs(lens.height / factor - height) < 1:
                return lens.resized(width, height), oriented
    problem = f"image is {stored[0]} x {stored[1]}, its camera {lens.width} x {lens.height}"
    raise InputError(shot.image, problem, "use the images that the cameras were solved for")


def _fitted_mask(path: Path, lens: Lens, oriented: bool) -> np.ndarray:
    mask = read_mask(path, oriented=oriented)
    height, width = mask.shape
    larger = width > lens.width and height > lens.height and _same_aspect((width, height), lens)
    if larger or (width, height) == (lens.width, lens.height):
        return _shrunk(mask, lens)
    problem = f"mask is {width} x {height}, its image {lens.width} x {lens.height}"
    raise InputError(path, problem, "make the mask at the image's size")


def _same_aspect(size: tuple[int, int], lens: Lens) -> bool:
    return abs(size[0] * lens.height - size[1] * lens.width) <= max(size)
