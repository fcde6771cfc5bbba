"""The command line of `sehdr-warp completion`: what a shell needs to complete commands and flags."""

import functools
import operator
import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from .arguments import MARKERS


@dataclass(frozen=True)
class Completion:
    """Print a script by which a shell completes commands and flags.

    bash: sehdr-warp completion bash > ~/.local/share/bash-completion/completions/sehdr-warp
    zsh:  sehdr-warp completion zsh > DIR/_sehdr-warp, where DIR is in $fpath
    fish: sehdr-warp completion fish > ~/.config/fish/completions/sehdr-warp.fish
    """

    shell: tyro.conf.Positional[Literal["bash", "zsh", "fish", "tcsh"] | None] = None
    """Which shell; by default the one of $SHELL."""


def run_completion(asked: Completion) -> None:
    """Prints the script."""
    from .cli import PROGRAM, command_options

    own = Path(os.environ.get("SHELL", "bash")).name
    shell = asked.shell or (own if own in ("bash", "zsh", "fish", "tcsh") else "bash")
    choices = [Annotated[options, tyro.conf.subcommand(name)] for name, options in command_options().items()]
    commands = functools.reduce(operator.or_, choices)
    with suppress(SystemExit):
        tyro.cli(commands, prog=PROGRAM, args=["--tyro-write-completion", shell, "-"], config=MARKERS)
