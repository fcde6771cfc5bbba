"""Command-line parsing with tyro, one-line usage errors, and lists of numbers."""

import ast
import dataclasses
import functools
import inspect
import io
import itertools
import math
import os
import re
import shutil
import textwrap
import typing
from collections.abc import Iterator
from contextlib import redirect_stderr, suppress

import tyro

from .errors import InputError, UsageError, did_you_mean

Options = typing.TypeVar("Options")
MIN_COLUMNS = 40
"""Columns of the narrowest terminal that help tables are laid out for; tyro takes minutes for a narrower one."""
_OTHER_NAMES = {
    **dict.fromkeys(("--max-steps", "--steps", "--max-num-iterations", "--num-iterations"), "--iterations"),
    **dict.fromkeys(("--output-dir", "--output-path", "--result-dir", "--model-path"), "--out"),
    **dict.fromkeys(("--data-factor", "--downscale-factor", "--resolution"), "--max-size"),
    "--test-every": "--holdout",
}
"""Flags of gsplat, nerfstudio and 3DGS, each with the flag of the same purpose here, which is spelled otherwise."""
MARKERS = (
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.OmitArgPrefixes,
    tyro.conf.DisallowNone,
    tyro.conf.PositionalMetavarFromFieldName,
)


def parse(options: type[Options], words: list[str], program: str) -> Options:
    """Parse the words of a command line into options.

    Args:
        options: a dataclass; its docstring and those of its fields are the help. A field may be a dataclass, whose
            fields form a group of the help; a TypedDict, whose fields are shown by --help-all alone; or a union of
            dataclasses, which are subcommands. A class attribute `removed_flags` may map flags of earlier versions
            to what to do instead.
        words: the words after the command.
        program: what stands before the words, such as `sehdr-warp train`.

    Raises:
        UsageError: for words that are not options, with the most similar option.
        SystemExit: after --help.
    """
    if shutil.get_terminal_size().columns < MIN_COLUMNS:
        os.environ["COLUMNS"] = str(MIN_COLUMNS)
    _mend_help(options)
    long_groups = {name: hint for name, hint in _hints(options).items() if typing.is_typeddict(_unwrap(hint))}
    if long_groups and "--help-all" in words:
        words = ["--help"]
    elif long_groups and {"-h", "--help"} & set(words):
        empty = dataclasses.field(default_factory=dict)
        group_hints = [(name, tyro.conf.Suppress[hint], empty) for name, hint in long_groups.items()]
        short = dataclasses.make_dataclass(options.__name__, group_hints, bases=(options,), frozen=True)
        short.__doc__ = options.__doc__
        try:
            tyro.cli(short, prog=program, args=["--help"], config=MARKERS)
        finally:
            print(f"{program} --help-all adds every field of the config, as --loss.ssim-weight 0.2.")
    _check_flags(options, words, program)
    output = io.StringIO()
    try:
        with redirect_stderr(output):
            return tyro.cli(options, prog=program, args=words, config=MARKERS)
    except SystemExit as end:
        if not end.code or not output.getvalue():  # After --help, or by a signal.
            raise
    raise UsageError(f"{_one_line(output.getvalue())}; see {program} --help")


def _check_flags(options: type, words: list[str], program: str) -> None:
    """Raise UsageError for words that are not a subcommand or a flag of the options."""
    if (commands := subcommands(options)) and words and not words[0].startswith("-"):
        if words[0] not in commands:
            hint = did_you_mean(words[0], commands) or f"; there are {', '.join(commands)}"
            raise UsageError(f"{program} {words[0]}: no such command{hint}")
        _check_flags(commands[words[0]], words[1:], f"{program} {words[0]}")
        return
    names, bare = {"--help", *flags(options)}, {"--" + name: metavar for name, metavar in positional(options).items()}
    bare |= {f"--{word.lower()}": metavar for metavar in bare.values() for word in metavar.split("|")}
    removed = getattr(options, "removed_flags", {})
    for word in words:
        flag = word.partition("=")[0].replace("_", "-")
        if not re.match(r"--[a-z]", flag) or flag in names:
            continue
        if flag in bare:
            raise UsageError(f"{program} takes {bare[flag]} without {flag}; see {program} --help")
        if flag in removed:
            raise UsageError(f"{flag} is gone: {removed[flag]}")
        # A mistyped part of a dotted flag (--los.clipping) is similar to the flag; a missing part (--clipping) is not.
        by_field = {name.rpartition(".")[2].removeprefix("--"): name for name in names if "." in name}
        if (own := _OTHER_NAMES.get(flag)) in names:
            unit = ", the longest side in pixels" if own == "--max-size" else ""
            raise UsageError(f"{program} has no {flag}, did you mean {own}{unit}?")
        hint = did_you_mean(flag, names) or (f", did you mean {by_field[flag[2:]]}?" if flag[2:] in by_field else "")
        raise UsageError(f"{program} has no {flag:.80}{hint or f'; see {program} --help'}")


def _hints(options: type) -> dict[str, typing.Any]:
    """Return the type hints of a dataclass with their annotations."""
    return typing.get_type_hints(options, include_extras=True)


def _unwrap(hint: typing.Any) -> typing.Any:
    """Return a type hint without its annotations."""
    return hint.__origin__ if typing.get_origin(hint) is typing.Annotated else hint


def subcommands(options: type) -> dict[str, type]:
    """Return the subcommands of options by name."""
    choices = (choice for hint in _hints(options).values() for choice in typing.get_args(_unwrap(hint)))
    commands = (choice for choice in choices if dataclasses.is_dataclass(_unwrap(choice)))
    return {
        mark.name: _unwrap(choice) for choice in commands for mark in choice.__metadata__ if getattr(mark, "name", 0)
    }


def flags(options: typing.Any) -> Iterator[str]:
    """Yield the flags of options, without those of their subcommands."""
    bare = positional(options)
    for name, hint in _hints(options).items():
        kind = _unwrap(hint)
        if name in bare:
            continue
        if dataclasses.is_dataclass(kind) or typing.is_typeddict(kind):
            yield from flags(kind)
        else:
            yield "--" + name.replace("_", "-")


def positional(options: typing.Any) -> dict[str, str]:
    """Return the names of the options that stand on a command line without a flag, each with its name in the help."""
    names = {}
    for name, hint in _hints(options).items():
        marks = getattr(hint, "__metadata__", ())
        if tyro.conf.Positional in marks:
            metavars = (getattr(mark, "metavar", None) for mark in marks)
            names[name] = next(filter(None, metavars), name.upper()).removesuffix(" ...")
    return names


def _mend_help(options: type) -> None:
    """Join the lines of each option's help, and leave out `(default: None)` and `(default: False)`.

    tyro breaks a docstring where the source does, and again where the terminal ends. Help may also be a comment on the
    option's line.
    """
    for field in dataclasses.fields(options) if dataclasses.is_dataclass(options) else ():
        owner = next(kind for kind in options.__mro__ if field.name in inspect.get_annotations(kind))
        hint = owner.__annotations__[field.name]
        for part in (hint, *typing.get_args(_unwrap(hint))):
            if dataclasses.is_dataclass(_unwrap(part)):
                _mend_help(_unwrap(part))
        if any(hasattr(mark, "help_behavior_hint") for mark in getattr(hint, "__metadata__", ())):
            continue
        empty = field.default in (None, False, (), "")
        config = tyro.conf.arg(help=_field_texts(owner).get(field.name), help_behavior_hint="" if empty else None)
        owner.__annotations__[field.name] = typing.Annotated[hint, config]


@functools.cache
def _field_texts(options: type) -> dict[str, str]:
    """Return the docstrings of a dataclass's fields, each as one line."""
    body = ast.parse(textwrap.dedent(inspect.getsource(options))).body[0]
    assert isinstance(body, ast.ClassDef)
    texts = {}
    for field, text in itertools.pairwise(body.body):
        match field, text:
            case ast.AnnAssign(target=ast.Name(name)), ast.Expr(ast.Constant(str(value))):
                texts[name] = " ".join(value.split())
    return texts


def _invalid_choice(match: re.Match) -> str:
    """Shorten tyro's message about an invalid choice.

    tyro lists the choices of an optional flag in any order, and with a None that nobody can type.
    """
    choices = ", ".join(sorted({*match[3].split(", ")} - {repr("None")}))
    return f"{match[2]} {match[1]}: not one of {choices}"


def _invalid_type(match: re.Match) -> str:
    """Shorten tyro's message about a value of the wrong type."""
    name = {"INT": "whole number", "FLOAT": "number"}.get(match[2], match[2])
    return f"{match[1]} {match[3]}: not a {name}"


_SHORTER = (
    (r"Missing value for argument '(\S+)'.*", r"\1 needs a value"),
    (r"invalid choice '(.*)' for argument '(\S+)'\. Expected one of \((.*?),?\) ?\.", _invalid_choice),
    (r"Error parsing (\S+): no type matching (.+) could be instantiated from \['(.*?)'\].*", _invalid_type),
    (r"Error parsing (\S+): .*: '(.*)'", r"\1 \2: not a number"),
    (r"Expected one of \{(.*)\} ?\.", r"needs one of \1"),
    (r"Unrecognized options: (.*)", r"\1: unexpected argument"),
)
"""Patterns of tyro's messages and shorter ones; a message that matches none is passed on as it is."""


def _one_line(text: str) -> str:
    """Return the message in a box that tyro printed, above its first rule, as one line."""
    title, *lines = re.sub(r"\x1b\[[0-9;]*m", "", text).splitlines() or [""]
    # The border takes two columns, drawn or blank; if it is blank, a rule follows the title.
    lines = [line[2:].rstrip(" │") for line in lines]
    lines = lines[not lines[0].strip("-") :]
    lines = list(itertools.takewhile(lambda line: not re.match("[-─]{4}", line), lines))
    if "Required options" in title:
        # Names are indented by four columns, their help by more.
        names = [line.strip() for line in lines if re.match(r" {4}\S", line)]
        return f"{lines[0].strip(' :').replace('Missing from ', '')} needs {', '.join(names)}"
    message = " ".join(" ".join(lines).split())
    shorter = (re.sub(pattern, by, message) for pattern, by in _SHORTER if re.fullmatch(pattern, message))
    return next(shorter, message)


def parse_numbers(flag: str, text: str, kind: type = float, minimum: float = -math.inf) -> tuple:
    """Return the numbers of a list such as 0.125,0.5,2.

    Args:
        flag: the flag that takes the list, for the error message.
        text: the list.
        kind: int or float.
        minimum: the least number that is allowed.

    Raises:
        InputError: for anything else, and for a number below the minimum.
    """
    with suppress(ValueError):
        values = tuple(kind(item) for item in text.split(","))
        if min(values) >= minimum:
            return values
    expected = "whole numbers" if kind is int else "numbers"
    expected += f" from {minimum:g}" if minimum > -math.inf else ""
    raise InputError(f"{flag} {text}", f"not {expected} separated by commas", f"write for example {flag}=1,2")


def parse_pairs(flag: str, text: str | None) -> dict[str, str] | None:
    """Return the pairs of a list such as partition=gpu,time=240; None for None.

    Raises:
        InputError: for anything else.
    """
    if text is None:
        return None
    pairs = {name: value for name, _, value in (item.partition("=") for item in text.split(","))}
    if not all(name and value for name, value in pairs.items()):
        example = f"write for example {flag}=partition=gpu"
        raise InputError(f"{flag} {text}", "not NAME=VALUE separated by commas", example)
    return pairs
