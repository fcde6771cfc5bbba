"""The lights of a trained scene as JSON or as OpenUSD lights, with a map of everything else."""

import json
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ...errors import SehdrError, path_of, require_loaded
from ...files import atomic_path, check_absent
from ...model.lights import Light, ReceivedLight, light_name, received_light
from ...runs.run import RenderableScene, Run
from ...scene.wide_camera import typical_focal_length
from ...subsets import first_names
from ..cameras.scene_cameras import training_cameras
from ..images.display import exposure_for_white
from ..images.exr import write_multipart_exr
from ..picture_header import provenance
from ..world_transform import WorldTransform, world_transform
from .environment_map import (
    COVERED,
    covered_percent,
    inpainted_light,
    latlong,
    little_visible,
    map_part,
    render_map,
    solid_angles,
)
from .map_center import MapCenter, check_beyond, find_center
from .unit import luminance_of_one

log = logging.getLogger(__name__)
SUFFIXES = (".json", ".usda")
UNSEEN = ("inpaint", "black")
UNCERTAIN = 0.5  # Stops of deviation above which a light is called uncertain
STRONG = 0.1  # Part of the share of the strongest uncertain light from which darker photos are to measure a light
MOST_GAIN = 4.0  # Of a light's radiance at the lit place; more is an error of its shape, seen from the edge
MAP_SIZE = 1024  # Pixels across of the map of what is not a light
_STAGE = """#usda 1.0
(
    customLayerData = {{
        string "sehdr:scene" = {scene}
    }}
    defaultPrim = "Lights"
    metersPerUnit = 1
    upAxis = "Y"
)

def Xform "Lights"
{{
    custom string sehdr:units = {units}
    custom matrix4d sehdr:worldMatrix = ( {matrix} )

{lights}
}}
"""
_LIGHT = """    def {kind} "{name}"
    {{
        custom float3 sehdr:lowerBound = {bound}
        custom float sehdr:shareOfLight = {share}
{deviation}        color3f inputs:color = {color}
        float inputs:intensity = {intensity}
        bool inputs:normalize = 0
{size}        matrix4d xformOp:transform = ( {rows} )
        uniform token[] xformOpOrder = ["xformOp:transform"]
    }}"""
_DOME = """    def DomeLight "Rest"
    {{
        custom float sehdr:inpaintedShare = {inpainted}
        color3f inputs:color = (1, 1, 1)
        float inputs:intensity = {intensity}
        asset inputs:texture:file = {asset}
        token inputs:texture:format = "latlong"
    }}"""


def write_lights(
    run: Run,
    path: Path | str,
    *,
    axes: str = "upright",
    up: str | None = None,
    scale: float | None = None,
    at: str | tuple[float, float, float] = "center",
    beyond: float | None = None,
    unseen: str = "inpaint",
    reference_white: float | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Write the lights of a scene; return the files.

    A light is a group of Gaussians that the photos clipped. With its size, its radiance gives the light that reaches
    the place `at` of it, so a lamp whose shade hides it from there is dimmer than in the table. A USD file has a
    SphereLight or RectLight for each, and a DomeLight for everything else: a map as write_environment_map() takes it at
    the same place, `<stem>_rest.exr`, in which the lights are dark. A sphere around the place stays in this map: within
    it gives no light. Alpha is the coverage by photos. If the unit of
    the run's light is known, lights and dome are in cd/m^2, as USD has them.

    Args:
        run: From load_run or train.
        path: .json, or .usda.
        axes: As in world_transform.
        up: As in world_transform.
        scale: As in world_transform.
        at: Place that is lit, as in write_environment_map(). Lights stay where they are.
        beyond: Distance within which everything is left out, as there.
        unseen: "inpaint": directions of the dome that no photo covers get the light around them, so that they do not
            darken what the dome lights. "black": they are black.
        reference_white: Value of the photos' white in the plates that the lights go with, as in render_views; lights
            and dome are then in the units of these plates, also if the unit of light is known.
        overwrite: Replace files that exist.

    Raises:
        SehdrError: For a suffix that is not known, or a scene that does not state what clipped.
        InputError: If a file exists.
    """
    require_loaded("load_run", run)
    path = path_of(path, "path")
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise SehdrError(f"{path}: lights are written as one of {', '.join(SUFFIXES)}; choose a suffix")
    if unseen not in UNSEEN:
        raise SehdrError(f"unseen {unseen!r} is not one of {', '.join(UNSEEN)}")
    check_beyond(beyond)
    rest = path.with_name(f"{path.stem}_rest.exr")
    files = [path] if suffix == ".json" else [path, rest]
    for file in files:
        check_absent(file, overwrite)
    if suffix == ".json" and unseen != "inpaint":
        raise SehdrError(f"{path}: unseen is for the map of a dome light, and .json has none; write .usda")
    transform = world_transform(run, axes, up=up, scale=scale)
    center = find_center(run, at, beyond, transform)
    factor, unit = exposure_for_white(run, reference_white), "relative radiance"
    if reference_white is not None:
        unit = f"white is {reference_white:g}"
    elif (luminance := luminance_of_one(run)) is not None:
        factor, unit = luminance, "cd/m^2"
        text = "%s: in cd/m^2; a value of 1 in plates is %.4g of them, and --reference-white puts all in one unit"
        log.info(text, path.name, luminance)
    units = f"{unit}, linear Rec.709"
    received = _received_at(run, center)
    visible = float(received.angles.sum()) / (4 * np.pi)
    if problem := little_visible(run, center, transform.points(center.position), visible):
        log.warning("%s", problem)
    lights = lights_as_received(run, run.find_lights(), center, received)
    if not lights:
        text = "%s: no lights, because no area that photos clip emits light; the map holds all light"
        log.warning(text, run.path)
    by_name = lights_by_name(lights)
    if inside := [name for name, light in by_name.items() if light.shape.surrounds(center.position)]:
        remains = "its light stays in the map of the rest" if suffix == ".usda" else "a sphere lights nothing within"
        log.warning("%s: the place that is lit lies within the sphere: %s", first_names(inside, 5), remains)
    if suffix == ".usda":
        by_name = {name: light for name, light in by_name.items() if name not in inside}
    rows = [_describe(name, light, transform, factor) for name, light in by_name.items()]
    if suffix == ".usda":
        inpainted = _write_rest(run, rest, list(by_name.values()), transform, axes, center, unseen, overwrite)
        mark = "@@@" if "@" in rest.name else "@"  # USD's quotes of a path
        asset = f"{mark}./{rest.name}{mark}"
        dome = _DOME.format(asset=asset, intensity=repr(float(factor)), inpainted=repr(inpainted))
        matrix = ", ".join(_tuple(row) for row in transform.matrix.T)  # USD's matrices act on row vectors.
        scene = json.dumps(run.scene_name, ensure_ascii=False)  # OpenUSD reads \u00e9 as u00e9.
        lines = "\n".join([*map(_usd, rows), dome])
        text = _STAGE.format(scene=scene, units=json.dumps(units), matrix=matrix, lights=lines)
    else:
        facts = {**provenance(run), "units": units, "axes": axes, "world_matrix": transform.matrix.tolist()}
        facts["lit_place"] = transform.points(center.position).tolist()
        text = json.dumps({**facts, "lights": rows}, indent=1)
    with atomic_path(path, overwrite) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return files


def _received_at(run: RenderableScene, center: MapCenter) -> ReceivedLight:
    focal = typical_focal_length(training_cameras(run))
    return received_light(run.field, center.position, focal, beyond=center.beyond, degree=run.degree)


def lights_as_received(
    run: RenderableScene, lights: Sequence[Light], center: MapCenter, received: ReceivedLight | None = None
) -> list[Light]:
    """Return lights with the radiance that gives, with their shapes, the light that a place receives of each.

    A lamp whose shade hides it from there becomes dimmer. A rectangle that faces away stays as it is. `received` is
    what the place receives, which is measured by default.
    """
    if received is None:
        received = _received_at(run, center)
    result = []
    for light in lights:
        angle, of_members = light.shape.solid_angle(center.position), received.angles[light.members, None]
        if angle > 0:
            # Radiance is converted, not what is received: sensor RGB is taken as white where it is above white.
            rec709 = run.in_rec709(received.light[light.members] / of_members.clamp_min(1e-20))
            radiance = (rec709 * of_members).sum(0).cpu().numpy() / angle
            gain = float(radiance.mean() / max(light.radiance.mean(), 1e-30))
            radiance *= min(1.0, MOST_GAIN / max(gain, 1e-30))
            bound = np.minimum(min(gain, 1.0) * light.lower_bound, radiance)
            light = replace(light, radiance=radiance, lower_bound=bound)
        elif np.linalg.norm(light.shape.position - center.position) < center.beyond:
            light = replace(light, radiance=np.zeros(3), lower_bound=np.zeros(3))
        result.append(light)
    return result


def lights_table(lights: Sequence[Any], unit: float | None = None, transform: WorldTransform | None = None) -> str:
    """Return lights as lines of text: name, share of the light, shape, radiance, how sure it is, place and size.

    Args:
        lights: As from find_lights().
        unit: cd/m^2 of a radiance of 1; None if it is not known.
        transform: To the coordinates of places and sizes; None for those of the scene.
    """
    if not lights:
        return "no lights: no area that photos clip emits light"
    transform = transform or WorldTransform.identity()
    unit_name = "radiance" if unit is None else "cd/m^2"
    lines = [f"name        share  shape  {unit_name:>10}  at least  +- stops  place, size"]
    for name, light in lights_by_name(lights).items():
        sides = light.shape.size[: 2 if light.shape.kind == "rect" else 1]
        size = " x ".join(f"{transform.scale * side:.3g}" for side in sides)
        place = ", ".join(f"{value:.3g}" for value in transform.points(light.shape.position))
        sure = "-" if light.deviation is None else f"{light.deviation:.2f}"
        radiances = (unit or 1.0) * np.mean([light.radiance, light.lower_bound], axis=1)
        figures = " ".join(f"{value:9.3g}" for value in radiances)
        name_and_share = f"{name:8} {100 * light.share:5.1f} %"
        lines.append(f"{name_and_share}  {light.shape.kind:6} {figures}  {sure:>8}  ({place}), {size}")
    return "\n".join([*lines, *uncertain_lights(lights_by_name(lights))])


def lights_by_name(lights: Sequence[Any]) -> dict[str, Any]:
    """Return lights, as from find_lights(), by their names."""
    return {light_name(index): light for index, light in enumerate(lights)}


def uncertain_lights(lights: Mapping[str, Any]) -> list[str]:
    """Return the sentences that name uncertain lights and what measures them; none without them."""
    unsure = {name: light for name, light in lights.items() if (light.deviation or 0) > UNCERTAIN}
    clipped = {name: light for name, light in unsure.items() if light.measured < 0.5}
    sentences = []
    if clipped:
        strongest = max(light.share for light in clipped.values())
        # Photos walk around a light without a share.
        strong = [light for light in clipped.values() if not light.share or light.share >= STRONG * strongest]
        radiance = float(np.max([light.radiance for light in strong]))
        bound = float(np.max([light.lower_bound for light in strong]))
        stops = max(1, math.ceil(math.log2(max(radiance, 1e-30) / max(bound, 1e-30))))
        guess = f"{first_names(list(clipped), 5)}: uncertain by more than {UNCERTAIN:g} stops where photos clip"
        remedy = f"three photos about {stops} stop{'s' * (stops > 1)} darker than the darkest that clip there"
        sentences.append(f"{guess}; {remedy} measure them")
    if names := [name for name in unsure if name not in clipped]:
        what = f"the scene differs by more than {UNCERTAIN:g} stops from darker photos, which do not clip there"
        sentences.append(f"{first_names(names, 5)}: {what}; more such photos, or more steps, may bring it closer")
    return sentences


def _describe(name: str, light: Any, transform: WorldTransform, unit: float) -> dict:
    """Return a light as plain values, in the coordinates and the unit of the file."""
    shape = light.shape
    return {
        "name": name,
        "shape": shape.kind,
        "position": transform.points(shape.position).tolist(),
        "axes": (shape.axes @ transform.rotation.T).tolist(),
        "size": [transform.scale * side for side in shape.size],
        "radiance": (unit * np.asarray(light.radiance, float)).tolist(),
        "lower_bound": (unit * np.asarray(light.lower_bound, float)).tolist(),
        "deviation_stops": light.deviation,
        "share_of_light": light.share,
    }


def _usd(row: dict) -> str:
    radiance = np.maximum(row["radiance"], 0)
    intensity = max(float(radiance.max()), 1e-12)
    width, height = row["size"]
    sphere = row["shape"] == "sphere"
    size = {"radius": width / 2} if sphere else {"width": width, "height": height}
    # USD's rectangles emit along -Z; matrices act on row vectors.
    across, upward, normal = np.array(row["axes"])
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([-across, upward, -normal])
    matrix[3, :3] = row["position"]
    deviation = row["deviation_stops"]
    return _LIGHT.format(
        kind="SphereLight" if sphere else "RectLight",
        name=row["name"],
        bound=_tuple(row["lower_bound"]),
        share=repr(float(row["share_of_light"])),
        deviation="" if deviation is None else f"        custom float sehdr:deviationStops = {deviation!r}\n",
        color=_tuple(radiance / intensity),
        intensity=repr(intensity),
        size="".join(f"        float inputs:{name} = {value!r}\n" for name, value in size.items()),
        rows=", ".join(_tuple(line) for line in matrix),
    )


def _tuple(values) -> str:
    return "(" + ", ".join(repr(float(value)) for value in values) + ")"


def _write_rest(
    run: Run,
    path: Path,
    lights: Sequence[Any],
    transform: WorldTransform,
    axes: str,
    center: MapCenter,
    unseen: str,
    overwrite: bool,
) -> float:
    """Write the map of a scene's surroundings, with the lights dark; arguments as in write_lights.

    Returns the share of the map's light that is filled in.
    """
    focal, members = typical_focal_length(training_cameras(run)), [light.members for light in lights]
    of_lights = torch.zeros(run.gaussian_count, device=run.device)
    for index in members:
        of_lights[index] = 1
    rest, whole = (
        render_map(run, center.position, MAP_SIZE, "latlong", transform.rotation, focal, **options)
        for options in (
            {"without": members, "beyond": center.beyond},
            {"shares": of_lights, "beyond": center.beyond},
        )
    )
    hdr, directions, weight = rest.hdr, latlong(MAP_SIZE) @ transform.rotation, solid_angles(MAP_SIZE, "latlong")
    assert whole.clipped is not None  # It is what `shares` is rendered to.
    # Dark lights are neither the light around them nor directions that no photo covers.
    source = np.where(whole.clipped > 0.5, 0, rest.alpha)
    inpainted = 0.0
    if unseen == "inpaint" and (source > COVERED).any():
        added = (1 - whole.alpha[..., None]) * inpainted_light(hdr, source, directions, weight)
        filled, total = (float((light.mean(2) * weight).sum()) for light in (added, hdr + added))
        inpainted = filled / max(total, 1e-30)
        figures = path.name, covered_percent(whole.alpha, weight), 100 * inpainted
        log.info("%s: photos cover %.0f %% of all directions; filled in: %.0f %% of the map's light", *figures)
        hdr = hdr + added
    write_multipart_exr(path, [map_part(run, hdr, rest.alpha, center, transform, axes)], overwrite=overwrite)
    return inpainted
