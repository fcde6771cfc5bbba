"""The command line of `sehdr-warp synth`."""

import logging
from dataclasses import dataclass
from pathlib import Path

import tyro

from ..arguments import parse_numbers
from ..errors import SehdrError

LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Synth:
    """Write the photos of HDR truth through a camera response, as an HDR-NeRF synthetic set."""

    truth: tyro.conf.Positional[str]  # A set with truth, or `embedded` or `embedded:NAME`.
    out: Path  # Folder for the set.
    response: str = "hdr-nerf"  # Camera response: a name (srgb, gamma-2.2, hdr-nerf ...) or a file.
    exposures: str | None = None
    """Times in seconds, such as 1/50,0.08,0.32; by default five, four times apart, around a well exposed one."""
    glare: float = 0.0  # Veiling glare index of the lens in percent (ISO 9358); real lenses have 0.5 to 3.
    noise: str | None = None  # Sensor noise as FULL_WELL,READ_NOISE in electrons, such as 20000,5; by default none.
    seed: int = 0  # Seed of the noise.
    overwrite: bool = False  # Replace the folder if it exists.


def run_synth(args: Synth) -> None:
    """Expose a set with truth and write the photos."""
    from ..files import check_absent
    from ..model.exposure import read_exposures
    from ..response import response_by_name
    from ..scene import load_scene
    from .expose import SensorNoise, exposure_ladder, write_photo_set

    response = response_by_name(args.response)
    for note in response.notes:
        LOG.info("%s", note)
    noise = None
    if args.noise is not None:
        figures = parse_numbers("--noise", args.noise)
        if len(figures) != 2:
            raise SehdrError(f"--noise {args.noise}: give two numbers, full well and read noise in electrons")
        noise = SensorNoise(*figures)
    times = args.exposures and [exposure.time for exposure in read_exposures(args.exposures, None, "--exposures")]
    check_absent(args.out, args.overwrite, folder=True)
    # Only truth is used of the set. A response as an object also stands beside photos whose light is known.
    scene = load_scene(args.truth, response=response_by_name("srgb"))
    times = times or exposure_ladder(scene, response)
    write_photo_set(
        scene, args.out, response, times, glare=args.glare, noise=noise, seed=args.seed, overwrite=args.overwrite
    )
    times_text = ", ".join(f"{time:.4g}" for time in times)
    print(f"{args.out}: {len(scene.views)} views at {times_text} s through {response.name}")
