"""Exported files of trained captures: whether they stand upright, are framed, hold no strays, and what they keep.

python -m benchmarks.files RUN[=X,Y,Z] ... --work files_work --json files.json

X,Y,Z is the true up in the coordinates of that run, if it is known. Otherwise `off` is the tilt of the floor that the
scene's mesh has, measured by depth alone, while up was found in the photos. Files are read back, and their pictures in
the run's held-out cameras, turned as the files are, are compared with the run's own.
"""

import logging
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

import sehdr_warp as sw
from sehdr_warp.errors import SehdrError
from sehdr_warp.output.cameras.scene_cameras import training_cameras
from sehdr_warp.output.export.gaussians import export
from sehdr_warp.output.export.proxy_mesh import proxy_mesh
from sehdr_warp.output.scene_page import write_scene_page
from sehdr_warp.output.world_transform import WorldTransform, file_transform, read_direction, world_transform
from sehdr_warp.response import response_by_name
from sehdr_warp.runs.run import load_splats
from sehdr_warp.scene.camera_focus import common_focus
from sehdr_warp.splats import GaussianArrays, read_gaussians
from sehdr_warp.subsets import evenly

from .results import finish, new_result
from .study import run

LOG = logging.getLogger("files")
SUFFIXES = (".usdc", ".glb", ".ply", ".sog")
VIEWS = 4  # Held-out views that are compared


def main(
    runs: tuple[str, ...], /, work: Path = Path("files_work"), json: Path | None = None, overwrite: bool = False
) -> None:
    """Export each run to every kind of file and judge the files.

    Args:
        runs: folders of runs, RUN or RUN=X,Y,Z.
        work: folder for the files.
        json: file of the result.
        overwrite: replace it.
    """
    if not runs:
        raise SehdrError("no runs; name folders of trained runs")
    result = new_result("files", torch.device("cuda" if torch.cuda.is_available() else "cpu"), {"runs": len(runs)})
    result["command"] = "python -m benchmarks.files RUN[=X,Y,Z] ... --json docs/reports/results/files.json"
    for text in runs:
        folder, _, direction = text.partition("=")
        run = sw.load_run(folder)
        LOG.info("%s", run.scene_name)
        result["rows"] += rows_of(run, work / run.scene_name.replace(":", "_"), direction)
    finish(result, json, overwrite)


def rows_of(run: "sw.Run", folder: Path, true_up: str = "") -> list[dict[str, Any]]:
    """Write a run's files into a folder; return a row for each."""
    folder.mkdir(parents=True, exist_ok=True)
    transform = world_transform(run)
    facts = {"scene": run.scene_name, "up": "poses" if run.up is None else run.up.source, "off": None, "by": ""}
    if true_up:
        facts |= {"off": _angle(transform.rotation @ read_direction(true_up)), "by": "truth"}
    elif ground := proxy_mesh(run, transform, resolution=96).ground:
        facts |= {"off": ground.tilt, "by": "floor"}
    rows = []
    for suffix in SUFFIXES:
        begun = time.perf_counter()
        path = export(run, folder / f"scene{suffix}", overwrite=True)
        seconds = time.perf_counter() - begun
        figures = judge(run, path, file_transform(transform, path))
        rows.append(facts | {"file": suffix, "megabytes": path.stat().st_size / 1e6, "seconds": seconds} | figures)
    begun = time.perf_counter()
    page = write_scene_page(run, folder / "scene.html", overwrite=True)
    size = page.stat().st_size / 1e6
    rows.append(facts | {"file": ".html", "megabytes": size, "seconds": time.perf_counter() - begun})
    return rows


def judge(run: "sw.Run", path: Path, transform: WorldTransform) -> dict[str, Any]:
    """Return how a file's pictures agree with the run's, and how far its Gaussians reach."""
    back = load_splats(path, device=run.device)
    held_out = [entry.camera for entry in run.cameras if entry.split == "test"] or training_cameras(run)
    encode, errors, linear = response_by_name("srgb").encode, [], path.suffix == ".usdc"
    for camera in evenly(held_out, VIEWS):
        moved = transform.camera(camera)
        with torch.no_grad():
            if linear:
                pair = [
                    encode(scene.render(each).hdr * run.base_time) for scene, each in ((back, moved), (run, camera))
                ]
            else:
                # At the file's own exposure, which SPZ does not state.
                pair = [back.field.render_ldr(moved, back.base_time), run.render_ldr(camera, run.base_time)]
        errors.append(float((pair[0].clamp(0, 1) - pair[1].clamp(0, 1)).square().mean()))
    return {"psnr": -10 * float(np.log10(max(np.mean(errors), 1e-12)))} | spread(read_gaussians(path), run, transform)


def spread(gaussians: GaussianArrays, run: "sw.Run", transform: WorldTransform) -> dict[str, float]:
    """Return the distances of a file's Gaussians from the middle of the photos, over the cameras' reach.

    `frame` is how much larger the box of all Gaussians, which viewers frame, is than that of 99.9 % of them.
    """
    positions = np.stack([transform.points(camera.position) for camera in training_cameras(run)])
    center = np.median(positions, axis=0)
    reach = float(np.percentile(np.linalg.norm(positions - center, axis=1), 90))
    focus = common_focus(training_cameras(run))
    if focus is not None:
        reach = max(reach, float(np.linalg.norm(transform.points(focus) - center)))
    distances = np.linalg.norm(gaussians.means - center, axis=1) / reach
    edges = np.percentile(gaussians.means, [0.05, 99.95], axis=0)
    box, most = (float(np.linalg.norm(np.ptp(corners, axis=0))) for corners in (gaussians.means, edges))
    return {"gaussians": gaussians.count, "farthest": float(distances.max()), "frame": box / most}


def _angle(up: np.ndarray) -> float:
    """Return the angle between a direction and +Y, degrees."""
    return float(np.degrees(np.arccos(np.clip(up[1] / np.linalg.norm(up), -1, 1))))


if __name__ == "__main__":
    run(main)
