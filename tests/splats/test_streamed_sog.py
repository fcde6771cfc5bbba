"""Streamed SOG: chunks that are near in space, a tree whose bounds hold, and what other programs write."""

import json
import subprocess

import numpy as np
import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.splats import read_gaussians, streamed_sog, write_gaussians
from tests.make_scenes import edited_json

from .samples import assert_alike, natural, package


@pytest.fixture
def small_chunks(monkeypatch):
    monkeypatch.setattr(streamed_sog, "CHUNK", 150)


def leaves(node):
    for child in node.get("children", []):
        yield from leaves(child)
    if "lods" in node:
        yield node


def test_chunks_are_read_as_one(tmp_path, small_chunks):
    original, path = natural(), tmp_path / "town" / "lod-meta.json"
    write_gaussians(path, original)
    meta = json.loads(path.read_text())
    assert (meta["version"], meta["lodLevels"], meta["count"], meta["counts"]) == (1, 1, 600, [600])
    nodes = list(leaves(meta["tree"]))
    assert len(nodes) == len(meta["filenames"]) == 4
    for node in nodes:
        part = node["lods"]["0"]
        chunk = json.loads((path.parent / meta["filenames"][part["file"]]).read_text())
        assert chunk["version"] == 2 and chunk["count"] == part["count"] == 150 and part["offset"] == 0
    read = read_gaussians(path)
    assert (read.degree, read.base_time) == (3, 0.25)
    assert_alike(original, read, harmonics=0.06)
    with pytest.raises(InputError, match="exists already"):
        write_gaussians(path, original)
    write_gaussians(path, original, overwrite=True)


def test_levels_of_other_programs(tmp_path, small_chunks):
    """The finest level is read, also where nodes share a chunk; a damaged index is refused."""
    original, path = natural(), tmp_path / "town" / "lod-meta.json"
    write_gaussians(path, original)
    with edited_json(path) as meta:
        node = next(leaves(meta["tree"]))
        first = {"file": node["lods"]["0"]["file"], "offset": 0, "count": 40}
        second = first | {"offset": 40, "count": 60}
        node["children"] = [{"bound": node["bound"], "lods": {"0": each, "1": first}} for each in (first, second)]
        del node["lods"]
    assert read_gaussians(path).count == 550
    for change in ({"filenames": ["../../x/meta.json"] * 4}, {"tree": {}}, {"version": 7}, {"tree": {"lods": 3}}):
        path.write_text(json.dumps(meta | change))
        with pytest.raises(InputError):
            read_gaussians(path)


@pytest.mark.parametrize(
    "part, named",
    [
        ({"count": 10**12}, "outside of a chunk"), ({"offset": 149}, "outside of a chunk"),
        ({"offset": -9, "count": 9}, "outside of a chunk"), ({"file": -1}, "file -1"),
        ({"count": 90}, "more Gaussians than a chunk of 150 has"),
    ],
)  # fmt: skip
def test_a_small_index_takes_no_memory_that_its_chunks_do_not_state(tmp_path, small_chunks, part, named):
    path = tmp_path / "town" / "lod-meta.json"
    write_gaussians(path, natural())
    with edited_json(path) as meta:
        meta["tree"] = {"children": [{"lods": {"0": {"file": 0, "offset": 0, "count": 40} | part}}] * 2}
    with pytest.raises(InputError, match=named):
        read_gaussians(path)


def test_a_chunk_is_read_once(tmp_path, small_chunks):
    path = tmp_path / "town" / "lod-meta.json"
    write_gaussians(path, natural())
    meta = json.loads(path.read_text())
    path.write_text(json.dumps(meta | {"filenames": meta["filenames"][:1] * 4}))
    with pytest.raises(InputError, match="a chunk is listed twice"):
        read_gaussians(path)


def test_splat_transform_reads_them(tmp_path, small_chunks):
    tool = package("@playcanvas/splat-transform") / "bin" / "cli.mjs"
    original, path = natural(), tmp_path / "town" / "lod-meta.json"
    write_gaussians(path, original)
    chunk = path.parent / "0_0" / "meta.json"
    subprocess.run(["node", tool, chunk, tmp_path / "b.ply"], check=True, capture_output=True)
    assert read_gaussians(tmp_path / "b.ply").count == 150


def test_bounds_hold_the_gaussians_of_their_chunks(tmp_path, small_chunks):
    original, path = natural(), tmp_path / "town" / "lod-meta.json"
    write_gaussians(path, original)
    meta, volume = json.loads(path.read_text()), 0.0
    for node in leaves(meta["tree"]):
        low, high = (np.array(node["bound"][name]) for name in ("min", "max"))
        inside = ((original.means >= low) & (original.means <= high)).all(1)
        assert inside.sum() >= 150
        volume += np.prod(high - low)
    whole = meta["tree"]["bound"]
    assert volume < 2.5 * np.prod(np.subtract(whole["max"], whole["min"])), "chunks are compact"
