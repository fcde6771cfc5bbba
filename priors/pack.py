"""Pack the listed panoramas, rooms and camera curves into one file: `python -m priors.pack DATA PACK`."""

from pathlib import Path

import numpy as np

from benchmarks.study import run
from sehdr_warp.scene.images.hdr_files import read_hdr

from .panoramas import ROOM_SIZE, WIDTH, half_size, listed_sources, to_differences, to_rgbe, write_pack

LIGHTS = ("window", "spot", "lamps")
STEPS = 256  # Of a curve, even in the cube root of exposure
WHITE_OF_REINHARD = 231.0  # The exposure that HDR-NeRF's curve shows as the last code


def main(data: Path, pack: Path, /) -> None:
    """Pack the listed panoramas, rooms and camera curves into one file.

    Args:
        data: folder with the panoramas of sources.toml, room*/groups and crf/.
        pack: the .npz to write.
    """
    sources = listed_sources()
    panoramas = [to_rgbe(half_size(read_hdr(data / source.file), WIDTH)) for source in sources]
    write_pack(
        pack,
        {
            "panoramas": to_differences(np.stack(panoramas)),
            "held_out": np.array([source.held_out for source in sources]),
            "names": np.array([source.name for source in sources]),
            "rooms": to_differences(to_rgbe(np.stack(list(room_views(data))))),
            "curves": curves(data / "crf" / "201_CRF_data.mat"),
        },
    )
    print(f"{pack}: {len(sources)} panoramas, {pack.stat().st_size / 1e6:.1f} MB")


def room_views(data: Path):
    """Yield [L, S, S, 3] for each view of the rendered rooms, whose lights are in files of their own."""
    for folder in sorted(data.glob("room*/groups")):
        for first in sorted(folder.glob(f"*_{LIGHTS[0]}.exr")):
            stem = first.name.removesuffix(f"{LIGHTS[0]}.exr")
            yield np.stack([half_size(read_hdr(folder / f"{stem}{light}.exr"), ROOM_SIZE) for light in LIGHTS])


def curves(measured: Path) -> np.ndarray:
    """Return [C, STEPS + 1] increasing curves from 0 to 1: sRGB, DoRF's, and formulas, a quarter of all."""
    exposure = np.linspace(0, 1, STEPS + 1) ** 3
    cameras = []
    if measured.is_file():
        import scipy.io

        table = scipy.io.loadmat(measured)
        for light, encoded in zip(table["I"], table["B"], strict=True):
            cameras.append(np.interp(exposure, light, encoded))
    srgb = np.where(exposure <= 0.0031308, 12.92 * exposure, 1.055 * np.maximum(exposure, 1e-9) ** (1 / 2.4) - 0.055)
    formulas = [srgb, exposure ** (1 / 2.2), exposure ** (1 / 1.8)]
    for white in (WHITE_OF_REINHARD, 60.0, 15.0, 4.0):
        x = exposure * white
        curve = (x / (1 + x)) ** (1 / 2.2)
        formulas.append(curve / curve[-1])
    cameras += formulas * max(1, len(cameras) // (3 * len(formulas)))
    steps = np.maximum.accumulate(np.array([srgb, *cameras]), 1) + 1e-7 * np.arange(STEPS + 1)
    return ((steps - steps[:, :1]) / (steps[:, -1:] - steps[:, :1])).astype(np.float32)


if __name__ == "__main__":
    run(main)
