"""The fields of a config as flags of the command line."""

from contextlib import suppress
from typing import Annotated, Any, Literal, TypedDict, get_args, get_origin

import tyro
from pydantic import TypeAdapter, ValidationError
from tyro.constructors import PrimitiveConstructorSpec

from .config_files import config_fields


def flag_of(path: str) -> str:
    """Return the flag of a field: `--loss.ssim-weight` for loss.ssim_weight."""
    return "--" + path.replace("_", "-")


def flags_type() -> type:
    """Return a TypedDict of all fields for tyro; after parsing it contains only the flags that were used, as text."""
    tables: dict[str, dict[str, Any]] = {}
    for path, item in config_fields():
        if path == "seed":  # A flag of its own, in every help.
            continue
        # Number of arguments, placeholder, and text without conversion in both directions.
        text = lambda words: words[0], lambda value: isinstance(value, str), lambda value: [value]
        spec = PrimitiveConstructorSpec(1, _metavar(item.annotation), *text)
        argument = tyro.conf.arg(
            help=" ".join((item.description or "").split()), help_behavior_hint=f"(default: {field_text(item.default)})"
        )
        tables.setdefault(path.rpartition(".")[0], {})[path] = Annotated[str, spec, argument]
    parts = {
        part: Annotated[TypedDict(part, fields, total=False), tyro.conf.arg(name=part)]  # type: ignore[misc]
        for part, fields in tables.items()
        if part
    }
    return TypedDict("Fields", {**tables.get("", {}), **parts}, total=False)  # type: ignore[misc]


def used_fields(values: dict) -> dict[str, str]:
    """Return the fields whose flags were used, with the text behind the flag, of a parsed flags_type()."""
    fields: dict[str, str] = {}
    for name, value in values.items():
        fields |= used_fields(value) if isinstance(value, dict) else {name: value}
    return fields


def parse_field(path: str, text: str):
    """Parse the text behind the flag of a field; lists are separated by commas.

    Text that cannot be parsed is returned as it is, so that the validation of the config explains what is allowed.
    """
    kind: Any = dict(config_fields())[path].annotation
    if get_origin(kind) is tuple:
        item_kind = get_args(kind)[0].__origin__  # Without its range, which the config explains
        return tuple(_parse(item_kind, item) for item in map(str.strip, text.split(",")) if item)
    return _parse(kind, text)


def _parse(kind: Any, text: str) -> Any:
    """Return text as a value of a type, or as it is."""
    with suppress(ValidationError):
        return TypeAdapter(kind).validate_python(text)
    return text


def field_text(value) -> str:
    """Return a field's value as its flag takes it."""
    if isinstance(value, tuple):
        value = ",".join(map(str, value))
    return str(value).lower() if isinstance(value, bool) else f"{value}" or "none"


def _metavar(kind) -> str:
    """Return the placeholder of a field's value in the help."""
    if get_origin(kind) is Literal:
        return "|".join(get_args(kind))
    if get_origin(kind) is Annotated:
        return _metavar(get_args(kind)[0])
    if get_origin(kind) is tuple:
        return f"{_metavar(get_args(kind)[0])},..."
    return {bool: "true|false", int: "INT", float: "NUM"}.get(kind, "TEXT")
