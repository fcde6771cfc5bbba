"""The unit of a scene's light: how many cd/m^2 a radiance of 1 is, from one reading of a meter or a grey card.

Photos determine radiance up to a factor, so one reading at one place makes the light of the whole scene absolute. It is
kept with the run; files then state it, and lights are written in cd/m^2.
"""

import logging
import math
from dataclasses import asdict, dataclass
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...errors import InputError, SehdrError, require_loaded
from ...files import read_json, write_json
from ...json_values import damage, number, numbers, text
from ...runs.values import LIGHT_UNIT_FILE
from ..cameras.scene_cameras import find_view
from ..images.tonemap import LUMINANCE

if TYPE_CHECKING:
    from ...runs.run import RenderableScene

log = logging.getLogger(__name__)
GREY_CARD = 0.18  # Reflectance of a photographer's grey card
EFFICACY = 179.0  # Lumens for each watt by which Radiance's files state luminance (its constant WHTEFFICACY)
_RANGE = 1e-9, 1e12  # cd/m^2 of one unit that can be
_CLIPPED = 0.1  # Share of clipped values at the reading's place from which its light is an estimate


@dataclass(frozen=True)
class LightUnit:
    """Luminance of a radiance of 1."""

    luminance: float
    view: str
    pixel: tuple[float, float]
    reading: str

    def __str__(self) -> str:
        """Return a line of text."""
        x, y = self.pixel
        return f"a radiance of 1 is {self.luminance:.4g} cd/m^2 ({self.reading} at {x:g},{y:g} of {self.view})"


def read_light_unit(run: "RenderableScene") -> LightUnit | None:
    """Return the unit that is kept with a run; None if there is none, for a file of Gaussians, or during a training.

    Raises:
        InputError: If the file is damaged.
    """
    folder = getattr(run, "path", None)
    if folder is None or not (path := Path(folder) / LIGHT_UNIT_FILE).is_file():
        return None
    values = read_json(path)
    try:
        x, y = numbers(values, "pixel", 2).tolist()
        luminance = _check(number(values, "luminance"))
        unit = LightUnit(luminance, text(values, "view"), (x, y), text(values, "reading"))
    except (SehdrError, KeyError, ValueError) as error:
        remedy = "delete the file, or take the reading again with `sehdr-warp meter`"
        problem = str(error) if isinstance(error, SehdrError) else damage(error)
        raise InputError(path, f"cannot be used ({problem})", remedy) from None
    return unit


def luminance_of_one(run: "RenderableScene") -> float | None:
    """Return cd/m^2 of a radiance of 1; None if it is not known."""
    unit = read_light_unit(run)
    return None if unit is None else unit.luminance


def meter(
    run: "RenderableScene",
    view: str,
    pixel: tuple[float, float],
    *,
    luminance: float | None = None,
    illuminance: float | None = None,
    reflectance: float = GREY_CARD,
    area: int = 5,
) -> LightUnit:
    """Set the unit of a run's light by a reading at a place of a view, keep it with the run and return it.

    Args:
        run: From load_run or train.
        view: Name of one of its views.
        pixel: x and y from the upper left corner, in the size that the run has the view in.
        luminance: Reading of a spot meter at that place, cd/m^2.
        illuminance: Reading of a lux meter on a matte surface there, such as a grey card.
        reflectance: Of that surface.
        area: Side of the square, in pixels, whose mean light is compared.

    Raises:
        TypeError: For a reading that is not a number.
        SehdrError: For a view or place that is not there, or values that cannot be.
    """
    require_loaded("load_run", run)
    entry = find_view(run, view)
    view, camera = entry.name, entry.camera
    try:
        x, y = map(float, pixel)
    except (TypeError, ValueError):
        raise SehdrError(f"pixel {pixel!r:.60} is not two numbers, x and y") from None
    for name, value in {"luminance": luminance, "illuminance": illuminance, "reflectance": reflectance}.items():
        if not isinstance(value, Real | None):
            raise TypeError(f"{name} is {value!r:.60}, expected a number")
    if not isinstance(area, Integral) or area < 1:
        raise SehdrError(f"area {area!r:.60} is not a number of pixels, 1 or more")
    if (luminance is None) == (illuminance is None):
        raise SehdrError("a reading is one of luminance, in cd/m^2, and illuminance, in lux")
    if luminance is not None and reflectance != GREY_CARD:
        raise SehdrError("a reflectance is that of a surface whose illuminance was read; a luminance needs none")
    if not 0 < reflectance <= 1:
        raise SehdrError(f"reflectance {reflectance:g} is not above 0 and at most 1; a grey card has {GREY_CARD}")
    if not (0 <= x < camera.width and 0 <= y < camera.height):
        size = f"{camera.width} x {camera.height}"
        raise SehdrError(f"pixel {x:g},{y:g} is outside of view {view}, which has {size} pixels in this run")
    if luminance is not None:
        reading, light = f"{luminance:g} cd/m^2", luminance
    else:
        assert illuminance is not None
        reading = f"{illuminance:g} lx on a reflectance of {reflectance:g}"
        light = illuminance * reflectance / math.pi
    if not (math.isfinite(light) and light > 0):
        raise SehdrError(f"a reading of {reading} is not a positive number")
    rows, columns = (slice(max(0, int(c) - area // 2), int(c) + (area + 1) // 2) for c in (y, x))
    rendered = float(run.render(camera).hdr.cpu().numpy()[rows, columns].mean((0, 1)) @ LUMINANCE)
    if rendered <= 0:
        raise SehdrError(f"the scene is black at {x:g},{y:g} of {view}; read a brighter place")
    clipped = run.render_clipped(camera)
    if clipped is not None and float(clipped[rows, columns].mean()) > _CLIPPED:
        log.warning("photos clip at %g,%g of %s: its light is an estimate; read a darker place", x, y, view)
    unit = LightUnit(_check(light / rendered), view, (float(x), float(y)), reading)
    write_json(Path(run.path) / LIGHT_UNIT_FILE, asdict(unit), internal=True)
    return unit


def _check(luminance: Any) -> float:
    if not isinstance(luminance, int | float) or not _RANGE[0] <= luminance <= _RANGE[1]:
        raise SehdrError(f"luminance {luminance} is not between {_RANGE[0]:g} and {_RANGE[1]:g} cd/m^2")
    return float(luminance)
