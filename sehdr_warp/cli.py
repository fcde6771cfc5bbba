"""The command `sehdr-warp`: find the command, parse its options, call it, and print errors as one line.

A call: main() -> run_program() -> _run(), which sets the process up -> parse_command() -> the command's function.

Each command is a dataclass of options and a function that takes them, in the `commands` module of its package. To add
one, add a line to COMMANDS. A module is imported when its command runs, so nothing here imports torch.
"""

import os
import shutil
import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any, NamedTuple

from . import __version__
from .errors import SehdrError, UsageError, as_user_error, did_you_mean, flags_in_messages, visible

PROGRAM = "sehdr-warp"


class Command(NamedTuple):
    """Location of a command."""

    module: str  # Module below the package
    options: str  # Dataclass of its options; the first sentence of its docstring is the command's summary
    run: str  # Function that takes the options
    takes_argv: bool = False  # True if the function also takes the words of the command line


COMMANDS = {
    "train and use a scene": {
        "train": Command("training.commands", "Train", "run_train", takes_argv=True),
        "render": Command("output.commands", "Render", "run_render"),
        "view": Command("viewer.commands", "View", "run_view"),
        "eval": Command("evaluation.commands", "Evaluate", "run_evaluate"),
        "compare": Command("evaluation.commands", "Compare", "run_compare"),
        "report": Command("output.commands", "Report", "run_report"),
        "envmap": Command("output.commands", "EnvironmentMap", "run_environment_map"),
        "lights": Command("output.commands", "Lights", "run_lights"),
        "meter": Command("output.commands", "Meter", "run_meter"),
        "export": Command("output.export.commands", "Export", "run_export"),
        "mesh": Command("output.export.commands", "Mesh", "run_mesh"),
        "convert": Command("output.export.commands", "Convert", "run_convert"),
    },
    "choose and calibrate": {
        "presets": Command("runs.commands", "Presets", "run_presets"),
        "config": Command("runs.commands", "ShowConfig", "run_config"),
        "calibrate": Command("scene.commands", "Calibrate", "run_calibrate"),
        "responses": Command("scene.commands", "Responses", "run_responses"),
        "scenes": Command("scene.commands", "Scenes", "run_scenes"),
    },
    "other tools": {
        "check": Command("check.commands", "Check", "run_check"),
        "synth": Command("synth.commands", "Synth", "run_synth"),
        "completion": Command("completion", "Completion", "run_completion"),
    },
}
"""Every command by name, under the headings of the help."""
_COMMANDS = {name: command for group in COMMANDS.values() for name, command in group.items()}
_FILM = f"{PROGRAM} render RUN --cameras orbit --video orbit.mp4 writes a film, --out DIR pictures"
_RENAMED = {
    "panorama": f"the command is {PROGRAM} envmap",
    "resume": f"{PROGRAM} train --resume --out RUN continues a training",
    "continue": f"{PROGRAM} train --resume --out RUN continues a training",
    "demo": f"{PROGRAM} train embedded --preset demo --out RUN trains one; make demo, in a checkout, reports on it",
    "score": f"the command is {PROGRAM} eval FOLDER --truth SET",
    "orbit": _FILM,
    "film": _FILM,
    "video": _FILM,
    "share": f"{PROGRAM} export RUN --out scene.html writes a page to share",
    "brackets": f"{PROGRAM} render RUN --out DIR --evs=-4,-2,0,2,4 writes brackets",
    "hdri": f"the command is {PROGRAM} envmap",
    "bench": "it left the installed program; in a checkout, run python -m benchmarks",
}
"""Hints for commands of earlier versions, and for words that people expect to be commands."""
_WITHOUT_TORCH = {"presets", "config", "responses", "scenes", "completion"}
"""Commands that do not load torch, and so run in little address space."""
_MIN_ADDRESS_SPACE = 1536 << 20
"""Bytes below which native libraries fail to reserve memory and crash with confusing messages."""
_reserve = [bytearray(4 << 20)]  # Memory that is released to print an error when a command has run out of memory


def main(arguments: list[str] | None = None) -> None:
    """Run a command line and exit, see run_program().

    Args:
        arguments: the words after the program's name; by default those of this process.
    """
    run_program(_run, list(sys.argv[1:] if arguments is None else arguments), PROGRAM)


@flags_in_messages()
def run_program(run: Callable[[list[str]], None], words: list[str], program: str) -> None:
    """Call run(words) and exit; an error that the user can act on is one line that begins with `program`.

    Raises:
        SystemExit: with status 0 for success, 1 for an error that the user can act on, 2 for wrong usage, 130 for an
            interrupt, and 141 if nobody reads the output any more.
    """
    try:
        try:
            run(words)
        finally:
            sys.stdout.flush()
    except KeyboardInterrupt:
        _print_error(f"{program}: interrupted")
        sys.exit(130)
    except BrokenPipeError:
        # The reader has gone, as in `sehdr-warp ... | head`. Python's own flush at exit would fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
    except Exception as error:
        _reserve.clear()
        message = as_user_error(error)
        if message is None:
            raise
        if "--debug" in words:
            import traceback

            traceback.print_exc()
        _print_error(f"{program}: {str(message).removeprefix(program + ' ')}")
        sys.exit(2 if isinstance(message, UsageError) else 1)
    sys.exit(0)


def command_options() -> dict[str, type]:
    """Return the dataclass of options of every command, by the command's name."""
    return {name: _load(command)[0] for name, command in _COMMANDS.items()}


def parse_command(words: list[str]) -> tuple[Callable, Any]:
    """Parse a command line without the flags that all commands share.

    Returns:
        The function that runs the command, and its options.

    Raises:
        UsageError: for an unknown command, or options that cannot be parsed.
        SystemExit: after --help.
    """
    from .arguments import parse

    name, *rest = words
    if name in _RENAMED:
        raise UsageError(f"no command {name}: {_RENAMED[name]}")
    if name not in _COMMANDS:
        hint = did_you_mean(name, {*_COMMANDS, "--help", "--version"})
        raise UsageError(f"no command {name}{hint}; {PROGRAM} --help lists them")
    options, run = _load(_COMMANDS[name])
    return run, parse(options, rest, f"{PROGRAM} {name}")


def _run(argv: list[str]) -> None:
    """Set the process up and run a command line."""
    words = [word for word in argv if word not in ("-q", "--quiet", "--verbose", "--debug")]
    if words and words[0] in _COMMANDS and words[0] not in _WITHOUT_TORCH and not {"-h", "--help"} & {*words}:
        _check_address_space()
    from .process import calm_threads, check_working_directory

    check_working_directory()
    calm_threads()
    from .console import show_logs, stages_on_terminal
    from .quiet import silence_exit

    silence_exit()
    quiet, verbose = {"-q", "--quiet"} & {*argv}, "--verbose" in argv
    show_logs("warning" if quiet else "debug" if verbose else "info")
    if not words or words[0] in ("-h", "--help"):
        print(_help())
        return
    if words[0] == "--version":
        print(f"{PROGRAM} {__version__}")
        return
    if words[0] == "help":
        words = [*words[1:2], "--help"]
        if len(words) == 1:
            print(_help())
            return
    run, options = parse_command(words)
    with stages_on_terminal():
        if _COMMANDS[words[0]].takes_argv:
            run(options, argv)
        else:
            run(options)


def _check_address_space() -> None:
    """Raise SehdrError under a low `ulimit -v`, where native libraries would crash with confusing messages."""
    try:
        import resource
    except ImportError:
        return
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit == resource.RLIM_INFINITY:
        return
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # OpenBLAS reserves address space for each thread.
    if limit < _MIN_ADDRESS_SPACE:
        limits = f"{limit >> 20} MiB of address space, but needs at least {_MIN_ADDRESS_SPACE >> 20}"
        raise SehdrError(f"out of memory: this process is limited to {limits}; raise the limit (ulimit -v)")


def _load(command: Command) -> tuple[type, Callable]:
    """Import a command's dataclass of options and its function."""
    module = import_module(f".{command.module}", __package__)
    return getattr(module, command.options), getattr(module, command.run)


def _help() -> str:
    """Return the commands under their headings, each with its summary."""
    import textwrap

    width = max(40, min(shutil.get_terminal_size().columns, 100))
    lines = [f"usage: {PROGRAM} COMMAND ...", "", "Scene-linear HDR Gaussian scenes from photos of one exposure.", ""]
    for heading, group in COMMANDS.items():
        lines.append(f"{heading}:")
        for name, command in group.items():
            summary = _summary(command)
            lines += textwrap.wrap(summary, width, initial_indent=f"  {name:<12}", subsequent_indent=" " * 14)
        lines.append("")
    return (
        "\n".join(lines)
        + f"""
First try:  {PROGRAM} train embedded --out runs/first
{PROGRAM} COMMAND --help explains a command. Every command takes -q (quiet),
--verbose, and --debug (where an error comes from). There is also --version."""
    )


def _summary(command: Command) -> str:
    """Return the first sentence of a command's help, read from its source because imports take seconds."""
    import ast
    from pathlib import Path

    path = Path(__file__).parent.joinpath(*command.module.split(".")).with_suffix(".py")
    classes = (node for node in ast.parse(path.read_text(encoding="utf-8")).body if isinstance(node, ast.ClassDef))
    docstring = next(ast.get_docstring(node) for node in classes if node.name == command.options)
    return " ".join((docstring or "").split()).partition(". ")[0].removesuffix(".")


def _print_error(line: str) -> None:
    """Print a line on standard error, or nothing if nobody reads it."""
    try:
        print(visible(line), file=sys.stderr, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())
