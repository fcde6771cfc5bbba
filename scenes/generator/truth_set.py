"""Sets of truth alone: their tables, and their packing as half floats.

A set of truth alone, in HDR-NeRF's synthetic layout, has `"photo_response": "reinhard-gamma"` in
`transforms_<split>.json`: load_scene makes its photos by that curve at the times of `exposure_<split>.json`.
"""

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sehdr_warp.errors import InputError
from sehdr_warp.files import atomic_folder, read_json, write_json
from sehdr_warp.scene.dataparser import DERIVED_PHOTOS, reinhard_gamma
from sehdr_warp.scene.images.hdr_files import read_hdr
from sehdr_warp.synth.expose import RadianceView, ladder_of, write_radiance, write_tables

# Below half's 65504 by more than a lossy file errs.
_LARGEST = 40000.0


def write_truth_tables(folder: Path, views: Sequence[RadianceView], making: dict) -> tuple[float, ...]:
    """Write all of a set but its EXR files, replacing what is there; returns the five exposure times.

    views: in the order of their files. making: what `synth.json` says of the set.
    """
    radiances = [view.radiance for view in views if view.split == "train"] or [view.radiance for view in views]
    times = ladder_of(folder.name, radiances, reinhard_gamma)
    size = {"w": views[0].camera.width, "h": views[0].camera.height}
    write_tables(folder, views, times, None, **size, photo_response=DERIVED_PHOTOS)
    write_json(folder / "synth.json", making, overwrite=True)
    return times


def pack_truth(folder: Path, out: Path, *, compression="dwab", level: float = 45.0, overwrite: bool = False) -> dict:
    """Write a set of truth as half floats into `out`, with all its tables; returns the error and the size.

    compression: "zip" and "piz" keep every half as it is, "dwab" is lossy by `level`: 45 is OpenEXR's default, lower
    keeps more. The radiance is first multiplied by a power of two (and the times divided by it) that brings the middle
    exposure time near 1/16 second, or less where the brightest pixel would pass 40000: dwab's steps are relative above
    a value of 1 and grow below it, so dark parts must not lie far below.

    Returned, and added to synth.json as `packing`: relative_error, RMS of (stored - truth) / (truth + 1e-3 median
    truth); mu_law_psnr of stored against truth, both over the view's largest value (mu 5000, RMS over all views);
    bytes of the whole set.
    Raises InputError where the folder is no finished set of truth.
    """
    import OpenEXR

    names = {split: [f"{kind}_{split}.json" for kind in ("transforms", "exposure")] for split in ("train", "test")}
    splits = [split for split in names if all((folder / name).is_file() for name in names[split])]
    if "train" not in splits:
        raise InputError(folder, "is no finished set of truth", "finish it with 'python -m scenes.generator render'")
    tables = {split: read_json(folder / f"exposure_{split}.json") for split in splits}
    times = sorted(set(tables["train"].values()))
    sources = [path for split in splits for path in sorted((folder / f"{split}_hdr").glob("hdr_*.exr"))]
    largest = max(float(read_hdr(source).max()) for source in sources)
    scale = 2.0 ** min(round(np.log2(16 * times[len(times) // 2])), np.floor(np.log2(_LARGEST / max(largest, 1e-30))))
    header, squares = {"compression": getattr(OpenEXR, f"{compression.upper()}_COMPRESSION")}, []
    if compression == "dwab":
        header["dwaCompressionLevel"] = float(level)
    with atomic_folder(out, overwrite) as temporary:
        for source in sources:
            truth, target = read_hdr(source) * np.float32(scale), temporary / source.relative_to(folder)
            write_radiance(target, truth, header=header)
            squares.append(_squared_errors(read_hdr(target).astype(np.float64), truth.astype(np.float64)))
        for split, table in tables.items():
            write_json(temporary / f"exposure_{split}.json", {name: time / scale for name, time in table.items()})
        for split in splits:
            shutil.copyfile(folder / f"transforms_{split}.json", temporary / f"transforms_{split}.json")
        relative, mu_law = np.mean(squares, 0)
        packing = {
            "compression": f"dwab {level:g}" if compression == "dwab" else compression,
            "relative_error": float(np.sqrt(relative)),
            "mu_law_psnr": -10 * float(np.log10(mu_law + 1e-15)),
            "bytes": sum(path.stat().st_size for path in temporary.rglob("*") if path.is_file()),
        }
        making = folder / "synth.json"
        write_json(temporary / "synth.json", (read_json(making) if making.is_file() else {}) | {"packing": packing})
    return packing


def _squared_errors(stored: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Means of the squared relative and mu-law errors."""
    relative = (stored - truth) / (truth + 1e-3 * np.median(truth) + 1e-30)
    stored, truth = (np.log1p(5000 * image / max(truth.max(), 1e-30)) / np.log1p(5000) for image in (stored, truth))
    return float(np.mean(relative**2)), float(np.mean((stored - truth) ** 2))
