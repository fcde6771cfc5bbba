"""Readers of scene-linear images: OpenEXR and Radiance files (shared-exponent RGBE; Ward, Graphics Gems II, II.5).

Colors are linear Rec.709 after reading, whatever primaries the file states. If it states none they are Rec.709's.
"""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...errors import InputError
from ...files import read_bytes
from ...quiet import silent_output
from ..color.primaries import REC709, encoding_of_interop_id, matrix_to_rec709
from .ldr_files import DAMAGED, check_size, kind_by_content, remedy_for_kind, require_file

# OpenEXR allocates all pixels before it reads one. Its ZIP of a single color holds 500 pixels in a byte.
_MOST_PIXELS_PER_BYTE = 4096
_REMEDY = "export the image again"
_MAX_HEADER_BYTES = 1 << 16
_COLOR_NAMES = "RGB", "rgb", "XYZ", "YYY", "VVV"  # Y alone is grey; with RY and BY it is luminance beside chroma
_PICTURE_LAYERS = "rgba", "rgb", "combined", "beauty", "image", "c", "color"  # Of Blender, Arnold, V-Ray, Nuke, ...
_XYZ = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3)
_RADIANCE = (0.640, 0.330, 0.290, 0.600, 0.150, 0.060, 0.333, 0.333)
"""Radiance's default primaries. Files that state them were mostly written by tools that mean Rec.709."""


class Light(NamedTuple):
    """A scene-linear picture."""

    pixels: np.ndarray  # [H, W, 3] float32 linear Rec.709 of read_hdr(): over black, if alpha covers a part
    coverage: np.ndarray | None  # [H, W] float32 in [0, 1], 0 where nothing was rendered; None if all is covered

    @property
    def uncovered(self) -> np.ndarray:
        """[H, W, 3] light of what covers a pixel, whatever part of it that is."""
        if self.coverage is None:
            return self.pixels
        return self.pixels / np.where(self.coverage > 0, self.coverage, np.float32(1))[:, :, None]


def hdr_size(path: Path) -> tuple[int, int]:
    """Return (width, height) from the header alone; raise InputError if it cannot be read or states too many pixels."""
    if path.suffix.lower() != ".hdr":
        return _exr_window(path)[1]
    require_file(path)
    _require_magic(path, b"#?R", "a Radiance picture")
    with path.open("rb") as file:
        size = _radiance_header(file.read(_MAX_HEADER_BYTES), path)[:2]
    check_size(path, *size)
    return size


def exr_exposure_time(path: Path) -> float | None:
    """Return the seconds that an OpenEXR file states as `expTime`, None if it states none."""
    time = _exr_header(path).get("expTime") if path.suffix.lower() == ".exr" else None
    return float(time) if isinstance(time, int | float) and np.isfinite(time) and time > 0 else None


def pixel_aspect(path: Path) -> float:
    """Return the width of a pixel over its height that an OpenEXR file states, 1 for other files."""
    return float(_exr_header(path)["pixelAspectRatio"]) if path.suffix.lower() == ".exr" else 1.0


def may_be_truth(path: Path) -> bool:
    """Return False for an OpenEXR file of passes such as depth alone, or that `render` wrote; True if unreadable."""
    if path.suffix.lower() != ".exr":
        return True
    try:
        with _exr_file(path, header_only=True) as file:
            endings = {ending for part in file.parts for ending in _channel_endings(part)}
            is_rendered = any("sehdr:view" in part.header for part in file.parts)
    except InputError:
        return True
    return not is_rendered and (not endings or _has_colors(endings))


def read_hdr(path: Path) -> np.ndarray:
    """Read scene-linear radiance in Rec.709.

    Negative values as stored are raised to zero; colors outside of Rec.709's gamut keep their negative parts.

    Returns:
        [H, W, 3] float32.

    Raises:
        InputError: if the file is missing, damaged or too large, states impossible colors, or a value is NaN or
            infinite (with its place).
    """
    return read_light(path).pixels


def read_light(path: Path) -> Light:
    """Read scene-linear radiance as read_hdr(), and its coverage; raises as read_hdr()."""
    coverage = None
    if path.suffix.lower() == ".hdr":
        hdr_size(path)
        pixels, primaries = _read_radiance(path)
    else:
        channels, header = read_exr_channels(path)
        channels = _picture_layer(channels, path)
        pixels, primaries = _exr_colors(channels, header, path)
        coverage = _coverage(channels, header)
    bad = ~np.isfinite(pixels)
    if bad.any():
        row, column, channel = (int(i) for i in np.argwhere(bad)[0])
        place = f"one {'RGB'[channel]} = {pixels[row, column, channel]} at x={column}, y={row}"
        raise InputError(path, f"{int(bad.any(axis=2).sum())} pixels not finite, {place}", _REMEDY)
    pixels = np.maximum(pixels, 0.0)
    try:
        matrix = matrix_to_rec709(primaries)
    except ValueError as error:
        raise InputError(path, str(error), "correct the attribute, or remove it for Rec.709") from None
    pixels = pixels if np.array_equal(matrix, np.eye(3)) else (pixels @ matrix.T).astype(np.float32)
    return Light(pixels, coverage)


def _coverage(channels: Mapping[str, np.ndarray], header: Mapping[str, Any]) -> np.ndarray | None:
    """Return [H, W] float32 in [0, 1]: alpha, 0 outside of the data window; None if all is covered, or nothing."""
    shape = next(iter(channels.values())).shape
    alpha = np.clip(np.nan_to_num(channels["A"]), 0, 1) if "A" in channels else np.ones(shape, np.float32)
    origin = header["displayWindow"][0]
    low, high = (corner - origin for corner in header["dataWindow"])
    inside = np.zeros(shape, bool)
    inside[max(low[1], 0) : max(high[1] + 1, 0), max(low[0], 0) : max(high[0] + 1, 0)] = True
    alpha = np.where(inside, alpha, 0).astype(np.float32)
    # Some programs write an alpha of 0 everywhere.
    return None if alpha.min() >= 1 or alpha.max() <= 0 else alpha


def _exr_colors(
    channels: Mapping[str, np.ndarray], header: Mapping[str, Any], path: Path
) -> tuple[np.ndarray, tuple[float, ...]]:
    """Return [H, W, 3] linear values, and the primaries that they are in."""
    chromaticities = header.get("chromaticities")
    primaries = REC709 if chromaticities is None else tuple(map(float, chromaticities))
    encoding = encoding_of_interop_id(str(header.get("colorInteropID", "")))
    if encoding.chromaticities is not None:
        primaries = encoding.chromaticities
    if set(channels) >= {"Y", "RY", "BY"}:
        return _from_luminance(channels, primaries, path), primaries
    names = next((names for names in _COLOR_NAMES if set(names) <= set(channels)), None)
    if names is None:
        problem = f"has the channels {sorted(channels)[:8]}, not R, G, B"
        raise InputError(path, problem, "export it with color channels")
    pixels = np.stack([channels[name] for name in names], axis=2)
    if names == "XYZ":
        return pixels, _XYZ
    return encoding.decode(pixels), primaries


def _picture_layer(channels: Mapping[str, np.ndarray], path: Path) -> Mapping[str, np.ndarray]:
    """Return the channels of the layer that is the picture (`ViewLayer.Combined.R` of Blender), named as if alone.

    Raises:
        InputError: if several layers have colors and their names do not say which is the picture.
    """
    if _has_colors(set(channels)):
        return channels
    layers: dict[str, dict[str, np.ndarray]] = {}
    for name, values in channels.items():
        layer, _, channel = name.rpartition(".")
        layers.setdefault(layer, {})[channel] = values
    with_color = [layer for layer, parts in layers.items() if set("RGB") <= set(parts)]
    pictures = [layer for layer in with_color if layer.rpartition(".")[2].lower() in _PICTURE_LAYERS]
    if len(pictures or with_color) > 1:
        problem = f"has the layers {sorted(with_color)[:5]}, and none of them is named as the picture"
        raise InputError(path, problem, "export the picture's R, G, B alone, or name its layer `rgba`")
    return layers[(pictures or with_color)[0]] if with_color else channels


def _from_luminance(channels: Mapping[str, np.ndarray], primaries: tuple[float, ...], path: Path) -> np.ndarray:
    """Return RGB of OpenEXR's luminance and chroma channels: RY = (R - Y) / Y, BY = (B - Y) / Y."""
    import colour

    places = np.array(primaries, float)
    try:
        matrix_to_rec709(primaries)
        weights = colour.normalised_primary_matrix(places[:6].reshape(3, 2), places[6:])[1]
    except ValueError as error:
        raise InputError(path, str(error), "correct the attribute, or remove it for Rec.709") from None
    luminance = channels["Y"]
    red, blue = ((channels[name] + 1) * luminance for name in ("RY", "BY"))
    green = (luminance - weights[0] * red - weights[2] * blue) / weights[1]
    return np.stack([red, green, blue], axis=2).astype(np.float32)


def read_exr_channels(path: Path) -> tuple[dict[str, np.ndarray], dict]:
    """Read the channels of an OpenEXR file over the display window, and its header: of the part that is the picture.

    Pixels of the display window outside the data window are 0. Subsampled channels are interpolated. Values are as
    stored: NaN and infinity pass.

    Returns:
        Channels [H, W] float32 by name, and the header's attributes.

    Raises:
        InputError: if the file is missing, damaged, truncated or holds more than MAX_PIXELS pixels.
    """
    origin, (width, height) = _exr_window(path)
    with _exr_file(path, separate_channels=True) as file:
        # A file whose pixels end early has no parts instead of raising.
        if not file.parts:
            raise InputError(path, "pixel data is damaged or ends early", DAMAGED)
        part = _colored_part(file)
        header = dict(file.header(part))
        arrays = {
            name: (channel.pixels, channel.xSampling, channel.ySampling)
            for name, channel in file.channels(part).items()
        }
    (low, high) = header["dataWindow"]
    left, top = (int(a) - b for a, b in zip(low, origin, strict=True))
    size = tuple(int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
    channels = {}
    for name, (pixels, *sampling) in arrays.items():
        if pixels is not None and pixels.ndim == 2:
            if sampling != [1, 1]:
                pixels = _interpolate(pixels, size[::-1], sampling[::-1])
            inside = pixels[max(-top, 0) : max(height - top, 0), max(-left, 0) : max(width - left, 0)]
            channels[name] = np.zeros((height, width), np.float32)
            channels[name][max(top, 0) :, max(left, 0) :][: inside.shape[0], : inside.shape[1]] = inside
    return channels, header


def _has_colors(channels: set[str]) -> bool:
    return any(set(names) <= channels for names in _COLOR_NAMES)


def _channel_endings(part: Any) -> set[str]:
    """Return the names of a part's channels without their layers; also if its header alone was read."""
    names = (str(channel.name) for channel in part.header.get("channels", ()))
    return {name.rpartition(".")[2] for name in (*part.channels, *names)}


def _colored_part(file: Any) -> int:
    """Return the number of an opened OpenEXR file's part that is the picture, 0 if none holds colors.

    Passes may lie in parts of their own, also before the picture: of parts with colors the first one counts that is
    named as the picture, else the first.
    """
    endings = [_channel_endings(part) for part in file.parts]
    colored = [number for number, own in enumerate(endings) if _has_colors(own)]
    names = {number: str(file.parts[number].header.get("name", "")) for number in colored}
    pictures = [number for number in colored if names[number].rpartition(".")[2].lower() in _PICTURE_LAYERS]
    return next(iter(pictures or colored), 0)


def _interpolate(pixels: np.ndarray, shape: tuple[int, ...], sampling: list[int]) -> np.ndarray:
    """Interpolate a subsampled channel, whose samples lie at every `sampling` rows and columns, bilinearly."""
    from scipy.ndimage import map_coordinates

    rows, columns = (np.arange(count) / step for count, step in zip(shape, sampling, strict=True))
    places = np.meshgrid(rows, columns, indexing="ij")
    return map_coordinates(pixels.astype(np.float32), places, order=1, mode="nearest", output=np.float32)


@contextmanager
def _exr_file(path: Path, **options) -> Iterator:
    import OpenEXR

    require_file(path)
    _require_magic(path, b"v/1\x01", "OpenEXR")
    try:
        with silent_output(), OpenEXR.File(str(path), **options) as file:
            yield file
    except (RuntimeError, ValueError, KeyError, TypeError, MemoryError) as error:
        raise InputError(path, f"cannot be read as OpenEXR ({error})", DAMAGED) from None


def _exr_header(path: Path) -> dict[str, Any]:
    """Return the attributes of an OpenEXR file's part that is the picture."""
    with _exr_file(path, header_only=True) as file:
        return dict(file.header(_colored_part(file)))


def _require_magic(path: Path, magic: bytes, kind: str) -> None:
    """Raise InputError with what a file is if it does not begin as its name says; unknown content is left to others."""
    with path.open("rb") as file:
        if file.read(len(magic)) == magic:
            return
    if content := kind_by_content(path):
        raise InputError(path, f"is {content}, not {kind}", remedy_for_kind(content))


def _exr_window(path: Path) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the display window's origin and its (width, height)."""
    header = _exr_header(path)
    windows = [[(int(x), int(y)) for x, y in header[key]] for key in ("displayWindow", "dataWindow")]
    sizes = [(high[0] - low[0] + 1, high[1] - low[1] + 1) for low, high in windows]
    file_size = path.stat().st_size
    for size in sizes:
        check_size(path, *size)
        if size[0] * size[1] > _MOST_PIXELS_PER_BYTE * file_size:
            raise InputError(path, f"states {size[0]} x {size[1]} pixels, but has only {file_size} bytes", DAMAGED)
    return windows[0][0], sizes[0]


def _read_radiance(path: Path) -> tuple[np.ndarray, tuple[float, ...]]:
    """Return [H, W, 3] float32 radiance (pixels divided by the header's EXPOSURE and COLORCORR), and its primaries."""
    data = read_bytes(path)
    width, height, position, exposure, primaries = _radiance_header(data[:_MAX_HEADER_BYTES], path)
    rgbe = np.empty((height, width, 4), np.uint8)
    for row in range(height):
        try:
            rgbe[row], position = _read_row(data, position, width)
        except (IndexError, ValueError):
            raise InputError(path, f"pixel data is damaged or ends early in row {row}", _REMEDY) from None
    scale = np.ldexp(1.0, rgbe[..., 3].astype(np.int32) - 136)
    pixels = (rgbe[..., :3] + 0.5) * scale[..., None] / exposure
    pixels[rgbe[..., 3] == 0] = 0.0
    return pixels.astype(np.float32), primaries


def _radiance_header(data: bytes, path: Path) -> tuple[int, int, int, np.ndarray, tuple[float, ...]]:
    """Return width, height, offset of the pixels, the product of the exposures [3], and the primaries."""
    if not data.startswith((b"#?RADIANCE", b"#?RGBE")):
        raise InputError(path, "is not a Radiance picture", _REMEDY)
    end = data.find(b"\n\n")
    size = re.compile(rb"-Y (\d{1,6}) \+X (\d{1,6})\n").match(data, end + 2) if end >= 0 else None
    if size is None:
        raise InputError(path, "Radiance header has no '-Y height +X width' line", _REMEDY)
    try:
        exposures = re.findall(rb"^EXPOSURE\s*=\s*([^\s]{1,40})", data[:end], re.MULTILINE)
        corrections = re.findall(rb"^COLORCORR\s*=\s*([^\n]{1,120})", data[:end], re.MULTILINE)
        factors = [np.full(3, float(value)) for value in exposures]
        factors += [np.array(value.split(), np.float64).reshape(3) for value in corrections]
        exposure = np.prod([np.ones(3), *factors], axis=0)
    except ValueError:
        exposure = np.full(3, np.nan)
    if not (np.isfinite(exposure).all() and (exposure > 0).all()):
        raise InputError(path, "EXPOSURE or COLORCORR are not positive numbers", _REMEDY)
    primaries = _XYZ if b"32-bit_rle_xyze" in data[:end] else REC709
    line = re.search(rb"^PRIMARIES\s*=\s*([^\n]{1,200})", data[:end], re.MULTILINE)
    if line and primaries is REC709:
        try:
            primaries = tuple(float(value) for value in line[1].split())
        except ValueError:
            primaries = ()
        if len(primaries) != 8:
            raise InputError(path, f"PRIMARIES = {line[1][:60]!r} are not eight numbers", _REMEDY)
        # Photoshop writes eight zeros for none.
        has_other_primaries = any(primaries) and not np.allclose(primaries, _RADIANCE, atol=0.002)
        primaries = primaries if has_other_primaries else REC709
    return int(size[2]), int(size[1]), size.end(), exposure, primaries


def _read_row(data: bytes, position: int, width: int) -> tuple[np.ndarray, int]:
    """Return a row [W, 4], flat or run-length coded, and the offset of the next.

    Raises:
        IndexError: if the data end early.
        ValueError: if they are damaged.
    """
    first = data[position : position + 4]
    if first[:2] != b"\2\2" or first[2] & 0x80 or not 8 <= width < 32768:
        end = position + 4 * width
        return np.frombuffer(data[position:end], np.uint8).reshape(width, 4), end
    if int.from_bytes(first[2:], "big") != width:
        raise ValueError
    position, planes = position + 4, bytearray()
    while len(planes) < 4 * width:
        count = data[position]
        if count > 128:
            planes += data[position + 1 : position + 2] * (count - 128)
            position += 2
        else:
            planes += data[position + 1 : position + 1 + count]
            position += 1 + count
    return np.frombuffer(planes, np.uint8).reshape(4, width).T, position
