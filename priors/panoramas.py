"""Panoramas and rooms that the prior for clipped light is trained on: read from the listed sources, packed in one file.

The pack holds radiance as RGBE (a mantissa of 8 bits for each channel, a shared exponent), which numpy alone can read,
as differences, which compress better.
"""

import tomllib
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

SOURCES = Path(__file__).parent / "sources.toml"
WIDTH = 512  # Of a packed panorama; its height is half of it
ROOM_SIZE = 100  # Height and width of a packed view of a room


@dataclass(frozen=True)
class Source:
    """One listed panorama: its file below the data folder, and whether it is held out of the training."""

    name: str
    file: str
    held_out: bool


@dataclass(frozen=True, eq=False)
class Pack:
    """Everything the training reads.

    panoramas: [P, H, 2 H, 3] float32 radiance. held_out: [P] bool. names: of the panoramas.
    rooms: [R, L, S, S, 3] float32 radiance of each view in each of L groups of lights. curves: [C, K] encoded values
    at K even steps of the cube root of exposure, from 0 to 1; the first is sRGB.
    """

    panoramas: np.ndarray
    held_out: np.ndarray
    names: list[str]
    rooms: np.ndarray
    curves: np.ndarray


def listed_sources() -> list[Source]:
    """Return the panoramas of sources.toml."""
    listed = tomllib.loads(SOURCES.read_text())
    held_out = set(listed["held_out"])
    sources = []
    for group in listed["groups"]:
        for stem in group["panoramas"]:
            name = f"{group['name']}/{stem}"
            sources.append(Source(name, f"{group['folder']}/{stem}{group['suffix']}", name in held_out))
    return sources


def to_rgbe(radiance: np.ndarray) -> np.ndarray:
    """Return [..., 4] uint8 of radiance [..., 3]: mantissas, and the exponent plus 128."""
    largest = np.maximum(radiance.max(-1), 1e-30)
    exponent = np.ceil(np.log2(largest * (1 + 1e-6))).astype(int)
    mantissa = np.clip(np.round(radiance * np.exp2(8.0 - exponent)[..., None]), 0, 255)
    return np.concatenate([mantissa, np.clip(exponent + 128, 0, 255)[..., None]], -1).astype(np.uint8)


def from_rgbe(packed: np.ndarray) -> np.ndarray:
    """Return the radiance [..., 3], float32, of to_rgbe's bytes."""
    return packed[..., :3].astype(np.float32) * np.exp2(packed[..., 3:].astype(np.float32) - 136.0)


def to_differences(packed: np.ndarray) -> np.ndarray:
    """Return [..., 4, H, W] uint8 of RGBE [..., H, W, 4]: red and blue less green, each less its left neighbor."""
    planes = np.moveaxis(packed, -1, -3).copy()
    planes[..., 0, :, :] -= planes[..., 1, :, :]
    planes[..., 2, :, :] -= planes[..., 1, :, :]
    return np.diff(planes, axis=-1, prepend=np.uint8(0))


def from_differences(differences: np.ndarray) -> np.ndarray:
    """Return the RGBE [..., H, W, 4] of to_differences."""
    planes = np.cumsum(differences, -1, np.uint8)
    planes[..., 0, :, :] += planes[..., 1, :, :]
    planes[..., 2, :, :] += planes[..., 1, :, :]
    return np.moveaxis(planes, -3, -1)


def half_size(radiance: np.ndarray, width: int) -> np.ndarray:
    """Return an image [H, W, 3] averaged over whole blocks to the width; other sizes are resized first, by area."""
    height = radiance.shape[0] * width // radiance.shape[1]
    down, across = radiance.shape[0] // height, radiance.shape[1] // width
    if (down * height, across * width) != radiance.shape[:2]:
        from PIL import Image

        planes = [Image.fromarray(np.ascontiguousarray(radiance[..., c])) for c in range(3)]
        resized = [np.asarray(p.resize((width, height), Image.Resampling.BOX)) for p in planes]
        return np.stack(resized, -1)
    return radiance.reshape(height, down, width, across, 3).mean((1, 3))


def read_pack(path: Path) -> Pack:
    """Return the arrays of a packed file."""
    with np.load(path) as arrays:
        panoramas, rooms = (from_rgbe(from_differences(arrays[name])) for name in ("panoramas", "rooms"))
        return Pack(panoramas, arrays["held_out"], arrays["names"].tolist(), rooms, arrays["curves"])


def pack_of_folder(folder: Path, pack: Pack) -> Pack:
    """Return a pack of the panoramas of a folder, .hdr and .exr, as a packed file would hold them, with pack's rest."""
    from sehdr_warp.scene.images.hdr_files import read_hdr

    files = sorted(file for file in folder.iterdir() if file.suffix in (".hdr", ".exr"))
    panoramas = np.stack([from_rgbe(to_rgbe(half_size(read_hdr(file), WIDTH))) for file in files])
    return replace(pack, panoramas=panoramas, held_out=np.ones(len(files), bool), names=[file.stem for file in files])


def write_pack(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write arrays as a compressed .npz with LZMA, which numpy reads."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as file:
        for name, values in arrays.items():
            with file.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, values)
