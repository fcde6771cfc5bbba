"""The scenes that come with the package or lie beside it: `embedded`, and `embedded:NAME`."""

import os
from importlib import resources
from pathlib import Path

from ..errors import InputError, did_you_mean

_MARK = "transforms_train.json"


def is_embedded(path: Path | str) -> bool:
    """Whether this names an embedded scene, known or not, rather than a folder."""
    return str(path) == "embedded" or str(path).startswith("embedded:")


def embedded_scenes() -> tuple[str, ...]:
    """The names that load_scene("embedded:NAME") finds here: room always, the others in a checkout or $SEHDR_SCENES."""
    return tuple(sorted({path.parent.name for place in _places() for path in place.glob(f"*/{_MARK}")}))


def embedded_folder(path: str) -> Path:
    """The folder of `embedded` or `embedded:NAME`; InputError where it is not here."""
    name = str(path).partition(":")[2] or "room"
    if name in embedded_scenes():
        return next(place / name for place in _places() if (place / name / _MARK).is_file())
    known = embedded_scenes()
    present = ", ".join(f"embedded:{each}" for each in known)
    raise InputError(path, f"is not here{did_you_mean(name, known)}; present are {present}",
                     "get the repository's scenes/ and name it in SEHDR_SCENES, or render it with "
                     "sehdr-warp synth")  # fmt: skip


def _places() -> list[Path]:
    """Where scenes lie: in the package, in $SEHDR_SCENES, and in scenes/ beside a checkout's package."""
    package = Path(str(resources.files("sehdr_warp")))
    stated = os.environ.get("SEHDR_SCENES")
    return [package / "embedded", *([Path(stated)] if stated else []), package.parent / "scenes"]
