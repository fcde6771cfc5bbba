"""Configs as files: TOML presets and overrides in, JSON beside the run out."""

import json
import reprlib
import tomllib
import types
import typing
from dataclasses import asdict, fields, is_dataclass
from importlib import resources
from pathlib import Path

from ..errors import InputError
from .config import Config, ConfigError

_LARGEST_FILE = 1 << 20
_REMEDY = "correct the file; configs/default.toml lists every field"


def preset_names() -> list[str]:
    """Names of the presets that ship with the package."""
    folder = resources.files("sehdr_warp.configs")
    return sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml"))


def load_config(preset: str | Path = "default", overrides: dict | None = None) -> Config:
    """The config of a preset or of a TOML file.

    preset: a name of preset_names(), or the path of a TOML file.
    overrides: dotted field names and values that replace the file's, e.g. {"schedule.iterations": 500}.

    Raises InputError naming file, field and value for a missing file, bad TOML, an unknown field, a wrong type or a
    value out of range.
    """
    source, values = _read(preset)
    return _override(source, values, overrides or {})


def override_config(config: Config, overrides: dict, source: Path | str = "config") -> Config:
    """A config with some fields replaced, given as for load_config; `source` names it in errors. Raises InputError."""
    return _override(source, config_to_dict(config), overrides)


def parse_setting(text: str) -> tuple[str, object]:
    """A field's dotted name and its value from `field=value`, the value as in TOML (plain words need no quotes).

    Raises InputError for a text without a name or an equals sign; load_config checks name and value.
    """
    path, equals, value = (part.strip() for part in text.partition("="))
    if not path or not equals:
        raise InputError(f"--set {text}", "is not field=value", "write for example --set loss.clipping=false")
    return path, toml_value(value)


def toml_value(text: str):
    """A value written as in TOML; what is no TOML is taken as a plain word."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def config_to_dict(config: Config) -> dict:
    """Plain nested values; config_from_dict reads them back exactly, through JSON as well."""
    return asdict(config)


def config_from_dict(values: dict, source: Path | str = "config") -> Config:
    """The config that config_to_dict described; `source` names it in errors. Raises InputError."""
    return _build(source, values)


def read_config_json(path: Path) -> Config:
    """The config saved with a run; raises InputError."""
    try:
        values = json.loads(_text(path))
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"not valid JSON ({error})", "the run is damaged: train again") from None
    return _build(path, values)


def _read(preset: str | Path) -> tuple[Path, dict]:
    """The file's path and its values on top of those of its base, bases first."""
    path = _locate(preset)
    chain, seen = [], set()
    while True:
        if path in seen:
            raise InputError(path, "its bases lead back to itself", "remove the key `base` from one of the files")
        seen.add(path)
        try:
            values = tomllib.loads(_text(path))
        except (ValueError, RecursionError) as error:
            raise InputError(path, f"not valid TOML ({error})", _REMEDY) from None
        chain.append(values)
        base = values.pop("base", None)
        if base is None:
            break
        if not isinstance(base, str):
            raise InputError(
                path, f"base = {base!r} is not a name", f"use one of {', '.join(preset_names())}, or a file"
            )
        path = _locate(base, beside=path.parent)
    merged: dict = {}
    for values in reversed(chain):
        _merge(merged, values)
    return _locate(preset), merged


def _locate(preset: str | Path, beside: Path | None = None) -> Path:
    if str(preset) in preset_names():
        return Path(str(resources.files("sehdr_warp.configs") / f"{preset}.toml"))
    path = Path(preset) if beside is None else beside / preset
    try:
        found = path.is_file()
    except (OSError, ValueError):  # A name that no file can have.
        found = False
    if not found:
        raise InputError(
            str(preset)[:200], "no such preset or file", f"use one of {', '.join(preset_names())}, or a TOML file"
        )
    return path


def _text(path: Path) -> str:
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise InputError(path, f"larger than {_LARGEST_FILE} bytes", "this is not a config file")
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", "check the path") from None
    except UnicodeDecodeError:
        raise InputError(path, "not UTF-8 text", "this is not a config file") from None


def _override(source: Path | str, values: dict, overrides: dict) -> Config:
    for path, value in overrides.items():
        *parents, leaf = path.split(".")
        table = values
        for parent in parents:
            table = table.setdefault(parent, {})
            if not isinstance(table, dict):
                raise InputError(source, f"{parent} = {_shown(table)} is not a table", _REMEDY)
        table[leaf] = value
    return _build(source, values)


def _merge(into: dict, values: dict) -> None:
    for key, value in values.items():
        if isinstance(value, dict) and isinstance(into.get(key), dict):
            _merge(into[key], value)
        else:
            into[key] = value


def _build(source: Path | str, values: dict) -> Config:
    try:
        return _table(Config, values, "")
    except ConfigError as error:
        raise InputError(
            source, str(error), "correct the value; configs/default.toml says what each field means"
        ) from None


def _table(kind: type, values, prefix: str):
    if not isinstance(values, dict):
        raise ConfigError(f"{prefix.rstrip('.') or 'the config'} = {_shown(values)} is not a table")
    hints = typing.get_type_hints(kind)
    unknown = sorted(set(values) - set(hints))
    if unknown:
        raise ConfigError(f"unknown field {prefix}{unknown[0]} = {_shown(values[unknown[0]])}")
    made = {}
    for item in fields(kind):
        if item.name in values:
            hint, value, path = hints[item.name], values[item.name], prefix + item.name
            made[item.name] = _table(hint, value, f"{path}.") if is_dataclass(hint) else _plain(hint, value, path)
    return kind(**made)


def _plain(hint, value, path: str):
    """A TOML or JSON value as the field's type; whole numbers are good for float fields, nothing else converts."""
    if isinstance(hint, types.GenericAlias):
        if not isinstance(value, list | tuple):
            raise ConfigError(f"{path} = {_shown(value)} is not a list")
        return tuple(_plain(typing.get_args(hint)[0], item, path) for item in value)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            raise ConfigError(f"{path} = {_shown(value)} is too large") from None
    if type(value) is not hint:
        raise ConfigError(f"{path} = {_shown(value)} is not of type {hint.__name__}")
    return value


def _shown(value) -> str:
    """A value for an error's one line: short, whatever a file holds."""
    return reprlib.repr(value)
