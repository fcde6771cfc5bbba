"""Configs as files and as flags, field by field, and what became of the fields of earlier versions."""

import json
import reprlib
import textwrap
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import reduce
from importlib import resources
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, Literal, TypedDict, get_args, get_origin

import tyro
from pydantic import BaseModel, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo
from tyro.constructors import PrimitiveConstructorSpec

from ..errors import InputError, did_you_mean
from ..files import read_text
from .config import Config, ConfigError

_LARGEST_FILE = 1 << 20
_REMEDY = "`sehdr-warp config` lists every field with its meaning"
_GONE = tomllib.loads((resources.files("sehdr_warp.runs") / "gone.toml").read_text(encoding="utf-8"))
RENAMED: dict[str, str] = _GONE.pop("renamed")
"""Fields of version 0.2, each with its name since version 0.3."""
GONE: dict[str, str] = {path: advice for advice, paths in _GONE.items() for path in paths}
"""Fields of earlier versions that no longer exist, each with what to do instead."""
_RENAMED_VALUES = {"densification.strategy": {"relocation": "mcmc", "gradient": "adc"}}


def preset_names() -> list[str]:
    """Names of the presets that ship with the package."""
    folder = resources.files("sehdr_warp.configs")
    return sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml"))


def preset_purpose(name: str) -> str:
    """What a preset is for: the first line of its file."""
    return read_text(_locate(name), _LARGEST_FILE).partition("\n")[0].strip("# .")


def load_config(
    preset: str | Path = "default", overrides: dict[str, Any] | None = None, flags: Mapping[str, str] | None = None
) -> Config:
    """The config of a preset or of a TOML file.

    Args:
        preset: a name of preset_names(), or a file.
        overrides: dotted field names and values that replace the file's, e.g. {"schedule.iterations": 500}.
        flags: what these are called in errors, where they are flags of a command line.

    Raises:
        InputError: with file, field and value, for what is missing, unknown or wrong.
    """
    config = config_from_dict(*_read(preset))
    return override_config(config, overrides or {}, "overrides", flags)


def as_config(config: object) -> Config | None:
    """A config in any of the forms that Training takes."""
    if config is None or isinstance(config, Config):
        return config
    if isinstance(config, str | Path):
        return load_config(config)
    if isinstance(config, Mapping):
        return override_config(Config(), dict(config), "overrides")
    raise InputError("config", f"is {type(config).__name__}", "give a preset's name, a dict of fields or a Config")


def override_config(
    config: Config, overrides: dict, source: Path | str = "the config", flags: Mapping[str, str] | None = None
) -> Config:
    """A config with some fields replaced, given as for load_config. Raises InputError that blames the override, by its
    flag where it has one, else as of `source`."""
    values = config.model_dump()
    for path, value in overrides.items():
        part, _, name = path.rpartition(".")
        table = values.setdefault(part, {}) if part else values
        if not isinstance(table, dict):
            raise InputError(path, f"{part} is a field, not a table", _REMEDY)
        table[name] = value
    return config_from_dict(values, source, flags)


def config_as_toml(config: Config, differing: bool = False) -> str:
    """A config as a TOML file: every field with its meaning, and marked where it is not the default's; or, differing,
    just these, which load_config takes."""
    lines, table = ['base = "default"'] if differing else [], ""
    for path, item in config_fields():
        part, _, name = path.rpartition(".")
        value = attrgetter(path)(config)
        if differing and value == item.default:
            continue
        if part != table:
            lines += ["", f"[{part}]"]
            table = part
        if not differing:
            told = " ".join((item.description or "").split())
            lines += textwrap.wrap(told, 116, initial_indent="# ", subsequent_indent="# ")
        changed = "" if differing or value == item.default else f"  # default: {json.dumps(item.default)}"
        # JSON's strings, numbers, booleans and lists are TOML's as well.
        lines.append(f"{name} = {json.dumps(value)}{changed}")
    return "\n".join(lines)


def value_of(path: str, text: str):
    """A field's value as written behind its flag, lists separated by commas; what is none stays text, of which the
    config says what it takes in its place."""
    kind: Any = dict(config_fields())[path].annotation
    given = [item for item in map(str.strip, text.split(",")) if item] if get_origin(kind) is tuple else text
    with suppress(ValidationError):
        return TypeAdapter(kind).validate_python(given)
    return given


def config_from_dict(values: dict, source: Path | str = "config", flags: Mapping[str, str] | None = None) -> Config:
    """The config of nested values, as its model_dump() gives them and JSON holds them. Raises InputError that blames a
    field by its flag, else as of `source`, and says of one of an earlier version what to do."""
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        path, problem = field_and_problem(error)
    except ConfigError as error:
        path, problem = "", str(error)
    flag = (flags or {}).get(path)
    if flag is None and flags and not path:  # Fields that contradict each other: the first that was named.
        flag = next((flag for path, flag in flags.items() if path in problem), None)
    if path in GONE:
        raise InputError(source, f"{problem} of an earlier version is gone", GONE[path])
    if path in RENAMED:
        raise InputError(source, f"{problem} has another name since version 0.3", f"write {RENAMED[path]}")
    raise InputError(flag or source, problem, _REMEDY)


def field_and_problem(found: ValidationError) -> tuple[str, str]:
    """The first field that is wrong, and `field = value: what is allowed`; of an unknown one, what is near."""
    error = found.errors()[0]
    path, value = ".".join(str(part) for part in error["loc"] if isinstance(part, str)), error["input"]
    unknown = error["type"] == "extra_forbidden"
    if unknown and isinstance(value, dict) and value:
        name, value = next(iter(value.items()))
        path += f".{name}"
    value = f"{path or 'the config'} = {reprlib.repr(value)}"
    if path in GONE or path in RENAMED:
        return path, value
    names = _RENAMED_VALUES.get(path, {})
    if isinstance(error["input"], str) and error["input"] in names:
        return path, f"{value} has another name since version 0.3: {names[error['input']]!r}"
    if unknown:
        return path, f"unknown field {value}{did_you_mean(path, (name for name, _ in config_fields()))}"
    return path, f"{value}: {error['msg'][0].lower()}{error['msg'][1:]}"


def _read(preset: str | Path) -> tuple[dict, Path]:
    """The values of a file on top of those of its bases, and its path."""
    path, chain = _locate(preset), {}
    while path is not None:
        if path in chain:
            raise InputError(path, "its bases lead back to itself", "remove the key `base` from one of the files")
        try:
            values = chain[path] = tomllib.loads(read_text(path, _LARGEST_FILE))
        except (ValueError, RecursionError) as error:
            raise InputError(path, f"not valid TOML ({error})", _REMEDY) from None
        base = values.pop("base", None)
        if not isinstance(base, str | None):
            raise InputError(path, f"base = {base!r} is not a name", f"use one of {preset_names()}, or a file")
        path = None if base is None else _locate(base, beside=path.parent)
    return reduce(_merged, reversed(chain.values())), next(iter(chain))


def _locate(preset: str | Path, beside: Path | None = None) -> Path:
    if str(preset) in preset_names():
        return Path(str(resources.files("sehdr_warp.configs") / f"{preset}.toml"))
    path = Path(preset) if beside is None else beside / preset
    with suppress(OSError, ValueError):  # A name that no file can have.
        if path.is_file():
            return path
    problem = f"no such preset or file{did_you_mean(str(preset), preset_names())}"
    raise InputError(str(preset)[:200], problem, f"use one of {', '.join(preset_names())}, or a TOML file")


def _merged(below: dict, above: dict) -> dict:
    both = {key for key in above if isinstance(above[key], dict) and isinstance(below.get(key), dict)}
    return below | above | {key: below[key] | above[key] for key in both}


def config_fields(kind: Any = Config, prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """Dotted name and declaration of every field, those of the config itself first."""
    tables = {name: item for name, item in kind.model_fields.items() if isinstance(item.annotation, type(BaseModel))}
    yield from ((prefix + name, item) for name, item in kind.model_fields.items() if name not in tables)
    for name, item in tables.items():
        yield from config_fields(item.annotation, f"{prefix}{name}.")


def flag_of(path: str) -> str:
    """The flag of a field: `--loss.ssim-weight` for loss.ssim_weight."""
    return "--" + path.replace("_", "-")


def flags_type() -> type:
    """A TypedDict of every field, for tyro: nothing but what was named is in it, as text."""
    tables: dict[str, dict[str, Any]] = {}
    for path, item in config_fields():
        if path == "seed":  # A flag of its own, in every help.
            continue
        # Arguments, how help calls them, and text as it is in both directions.
        text = lambda words: words[0], lambda value: isinstance(value, str), lambda value: [value]
        spec = PrimitiveConstructorSpec(1, _metavar(item.annotation), *text)
        told = tyro.conf.arg(
            help=" ".join((item.description or "").split()), help_behavior_hint=f"(default: {_shown(item.default)})"
        )
        tables.setdefault(path.rpartition(".")[0], {})[path] = Annotated[str, spec, told]
    parts = {
        part: Annotated[TypedDict(part, fields, total=False), tyro.conf.arg(name=part)]  # type: ignore[misc]
        for part, fields in tables.items()
        if part
    }
    return TypedDict("Fields", {**tables.get("", {}), **parts}, total=False)  # type: ignore[misc]


def named_fields(values: dict) -> dict[str, str]:
    """The flat names and texts of what flags_type() read."""
    found: dict[str, str] = {}
    for name, value in values.items():
        found |= named_fields(value) if isinstance(value, dict) else {name: value}
    return found


def _shown(value) -> str:
    """A field's value as its flag takes it."""
    if isinstance(value, tuple):
        value = ",".join(map(str, value))
    return str(value).lower() if isinstance(value, bool) else f"{value}" or "none"


def _metavar(kind) -> str:
    if get_origin(kind) is Literal:
        return "|".join(get_args(kind))
    if get_origin(kind) is Annotated:
        return _metavar(get_args(kind)[0])
    if get_origin(kind) is tuple:
        return f"{_metavar(get_args(kind)[0])},..."
    return {bool: "true|false", int: "INT", float: "NUM"}.get(kind, "TEXT")
