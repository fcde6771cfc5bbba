"""What the cases of an outsider share: somebody who had seen neither the program's sources nor this trial.

The cases are files that were sent to a user, and odd places. Each says what it expects: a refusal in one line, or,
under EITHER, that line or the right result.
"""

import json
import os
from pathlib import Path
from typing import Any

import pytest

REFUSED, EITHER = (1, 2), (0, 1)
NAN, FAR = float("nan"), 1e300
RENDER = "render run --out new --cameras test --size 8x8 --device cpu"
STATE = "checkpoints/iteration_00000024/state.safetensors"
DEEP = "[" * 100_000
IDENTITY = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]
CAMERA = {"name": "c", "width": 8, "height": 8, "fx": 9, "fy": 9, "cx": 4, "cy": 4, "world_to_camera": IDENTITY}


def case(name: str, *values: Any, codes: tuple[int, ...] = REFUSED):
    return pytest.param(*values, codes, id=name[:60])


def put(path: Path, content: Any) -> None:
    """Write bytes, text or JSON to a file, or make one of another kind: `fifo`, `zero`, `folder`, `sparse`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    kinds = {"fifo": os.mkfifo, "zero": lambda place: place.symlink_to("/dev/zero"), "folder": os.mkdir}
    if isinstance(content, str) and content in kinds:
        kinds[content](path)
    elif isinstance(content, bytes):
        path.write_bytes(content)
    else:
        text = content if isinstance(content, str) else json.dumps(content)
        path.write_bytes(text.encode("utf-8", "surrogatepass"))
