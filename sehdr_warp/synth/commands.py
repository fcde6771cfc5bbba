"""The command line of `sehdr-warp synth`: what may be asked for, and the calls."""

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from ..arguments import numbers
from ..errors import SehdrError

LOG = logging.getLogger(__name__)
Positional = tyro.conf.Positional


@dataclass(frozen=True)
class RenderTruth:
    """Render HDR truth with Mitsuba 3: 35 views a scene, 18 train and 17 test. Finished views are kept: call again to
    go on after a stop."""

    name: Positional[str]
    """study, window, lamps, metal, glass, sunlit, night, overcast, or all."""
    out: Path
    """Folder; each scene gets a folder in it."""
    size: str = "200x200"
    """Width and height in pixels."""
    samples: int = 512
    """Light paths of a pixel in an easy scene; hard ones take up to four times as many."""
    seed: int = 0
    """Seed of shapes, textures and light paths."""
    variant: Literal["auto", "cuda_ad_rgb", "llvm_ad_rgb", "scalar_rgb"] = "auto"
    """Mitsuba's: CUDA needs an NVIDIA driver with OptiX, LLVM needs libLLVM 16 or later (DRJIT_LIBLLVM_PATH)."""
    denoise: Literal["none", "oidn"] = "none"
    """oidn: Open Image Denoise, guided by albedo and normals: far less noise for a small bias."""
    views: str | None = None
    """Only these of the 35, such as 0,17,34."""


@dataclass(frozen=True)
class ExposeTruth:
    """Write the photos of HDR truth through a camera response, as an HDR-NeRF synthetic set."""

    truth: Positional[str]
    """A set with truth, or `embedded` or `embedded:NAME`."""
    out: Path
    """Folder for the set."""
    response: str = "hdr-nerf"
    """Camera response: a name (srgb, gamma-2.2, hdr-nerf ...) or a file."""
    exposures: str | None = None
    """Times in seconds, such as 1/50,0.08,0.32; by default five, four times apart, around a well exposed one."""
    noise: str | None = None
    """Sensor noise as FULL_WELL,READ_NOISE in electrons, such as 20000,5; by default none."""
    seed: int = 0
    """Seed of the noise."""
    overwrite: bool = False
    """Replace the folder if it exists."""


@dataclass(frozen=True)
class PackTruth:
    """Write rendered truth as half floats, small enough to ship, and measure what that costs."""

    folder: Positional[Path]
    """Of a rendered scene."""
    out: Path
    """Folder for the small set."""
    compression: Literal["zip", "piz", "dwab"] = "dwab"
    """OpenEXR's; zip and piz are lossless."""
    level: float = 45.0
    """Of dwab: lower keeps more."""
    overwrite: bool = False
    """Replace the folder if it exists."""


@dataclass(frozen=True)
class Synth:
    """Make HDR scenes with truth: render them, expose them, pack them."""

    action: (
        Annotated[RenderTruth, tyro.conf.subcommand("render")]
        | Annotated[ExposeTruth, tyro.conf.subcommand("expose")]
        | Annotated[PackTruth, tyro.conf.subcommand("pack")]
    )


def run_synth(command: Synth) -> None:
    _ACTIONS[type(command.action)](command.action)


def _render(asked: RenderTruth) -> None:
    from .render import Settings, load_mitsuba, render_scene
    from .scenes import recipes_named

    recipes = recipes_named(asked.name)
    width, _, height = asked.size.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise SehdrError(f"--size {asked.size}: is not WIDTHxHEIGHT in pixels; write for example --size 200x200")
    views = numbers("--views", asked.views, int)
    settings = Settings(int(width), int(height), asked.samples, asked.seed, views, asked.denoise)
    mi = load_mitsuba(asked.variant)
    LOG.info("Mitsuba %s, %s", mi.__version__, mi.variant())
    for recipe in recipes:
        print(render_scene(mi, recipe, asked.out, settings))


def _expose(asked: ExposeTruth) -> None:
    from ..field.exposure import read_exposures
    from ..files import check_absent
    from ..response import response_by_name
    from ..scene import load_scene
    from .expose import SensorNoise, exposure_ladder, write_photo_set

    response = response_by_name(asked.response)
    for note in response.notes:
        LOG.info("%s", note)
    noise = None
    if asked.noise is not None:
        figures = numbers("--noise", asked.noise) or ()
        if len(figures) != 2:
            raise SehdrError(f"--noise {asked.noise}: give two numbers, full well and read noise in electrons")
        noise = SensorNoise(*figures)
    times = asked.exposures and [exposure.time for exposure in read_exposures(asked.exposures, None, "--exposures")]
    check_absent(asked.out, asked.overwrite, folder=True)
    scene = load_scene(asked.truth, response="srgb")
    times = times or exposure_ladder(scene, response)
    write_photo_set(scene, asked.out, response, times, noise=noise, seed=asked.seed, overwrite=asked.overwrite)
    stated = ", ".join(f"{time:.4g}" for time in times)
    print(f"{asked.out}: {len(scene.views)} views at {stated} s through {response.name}")


def _pack(asked: PackTruth) -> None:
    from .expose import pack_truth

    packing = pack_truth(**vars(asked))
    print(
        f"{asked.out}: {packing['bytes'] / 1e6:.2f} MB, relative error {100 * packing['relative_error']:.2f} %, "
        f"{packing['mu_law_psnr']:.1f} dB (mu-law)"
    )


_ACTIONS = {RenderTruth: _render, ExposeTruth: _expose, PackTruth: _pack}
