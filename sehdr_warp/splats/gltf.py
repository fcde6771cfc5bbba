"""Binary glTF with KHR_gaussian_splatting: display-referred colors, as its color spaces ask.

Scales are linear, opacities in [0, 1], rotations (x y z w); COLOR_0 is what viewers without the extension show.
"""

import json
import logging
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__
from ..errors import InputError
from ..files import atomic_path, read_bytes
from ..json_values import damage
from .arrays import HARMONIC_0, GaussianArrays, degree_of, join_gaussians, read_facts, stated_facts

log = logging.getLogger(__name__)
EXTENSION = "KHR_gaussian_splatting"
_FILTER = "_SEHDR_FILTER"  # Attribute of filter_shares; programs have their own behind an underscore.
_SPACE = "srgb_rec709_display"
_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_FLOAT, _POINTS, _VERTICES = 5126, 0, 34962
# Components, and for each their type and the value of 1 where they are normalized integers.
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_TYPES = {5120: ("<i1", 127), 5121: ("<u1", 255), 5122: ("<i2", 32767), 5123: ("<u2", 65535), _FLOAT: ("<f4", 1)}
_DAMAGED = "export it again"
_MOST_PARTS = 10_000  # Primitives that nodes show; each takes a fraction of a millisecond


def write_glb(path: Path, gaussians: GaussianArrays, overwrite: bool) -> None:
    """Write a .glb file; arguments as in write_gaussians."""
    color = np.clip(gaussians.harmonics[:, 0] * HARMONIC_0 + 0.5, 0, 1)
    attributes = {
        "POSITION": gaussians.means,
        "COLOR_0": np.concatenate([color, gaussians.opacities[:, None]], axis=1),
        f"{EXTENSION}:ROTATION": np.roll(gaussians.unit_quaternions, -1, axis=1),
        f"{EXTENSION}:SCALE": np.exp(gaussians.log_scales),
        f"{EXTENSION}:OPACITY": gaussians.opacities[:, None],
    }
    if (shares := gaussians.filter_shares) is not None:
        attributes[_FILTER] = shares[:, None]
    attributes |= {name: gaussians.harmonics[:, i] for i, name in enumerate(_harmonic_names(gaussians.degree))}
    blobs = [np.ascontiguousarray(values, "<f4").tobytes() for values in attributes.values()]
    views, accessors, offset = [], [], 0
    for index, (values, blob) in enumerate(zip(attributes.values(), blobs, strict=True)):
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(blob), "target": _VERTICES})
        kind = next(name for name, width in _WIDTHS.items() if width == values.shape[1])
        accessors.append({"bufferView": index, "componentType": _FLOAT, "count": len(values), "type": kind})
        offset += len(blob)
    means = gaussians.means.astype(np.float32)  # The limits are those of the stored numbers.
    accessors[0] |= {"min": means.min(axis=0).tolist(), "max": means.max(axis=0).tolist()}
    extension = {"kernel": "ellipse", "colorSpace": _SPACE}
    extension |= {"projection": "perspective", "sortingMethod": "cameraDistance"}
    primitive = {
        "mode": _POINTS,
        "attributes": {name: index for index, name in enumerate(attributes)},
        "extensions": {EXTENSION: extension},
    }
    extras = stated_facts(gaussians) | ({"opacity_compensation": True} if gaussians.antialiased else {})
    described = {
        "asset": {"version": "2.0", "generator": f"sehdr-warp {__version__}"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive], "extras": extras}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    text = json.dumps(described, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    length = 12 + 8 + len(text) + 8 + offset
    with atomic_path(path, overwrite) as temporary, temporary.open("wb") as file:
        file.write(struct.pack("<5I", _MAGIC, 2, length, len(text), _JSON) + text + struct.pack("<2I", offset, _BIN))
        file.writelines(blobs)


def read_glb(path: Path) -> GaussianArrays:
    """Read the primitives with the extension, with display colors in sRGB, moved by the nodes that show them.

    Other nodes, such as cameras and lights, may have any transform.
    """
    described, binary = _chunks(path)
    try:
        parts, total = [], 0
        for number, matrix in _scene_meshes(described, path):
            mesh = _item(described, "meshes", number)
            for primitive in mesh["primitives"]:
                if EXTENSION in primitive.get("extensions", {}):
                    gaussians = _primitive(described, binary, mesh, primitive, path)
                    total += gaussians.count
                    if len(parts) >= _MOST_PARTS or total > len(binary):
                        problem = f"shows {total} Gaussians, more than its {len(binary)} bytes, by nodes of one mesh"
                        raise InputError(path, problem, "export each Gaussian once")
                    parts.append(gaussians if np.allclose(matrix, np.eye(4)) else _move(gaussians, matrix, path))
    except (KeyError, IndexError, TypeError, AttributeError, ValueError, OverflowError) as error:
        raise InputError(path, f"is damaged glTF ({damage(error)})", _DAMAGED) from None
    if not parts:
        raise InputError(path, f"has no primitive with {EXTENSION}", "export Gaussians by the ratified extension")
    return join_gaussians(parts)


def _primitive(described: dict, binary: bytes, mesh: dict, primitive: dict, path: Path) -> GaussianArrays:
    attributes, extension = primitive["attributes"], primitive["extensions"][EXTENSION]
    if compressed := next((name for name in extension.get("extensions", {}) if "compression" in name), None):
        raise InputError(path, f"is compressed ({compressed!s:.60})", "export it uncompressed, or as SPZ")
    for key, expected in (("colorSpace", _SPACE), ("kernel", "ellipse")):
        if extension.get(key) != expected:
            problem = f"its {key} is {extension.get(key)!r:.60}, not {expected}"
            raise InputError(path, problem, "export it as display colors in sRGB, of ellipses")

    def values(name: str, columns: int) -> np.ndarray:
        if name not in attributes:
            raise InputError(path, f"has no attribute {name}", "export it by the ratified extension")
        return _accessor(described, binary, attributes[name], columns)

    names = (name for name in attributes if name.startswith(f"{EXTENSION}:SH_DEGREE_"))
    degree = degree_of(sum(1 for _ in names), path)
    opacities = values(f"{EXTENSION}:OPACITY", 1)[:, 0]
    extras = mesh.get("extras", {})
    scales = values(f"{EXTENSION}:SCALE", 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = scales if (are_logarithms := bool((scales < 0).any())) else np.log(scales)
        logits = np.log(opacities) - np.log1p(-opacities)
    if are_logarithms:
        log.warning("%s: its SCALE has negative numbers and is read as logarithms, as SplatTransform wrote it", path)
    gaussians = GaussianArrays(
        means=values("POSITION", 3),
        log_scales=log_scales,
        quaternions=np.roll(values(f"{EXTENSION}:ROTATION", 4), 1, axis=1),
        opacity_logits=logits,
        harmonics=np.stack([values(name, 3) for name in _harmonic_names(degree)], axis=1),
        color_model="display",
        antialiased=extras.get("opacity_compensation") is True,
        **read_facts(extras, path),
    )
    return gaussians.without_filter(values(_FILTER, 1)[:, 0]) if _FILTER in attributes else gaussians


def _scene_meshes(described: dict, path: Path) -> list[tuple[int, np.ndarray]]:
    """Return the mesh and the world transform of each node with a mesh; of a file without nodes all meshes, unmoved."""
    nodes = described.get("nodes", [])
    parents = {child: number for number, node in enumerate(nodes) for child in node.get("children", [])}
    worlds: dict[int, np.ndarray] = {}
    meshes = []
    for number, node in enumerate(nodes):
        if "mesh" not in node:
            continue
        chain, above = [number], number
        while above in parents and above not in worlds:
            above = parents[above]
            chain.append(above)
            if len(chain) > len(nodes):
                raise InputError(path, "has nodes that hold each other", _DAMAGED)
        for each in reversed(chain):
            if each not in worlds:
                above = worlds[parents[each]] if each in parents else np.eye(4)
                worlds[each] = above @ _node_matrix(_item(described, "nodes", each))
        meshes.append((node["mesh"], worlds[number]))
    return meshes or [(number, np.eye(4)) for number in range(len(described["meshes"]))]


def _node_matrix(node: dict) -> np.ndarray:
    """Return the local transform [4, 4] of a node, whose matrix is stored by columns."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    if "rotation" in node:
        from scipy.spatial.transform import Rotation

        matrix[:3, :3] = Rotation.from_quat(np.array(node["rotation"], np.float64)).as_matrix()
    matrix[:3, :3] *= np.array(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = np.array(node.get("translation", (0, 0, 0)), np.float64)
    return matrix


def _move(gaussians: GaussianArrays, matrix: np.ndarray, path: Path) -> GaussianArrays:
    stretch = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    if not (np.isfinite(matrix).all() and stretch[2] > 0 and stretch[0] < 1.001 * stretch[2]):
        raise InputError(path, "stretches its Gaussians by a node's transform", "bake the transform into the Gaussians")
    if np.linalg.det(matrix[:3, :3]) < 0:
        raise InputError(path, "mirrors its Gaussians by a node's transform", "bake the transform into the Gaussians")
    return replace(gaussians.transformed(matrix), world_matrix=gaussians.world_matrix)


def _harmonic_names(degree: int) -> list[str]:
    return [f"{EXTENSION}:SH_DEGREE_{l}_COEF_{n}" for l in range(degree + 1) for n in range(2 * l + 1)]  # noqa: E741


def _chunks(path: Path) -> tuple[dict[str, Any], bytes]:
    """Return the description and the binary chunk."""
    data = read_bytes(path)
    if len(data) < 20 or struct.unpack_from("<2I", data) != (_MAGIC, 2):
        raise InputError(path, "is not binary glTF 2.0", _DAMAGED)
    length, kind = struct.unpack_from("<2I", data, 12)
    try:
        described = json.loads(data[20 : 20 + length])
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"its description is not JSON ({error!s:.80})", _DAMAGED) from None
    if kind != _JSON or not isinstance(described, dict):
        raise InputError(path, "its first chunk is not a description", _DAMAGED)
    return described, data[28 + length :]


def _item(described: dict, kind: str, index: Any) -> dict:
    """Return an element of a list of the description; raise ValueError for an index out of range."""
    if type(index) is not int or not 0 <= index < len(described[kind]):
        raise ValueError(f"{kind} has no {index!r:.20}")
    return described[kind][index]


def _accessor(described: dict, binary: bytes, index: int, columns: int) -> np.ndarray:
    """Return [count, columns] float32; raise ValueError or KeyError if the file is damaged."""
    accessor = _item(described, "accessors", index)
    if "sparse" in accessor:
        raise ValueError(f"accessor {index} is sparse, which is not read")
    view = _item(described, "bufferViews", accessor["bufferView"])
    buffer = _item(described, "buffers", view["buffer"])
    if view["buffer"] != 0 or "uri" in buffer:
        raise ValueError(f"buffer {view['buffer']} is not in the file")
    kind, one = _TYPES[accessor["componentType"]]
    if _WIDTHS[accessor["type"]] != columns or (one > 1 and not accessor.get("normalized")):
        raise ValueError(f"accessor {index} is {accessor['type']}")
    row = np.dtype(kind).itemsize * columns
    offset, stride = view.get("byteOffset", 0) + accessor.get("byteOffset", 0), view.get("byteStride", row)
    if type(stride) is not int or stride < row:  # Of 0, one element would stand for any number of them.
        raise ValueError(f"a stride of {stride!r:.20} bytes is less than the {row} of an element")
    values = np.ndarray((accessor["count"], columns), kind, binary, offset, (stride, row // columns))
    return np.maximum(values.astype(np.float32) / one, -np.inf if one == 1 else -1)
