"""What the command lines of all rooms share: parsing with tyro, refusals in one line, and lists of numbers."""

import dataclasses
import inspect
import io
import itertools
import math
import re
import typing
from collections.abc import Iterator
from contextlib import redirect_stderr, suppress

import tyro

from .errors import InputError, UsageError, did_you_mean

Options = typing.TypeVar("Options")
MARKERS = (
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.OmitArgPrefixes,
    tyro.conf.DisallowNone,
    tyro.conf.PositionalMetavarFromFieldName,
)


def parse(options: type[Options], words: list[str], program: str) -> Options:
    """The options that the words of a command line state.

    options: a dataclass; its docstring and its fields' are the help. A field may be a dataclass, whose fields form a
    group of the help, a TypedDict, whose fields are in --help-all alone, or a union of dataclasses, which are
    subcommands. A class attribute `gone` may say of flags of earlier versions what to do now.
    program: what stands before the words, such as `sehdr-warp train`.

    Raises UsageError, with the nearest right word, for one that is no option, and SystemExit after --help.
    """
    _hide_empty_defaults(options)
    details = {name: hint for name, hint in _hints(options).items() if typing.is_typeddict(_plain(hint))}
    if details and "--help-all" in words:
        words = ["--help"]
    elif details and {"-h", "--help"} & set(words):
        none = dataclasses.field(default_factory=dict)
        hidden = [(name, tyro.conf.Suppress[hint], none) for name, hint in details.items()]
        short = dataclasses.make_dataclass(options.__name__, hidden, bases=(options,), frozen=True)
        short.__doc__ = options.__doc__
        try:
            tyro.cli(short, prog=program, args=["--help"], config=MARKERS)
        finally:
            print(f"{program} --help-all adds every field of the config, as --loss.ssim-weight 0.2.")
    _check_flags(options, words, program)
    told = io.StringIO()
    try:
        with redirect_stderr(told):
            return tyro.cli(options, prog=program, args=words, config=MARKERS)
    except SystemExit as end:
        if not end.code:
            raise
    raise UsageError(f"{_one_line(told.getvalue())}; see {program} --help")


def _check_flags(options: type, words: list[str], program: str) -> None:
    """Refuses words that are no subcommand or no flag of the options."""
    if (below := subcommands(options)) and words and not words[0].startswith("-"):
        if words[0] not in below:
            hint = did_you_mean(words[0], below) or f"; there are {', '.join(below)}"
            raise UsageError(f"{program} {words[0]}: no such command{hint}")
        _check_flags(below[words[0]], words[1:], f"{program} {words[0]}")
        return
    known, bare = {"--help", *flags(options)}, {"--" + name for name in positional(options)}
    for word in words:
        flag = word.partition("=")[0].replace("_", "-")
        if not re.match(r"--[a-z]", flag) or flag in known:
            continue
        if flag in bare:
            raise UsageError(f"{program} takes {flag[2:].upper()} without {flag}; see {program} --help")
        if flag in getattr(options, "gone", {}):
            raise UsageError(f"{flag} is gone: {options.gone[flag]}")
        # A field's own name is nearer than its part's: --los.clipping, --clipping.
        tails = {name.rpartition(".")[2].removeprefix("--"): name for name in known if "." in name}
        hint = did_you_mean(flag, known) or (f", did you mean {tails[flag[2:]]}?" if flag[2:] in tails else "")
        raise UsageError(f"{program} has no {flag}{hint or f'; see {program} --help'}")


def _hints(options: type) -> dict[str, typing.Any]:
    return typing.get_type_hints(options, include_extras=True)


def _plain(hint) -> typing.Any:
    return hint.__origin__ if typing.get_origin(hint) is typing.Annotated else hint


def subcommands(options: type) -> dict[str, type]:
    """The subcommands of options by name."""
    choices = (choice for hint in _hints(options).values() for choice in typing.get_args(_plain(hint)))
    below = (choice for choice in choices if dataclasses.is_dataclass(_plain(choice)))
    return {mark.name: _plain(choice) for choice in below for mark in choice.__metadata__ if getattr(mark, "name", 0)}


def flags(options: typing.Any) -> Iterator[str]:
    """The flags of options, without those of their subcommands."""
    without = set(positional(options))
    for name, hint in _hints(options).items():
        kind = _plain(hint)
        if name in without:
            continue
        if dataclasses.is_dataclass(kind) or typing.is_typeddict(kind):
            yield from flags(kind)
        else:
            yield "--" + name.replace("_", "-")


def positional(options: typing.Any) -> list[str]:
    """The options that stand on a command line without a flag."""
    return [name for name, hint in _hints(options).items() if tyro.conf.Positional in getattr(hint, "__metadata__", ())]


def _hide_empty_defaults(options: type) -> None:
    """Leaves `(default: None)` and `(default: False)`, which say nothing, out of the help of options."""
    for field in dataclasses.fields(options) if dataclasses.is_dataclass(options) else ():
        owner = next(kind for kind in options.__mro__ if field.name in inspect.get_annotations(kind))
        hint = owner.__annotations__[field.name]
        for part in (hint, *typing.get_args(_plain(hint))):
            if dataclasses.is_dataclass(_plain(part)):
                _hide_empty_defaults(_plain(part))
        marks = getattr(hint, "__metadata__", ())
        if field.default in (None, False, (), "") and not any(hasattr(mark, "help_behavior_hint") for mark in marks):
            quiet = tyro.conf.arg(help_behavior_hint="")
            owner.__annotations__[field.name] = typing.Annotated[hint, quiet]


def _sorted_choices(match: re.Match) -> str:
    """A refused choice; of a flag that need not be given, tyro lists them in any order, with a None that none types."""
    return f"{match[2]} {match[1]}: is none of {', '.join(sorted({*match[3].split(', ')} - {repr('None')}))}"


# What tyro says, and the same in fewer words; a text in none of these forms is passed on as it is.
_SHORTER = (
    (r"Missing value for argument '(\S+)'.*", r"\1 needs a value"),
    (r"invalid choice '(.*)' for argument '(\S+)'\. Expected one of \((.*?),?\) ?\.", _sorted_choices),
    (r"Error parsing (\S+): no type matching (.+) could be instantiated from \['(.*?)'\].*", r"\1 \3: is no \2"),
    (r"Error parsing (\S+): .*: '(.*)'", r"\1 \2: is no number"),
    (r"Expected one of \{(.*)\} ?\.", r"needs one of \1"),
    (r"Unrecognized options: (.*)", r"\1: more than is asked for"),
)


def _one_line(told: str) -> str:
    """What tyro says in a box, above the first rule, as one line."""
    title, *lines = re.sub(r"\x1b\[[0-9;]*m", "", told).splitlines() or [""]
    # Two columns of border, drawn or blank; without drawing there is a rule below the title.
    lines = [line[2:].rstrip(" │") for line in lines]
    lines = lines[not lines[0].strip("-") :]
    lines = list(itertools.takewhile(lambda line: not re.match("[-─]{4}", line), lines))
    if "Required options" in title:
        # Names stand four columns in, their help deeper.
        names = [line.strip() for line in lines if re.match(r" {4}\S", line)]
        return f"{lines[0].strip(' :').replace('Missing from ', '')} needs {', '.join(names)}"
    text = " ".join(" ".join(lines).split())
    shorter = (re.sub(pattern, said, text) for pattern, said in _SHORTER if re.fullmatch(pattern, text))
    return next(shorter, text)


def numbers(flag: str, text: str, kind: type = float, least: float = -math.inf) -> tuple:
    """The numbers of a list such as 0.125,0.5,2; raises InputError, with the flag, for anything else and for a number
    below `least`."""
    with suppress(ValueError):
        found = tuple(kind(item) for item in text.split(","))
        if min(found) >= least:
            return found
    wanted = "whole numbers" if kind is int else "numbers"
    wanted += f" from {least:g}" if least > -math.inf else ""
    raise InputError(f"{flag} {text}", f"not {wanted} separated by commas", f"write for example {flag}=1,2")


def positive(flag: str, value):
    """The value, if it is above 0; raises InputError, with the flag, if it is not."""
    if not value > 0:
        raise InputError(f"{flag} {value}", "not positive", "give a number above 0")
    return value
