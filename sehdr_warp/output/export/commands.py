"""Command lines of `sehdr-warp export`, `mesh` and `convert`. torch is imported when they run."""

import shlex
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

from ...errors import UsageError
from ...runs.open import load_run_scene, open_run, open_scene
from ..commands import WorldOptions, changed_flags

if TYPE_CHECKING:
    from ...runs.run import RenderableScene

_MESH_SUFFIXES = (".obj", ".abc", ".fbx", ".stl")


@dataclass(frozen=True)
class SplatFileOptions:
    """Colors and harmonics of a file of Gaussians."""

    kind: Literal["hdr", "ldr"] | None = None
    """ldr: the colors of a photo, as viewers show them. hdr: scene-linear radiance. By default hdr for USD, else
    ldr."""
    exposure: str | None = None
    """Exposure of ldr colors: seconds (1/125), stops from the photos' exposure (-2ev) or multiples of it (1/8x)."""
    degree: int | None = None  # Pad the harmonics with zeros up to this degree, for readers that take 3 alone.


@dataclass(frozen=True)
class EditOptions:
    """Gaussians that the file leaves out."""

    crop: str | None = None
    """Keep only this region, in upright coordinates or those of --axes: sphere:x,y,z,radius or
    box:x0,y0,z0,x1,y1,z1."""
    cut: str | None = None  # Leave this region out, written as that of --crop.
    min_opacity: float = 1 / 255  # Least opacity; below 1/255 no program draws a Gaussian.
    min_views: int = 0  # Leave out what fewer training cameras show: 2 removes most floaters.
    mask_only: bool = False  # Keep only what the masks of the photos show white; masks of a few photos are enough.
    data: str | None = None  # The photos with these masks, if they have moved since the training.
    max_gaussians: int | None = None
    """Keep this many, those that pictures show most, and fit their colors again: a small file to share."""


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write the Gaussians as a file for viewers and other tools, or as a page that shows them in HDR."""

    run: Positional[Path]  # Folder of a run, or a file of Gaussians.
    out: Path
    """The file; its suffix decides: .ply, .glb (glTF), .usda, .usdc or .usdz (OpenUSD), .html (a page to send), or the
    small ones .sog, .spz and .compressed.ply. FOLDER/lod-meta.json is streamed SOG: chunks of a large scene."""
    world: WorldOptions = field(default_factory=WorldOptions)
    edits: EditOptions = EditOptions()
    merge: tuple[Path, ...] = ()  # Further runs or files in the same coordinates, which the file holds as well.
    file: SplatFileOptions = SplatFileOptions()
    cameras: bool = False
    """Also write the cameras beside it (scene.ply.cameras.json), in the form of the reference release of 3D Gaussian
    Splatting."""
    overwrite: bool = False  # Replace files that exist.
    device: str | None = None  # cpu or cuda:N; by default the first GPU if there is one.


@dataclass(frozen=True, kw_only=True)
class Convert:
    """Convert a file of Gaussians to another format."""

    source: Positional[Path]  # The file: .ply, .glb, .usda, .usdc, .usdz, .sog, .spz or .compressed.ply.
    out: Positional[Path]  # The file to write; its suffix decides.
    file: SplatFileOptions = SplatFileOptions()
    overwrite: bool = False  # Replace a file that exists.
    device: str | None = None  # cpu or cuda:N; by default the first GPU if there is one.


@dataclass(frozen=True, kw_only=True)
class Mesh:
    """Write a mesh of a scene's surfaces: to catch shadows, to collide, to hide what is behind."""

    run: Positional[Path]  # Folder of a run.
    out: Path  # The file: .usda or .usdc (OpenUSD) or .obj.
    world: WorldOptions = field(default_factory=WorldOptions)
    crop: str | None = None
    """Mesh only this region, in upright coordinates or those of --axes: sphere:x,y,z,radius or
    box:x0,y0,z0,x1,y1,z1."""
    resolution: int = 160  # Voxels along the longest side; memory grows with its cube.
    overwrite: bool = False  # Replace a file that exists.
    device: str | None = None  # cpu or cuda:N; by default the first GPU if there is one.


def run_mesh(args: Mesh) -> None:
    """Run `sehdr-warp mesh`."""
    from .proxy_mesh import check_mesh, write_proxy_mesh

    check_mesh(args.out, args.resolution, args.crop, args.overwrite)  # Before the scene is opened.
    options = {"resolution": args.resolution, "crop": args.crop, "overwrite": args.overwrite} | vars(args.world)
    print(write_proxy_mesh(open_run(args.run, args.device), args.out, **options))


def run_export(args: Export) -> None:
    """Run `sehdr-warp export`."""
    from ...runs.run import Run
    from ...splats import check_new_file, check_suffix
    from .splat_edits import SplatEdits

    if args.out.suffix.lower() in _MESH_SUFFIXES:
        command = shlex.join(["sehdr-warp", "mesh", str(args.run), "--out", str(args.out.with_suffix(".usdc"))])
        raise UsageError(f"{args.out}: meshes are written by {command}")
    is_page = check_suffix(args.out, ".html") == ".html"
    flags = [*changed_flags(args.world), *changed_flags(args.file), *["--cameras"] * args.cameras]
    if is_page and flags:
        refused = ", ".join(flags)
        raise UsageError(f"{refused}: without effect on a page, which has its own exposure, cameras and axes")
    check_new_file(args.out, cameras=args.cameras, overwrite=args.overwrite)
    values = dict(vars(args.edits))
    mask_only, data = values.pop("mask_only"), values.pop("data")
    if data is not None and not mask_only:
        raise UsageError("--data: the photos are only read for --mask-only")
    edits = SplatEdits(**values)  # It refuses values that cannot be, before anything is loaded.
    run = open_scene(args.run, args.device)
    if mask_only:
        if not isinstance(run, Run):
            raise UsageError("--mask-only: needs a run and its photos; a file of Gaussians has none")
        edits = replace(edits, mask_views=load_run_scene(run, data).views)
    if args.merge:
        from ..merged_scene import merge_scenes

        run = merge_scenes(run, *(open_scene(path, args.device) for path in args.merge))
    if is_page:
        from ..scene_page import write_scene_page

        print(write_scene_page(run, args.out, edits=edits, overwrite=args.overwrite))
    else:
        options = vars(args.world) | {"edits": edits, "cameras": args.cameras, "overwrite": args.overwrite}
        _export(run, args.out, args.file, options)


def run_convert(args: Convert) -> None:
    """Run `sehdr-warp convert`."""
    from ...splats import check_new_file, check_suffix

    command = shlex.join(["sehdr-warp", "export", str(args.source), "--out", str(args.out)])
    if args.source.is_dir():
        raise UsageError(f"{args.source}: is a folder; runs are written by {command}")
    check_suffix(args.source)  # First, because export cannot read it either.
    if args.out.suffix.lower() == ".html":
        raise UsageError(f"{args.out}: pages are written by {command}")
    check_suffix(args.out)
    check_new_file(args.out, overwrite=args.overwrite)
    from .splat_edits import SplatEdits

    options = {"axes": None, "edits": SplatEdits(min_opacity=0), "overwrite": args.overwrite}
    _export(open_scene(args.source, args.device), args.out, args.file, options)


def _export(run: "RenderableScene", out: Path, file: SplatFileOptions, options: dict[str, Any]) -> None:
    """Export a scene with the options of export(), and print the path."""
    from ...model.exposure import exposure_times
    from .gaussians import export

    times = () if file.exposure is None else exposure_times(run.base_time, file.exposure)
    if len(times) > 1:
        raise UsageError(f"--exposure {file.exposure}: a splat file holds the colors of one exposure; name one")
    print(export(run, out, kind=file.kind, exposure_time=next(iter(times), None), degree=file.degree, **options))
