"""Streamed SOG (PlayCanvas), version 1: a folder of SOG chunks with a tree of their bounds in lod-meta.json.

Viewers load the chunks that a camera sees. The specification is public
(developer.playcanvas.com/user-manual/gaussian-splatting/formats/streamed-sog); each chunk is SOG whose files are not
zipped. One level of detail is written, and the finest is read.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__
from ..errors import InputError
from ..files import atomic_folder, read_bytes, read_json, resolve_inside
from .arrays import GaussianArrays, join_gaussians
from .sog import gaussians_of_files, refusing_damage, sog_files

NAME = "lod-meta.json"
CHUNK = 1 << 18  # Largest number of Gaussians of a chunk
DEVIATIONS = 3.0  # Size of a Gaussian in bounds, standard deviations
_MOST_NODES = 1 << 20
_DAMAGED = "export it again"


def write_streamed_sog(path: Path, gaussians: GaussianArrays, overwrite: bool) -> None:
    """Write lod-meta.json and its chunks, which take the folder of the file for themselves.

    Arguments as in write_gaussians.
    """
    chunks: list[np.ndarray] = []
    half = DEVIATIONS * gaussians.axis_deviations
    tree = _node(gaussians.means.astype(np.float64), half, np.arange(gaussians.count), chunks)
    names = [f"0_{number}" for number in range(len(chunks))]
    meta = {
        "version": 1,
        "asset": {"generator": f"sehdr-warp {__version__}"},
        "count": gaussians.count,
        "counts": [gaussians.count],
        "lodLevels": 1,
        "filenames": [f"{name}/meta.json" for name in names],
        "tree": tree,
    }
    with atomic_folder(path.parent, overwrite) as folder:
        for name, rows in zip(names, chunks, strict=True):
            (folder / name).mkdir()
            for file, content in sog_files(gaussians.rows(rows)):
                (folder / name / file).write_bytes(content.encode() if isinstance(content, str) else content)
        (folder / path.name).write_text(json.dumps(meta), encoding="utf-8")


def read_streamed_sog(path: Path) -> GaussianArrays:
    """Read the Gaussians of the finest level of a streamed SOG."""
    meta = read_json(path)
    if meta.get("version", 1) != 1:
        raise InputError(path, f"is streamed SOG of version {meta['version']!r:.20}", "version 1 is read")
    with refusing_damage(path):
        parts: dict[int, list[tuple[int, int]]] = {}
        nodes = [meta["tree"]]
        for node in nodes:
            nodes += node.get("children", [])  # The loop goes on with them.
            if len(nodes) > _MOST_NODES:
                raise ValueError(f"more than {_MOST_NODES} nodes")
            if "lods" in node and "0" in node["lods"]:
                part = node["lods"]["0"]
                parts.setdefault(int(part["file"]), []).append((int(part["offset"]), int(part["count"])))
        chunks: dict[Path, GaussianArrays] = {}
        for index, ranges in sorted(parts.items()):
            if index < 0:
                raise ValueError(f"file {index}")
            chunk = resolve_inside(path.parent, meta["filenames"][index], path)
            if chunk in chunks:
                raise ValueError("a chunk is listed twice")
            folder = chunk.parent

            def read(name: str, limit: int, folder: Path = folder) -> bytes:
                return read_bytes(resolve_inside(folder, name, path), limit)

            gaussians = gaussians_of_files(read, chunk)
            chunks[chunk] = gaussians.rows(_rows(ranges, gaussians.count))
        if not chunks:
            raise ValueError("no node has Gaussians of level 0")
    return join_gaussians([*chunks.values()])


def _rows(ranges: list[tuple[int, int]], count: int) -> np.ndarray:
    """Return the rows of (first, number) of a chunk.

    Raises ValueError for rows that a chunk of `count` does not have: a small file must not take much memory.
    """
    if any(first < 0 or number < 0 or first + number > count for first, number in ranges):
        raise ValueError(f"Gaussians outside of a chunk of {count}")
    if sum(number for _, number in ranges) > count:
        raise ValueError(f"more Gaussians than a chunk of {count} has")
    return np.concatenate([np.arange(first, first + number) for first, number in ranges])


def _node(means: np.ndarray, half: np.ndarray, rows: np.ndarray, chunks: list[np.ndarray]) -> dict[str, Any]:
    """Return the node of some rows, split along its longest side until chunks are small enough."""
    low, high = (means[rows] - half[rows]).min(axis=0), (means[rows] + half[rows]).max(axis=0)
    node: dict[str, Any] = {"bound": {"min": low.tolist(), "max": high.tolist()}}
    if len(rows) <= CHUNK:
        node["lods"] = {"0": {"file": len(chunks), "offset": 0, "count": len(rows)}}
        chunks.append(rows)
        return node
    axis = int(np.argmax(np.ptp(means[rows], axis=0)))
    order = np.argpartition(means[rows, axis], len(rows) // 2)
    halves = rows[order[: len(rows) // 2]], rows[order[len(rows) // 2 :]]
    node["children"] = [_node(means, half, part, chunks) for part in halves]
    return node
