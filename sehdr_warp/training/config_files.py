"""Configs as files: TOML presets and overrides in, JSON beside the run out."""

import json
import reprlib
import textwrap
import tomllib
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic import ValidationError

from ..errors import InputError, did_you_mean
from ..files import read_json, read_text
from .config import Config, ConfigError
from .config_fields import GONE, config_fields

_LARGEST_FILE = 1 << 20
_REMEDY = "`sehdr-warp config` lists every field with its meaning"


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
        preset: a name of preset_names(), or the path of a TOML file.
        overrides: dotted field names and values that replace the file's, e.g. {"schedule.iterations": 500}.
        flags: what overrides are called in errors, where they are flags of a command line.

    Raises:
        InputError: naming file, field and value for a missing file, bad TOML, an unknown field, a wrong type or a value
            out of range.
    """
    source, values = _read(preset)
    _build(source, values)
    return _override("overrides", values, overrides or {}, flags)


def override_config(
    config: Config, overrides: dict, source: Path | str = "the config", flags: Mapping[str, str] | None = None
) -> Config:
    """A config with some fields replaced, given as for load_config; `source` names it in errors. Raises InputError."""
    return _override(source, config_to_dict(config), overrides, flags)


def config_as_toml(config: Config, differing: bool = False) -> str:
    """A config as a TOML file: every field with its meaning, and marked where it is not the default's; or, differing,
    just these, which load_config takes."""
    lines: list[str] = ['base = "default"'] if differing else []
    table = ""
    for path, item in config_fields():
        part, _, name = path.rpartition(".")
        value = getattr(getattr(config, part) if part else config, name)
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
    """A field's value as it was written behind its flag; the config then checks it.

    Text stands as it is, lists are separated by commas, and everything else is written as in TOML.
    """
    kind = dict(config_fields())[path].annotation
    if get_origin(kind) is tuple:
        return [_one_value(get_args(kind)[0], item) for item in map(str.strip, text.split(",")) if item]
    return _one_value(kind, text)


def _one_value(kind, text: str):
    kind = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    return text if kind is str or get_origin(kind) is Literal else toml_value(text)


def toml_value(text: str):
    """A value written as in TOML; what is no TOML is taken as a plain word."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def config_to_dict(config: Config) -> dict:
    """Plain nested values; config_from_dict reads them back exactly, through JSON as well."""
    return config.model_dump()


def config_from_dict(values: dict, source: Path | str = "config") -> Config:
    """The config that config_to_dict described; `source` names it in errors. Raises InputError."""
    return _build(source, values)


def read_config_json(path: Path) -> Config:
    """The config saved with a run; raises InputError."""
    return _build(path, read_json(path))


def _read(preset: str | Path) -> tuple[Path, dict]:
    """The file's path and its values on top of those of its base, bases first."""
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
            remedy = f"use one of {', '.join(preset_names())}, or a file"
            raise InputError(path, f"base = {base!r} is not a name", remedy)
        path = None if base is None else _locate(base, beside=path.parent)
    merged: dict = {}
    for values in reversed(chain.values()):
        _merge(merged, values)
    return next(iter(chain)), merged


def _locate(preset: str | Path, beside: Path | None = None) -> Path:
    if str(preset) in preset_names():
        return Path(str(resources.files("sehdr_warp.configs") / f"{preset}.toml"))
    path = Path(preset) if beside is None else beside / preset
    try:
        found = path.is_file()
    except (OSError, ValueError):  # A name that no file can have.
        found = False
    if not found:
        problem = f"no such preset or file{did_you_mean(str(preset), preset_names())}"
        raise InputError(str(preset)[:200], problem, f"use one of {', '.join(preset_names())}, or a TOML file")
    return path


def _override(source: Path | str, values: dict, overrides: dict, flags: Mapping[str, str] | None) -> Config:
    """Values with others in their place. Raises InputError that blames the override, by its flag where it has one."""
    for path, value in overrides.items():
        *parents, leaf = path.split(".")
        table = values
        for parent in parents:
            table = table.setdefault(parent, {})
            if not isinstance(table, dict):
                raise InputError(path, f"{parent} is a field, not a table", _REMEDY)
        table[leaf] = value
    return _build(source, values, flags)


def _merge(into: dict, values: dict) -> None:
    for key, value in values.items():
        if isinstance(value, dict) and isinstance(into.get(key), dict):
            _merge(into[key], value)
        else:
            into[key] = value


def _build(source: Path | str, values: dict, flags: Mapping[str, str] | None = None) -> Config:
    try:
        return Config.model_validate(_with_tuples(values))
    except ValidationError as error:
        path, problem = _problem(error.errors()[0])
    except ConfigError as error:
        path, problem = "", str(error)
    flag = (flags or {}).get(path)
    if flag is None and flags and not path:  # Fields that contradict each other: the first that was named.
        flag = next((flag for path, flag in flags.items() if path in problem), None)
    if path in GONE:
        raise InputError(source, f"{problem} of an earlier version is gone", GONE[path])
    raise InputError(flag or source, problem, _REMEDY)


def _with_tuples(values, depth: int = 0):
    """TOML's and JSON's lists as the tuples that a config holds; what is nested deeper than a config is left."""
    if isinstance(values, dict):
        return {key: value if depth > 2 else _with_tuples(value, depth + 1) for key, value in values.items()}
    return tuple(map(_with_tuples, values)) if isinstance(values, list) else values


def _problem(error: dict) -> tuple[str, str]:
    """The field of one of pydantic's errors, and `field = value: what is allowed`; of an unknown one, what is near."""
    path, value = ".".join(str(part) for part in error["loc"] if isinstance(part, str)), error["input"]
    if error["type"] == "extra_forbidden" and isinstance(value, dict) and value:
        name, value = next(iter(value.items()))
        path += f".{name}"
    value = f"{path or 'the config'} = {_shown(value)}"
    if path in GONE:
        return path, value
    if error["type"] == "extra_forbidden":
        return path, f"unknown field {value}{did_you_mean(path, (name for name, _ in config_fields()))}"
    return path, f"{value}: {error['msg'][0].lower()}{error['msg'][1:]}"


def _shown(value) -> str:
    """A value for an error's one line: short, whatever a file holds."""
    return reprlib.repr(value)
