"""PLY of 3D Gaussian Splatting (Kerbl et al. 2023, the reference release), little-endian float32.

Attributes: x y z, nx ny nz (zero), f_dc_0..2, f_rest_0..3(K-1)-1 (all coefficients of red, then of green, then of
blue), opacity (logit), scale_0..2 (logarithm), rot_0..3 (w x y z). The color model and the base exposure time are
`comment sehdr:...` lines of the header; a file without them holds display colors. Two more habits are read: the
smoothing filter of Mip-Splatting (filter_3D), and the comment `SplatRenderMode: mip` of gsplat, nerfstudio and Brush.
So are 8-bit colors in place of f_dc (red, green, blue), as nerfstudio writes them on demand.

Viewers read no normals, and strict ones no property more. So nx holds the filter that sizes include (filter_shares) if
the header states the focal lengths of the photos.
"""

import io
import logging
import re
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..files import atomic_path, plain_size, read_bytes
from ..limits import available_memory
from ..subsets import first_names
from .arrays import HARMONIC_0, GaussianArrays, degree_of, read_facts
from .compressed_ply import header_comments, unpack_ply

log = logging.getLogger(__name__)
_FLAT = np.log(1e-6)  # Third log size of 2D Gaussian Splatting's files, which have two; as SuperSplat reads them
_DAMAGED = "copy or export the file again"
_COLOR_MODELS = ("display", "log", "linear")
_GROUPS = ("x y z", "scale_0 scale_1 scale_2", "rot_0 rot_1 rot_2 rot_3", "opacity", "f_dc_0 f_dc_1 f_dc_2")
_RGB = ("red", "green", "blue")
_FEWEST_JUDGED = 100  # Gaussians of a file whose values are judged together
_MOST_HEADER = 1 << 16
_MEMORY_PER_BYTE = 2.5
"""Bytes of memory for each byte of a file: its columns as arrays, once by property and once by Gaussian, and checks."""


def write_ply(path: Path, gaussians: GaussianArrays, overwrite: bool) -> None:
    """Write a .ply file; arguments as in write_gaussians."""
    from plyfile import PlyData, PlyElement

    rest = gaussians.harmonics[:, 1:].swapaxes(1, 2).reshape(gaussians.count, -1)
    filters = np.zeros(gaussians.count) if (shares := gaussians.filter_shares) is None else shares
    parts = {
        "x y z": gaussians.means,
        "nx ny nz": filters[:, None] * [1, 0, 0],
        "f_dc_0 f_dc_1 f_dc_2": gaussians.harmonics[:, 0],
        " ".join(f"f_rest_{i}" for i in range(rest.shape[1])): rest,
        "opacity": gaussians.opacity_logits[:, None],
        "scale_0 scale_1 scale_2": gaussians.log_scales,
        "rot_0 rot_1 rot_2 rot_3": gaussians.quaternions,
    }
    columns = [pair for names, values in parts.items() for pair in zip(names.split(), values.T, strict=True)]
    table = np.empty(gaussians.count, [(name, "<f4") for name, _ in columns])
    for name, values in columns:
        table[name] = values
    vertices = PlyElement.describe(table, "vertex")
    with atomic_path(path, overwrite) as temporary, temporary.open("wb") as file:
        PlyData([vertices], byte_order="<", comments=header_comments(gaussians)).write(file)


def read_ply(path: Path) -> GaussianArrays:
    """Read a file of the reference release, gsplat, nerfstudio or this package; a warning names other properties.

    Compressed PLY is recognized by its properties, whatever the file's name.
    """
    from plyfile import PlyParseError

    _check_header(path)
    try:
        read = _read(path)
        vertex = read["vertex"]
        names = {each.name for each in vertex.properties}
        if "packed_position" in names:
            facts = _facts(read.comments, path)
            facts["color_model"] = "display"
            return GaussianArrays(**unpack_ply(read, path), **facts)
        flat = "scale_2" not in names and {"scale_0", "scale_1", "rot_3"} <= names
        bytes_ = {each.name for each in vertex.properties if each.val_dtype == "u1"}
        rgb = not names & {"f_dc_0", "f_dc_1", "f_dc_2"} and bytes_.issuperset(_RGB)
        present = names | ({"scale_2"} if flat else set()) | (set(_GROUPS[-1].split()) if rgb else set())
        missing = [name for group in _GROUPS for name in group.split() if name not in present]
        if missing:
            is_cloud = "red" in names and len(missing) > 6
            problem = "is a point cloud, not Gaussians" if is_cloud else f"has no {', '.join(missing[:4])}"
            raise InputError(path, problem, "export 3D Gaussians as an uncompressed PLY")
        whole = [p.name for p in vertex.properties if p.name in " ".join(_GROUPS).split() and p.val_dtype[0] != "f"]
        if whole:
            raise InputError(path, f"its {whole[0]} is of whole numbers", "export 3D Gaussians as an uncompressed PLY")
        rest = sorted((n for n in names if re.fullmatch(r"f_rest_\d{1,4}", n)), key=lambda name: int(name[7:]))
        degree_of(1 + len(rest) / 3, path)
        filtered = ["filter_3D"] if "filter_3D" in names else []
        read_or_idle = {*" ".join(_GROUPS).split(), *rest, *filtered, *_RGB, "alpha", "nx", "ny", "nz"}
        if unread := [each.name for each in vertex.properties if each.name not in read_or_idle]:
            log.warning("%s: is read as 3D Gaussians, without its further properties %s", path, first_names(unread, 6))
        groups = (*(group.split() for group in _GROUPS), rest, filtered)
        stored = [[np.asarray(vertex[name], np.float32) for name in group if name in names] for group in groups]
        columns = [np.stack(group, axis=1) if group else np.zeros(0, np.float32) for group in stored]
        if flat:
            thin = np.full((len(columns[0]), 1), _FLAT, np.float32)
            columns[1] = np.concatenate([columns[1], thin], axis=1)
    except (PlyParseError, KeyError, ValueError, OverflowError, OSError, MemoryError) as error:
        raise InputError(path, f"cannot be read as PLY ({error!s:.120})", _DAMAGED) from None
    if rgb:
        colors = np.stack([np.asarray(vertex[name], np.float32) for name in _RGB], axis=1)
        columns[4] = ((colors / 255 - 0.5) / np.float32(HARMONIC_0)).astype(np.float32)
    means, log_scales, quaternions, opacity, constant, higher, smoothing = columns
    if flat:
        log.info("%s: its Gaussians have two sizes (2D Gaussian Splatting), and are read as flat ones", path)
    _warn_of_activated(path, log_scales, opacity)
    if smoothing.size:
        log_scales, opacity = _smooth(log_scales, opacity, smoothing)
        log.info("%s: its 3D smoothing filter (filter_3D) is fused into sizes and opacities", path)
    higher = higher.reshape(len(means), 3, len(rest) // 3).swapaxes(1, 2)
    harmonics = np.concatenate([constant[:, None], higher], axis=1)
    arrays = means, log_scales, quaternions, opacity[:, 0], harmonics
    gaussians = GaussianArrays(*arrays, **_facts(read.comments, path))
    if gaussians.antialiased and gaussians.photo_focals is not None and "nx" in names and vertex["nx"].any():
        return gaussians.without_filter(np.asarray(vertex["nx"], np.float32))
    return gaussians


def _read(path: Path):
    """Return plyfile's data of a file; header letters that are not ASCII are replaced, as plyfile refuses them."""
    from plyfile import PlyData

    head, end, _ = _start(path).partition(b"end_header")
    if head.isascii() or not end:
        return PlyData.read(str(path), mmap="r")
    data = bytearray(path.read_bytes())
    data[: len(head)] = bytes(byte if byte < 128 else ord("?") for byte in head)
    return PlyData.read(io.BytesIO(data))


def _warn_of_activated(path: Path, log_scales: np.ndarray, logits: np.ndarray) -> None:
    """Warn if a program stored sizes [N, 2 or 3] or opacities [N, 1] themselves, not logarithms and logits."""
    if len(logits) < _FEWEST_JUDGED:
        return
    if logits.min() >= 0 and logits.max() <= 1:
        text = "%s: all opacities lie between 0 and 1: if they are not logits, the scene is half transparent"
        log.warning(text, path)
    if log_scales[:, :2].min() > 0:
        log.warning("%s: all sizes are above 1 unit: if they are not logarithms, its Gaussians are far too large", path)


def _smooth(log_scales: np.ndarray, logits: np.ndarray, smoothing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fuse Mip-Splatting's 3D smoothing filter (Yu et al. 2024, section 5.1) into sizes [N, 3] and opacities [N, 1].

    `smoothing` is the standard deviation [N, 1] of the filter in scene units.
    """
    variances = np.exp(2 * log_scales.astype(np.float64))
    wide = variances + np.square(smoothing.astype(np.float64))
    ratio = np.sqrt(np.prod(variances / wide, axis=1, keepdims=True))
    with np.errstate(divide="ignore"):
        opacities = ratio / (1 + np.exp(-logits.astype(np.float64)))
        return (0.5 * np.log(wide)).astype(np.float32), np.log(opacities / (1 - opacities)).astype(np.float32)


def _check_header(path: Path) -> None:
    """Refuse a file that claims more than it can hold, before anything is read.

    plyfile would first reserve the memory of all that a text file claims.
    """
    size = len(read_start := _start(path))
    header = read_start.partition(b"end_header")[0]
    if not header.startswith(b"ply") or size == len(header):
        raise InputError(path, "is not a PLY file", _DAMAGED)
    if (needed := _MEMORY_PER_BYTE * path.stat().st_size) > (free := available_memory()):
        problem = f"takes about {needed / 1e9:.3g} GB of memory to read, and {free / 1e9:.3g} GB are free"
        raise InputError(path, problem, "use a smaller file, or a machine with more memory")
    claimed = [int(number) for number in re.findall(rb"^element\s+\S+\s+(\d{1,19})\s*$", header, re.MULTILINE)]
    smallest = len(re.findall(rb"^property\s", header, re.MULTILINE)) if len(claimed) == 1 else 1
    if sum(claimed) * smallest > path.stat().st_size:
        raise InputError(
            path, f"claims {sum(claimed)} elements, more than its {path.stat().st_size} bytes hold", _DAMAGED
        )


def _start(path: Path) -> bytes:
    try:
        if plain_size(path) < 1024:
            read_bytes(path)  # It refuses a pointer.
        with path.open("rb") as file:
            return file.read(_MOST_HEADER)
    except FileNotFoundError:
        raise InputError(path, "file not found", "check the name") from None
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror or error})", "check its permissions") from None


def _facts(comments: list[str], path: Path) -> dict[str, Any]:
    """Return the fields of GaussianArrays that comments of the header state; raise InputError if one cannot be."""
    facts = dict(line.removeprefix("sehdr:").split(maxsplit=1) for line in comments if re.match(r"sehdr:\w+ \S", line))
    color_model = facts.get("color_model", "display")
    if color_model not in _COLOR_MODELS:
        problem = f"its header states color model {color_model!r:.40}"
        raise InputError(path, problem, f"state one of {', '.join(_COLOR_MODELS)}")
    antialiased = any(re.fullmatch(r"SplatRenderMode:\s*mip", line.strip(), re.IGNORECASE) for line in comments)
    return read_facts(facts, path) | {"color_model": color_model, "antialiased": antialiased}
