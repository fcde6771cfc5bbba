"""Preprocess photos into views: decode, orient, undistort and resize, with every average taken in linear light."""

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from PIL import Image

from ..errors import InputError
from ..parallel import prefetch_map
from ..progress import track_progress
from .camera import Camera
from .color.encoding import DEVIATION, ColorEncoding
from .color.primaries import linear_to_srgb
from .color.srgb_codes import FloatTable, bands_of
from .dataparser import DataparserOutputs, ImageRecord, reinhard_gamma
from .float_photos import float_codes
from .images.downsampling import area_average
from .images.gain_map import gain_map_notes, light_of, read_gain_map, with_light_above_white
from .images.hdr_files import Light, hdr_size, read_hdr, read_light
from .images.ldr_files import EncodedImage, file_kind, with_whole_white
from .lens import Lens, Undistortion
from .masks import mask_note, read_mask
from .photo_content import require_content, unused_bits_note
from .photo_storage import PhotoKeeper
from .photos import fitted_lens, read_photo, stored_orientation, unusable_notes
from .raw.decode import linear_codes
from .types import Scene, View, codes_of
from .video.color import codes_in_rec709
from .wide_camera import solid_angles

if TYPE_CHECKING:
    from ..response import Response

_log = logging.getLogger("sehdr_warp.scene")
_LEAST_CLIPPED = 0.05  # Part of a pixel's area that may be clipped for its light above white to be known
_LEAST_SHARE = 0.5  # Part of a photo's area that undistortion leaves of lenses that exist
_PIXELS_AT_ONCE = 64_000_000  # Pixels of the photos that are read in parallel, which bounds memory


def preprocess(
    dataset: DataparserOutputs,
    response: "Response",
    names: Sequence[str],
    max_size: int | None = None,
    photo_storage: str = "auto",
) -> Scene:
    """Undistort and resize the photos of a dataset.

    A photo that needs neither keeps its codes; others get codes of 16 bits.

    Args:
        dataset: what parse_dataset returned.
        response: decodes codes to the light in which averages are taken.
        names: of the views.
        max_size: longest side of the views in pixels; None keeps the photos' sizes.
        photo_storage: where views are stored, see PhotoKeeper.

    Raises:
        InputError: if a file is damaged, sizes disagree, or the photos show nothing but black or white.
    """
    to_rec709 = dataset.color_matrix if dataset.within_rec709 else None
    preprocessor = _Preprocessor(max_size, response, dataset.alpha, to_rec709)
    keeper = PhotoKeeper(
        photo_storage, len(names), sum(record.lens.width * record.lens.height for record in dataset.records)
    )
    # OpenEXR and LibRaw are read one at a time: their output to the terminal is suppressed for the whole process.
    quiet = any(record.hdr is not None or file_kind(record.image) != "encoded" for record in dataset.records)
    most = 1 if quiet else _PIXELS_AT_ONCE // max(record.lens.width * record.lens.height for record in dataset.records)
    jobs = ((record, names[i]) for i, record in track_progress("reading views", dataset.records, _log))
    views, problems = [], []
    for view in prefetch_map(lambda job: preprocessor.view_or_error(*job), jobs, most):
        if isinstance(view, InputError):
            problems.append(view)
        else:
            views.append(keeper.store(view))
    truth_count = sum(record.hdr is not None for record in dataset.records)
    damaged = unusable_notes(problems, len(names))
    damaged += unusable_notes(preprocessor.unusable_truth, truth_count, truth=True)
    require_content([view for view in views if view.split == "train"] or views, dataset.folder)
    masks = mask_note(list(preprocessor.mask_shares.values()), len(preprocessor.labeled_masks))
    if preprocessor.transparent:
        meaning = "are left out" if dataset.alpha == "mask" else "count as black light"
        count = f"{len(preprocessor.transparent)} of {len(names)} photos"
        masks.append(f"transparency: {count} have transparent pixels, which {meaning}")
    masks += _cropped_note(preprocessor.cropped, dataset)
    masks += gain_map_notes(preprocessor.gain_map_problems)
    masks += unused_bits_note(preprocessor.largest_code, linear=dataset.kind == "linear")
    notes = (*dataset.notes, *damaged, *masks, *([keeper.note] if keeper.note else []))
    points, colors = dataset.cloud
    times_known = dataset.times_known
    black = bool(preprocessor.transparent) and dataset.alpha == "background"
    return Scene(
        dataset.name,
        dataset.format,
        tuple(views),
        points,
        colors,
        times_known,
        notes,
        response=response,
        black_background=black,
    )


def _cropped_note(cropped: Mapping[Path, float], dataset: DataparserOutputs) -> list[str]:
    """Return a note on photos of which undistortion leaves too little, by the part of their area that it leaves."""
    if not cropped:
        return []
    record = next(record for record in dataset.records if record.image in cropped)
    count, share = f"{len(cropped)} of {len(dataset.records)} photos", max(cropped.values())
    problem = f"lens: undistorted, {count} show at most {share:.0%} of their area, because the distortion that"
    problem += f" {record.lens.source.name} states bends the rest back, as no lens does"
    return [f"{problem}; to find the cameras anew, give a folder with the photos alone"]


def read_codes(record: ImageRecord) -> EncodedImage:
    """Read a photo's codes, or compute them from HDR truth or light, before anything is undistorted or resized."""
    stored = _read_stored(record, {}, oriented=False)
    return stored.encoding.convert(stored.photo)


class _StoredPhoto(NamedTuple):
    """A photo as its file stores it."""

    photo: EncodedImage  # Codes before they are converted to sRGB's
    encoding: ColorEncoding  # Of the codes
    is_transparent: bool  # Whether the file has transparent parts; the photo has alpha only if they are not black yet


def _read_stored(
    record: ImageRecord, problems: dict[Path, str], *, oriented: bool, masked: bool = False
) -> _StoredPhoto:
    """Return a photo before its codes are converted to sRGB's.

    The problem of a damaged gain map goes to `problems`. `masked` leaves float pictures without the black that their
    transparent parts lie over.
    """
    srgb, kind = ColorEncoding("sRGB"), file_kind(record.image)
    if record.derived:
        codes = codes_of(reinhard_gamma(read_hdr(record.image) * record.seconds), 8)
        return _StoredPhoto(EncodedImage(codes, None), srgb, False)
    if kind == "float":
        light = read_light(record.image)
        pixels = light.uncovered if masked else light.pixels
        codes = float_codes(pixels * record.light_scale, record.seconds)
        photo = EncodedImage(codes, light.coverage if masked else None)
        return _StoredPhoto(photo, srgb, light.coverage is not None)
    photo, encoding = read_photo(record.image, oriented=oriented), record.encoding or srgb
    if kind == "encoded" and not record.linear:
        gain_map = read_gain_map(record.image, oriented=oriented, problems=problems)
        if record.gain_map_scale is not None:
            photo = light_of(photo, gain_map, record.gain_map_scale)
            encoding = replace(encoding, curves=(), table=None)  # The light is in sRGB's curve already
        elif gain_map is not None:
            photo = with_light_above_white(photo, gain_map)
    elif record.linear and encoding.light is None:
        photo = EncodedImage(linear_codes(photo.pixels / photo.levels), photo.alpha)
        encoding = replace(encoding, curves=(), table=None)
    return _StoredPhoto(photo, encoding, photo.alpha is not None)


@dataclass(frozen=True)
class _Resampler:
    """Undistorts and averages images from the size of a photo to that of its view."""

    working: Lens  # The photo's lens, at the size in which it is undistorted
    undistortion: Undistortion | None  # Of that lens; None for a pinhole
    camera: Camera  # Camera of the view

    def __call__(self, image: np.ndarray, values: Callable[[slice], np.ndarray | None] | None = None) -> np.ndarray:
        """Return [H, W] or [H, W, C] of the view's size; `values` as in area_average()."""
        if self.undistortion is None:
            return _shrink(image, self.camera, values)
        return _shrink(self.undistortion.apply(_shrink(image, self.working, values)), self.camera)

    def borders(self) -> list[np.ndarray]:
        """Return the mask of what the photo shows of the view, if it does not show all of it."""
        inside = None if self.undistortion is None else self.undistortion.inside
        return [] if inside is None else [_shrink(inside, self.camera)]


class _Preprocessor:
    """Preprocessor of a set: turns photos into views on several threads, and collects notes about them."""

    def __init__(self, max_size: int | None, response: "Response", alpha: str, to_rec709: np.ndarray | None):
        self.max_size, self.response, self.alpha, self.to_rec709 = max_size, response, alpha, to_rec709
        self._tables: dict[int, np.ndarray] = {}
        self._light_of_srgb: FloatTable | None = None  # Of photos whose colors are converted
        self._last: tuple[Lens, Undistortion] | None = None
        self.mask_shares: dict[str, float | None] = {}  # By view: the mean of its mask file
        self.labeled_masks: set[Path] = set()
        self.cropped: dict[Path, float] = {}  # Photos of which undistortion leaves too little: the part of their area
        self.transparent: set[str] = set()  # Views whose photos have transparent pixels
        self.largest_code = 0  # Of photos with 16 bits
        self.unusable_truth: list[InputError] = []
        self.gain_map_problems: dict[Path, str] = {}
        self._alone = threading.Lock()  # Guards what threads share; a response uses all cores by itself

    def view_or_error(self, record: ImageRecord, name: str) -> View | InputError:
        """Return the view of a photo, or the error if the photo or its mask cannot be used; raises other errors."""
        try:
            return self.view(record, name)
        except InputError as error:
            own = str(record.image), str(record.mask)
            if error.path not in own or record.derived:
                raise
            return error

    def view(self, record: ImageRecord, name: str) -> View:
        """Return the view of a photo; raise InputError if a file of it cannot be used."""
        lens, oriented = (record.lens, False) if record.derived else fitted_lens(record)
        resample = self._resampler(record, lens)
        camera = resample.camera
        hdr = self._truth(record, name, lens, resample)
        if hdr is not None and record.is_own_truth:
            hdr *= np.float32(record.light_scale)
        time, split = record.seconds, record.split or "train"
        stored = None if record.mask is None else _fitted_mask(record.mask, lens, oriented, self.labeled_masks)
        self.mask_shares[name] = None if stored is None else float(stored.mean())
        if record.derived and hdr is not None:  # Compute HDR-NeRF's photo from the truth at the final size.
            mask = _by_solid_angle(None if stored is None else resample(stored), camera)
            codes = codes_of(reinhard_gamma(hdr * time), 8)
            return View(name, codes, camera, time, split, mask, hdr, record.image)
        masked = self.alpha == "mask"
        photo, encoding, is_transparent = _read_stored(record, self.gain_map_problems, oriented=oriented, masked=masked)
        if photo.levels > 255 and file_kind(record.image) == "encoded" and record.gain_map_scale is None:
            self.largest_code = max(self.largest_code, int(photo.pixels.max()))
        if photo.white_from is not None and photo.levels == 255 and photo.above_white is None:
            photo = replace(photo, pixels=with_whole_white(photo.pixels, photo.white_from))
        masks = resample.borders() + ([] if stored is None else [resample(stored)])
        if is_transparent:
            self.transparent.add(name)
        if masked and photo.alpha is not None:
            masks.append(resample(photo.alpha))
        photo = self._at_view_size(
            photo, encoding, resample, resized=(camera.width, camera.height) != (lens.width, lens.height)
        )
        if self.to_rec709 is not None:
            with self._alone:
                photo = replace(photo, pixels=codes_in_rec709(photo.pixels, self.response, self.to_rec709))
        mask = np.clip(np.prod(masks, axis=0), 0, 1).astype(np.float32) if masks else None
        mask = _by_solid_angle(None if mask is None or mask.min() >= 1 - 1e-6 else mask, camera)
        return View(
            name,
            photo.pixels,
            camera,
            time,
            split,
            mask,
            hdr,
            record.image,
            light_above_white=photo.above_white,
            light_above_white_deviation=photo.above_white_deviation,
            lens=record.lens,
            orientation=1 if oriented else stored_orientation(record.image),
            uncertain=record.uncertain,
        )

    def _truth(self, record: ImageRecord, name: str, lens: Lens, resample: _Resampler) -> np.ndarray | None:
        """Return the truth of a photo at the size of its view; None without a file, or with one that cannot be used."""
        if record.hdr is None:
            return None
        try:
            truth = _read_truth(record.hdr, lens, resample.camera, resample.undistortion is not None)
        except InputError as error:
            if record.is_own_truth:
                raise
            self.unusable_truth.append(error)
            return None
        if record.derived and truth.coverage is not None:
            self.transparent.add(name)
        return resample(truth.pixels)

    def _resampler(self, record: ImageRecord, lens: Lens) -> _Resampler:
        """Return the resampler of a photo; photos of one lens in a row share its map, which is as large as an image."""
        if lens.is_pinhole or record.derived:
            return _Resampler(lens, None, lens.camera(record.world_to_camera).within(self.max_size))
        # Distortion is smooth: undistorting at twice the final size or more is exact to a fraction of a pixel.
        factor = 1 if self.max_size is None else max(lens.width, lens.height) // (2 * self.max_size)
        if factor > 1:
            lens = lens.resized(round(lens.width / factor), round(lens.height / factor))
        with self._alone:
            if self._last is None or self._last[0] != lens:
                self._last = lens, Undistortion(lens)
            undistortion = self._last[1]
        if undistortion.share < _LEAST_SHARE:
            self.cropped[record.image] = undistortion.share
        return _Resampler(lens, undistortion, undistortion.camera(record.world_to_camera).within(self.max_size))

    def _at_view_size(
        self, photo: EncodedImage, encoding: ColorEncoding, resample: _Resampler, *, resized: bool
    ) -> EncodedImage:
        """Return a photo in sRGB's colors at the size of its view; its transparency is that of masks, or blended in."""
        alpha = None if self.alpha == "mask" else photo.alpha
        averages = resample.undistortion is not None or resized or alpha is not None
        to_shared = getattr(self.response, "to_shared", None)  # Of a response whose channels differ
        if to_shared is not None or not averages:
            photo, encoding = encoding.convert(photo), ColorEncoding("sRGB")
        photo = photo if to_shared is None else replace(photo, pixels=to_shared(photo.pixels))
        return self._average(replace(photo, alpha=alpha), encoding, resample) if averages else photo

    def _average(self, photo: EncodedImage, encoding: ColorEncoding, resample: _Resampler) -> EncodedImage:
        """Return the codes of the mean light, and the light above white that is left in it.

        Colors that are not sRGB's are converted on the way, because codes of all pixels would take time and memory.
        """
        codes, alpha, above, levels = photo.pixels, photo.alpha, photo.above_white, photo.levels
        with self._alone:
            if levels not in self._tables:
                light = self.response.decode(np.arange(levels + 1, dtype=np.float64) / levels)
                self._tables[levels] = np.maximum(light, 0.0).astype(np.float32)
            if not encoding.is_srgb and self._light_of_srgb is None:
                self._light_of_srgb = FloatTable(self._decode_srgb)
        white = self._tables[levels][levels]

        def weighted(values: np.ndarray | None, rows: slice) -> np.ndarray | None:
            return values if alpha is None or values is None else values * alpha[rows, :, None]

        def light_by_encoding(rows: slice) -> np.ndarray:
            assert self._light_of_srgb is not None
            light, clipped = encoding.to_linear(codes[rows], None if above is None else above[rows])
            if clipped.any():
                light[clipped] = 1
            return self._light_of_srgb(light)

        def light_of(rows: slice) -> np.ndarray:
            if not encoding.is_srgb:
                return np.concatenate([light_by_encoding(band) for band in bands_of(rows, codes.shape[1])])
            light = self._tables[levels][codes[rows]]
            return light if above is None else np.where(above[rows] > 0, above[rows] * white, light)

        def clipped_in(rows: slice) -> np.ndarray | None:
            clipped = codes[rows] == levels
            clipped = clipped if above is None else clipped & (above[rows] == 0)
            return clipped.astype(np.float32) if clipped.any() else None

        light = resample(codes, lambda rows: weighted(light_of(rows), rows))
        clipped = resample(codes, lambda rows: weighted(clipped_in(rows), rows))
        with self._alone:
            encoded = self.response.encode(light)
        # A mean over clipped samples is a lower bound, so a pixel counts as clipped if half of its area is.
        averaged = codes_of(np.where(clipped >= 0.5, np.float32(1.0), encoded), 16)
        if above is None and encoding.is_srgb:
            return EncodedImage(averaged, None)
        overflow = (averaged == 65535) & (clipped < _LEAST_CLIPPED)
        brighter = np.where(overflow, np.maximum(light / white, 1), 0).astype(np.float16) if overflow.any() else None
        deviation = photo.above_white_deviation if encoding.is_srgb else max(DEVIATION, photo.above_white_deviation)
        return EncodedImage(averaged, None, brighter, 0.0 if brighter is None else deviation)

    def _decode_srgb(self, light: np.ndarray) -> np.ndarray:
        """Return what the response decodes codes of sRGB to, by their linear light, 1 at white."""
        decoded = np.maximum(self.response.decode(linear_to_srgb(np.minimum(light, 1))), 0)
        return np.where(light > 1, light * float(self.response.decode(np.ones(1))[0]), decoded)


def _by_solid_angle(mask: np.ndarray | None, camera: Camera) -> np.ndarray | None:
    """Return the mask of a view; pixels of a panorama or a wide fisheye photo count by their solid angle."""
    if camera.is_pinhole:
        return mask
    weights = solid_angles(camera)
    return weights if mask is None else weights * mask


def _shrink(
    image: np.ndarray, to: Lens | Camera, values: Callable[[slice], np.ndarray | None] | None = None
) -> np.ndarray:
    return area_average(image, to.width, to.height, values)


def _read_truth(path: Path, lens: Lens, camera: Camera, bent: bool) -> Light:
    size = hdr_size(path)
    # Truth may be larger than the photos, because HDR-NeRF's evaluation averages it down, but never smaller.
    larger = size[0] >= camera.width and size[1] >= camera.height and _same_aspect(size, (lens.width, lens.height))
    if size != (lens.width, lens.height) and (bent or not larger):
        problem = f"HDR truth is {size[0]} x {size[1]}, the photo {lens.width} x {lens.height}"
        raise InputError(path, problem, "render the truth at the photo's size, or remove it")
    return read_light(path)


def _fitted_mask(path: Path, lens: Lens, oriented: bool, labeled: set[Path]) -> np.ndarray:
    mask = read_mask(path, oriented=oriented, labeled=labeled)
    height, width = mask.shape
    if width >= lens.width and height >= lens.height and _same_aspect((width, height), (lens.width, lens.height)):
        return _shrink(mask, lens)
    if width < lens.width and height < lens.height and _same_aspect((lens.width, lens.height), (width, height)):
        resized = Image.fromarray(mask).resize((lens.width, lens.height), Image.Resampling.BILINEAR)
        return np.asarray(resized)
    problem = f"mask is {width} x {height}, its image {lens.width} x {lens.height}"
    raise InputError(path, problem, "make the mask at the image's size")


def _same_aspect(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Return whether the first size is the other one enlarged, within a pixel of it."""
    return abs(size[0] * other[1] - size[1] * other[0]) <= max(size)
