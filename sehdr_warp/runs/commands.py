"""The command lines of `sehdr-warp presets` and `config`."""

import json
from dataclasses import dataclass

from tyro.conf import Positional

from . import config_files as configs


@dataclass(frozen=True)
class Presets:
    """List the presets: what each is for, and what it costs."""

    json: bool = False  # Print them as JSON.


@dataclass(frozen=True)
class ShowConfig:
    """Print the whole config of a preset or a run, with the meaning of every field, as a TOML file."""

    which: Positional[str] = "default"  # A preset, a TOML file, or the folder of a run.
    diff: bool = False  # Only what differs from the default preset: a file that --preset takes.
    json: bool = False  # Print it as JSON.


def run_presets(args: Presets) -> None:
    """Print every preset with its purpose and cost."""
    names, purpose = configs.preset_names(), configs.preset_purpose
    rows = {name: {"purpose": purpose(name), "cost": _cost(configs.load_config(name))} for name in names}
    lines = (f"{name:<14}{row['purpose']}\n{'':<14}{row['cost']}" for name, row in rows.items())
    print(json.dumps(rows) if args.json else "\n".join(lines))


def run_config(args: ShowConfig) -> None:
    """Print a config."""
    from .run_folder import RunFolder

    folder = RunFolder(args.which)
    config = folder.read_config() if folder.config_file.is_file() else configs.load_config(args.which)
    print(json.dumps(config.model_dump()) if args.json else configs.config_as_toml(config, args.diff))


def _cost(config) -> str:
    """Describe the amount of work of a training."""
    planned = "steps planned from the photos, up to" if config.plan.enabled else "steps:"
    parts = {
        f"{planned} {config.schedule.iterations}": True,
        f"up to {config.densification.cap_max:,} Gaussians": True,
        f"{len(config.fusion.exposures)} brackets in every step": config.fusion.enabled,
        "a learned response": config.response.name == "learned",
        "needs HDR truth": config.loss.uses_hdr,
    }
    return "; ".join(part for part, holds in parts.items() if holds)
