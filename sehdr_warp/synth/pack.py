"""Truth made small enough to ship: half floats under a compression whose error is measured against the floats."""

import json
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..files import atomic_folder, write_json
from ..scene.hdr_files import read_hdr
from .truth_set import read_making

COMPRESSIONS = ("zip", "piz", "dwab")
"""OpenEXR's names; zip and piz keep every half as it is, dwab is lossy."""
_MU = 5000.0
# Below half's 65504 by more than a lossy file errs.
_LARGEST = 40000.0


def pack_truth(
    folder: Path | str,
    out: Path | str,
    *,
    compression: str = "dwab",
    level: float = 45.0,
    overwrite: bool = False,
) -> dict:
    """Write a set of truth as half floats into `out`, with all its tables; returns the error and the size.

    folder: from render_scene. level: of dwab: 45 is OpenEXR's default, lower keeps more.
    The radiance is first multiplied by a power of two (and the times divided by it) that brings the middle exposure
    time near 1/16 second, or less where the brightest pixel would pass 40000: dwab's steps are relative above a value
    of 1 and grow below it, so dark parts must not lie far below. The scale of rendered light means nothing.

    Returned, and added to synth.json as `packing`: relative_error, RMS of (stored - truth) / (truth + 1e-3 median
    truth); mu_law_psnr of stored against truth, both over the view's largest value (mu 5000, RMS over all views);
    bytes of the whole set.
    Raises InputError where the folder is no finished set of truth.
    """
    if compression not in COMPRESSIONS:
        raise ValueError(f"compression {compression!r} is not one of {COMPRESSIONS}")
    folder, out = Path(folder), Path(out)
    tables, times = _tables(folder)
    sources = {split: sorted((folder / f"{split}_hdr").glob("hdr_*.exr")) for split in tables}
    largest = max(float(read_hdr(source).max()) for found in sources.values() for source in found)
    scale = 2.0 ** min(round(np.log2(16 * times[len(times) // 2])), np.floor(np.log2(_LARGEST / max(largest, 1e-30))))
    squared = {"relative": [], "mu_law": []}
    with atomic_folder(out, overwrite) as made:
        for split in tables:
            for source in sources[split]:
                truth = read_hdr(source) * np.float32(scale)
                target = made / f"{split}_hdr" / source.name
                target.parent.mkdir(exist_ok=True)
                _write_half(target, truth, compression, level)
                for name, error in _errors(read_hdr(target), truth).items():
                    squared[name].append(float(np.mean(error**2)))
        for split, table in tables.items():
            (made / f"transforms_{split}.json").write_text(json.dumps(table["transforms"]) + "\n")
            scaled = {name: time / scale for name, time in table["times"].items()}
            write_json(made / f"exposure_{split}.json", scaled)
        (made / "points3d.ply").write_bytes((folder / "points3d.ply").read_bytes())
        size = sum(path.stat().st_size for path in made.rglob("*") if path.is_file())
        packing = {
            "compression": f"dwab {level:g}" if compression == "dwab" else compression,
            "relative_error": float(np.sqrt(np.mean(squared["relative"]))),
            "mu_law_psnr": -10 * float(np.log10(np.mean(squared["mu_law"]) + 1e-15)),
            "bytes": size,
        }
        write_json(made / "synth.json", read_making(folder) | {"packing": packing})
    return packing


def _tables(folder: Path) -> tuple[dict[str, dict], list[float]]:
    """What the set's JSON files say, by split, and the exposure times."""
    tables = {}
    for split in ("train", "test"):
        paths = folder / f"transforms_{split}.json", folder / f"exposure_{split}.json"
        if all(path.is_file() for path in paths):
            try:
                tables[split] = dict(
                    zip(("transforms", "times"), (json.loads(p.read_text()) for p in paths), strict=True)
                )
            except ValueError as error:
                raise InputError(folder, f"has damaged tables ({error})", "render the scene again") from None
    if "train" not in tables or not (folder / "points3d.ply").is_file():
        raise InputError(folder, "is no finished set of truth", "finish it with 'sehdr-warp synth render'")
    return tables, sorted(set(tables["train"]["times"].values()))


def _errors(stored: np.ndarray, truth: np.ndarray) -> dict[str, np.ndarray]:
    stored, truth = stored.astype(np.float64), truth.astype(np.float64)
    scale = max(truth.max(), 1e-30)
    relative = (stored - truth) / (truth + 1e-3 * np.median(truth) + 1e-30)
    return {
        "relative": relative,
        "mu_law": (np.log1p(_MU * stored / scale) - np.log1p(_MU * truth / scale)) / np.log1p(_MU),
    }


def _write_half(path: Path, pixels: np.ndarray, compression: str, level: float) -> None:
    import OpenEXR

    kinds = {"zip": OpenEXR.ZIP_COMPRESSION, "piz": OpenEXR.PIZ_COMPRESSION, "dwab": OpenEXR.DWAB_COMPRESSION}
    header = {"compression": kinds[compression], "type": OpenEXR.scanlineimage}
    if compression == "dwab":
        header["dwaCompressionLevel"] = float(level)
    with OpenEXR.File(header, {"RGB": np.ascontiguousarray(pixels, np.float16)}) as file:
        file.write(str(path))
