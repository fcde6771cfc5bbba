"""Options that several commands of this package share."""

from dataclasses import dataclass, fields
from typing import Any, Literal


@dataclass(frozen=True)
class WorldOptions:
    """Coordinates of the files."""

    axes: Literal["upright", "scene"] = "upright"
    """upright: +Y is up (in PLY -Y, as its viewers expect), the subject is in the middle. scene: the photos' own
    coordinates."""
    up: str | None = None
    """The scene's up direction in its own coordinates, if the photos do not show it: x,y,z, or an axis such as -y."""
    scale: float | None = None
    """Meters for each unit of the scene; by default as kept by the viewer, else 1."""


def changed_flags(options: Any) -> list[str]:
    """Return the flags of a dataclass of options whose values are not the default."""
    names = [field.name for field in fields(options) if getattr(options, field.name) != field.default]
    return ["--" + name.replace("_", "-") for name in names]
