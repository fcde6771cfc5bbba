"""The command `sehdr-warp`: finds the command, parses, calls, and says in one line what went wrong.

Each command is a dataclass of options and a function that takes it, in the `commands` module of its room; a new one is
a line of COMMANDS. Modules are imported by the commands that need them: nothing here needs torch.
"""

import os
import shutil
import sys
from collections.abc import Callable
from importlib import import_module

from . import __version__
from .errors import SehdrError, UsageError, did_you_mean, surroundings_told

PROGRAM = "sehdr-warp"
LEAST_COLUMNS = 40
COMMANDS = {
    "train and use a scene": {
        "train": ("training.commands", "Train", "run_train"),
        "render": ("output.commands", "Render", "run_render"),
        "view": ("viewer.commands", "View", "run_view"),
        "eval": ("evaluation.commands", "Evaluate", "run_evaluate"),
        "report": ("output.commands", "Report", "run_report"),
        "envmap": ("output.commands", "EnvironmentMap", "run_environment_map"),
        "export": ("output.commands", "Export", "run_export"),
        "convert": ("output.commands", "Convert", "run_convert"),
        "compare": ("evaluation.commands", "Compare", "run_compare"),
        "score": ("evaluation.commands", "Score", "run_score"),
    },
    "what there is to choose from": {
        "presets": ("training.commands", "Presets", "run_presets"),
        "config": ("training.commands", "ShowConfig", "run_config"),
        "calibrate": ("scene.commands", "Calibrate", "run_calibrate"),
        "responses": ("scene.commands", "Responses", "run_responses"),
        "scenes": ("scene.commands", "Scenes", "run_scenes"),
    },
    "measure and make": {
        "check": ("check.commands", "Check", "run_check"),
        "synth": ("synth.commands", "Synth", "run_synth"),
        "completion": ("completion", "Completion", "run_completion"),
    },
}
"""Every command, under the headings of the help: its module, dataclass of options, and the function that runs them."""
words_given: list[str] = []
"""The words of the command line that is run."""
_RENAMED = {
    "panorama": f"the command is {PROGRAM} envmap",
    "resume": f"{PROGRAM} train --resume --out RUN goes on with a training",
}
"""What to type for commands of earlier versions, and for words that people expect to be commands."""
_LIGHT = {"presets", "config", "responses", "scenes", "completion"}
"""Commands that load no torch."""
_LEAST_ADDRESS_SPACE = 1536 << 20
_reserve = [bytearray(4 << 20)]
"""Memory for the last words of a command that finds no more."""
_MODULES = {name: command for group in COMMANDS.values() for name, command in group.items()}


def main(arguments: list[str] | None = None) -> None:
    """Runs a command line and exits: 0 done, 1 an error the user can act on, 2 wrong usage, 130 interrupted, 141 nobody
    reads its output any more."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    words_given[:] = words
    try:
        try:
            _run([word for word in words if word != "--debug"])
        finally:
            sys.stdout.flush()
    except KeyboardInterrupt:
        _tell(f"{PROGRAM}: interrupted")
        sys.exit(130)
    except BrokenPipeError:
        # As of `sehdr-warp ... | head`; Python would complain again when it closes what nobody reads.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
    except Exception as error:
        _reserve.clear()
        told = surroundings_told(error)
        if told is None:
            raise
        if "--debug" in words:
            import traceback

            traceback.print_exc()
        _tell(f"{PROGRAM}: {str(told).removeprefix(PROGRAM + ' ')}")
        sys.exit(2 if isinstance(told, UsageError) else 1)
    sys.exit(0)


def command_options() -> dict[str, type]:
    """The dataclass of options of every command, by its name."""
    return {name: _load(name)[0] for name in _MODULES}


def _run(words: list[str]) -> None:
    from .process import calm_threads

    calm_threads()
    if shutil.get_terminal_size().columns < LEAST_COLUMNS:  # No table fits, and to try takes minutes.
        os.environ["COLUMNS"] = str(LEAST_COLUMNS)
    from .console import show_logs
    from .quiet import silence_exit

    silence_exit()
    quiet, verbose = {"-q", "--quiet"} & set(words), "--verbose" in words
    show_logs("warning" if quiet else "debug" if verbose else "info")
    words = [word for word in words if word not in ("-q", "--quiet", "--verbose")]
    if not words or words[0] in ("-h", "--help"):
        print(_help())
        return
    if words[0] == "--version":
        print(f"{PROGRAM} {__version__}")
        return
    run, options = parse_command(words)
    if words[0] not in _LIGHT:
        _check_address_space()
    run(options)


def _check_address_space() -> None:
    """Where libraries may not reserve what they ask for, they crash, or end the process with words of their own."""
    try:
        import resource
    except ImportError:
        return
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit == resource.RLIM_INFINITY:
        return
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # It reserves for each.
    if limit < _LEAST_ADDRESS_SPACE:
        told = f"{limit >> 20} MiB of address space, and {_LEAST_ADDRESS_SPACE >> 20} are the least"
        raise SehdrError(f"out of memory: this process is limited to {told}; raise the limit (ulimit -v)")


def parse_command(words: list[str]) -> tuple[Callable, object]:
    """The function that runs a command, and its options; raises UsageError, and SystemExit after --help."""
    from .arguments import parse

    name, *rest = words
    if name == "bench":
        program = " ".join(["python -m benchmarks", *rest])
        raise UsageError(f"bench is not part of the installed program; in a checkout, run {program}")
    if name in _RENAMED:
        raise UsageError(f"no command {name}: {_RENAMED[name]}")
    if name not in _MODULES:
        raise UsageError(f"no command {name}{did_you_mean(name, _MODULES)}; {PROGRAM} --help lists them")
    options, run = _load(name)
    return run, parse(options, rest, f"{PROGRAM} {name}")


def _load(name: str):
    module, options, run = _MODULES[name]
    found = import_module(f".{module}", __package__)
    return getattr(found, options), getattr(found, run)


def _help() -> str:
    """The commands under their headings, each with the first sentence of its help."""
    import textwrap

    width = min(shutil.get_terminal_size().columns, 100)
    lines = [f"usage: {PROGRAM} COMMAND ...", "", "Scene-linear HDR Gaussian scenes from photos of one exposure.", ""]
    for heading, group in COMMANDS.items():
        lines.append(f"{heading}:")
        for name, command in group.items():
            told = _summary(*command[:2])
            lines += textwrap.wrap(told, width, initial_indent=f"  {name:<12}", subsequent_indent=" " * 14)
        lines.append("")
    return (
        "\n".join(lines)
        + f"""
First try:  {PROGRAM} train embedded --out runs/first
{PROGRAM} COMMAND --help explains it. Every command takes -q (quiet),
--verbose, and --debug (where an error comes from). --version prints it."""
    )


def _summary(module: str, options: str) -> str:
    """The first sentence of a command's help, read from the source: importing every room takes seconds."""
    import ast
    from pathlib import Path

    source = Path(__file__).parent.joinpath(*module.split(".")).with_suffix(".py").read_text(encoding="utf-8")
    defined = next(node for node in ast.parse(source).body if isinstance(node, ast.ClassDef) and node.name == options)
    return " ".join((ast.get_docstring(defined) or "").split()).partition(". ")[0].removesuffix(".")


def _tell(line: str) -> None:
    try:
        print(line, file=sys.stderr, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())
