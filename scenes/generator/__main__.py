"""`python -m scenes.generator`: render the scenes, pack them."""

import logging
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from sehdr_warp.arguments import parse, parse_numbers
from sehdr_warp.errors import SehdrError

from .light import render_light
from .recipes import recipes_named
from .render import Settings, load_mitsuba, render_scene
from .truth_set import pack_truth

PROGRAM = "python -m scenes.generator"
LOG = logging.getLogger("scenes.generator")
Positional = tyro.conf.Positional


@dataclass(frozen=True)
class Render:
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
class Pack:
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
class Light:
    """Add maps of the light at four places to a set; `benchmarks quality` judges irradiance by them."""

    name: Positional[str]
    """Of the scene, or all."""
    folder: Path
    """The folder that holds the set's folder."""
    samples: int = 256
    """Light paths of a pixel in an easy scene."""
    variant: Literal["auto", "cuda_ad_rgb", "llvm_ad_rgb"] = "auto"
    """Mitsuba's."""


@dataclass(frozen=True)
class Generator:
    """Render HDR scenes with truth, and pack them."""

    action: (
        Annotated[Render, tyro.conf.subcommand("render")]
        | Annotated[Pack, tyro.conf.subcommand("pack")]
        | Annotated[Light, tyro.conf.subcommand("light")]
    )


def main(words: list[str] | None = None) -> None:
    """Runs a command line; exits with 1 and one line on standard error for what the user can act on."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        action = parse(Generator, sys.argv[1:] if words is None else words, PROGRAM).action
        {Render: render, Pack: pack, Light: light}[type(action)](action)
    except SehdrError as error:
        sys.exit(f"{PROGRAM}: {str(error).removeprefix(PROGRAM + ' ')}")
    except KeyboardInterrupt:
        sys.exit(130)


def render(args: Render) -> None:
    recipes = recipes_named(args.name)
    width, _, height = args.size.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise SehdrError(f"--size {args.size}: is not WIDTHxHEIGHT in pixels; write for example --size 200x200")
    views = None if args.views is None else parse_numbers("--views", args.views, int)
    settings = Settings(int(width), int(height), args.samples, args.seed, views, args.denoise)
    mi = load_mitsuba(args.variant)
    LOG.info("Mitsuba %s, %s", mi.__version__, mi.variant())
    for recipe in recipes:
        print(render_scene(mi, recipe, args.out, settings))


def pack(args: Pack) -> None:
    packing = pack_truth(**vars(args))
    print(
        f"{args.out}: {packing['bytes'] / 1e6:.2f} MB, relative error {100 * packing['relative_error']:.2f} %, "
        f"{packing['mu_law_psnr']:.1f} dB (mu-law)"
    )


def light(args: Light) -> None:
    recipes = recipes_named(args.name)
    mi = load_mitsuba(args.variant)
    for recipe in recipes:
        print(*render_light(mi, recipe, args.folder / recipe.name, args.samples), sep="\n")


if __name__ == "__main__":
    main()
