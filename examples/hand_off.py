"""Deliver a scene to lighting: exposure brackets in ACEScg from cameras of your own.

python examples/hand_off.py RUN [OUT]        RUN is the folder of a training, such as runs/quickstart/run
"""

import json
import sys
from pathlib import Path

import sehdr_warp as sw


def main(run_folder: Path, out: Path) -> list[Path]:
    """Write `shot/` (EXR brackets, previews, brackets.json) and cameras.json; return the EXR files."""
    run = sw.load_run(run_folder)
    out.mkdir(parents=True, exist_ok=True)

    # A camera file: OpenCV axes, as the package reads them; those of nerfstudio are read as well.
    camera = run.cameras[0].camera
    half = camera.resized(camera.width // 2, camera.height // 2)
    (out / "cameras.json").write_text(json.dumps({"cameras": [{"name": "plate", **half.to_dict()}]}))

    files = sw.render_views(
        run,
        out / "shot",
        cameras=out / "cameras.json",
        exposures=("1/8x", "1x", "8x"),
        colorspace="acescg",
        pixel="float",
        overwrite=True,
    )
    for view in json.loads((out / "shot" / "brackets.json").read_text())["views"]:
        for exposure in view["exposures"]:
            print(f"{exposure['file']}: {exposure['exposure_time']:g} s, {exposure['ev']:+g} stops")
    return [file for file in files if file.suffix == ".exr"]


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2] if len(sys.argv) > 2 else "runs/hand_off"))
