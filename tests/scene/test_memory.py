"""How much memory loading takes: codes stay codes. `python -m tests.scene.test_memory 200 4000 3000` measures a set."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sehdr_warp.scene import look_at

LOAD = """
import re, sys
from pathlib import Path
import torch
from sehdr_warp.scene import load_scene
peak = lambda: 1024 * int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1])
before = peak()
scene = load_scene(sys.argv[1], response=sys.argv[2])
codes = sum(view.codes.nbytes for view in scene.views)
print(before, peak(), codes)
"""


def write_set(folder: Path, count: int, width: int, height: int) -> None:
    """JPEGs of noise over a gradient, one encoded in a few versions and saved many times, with transforms.json."""
    (folder / "images").mkdir()
    rng = np.random.default_rng(0)
    ramp = np.linspace(20, 220, width)[None, :, None] * np.linspace(0.4, 1, height)[:, None, None]
    versions = []
    for part in range(min(4, count)):
        photo = np.clip(ramp * (1 + part / 50) + rng.normal(0, 6, (height, width, 3)), 0, 255).astype(np.uint8)
        Image.fromarray(photo).save(folder / "version.jpg", quality=85)
        versions.append((folder / "version.jpg").read_bytes())
    frames = []
    for i in range(count):
        (folder / "images" / f"{i:04d}.jpg").write_bytes(versions[i % len(versions)] + bytes([i % 256]))
        matrix = np.linalg.inv(look_at((4 * np.sin(i / 30), -4 * np.cos(i / 30), 0.5)))
        matrix[:3, 1:3] *= -1
        frames.append({"file_path": f"images/{i:04d}.jpg", "transform_matrix": matrix.tolist()})
    (folder / "points.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\n"
        + "".join(f"property float {axis}\n" for axis in "xyz")
        + "end_header\n0 0 0\n"
    )
    values = {"camera_angle_x": 0.8, "w": width, "h": height, "ply_file_path": "points.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(values))


def measure(folder: Path, response: str = "auto") -> tuple[int, int, int]:
    """Bytes: the peak before loading and after, and of the codes, in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", LOAD, str(folder), response], capture_output=True, text=True, check=True
    )
    return tuple(int(value) for value in done.stdout.split())


@pytest.mark.skipif(sys.platform != "linux", reason="the peak is read from /proc")
def test_a_loaded_photo_takes_three_bytes_a_pixel(tmp_path):
    write_set(tmp_path, 20, 1600, 1200)
    before, peak, codes = measure(tmp_path, "srgb")
    assert codes == 20 * 1600 * 1200 * 3
    # What decoding a few photos takes besides; float32 copies of all would be four times the codes more.
    assert peak - before < codes + 200e6


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        write_set(Path(place), *map(int, sys.argv[1:4]))
        print("peak before, peak after, codes (GB):", *(round(value / 1e9, 2) for value in measure(Path(place))))
