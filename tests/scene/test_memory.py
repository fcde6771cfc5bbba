"""How much memory loading takes: codes stay codes."""

import subprocess
import sys

import pytest

from tests.make_scenes import write_blender, write_ply

LOAD = """
import re, sys
from pathlib import Path
import torch
from sehdr_warp.scene import load_scene
peak = lambda: 1024 * int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1])
before = peak()
scene = load_scene(sys.argv[1], response="srgb")
print(before, peak(), sum(view.codes.nbytes for view in scene.views))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the peak is read from /proc")
def test_a_loaded_photo_takes_three_bytes_a_pixel(tmp_path):
    write_blender(tmp_path, 12, size=(1600, 1200), ply_file_path="p.ply")
    write_ply(tmp_path / "p.ply", [(0, 0, 0)])
    done = subprocess.run([sys.executable, "-c", LOAD, str(tmp_path)], capture_output=True, text=True, check=True)
    before, peak, codes = map(int, done.stdout.split())
    assert codes == 12 * 1600 * 1200 * 3
    # What decoding a few photos takes besides; float32 copies of all would be four times the codes more.
    assert peak - before < codes + 200e6
