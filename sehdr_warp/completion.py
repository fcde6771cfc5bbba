"""The command line of `sehdr-warp completion`: what a shell needs to complete commands and flags."""

import os
from contextlib import suppress
from dataclasses import dataclass, field, make_dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from .arguments import MARKERS


@dataclass(frozen=True)
class Completion:
    """Print a script by which a shell completes commands and flags.

    bash: sehdr-warp completion bash > ~/.local/share/bash-completion/completions/sehdr-warp

    zsh: sehdr-warp completion zsh > DIR/_sehdr-warp, where DIR is in $fpath

    fish: sehdr-warp completion fish > ~/.config/fish/completions/sehdr-warp.fish
    """

    shell: tyro.conf.Positional[Literal["bash", "zsh", "fish", "tcsh"] | None] = None
    """Which shell; by default the one of $SHELL."""


def run_completion(asked: Completion) -> None:
    from .cli import PROGRAM, command_options

    own = Path(os.environ.get("SHELL", "bash")).name
    shell = asked.shell or (own if own in ("bash", "zsh", "fish", "tcsh") else "bash")
    # What every command takes; cli.py reads these flags before a command does.
    short = {"quiet": ["-q"], "verbose": None, "debug": None}
    common = [(name, Annotated[bool, tyro.conf.arg(aliases=of)], field(default=False)) for name, of in short.items()]
    commands = {}
    for name, options in command_options().items():
        commands[name] = make_dataclass(options.__name__, common, bases=(options,), frozen=True, kw_only=True)
        commands[name].__doc__ = options.__doc__
    asked_for = ["--tyro-write-completion", shell, "-"]
    with suppress(SystemExit):
        tyro.extras.subcommand_cli_from_dict(commands, prog=PROGRAM, args=asked_for, config=MARKERS)
