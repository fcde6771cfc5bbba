"""Blender opens our files and shows the same; skipped without bpy (in this Python, or that of SEHDR_BLENDER_PYTHON)."""

import importlib.util
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sehdr_warp.output.cameras.selection import select_cameras
from sehdr_warp.output.export.gaussians import export
from sehdr_warp.output.export.proxy_mesh import write_proxy_mesh
from sehdr_warp.output.images.exr import exr_header, rgb_channels, write_exr
from sehdr_warp.output.lighting.environment_map import latlong, solid_angles
from sehdr_warp.output.render_views import render_views
from sehdr_warp.output.world_transform import world_transform
from sehdr_warp.scene.images.hdr_files import read_hdr

from .helpers import AnalyticRun, run_of, splats

SIZE, FRAMES, RADIUS = (320, 180), (0, 2), 0.02
NORMALS = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1), (0.6, 0.64, 0.48)]


def blender():
    python = os.environ.get("SEHDR_BLENDER_PYTHON")
    if python is None and importlib.util.find_spec("bpy") is None:
        pytest.skip("bpy is not installed")
    return python or sys.executable


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    """A folder of files that Blender has opened and rendered, what it found, and the run."""
    pytest.importorskip("pxr")
    python, folder = blender(), tmp_path_factory.mktemp("blender")
    run = AnalyticRun()
    for entry in run.cameras:  # Blender's pixels are square.
        entry.camera = replace(entry.camera, fy=entry.camera.fx)
    render_views(run, folder / "views", cameras="orbit", count=3, size="320x180")
    transform = world_transform(run)
    points = transform.points(np.array([(0, 0, 0), (0.4, 0.1, 0.2), (-0.5, 0.15, -0.1), (0.2, -0.2, 0.5)]))
    (folder / "cameras.usda").write_text((folder / "views" / "cameras.usda").read_text())
    os.link(folder / "views" / "hdr" / "orbit_000.exr", folder / "picture.exr")
    directions = latlong(128)
    light = np.exp(2 * directions @ np.array([0.3, 0.5, 0.8]))[..., None] * [1.0, 0.5, 0.25]
    light[20:24, 90:96] += 40  # A lamp
    write_exr(folder / "env.exr", rgb_channels(light), pixel="float", header=exr_header())
    scene = run_of(folder, splats([(0, 0, 0), (1, 0, 0)], [0.9, 0.5]))
    for name in ("splats.glb", "splats.usdc"):
        export(scene, folder / name)
    if importlib.util.find_spec("skimage"):
        from .export.test_proxy_mesh import BallOnFloor

        write_proxy_mesh(BallOnFloor(), folder / "proxy.usdc", resolution=48)
    facts = {"points": points.tolist(), "radius": RADIUS, "frames": FRAMES, "size": SIZE, "normals": NORMALS}
    (folder / "facts.json").write_text(json.dumps(facts))
    script = Path(__file__).with_name("blender_script.py")
    options = {"capture_output": True, "text": True, "timeout": 500, "env": {"HOME": str(folder)}}
    done = subprocess.run([python, script, folder], **options)
    assert done.returncode == 0, done.stdout[-1500:] + done.stderr[-1500:]
    lines = [line for line in done.stdout.splitlines() if line.startswith("RESULT ")]
    return folder, json.loads(lines[0].removeprefix("RESULT ")), done.stdout + done.stderr, run, light, points


def spots(image):
    """Centers [N, 2] of the bright spots of a picture, in pixels."""
    from scipy.ndimage import center_of_mass, label

    grey = image.mean(axis=2)
    labels, count = label(grey > 0.02)
    return np.array([center_of_mass(grey, labels, i + 1)[::-1] for i in range(count)]) + 0.5


def test_cameras_match_within_a_pixel(opened):
    folder, report, _, run, _, points = opened
    assert report["cameras"] == ["orbit"]
    transform = world_transform(run)
    cameras = [transform.camera(each.resized(*SIZE)) for _, each in select_cameras(run, "orbit", count=3)]
    for frame in FRAMES:
        local = points @ cameras[frame].world_to_camera[:3, :3].T + cameras[frame].world_to_camera[:3, 3]
        focal, middle = cameras[frame].intrinsics[:2], cameras[frame].intrinsics[2:]
        expected = local[:, :2] / local[:, 2:] * focal + middle
        inside = ((expected > 3) & (expected < np.array(SIZE) - 3)).all(axis=1)
        assert inside.sum() >= 2
        spots_of_map = spots(read_hdr(folder / f"match_{frame}.exr"))
        distances = np.linalg.norm(expected[inside][:, None] - spots_of_map, axis=2).min(axis=1)
        assert distances.max() < 1, (frame, expected, spots_of_map)


def test_a_map_lights_as_it_should(opened):
    folder, report, _, _, light, _ = opened
    assert report["map"]["size"] == [128, 64] and "Rec.709" in report["map"]["space"]
    directions, weight = latlong(128), solid_angles(128, "latlong")[..., None]
    weight = weight * 4 * np.pi / weight.sum()
    for index, normal in enumerate(NORMALS):
        cosine = np.maximum(directions @ (np.array(normal) / np.linalg.norm(normal)), 0)[..., None]
        expected = 0.5 / np.pi * (light * cosine * weight).sum(axis=(0, 1))
        rendered = read_hdr(folder / f"lit_{index}.exr").mean(axis=(0, 1))
        np.testing.assert_allclose(rendered, expected, rtol=0.02, err_msg=str(normal))


def test_files_are_imported_without_warnings(opened):
    _, report, output, *_ = opened
    assert report["splats.glb"] == report["splats.usdc"] == ["FINISHED"]
    assert report.get("proxy.usdc", ["FINISHED"]) == ["FINISHED"]
    assert report["picture"]["size"] == list(SIZE) and "Rec.709" in report["picture"]["space"]
    lines = [line for line in output.splitlines() if "warning" in line.lower() or "error" in line.lower()]
    assert [line for line in lines if "blender_script.py" not in line] == []  # Of the script itself
