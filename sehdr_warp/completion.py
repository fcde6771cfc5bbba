"""The command line of `sehdr-warp completion`: a script with which a shell completes commands and flags."""

import os
from contextlib import suppress
from dataclasses import dataclass, field, make_dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from .arguments import MARKERS

_SHELLS = ("bash", "zsh", "fish", "tcsh")
_COMMON_FLAGS = {"quiet": ["-q"], "verbose": None, "debug": None}
"""Flags that every command takes, with their short forms; cli.py reads them before the command does."""


@dataclass(frozen=True)
class Completion:
    """Print a script with which a shell completes commands and flags.

    bash: sehdr-warp completion bash > ~/.local/share/bash-completion/completions/sehdr-warp

    zsh: sehdr-warp completion zsh > DIR/_sehdr-warp, where DIR is in $fpath

    fish: sehdr-warp completion fish > ~/.config/fish/completions/sehdr-warp.fish

    Make the folder first if it is missing (mkdir -p).
    """

    shell: tyro.conf.Positional[Literal["bash", "zsh", "fish", "tcsh"] | None] = None
    """Which shell; by default the one of $SHELL."""


def run_completion(options: Completion) -> None:
    """Print the script."""
    from .cli import PROGRAM, command_options

    login_shell = Path(os.environ.get("SHELL", "bash")).name
    shell = options.shell or (login_shell if login_shell in _SHELLS else "bash")
    common = [
        (name, Annotated[bool, tyro.conf.arg(aliases=aliases)], field(default=False))
        for name, aliases in _COMMON_FLAGS.items()
    ]
    commands = {}
    for name, command in command_options().items():
        commands[name] = make_dataclass(command.__name__, common, bases=(command,), frozen=True, kw_only=True)
        commands[name].__doc__ = command.__doc__
    words = ["--tyro-write-completion", shell, "-"]
    with suppress(SystemExit):
        tyro.extras.subcommand_cli_from_dict(commands, prog=PROGRAM, args=words, config=MARKERS)
