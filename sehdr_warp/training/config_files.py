"""Configs as files: TOML presets and overrides in, JSON beside the run out."""

import difflib
import json
import reprlib
import tomllib
from importlib import resources
from pathlib import Path

from pydantic import BaseModel, ValidationError

from ..errors import InputError
from .config import Config
from .config_checks import ConfigError

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
    return config.model_dump()


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
        return Config.model_validate(_with_tuples(values))
    except ValidationError as error:
        problem = _problem(error.errors()[0])
    except ConfigError as error:
        problem = str(error)
    raise InputError(source, problem, "correct the value; configs/default.toml says what each field means")


def _with_tuples(values):
    """TOML's and JSON's lists as the tuples that a config holds."""
    if isinstance(values, dict):
        return {key: _with_tuples(value) for key, value in values.items()}
    return tuple(map(_with_tuples, values)) if isinstance(values, list) else values


def _problem(error: dict) -> str:
    """One of pydantic's errors as `field = value: what is allowed`; of an unknown field, which known one is near."""
    path = ".".join(str(part) for part in error["loc"] if isinstance(part, str)) or "the config"
    value = f"{path} = {_shown(error['input'])}"
    if error["type"] == "extra_forbidden":
        near = difflib.get_close_matches(path, _paths(Config), 1)
        return f"unknown field {value}" + (f"; did you mean {near[0]}?" if near else "")
    return f"{value}: {error['msg'][0].lower()}{error['msg'][1:]}"


def _paths(kind: type[BaseModel], prefix: str = "") -> list[str]:
    """Dotted names of all tables and fields."""
    found = []
    for name, item in kind.model_fields.items():
        inner = item.annotation
        found.append(prefix + name)
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            found += _paths(inner, f"{prefix}{name}.")
    return found


def _shown(value) -> str:
    """A value for an error's one line: short, whatever a file holds."""
    return reprlib.repr(value)
