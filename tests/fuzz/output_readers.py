"""Small response curves, splats and OCIO configs to damage, and their readers."""

import gzip
import json
import struct
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from scipy.io import savemat

from sehdr_warp.output.cameras.exchange import usd_cameras
from sehdr_warp.output.images.ocio import ocio_view
from sehdr_warp.own_files import LIST
from sehdr_warp.response import response_by_name
from sehdr_warp.scene import load_cameras
from sehdr_warp.splats import USD_SUFFIXES, GaussianArrays, read_gaussians, required_color_model, write_gaussians
from tests.ocio_config import ocio_config
from tests.output.helpers import camera

from .reader import Reader, each


def make_responses(folder: Path) -> None:
    x = np.linspace(0, 1, 9)
    y = x**0.5
    row = " ".join(f"{v:.4f}" for v in x)
    curve = " ".join(f"{v:.4f}" for v in y)
    (folder / "c.csv").write_text("exposure,value\n" + "".join(f"{a},{b}\n" for a, b in zip(x, y)))
    (folder / "c.json").write_text(json.dumps({"exposures": x.tolist(), "values": y.tolist()}))
    stored = {"kind": "table", "name": "n", "exposures": x.tolist(), "values": y.tolist(), "notes": []}
    (folder / "d.json").write_text(json.dumps(stored))
    (folder / "dorf.txt").write_text("".join(f"n{i}\nkind\nI =\n{row}\nB =\n{curve}\n" for i in range(2)))
    (folder / "emor.txt").write_text(f"E =\n{row}\nf0 =\n{curve}\nh(1)=\n{row}\n")
    savemat(folder / "m.mat", {"B": np.stack([y, y]), "I": np.stack([x, x])})


def make_curves(folder: Path) -> None:
    make_responses(folder)
    (folder / "m.mat").unlink()


def read_response(path: Path):
    selectors = {"dorf.txt": ":1", "emor.txt": ":0.1", "m.mat": ":0"}
    curve = response_by_name(f"{path}{selectors.get(path.name, '')}")
    return curve.decode(curve.encode(np.array([0.0, 0.2, 3.0]))), curve.white


def make_splats(*suffixes: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        arrays = [np.full((3, *shape), 0.25, np.float32) for shape in ((3,), (3,), (4,), (), (4, 3))]
        for suffix in suffixes:
            file = folder / f"a{suffix}"
            write_gaussians(file, GaussianArrays(*arrays, required_color_model(file) or "linear", 0.5))
        if ".usda" in suffixes:
            (folder / "b.usda").write_text(usd_cameras([("a", camera(16, 12)), ("b", camera(8, 8))], np.eye(4)))
        (folder / LIST).unlink()

    return make


def fit_chunks(folder: Path) -> None:
    """Lengths of a GLB's chunks that fit again."""
    data = (folder / "a.glb").read_bytes()
    end = data.find(b"BIN\0") - 4
    if end > 20:
        data = data[:8] + struct.pack("<2I", len(data), end - 20) + data[16:]
        (folder / "a.glb").write_bytes(data)


def read_usd(path: Path):
    return (load_cameras if path.name == "b.usda" else read_gaussians)(path)


def make_sog(folder: Path) -> None:
    make_splats(".sog")(folder)
    with zipfile.ZipFile(folder / "a.sog") as archive:
        archive.extractall(folder / "parts")


def read_sog(folder: Path):
    """The file, and one of its parts whose checksums fit."""
    with zipfile.ZipFile(folder / "b.sog", "w") as archive:
        for part in sorted((folder / "parts").iterdir()):
            archive.write(part, part.name)
    each(*(partial(lambda name, folder: read_gaussians(folder / name), name) for name in ("a.sog", "b.sog")))(folder)


def make_streamed(folder: Path) -> None:
    count = 200
    arrays = [np.linspace(0.1, 0.9, count * n, dtype=np.float32).reshape(count, n) for n in (3, 3, 4)]
    opacities, harmonics = np.full(count, 0.5, np.float32), np.full((count, 4, 3), 0.25, np.float32)
    write_gaussians(folder / "town" / "lod-meta.json", GaussianArrays(*arrays, opacities, harmonics, "display", 0.5))
    for path in folder.rglob(LIST):
        path.unlink()


def make_spz(folder: Path) -> None:
    make_splats(".spz")(folder)
    (folder / "plain.spz").write_bytes(gzip.decompress((folder / "a.spz").read_bytes()))


def make_ocio(folder: Path) -> None:
    rows = "".join(f"{r} {g} {b}\n" for b in (0, 1) for g in (0, 1) for r in (0, 1))
    (folder / "look.cube").write_text(f"LUT_3D_SIZE 2\n{rows}")
    (folder / "curve.spi1d").write_text("Version 1\nFrom 0 1\nLength 3\nComponents 1\n{\n0\n0.4\n1\n}\n")
    (folder / "own.ocio").write_text(
        ocio_config("""!<GroupTransform>
      children:
        - !<FileTransform> {src: look.cube, interpolation: linear}
        - !<FileTransform> {src: curve.spi1d}
        - !<MatrixTransform> {matrix: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}
        - !<ExponentTransform> {value: [2.2, 2.2, 2.2, 1]}""")
    )


def read_ocio(folder: Path):
    return ocio_view(str(folder / "own.ocio"), "V")(np.full((2, 2, 3), 0.18, np.float32))


READERS = {
    "responses": Reader(make_responses, ("*",), each(read_response), text=True, cost=30),
    "curves": Reader(make_curves, ("*",), each(read_response), text=True),
    "ply": Reader(make_splats(".ply"), ("*",), each(read_gaussians), text=True, cost=0.7),
    "glb": Reader(make_splats(".glb"), ("*",), each(read_gaussians), text=True, repair=fit_chunks, cost=0.5),
    "compressed-ply": Reader(make_splats(".compressed.ply"), ("*",), each(read_gaussians), text=True, cost=1.4),
    "sog": Reader(make_sog, ("*.sog", "parts/*"), read_sog, text=True, cost=7),
    "streamed-sog": Reader(
        make_streamed,
        ("town/*.json", "town/*/*.json"),
        lambda folder: read_gaussians(folder / "town" / "lod-meta.json"),
        text=True,
        cost=7,
    ),
    "spz": Reader(make_spz, ("*",), each(read_gaussians), cost=1.1),
    "ocio": Reader(make_ocio, ("*",), read_ocio, text=True, cost=1.3),
    "usd": Reader(make_splats(*USD_SUFFIXES), ("*",), each(read_usd), text=True, cost=20),
}
