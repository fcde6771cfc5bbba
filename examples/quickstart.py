"""From photos to HDR views and exposure brackets, on the scene that comes with the package: a minute on two cores.

python examples/quickstart.py [OUT]
"""

import sys
from pathlib import Path

import sehdr_warp as sw


def main(out: Path, max_size: int = 96, iterations: int = 600) -> sw.Run:
    """Write a run, and its held-out views at five exposures, into the folder `out`."""
    scene = sw.load_scene("embedded", max_size=max_size)  # or a folder of your photos
    config = sw.load_config("demo", {"schedule.iterations": iterations, "response.name": "hdr-nerf"})
    run = sw.train(scene, out / "run", config, overwrite=True)
    sw.render_views(run, out / "views", cameras="test", evs=(-4, -2, 0, 2, 4), overwrite=True)

    view = scene.test_views[0]
    radiance = run.render(view.camera).hdr  # [H, W, 3], scene-linear
    brightest = float(radiance.max()) * view.exposure_time
    print(f"{out}: brightest pixel of {view.name} at {brightest:.2f} times the photos' unit of exposure")
    return run


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/quickstart"))
