"""The command line of `sehdr-warp scenes`."""

import json
from dataclasses import dataclass


@dataclass(frozen=True)
class Scenes:
    """List the scenes that come with the package or a checkout of it, for train and load_scene."""

    json: bool = False
    """Print them as JSON."""


def run_scenes(asked: Scenes) -> None:
    """Prints the names; `embedded` alone is embedded:room."""
    from . import embedded_scenes

    names = [f"embedded:{name}" for name in embedded_scenes()]
    print(json.dumps(names) if asked.json else "\n".join(names))
