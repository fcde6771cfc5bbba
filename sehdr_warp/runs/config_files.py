"""Configs as presets, files and nested values, and the names of fields in earlier versions."""

import json
import logging
import reprlib
import textwrap
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cache, reduce
from importlib import resources
from operator import attrgetter
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from ..errors import InputError, did_you_mean, path_of
from ..files import read_text
from .config import Config, ConfigError

log = logging.getLogger(__name__)

_MAX_FILE_BYTES = 1 << 20
_REMEDY = "`sehdr-warp config` lists every field with its meaning"
_GONE = tomllib.loads((resources.files("sehdr_warp.runs") / "gone.toml").read_text(encoding="utf-8"))
RENAMED: dict[str, str] = _GONE.pop("renamed")  # Fields of version 0.2, each with its name since version 0.3
GONE: dict[str, str] = {path: advice for advice, paths in _GONE.items() for path in paths}
"""Fields of earlier versions that no longer exist, each with what to do instead."""
NEW_FIELDS: dict[str, Any] = {"model.order_angle": 0.0, "loss.transmittance_weight": 0.0}
"""Fields that runs of earlier versions lack, each with the value that these were trained by."""
_RENAMED_VALUES = {"densification.strategy": {"relocation": "mcmc", "gradient": "adc"}}


def preset_names() -> list[str]:
    """Return the names of the presets that ship with the package."""
    folder = resources.files("sehdr_warp.configs")
    return sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml"))


def preset_purpose(name: str) -> str:
    """Return the purpose of a preset: the first line of its file."""
    return read_text(_locate(name), _MAX_FILE_BYTES).partition("\n")[0].strip("# .")


def load_config(
    preset: str | Path = "default", overrides: dict[str, Any] | None = None, flags: Mapping[str, str] | None = None
) -> Config:
    """Load the config of a preset or of a TOML file.

    Args:
        preset: A name of preset_names(), or a file.
        overrides: Dotted field names and values that replace those of the file, e.g. {"schedule.iterations": 500}.
        flags: For each overridden field the command-line flag that error messages name.

    Raises:
        InputError: With file, field and value, for anything missing, unknown or wrong.
        TypeError: For a preset or overrides of another type.
    """
    if isinstance(preset, Mapping):
        raise TypeError(f"preset is {preset!r:.60}, expected a name or a file; pass fields as overrides")
    if not isinstance(overrides or {}, Mapping):
        raise TypeError(f"overrides is {overrides!r:.60}, expected a dict of field names and values")
    config = config_from_dict(*_read(preset if isinstance(preset, str) else path_of(preset, "preset")))
    return override_config(config, overrides or {}, "overrides", flags)


def as_config(config: object) -> Config | None:
    """Convert any of the forms that create_trainer() takes to a Config; None stays None.

    The plan does not change fields of a mapping: they are added to plan.keep.
    """
    if config is None or isinstance(config, Config):
        return config
    if isinstance(config, str | Path):
        return load_config(config)
    if isinstance(config, Mapping):
        changed = override_config(Config(), dict(config), "overrides")
        fields = set(changed.plan.keep)
        for path, value in config.items():
            table = value.model_dump(exclude_unset=True) if isinstance(value, BaseModel) else value
            fields |= {f"{path}.{name}" for name in table} if isinstance(table, Mapping) else {path}
        user_fields = {path for path in fields if not path.startswith("plan.")}
        return override_config(changed, {"plan.keep": sorted(user_fields)})
    raise InputError("config", f"is {type(config).__name__}", "pass a preset's name, a dict of fields or a Config")


def override_config(
    config: Config, overrides: dict, source: Path | str = "the config", flags: Mapping[str, str] | None = None
) -> Config:
    """Return a config with some fields replaced; `overrides` and `flags` as in load_config().

    Raises InputError, with the field's flag or else `source`, if a field is unknown or its value is wrong.
    """
    values = config.model_dump()
    for path, value in overrides.items():
        part, _, name = path.rpartition(".")
        table = values.setdefault(part, {}) if part else values
        if not isinstance(table, dict):
            raise InputError(path, f"{part} is a field, not a table", _REMEDY)
        table[name] = value
    return config_from_dict(values, source, flags)


def with_iterations_of(saved: Config, config: Config) -> Config:
    """Return the config of a preset with the iterations of the run that it continues: a preset does not stretch it."""
    before, own = saved.schedule.iterations, config.schedule.iterations
    if own > before:
        log.info("the run keeps its %d iterations, not the preset's %d; schedule.iterations gives it more", before, own)
    return override_config(config, {"schedule.iterations": before})


def require_same_config(config: Config, saved: Config, file: Path, remedy: str) -> None:
    """Raise InputError, with the first field that differs and both values, if a config is not the one saved in a file.

    plan.keep may differ, because the fields that the plan kept are compared.
    """
    for path, _ in config_fields():
        old, new = attrgetter(path)(saved), attrgetter(path)(config)
        if old != new and path != "plan.keep":
            raise InputError(file, f"{path} = {old!r}, but {new!r} was asked for", remedy)


def config_as_toml(config: Config, differing: bool = False) -> str:
    """Return a config as a TOML file; if `differing`, only what differs from the default preset, without meanings."""
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
            meaning = " ".join((item.description or "").split())
            lines += textwrap.wrap(meaning, 116, initial_indent="# ", subsequent_indent="# ")
        changed = "" if differing or value == item.default else f"  # default: {json.dumps(item.default)}"
        lines.append(f"{name} = {_as_toml(value)}{changed}")
    return "\n".join(lines)


def _as_toml(value: Any) -> str:
    """Return a value as ASCII: JSON's strings, numbers, booleans and lists are TOML's, but for escapes over 16 bits."""
    text = json.dumps(value, ensure_ascii=False)
    escaped = (f"\\u{ord(letter):04x}" if ord(letter) < 0x10000 else f"\\U{ord(letter):08x}" for letter in text)
    return "".join(letter if 31 < ord(letter) < 127 else code for letter, code in zip(text, escaped, strict=True))


def config_from_dict(values: dict, source: Path | str = "config", flags: Mapping[str, str] | None = None) -> Config:
    """Validate nested values, as Config.model_dump() returns them and JSON stores them.

    Raises:
        InputError: With the flag of the wrong field, or else `source`. For a field of an earlier version it names the
            new field, or what to do instead; one that is gone may be 0, which was off.
    """
    for path in GONE:
        part, _, name = path.rpartition(".")
        if isinstance(table := values.get(part), dict) and table.get(name) == 0:
            values = values | {part: {key: value for key, value in table.items() if key != name}}
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        path, problem = field_and_problem(error)
    except ConfigError as error:
        path, problem = "", str(error)
    flag = (flags or {}).get(path)
    if flag is None and flags and not path:  # Contradicting fields: name the flag of the first.
        flag = next((flag for path, flag in flags.items() if path in problem), None)
    if path in GONE:
        raise InputError(source, f"{problem} is of an earlier version and was removed", GONE[path])
    if path in RENAMED:
        raise InputError(source, f"{problem} has another name since version 0.3", f"write {RENAMED[path]}")
    raise InputError(flag or source, problem, _REMEDY)


def config_of_run(values: dict, file: Path) -> Config:
    """Return config_from_dict() of a run's values, of an earlier version too, which goes on as it began if it can.

    A field that is gone is left out with a warning, not refused: the run was trained with it, and its checkpoint states
    the hash of its file, so nobody can leave it out there.
    """
    for path, value in NEW_FIELDS.items():
        part, _, name = path.rpartition(".")
        if isinstance(table := values.get(part), dict):
            values = values | {part: {name: value} | table}
    for path in GONE:
        part, _, name = path.rpartition(".")
        if isinstance(table := values.get(part), dict) and table.get(name):
            _warn_of_gone_field(file, path, json.dumps(table[name]))
            values = values | {part: table | {name: 0}}
    return config_from_dict(values, file)


@cache  # A command reads the config several times.
def _warn_of_gone_field(file: Path, path: str, value: str) -> None:
    text = "%s: %s = %s is of an earlier version and was removed; a training that continues ignores it"
    log.warning(text, file, path, value)


def field_and_problem(validation: ValidationError) -> tuple[str, str]:
    """Return the path of the first wrong field, and `field = value: what is allowed` or a similar known field.

    A field that is missing has no value, and a table with entries is `{...}`.
    """
    error = validation.errors()[0]
    path, value = ".".join(str(part) for part in error["loc"] if isinstance(part, str)), error["input"]
    if error["type"] == "missing":
        return path, f"{path} is missing"
    unknown = error["type"] == "extra_forbidden"
    if unknown and isinstance(value, dict) and value:
        name, value = next(iter(value.items()))
        path += f".{name}"
    text = "{...}" if isinstance(value, dict) and value else reprlib.repr(value)
    value = f"{path or 'the config'} = {text}"
    if path in GONE or path in RENAMED:
        return path, value
    names = _RENAMED_VALUES.get(path, {})
    if isinstance(error["input"], str) and error["input"] in names:
        return path, f"{value} has another name since version 0.3: {names[error['input']]!r}"
    if unknown:
        return path, f"unknown field {value}{did_you_mean(path, (name for name, _ in config_fields()))}"
    return path, f"{value}: {error['msg'][0].lower()}{error['msg'][1:]}"


def _read(preset: str | Path) -> tuple[dict, Path]:
    """Return the values of a file merged over those of its bases, and its path."""
    path, chain = _locate(preset), {}
    while path is not None:
        if path in chain:
            raise InputError(path, "its bases lead back to itself", "remove the key `base` from one of the files")
        try:
            values = chain[path] = tomllib.loads(read_text(path, _MAX_FILE_BYTES))
        except (ValueError, RecursionError) as error:
            raise InputError(path, f"not valid TOML ({error})", _REMEDY) from None
        base = values.pop("base", None)
        if not isinstance(base, str | None):
            raise InputError(path, f"base = {base!r} is not a name", f"use one of {preset_names()}, or a file")
        path = None if base is None else _locate(base, path)
    return reduce(_merge, reversed(chain.values())), next(iter(chain))


def _locate(preset: str | Path, file: Path | None = None) -> Path:
    """Return the path of a preset or file, which `file` states as its base; raises InputError if there is none."""
    if str(preset) in preset_names():
        return Path(str(resources.files("sehdr_warp.configs") / f"{preset}.toml"))
    path = Path(preset) if file is None else file.parent / preset
    with suppress(OSError, ValueError):  # Text that cannot be a file name.
        if path.is_file():
            return path
    problem = f"no such preset or file{did_you_mean(str(preset), preset_names())}"
    where = f"{preset!s:.200}" if file is None else f"{file}: base = {preset!r:.200}"
    raise InputError(where, problem, f"use one of {', '.join(preset_names())}, or a TOML file")


def _merge(below: dict, above: dict) -> dict:
    """Merge two levels of tables; values of `above` win."""
    both = {key for key in above if isinstance(above[key], dict) and isinstance(below.get(key), dict)}
    return below | above | {key: below[key] | above[key] for key in both}


def config_fields(kind: Any = Config, prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """Yield dotted name and declaration of every field, first those outside of tables."""
    tables = {name: item for name, item in kind.model_fields.items() if isinstance(item.annotation, type(BaseModel))}
    yield from ((prefix + name, item) for name, item in kind.model_fields.items() if name not in tables)
    for name, item in tables.items():
        yield from config_fields(item.annotation, f"{prefix}{name}.")
