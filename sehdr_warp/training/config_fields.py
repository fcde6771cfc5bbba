"""The fields of a config one by one: their names, help and flags, and what became of those of earlier versions."""

import typing
from collections.abc import Iterator
from typing import Annotated, Literal, TypedDict, get_args, get_origin

import tyro
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from tyro.constructors import PrimitiveConstructorSpec

from .config import Config

_GAINED_NOTHING = """model.dropout model.far_points response.refine response.refine_after response.refine_weight
    loss.interval loss.highlight_weight loss.highlight_stops loss.highlight_expected loss.harmonics_weight
    loss.scale_weight densification.contribution densification.contribution_at densification.slope_corrected
    densification.revised_opacity optimizer.refinement optimizer.final_factor optimizer.decay_from
    optimizer.visible_only schedule.harmonics_on_demand schedule.harmonics_gain schedule.coarse_levels
    schedule.coarse_every schedule.early_stop schedule.early_stop_every schedule.early_stop_gain
    schedule.early_stop_on"""
_CONSTANT = """model.low_pass model.initial_opacity model.initial_scale response.width fusion.sigma fusion.width
    fusion.hidden_layers fusion.evaluation loss.knee loss.domain loss.hdr_domain loss.linear_detach loss.anchor_value
    schedule.nonfinite_limit"""
GONE = {
    **dict.fromkeys(_GAINED_NOTHING.split(), "it gained nothing: leave it out"),
    **dict.fromkeys(_CONSTANT.split(), "it always is what the default was: leave it out"),
    "response.form": 'write response.name = "learned" for mlp, nothing for curve',
    "schedule.stated_for": "iteration numbers are for 30000 iterations: scale them",
    "plan.decisions": "all are made, and plan.keep says which fields stay",
}
"""Fields of earlier versions, each with what to do now."""


def config_fields(kind: type[BaseModel] = Config, prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """Dotted name and declaration of every field, those of the config itself first."""
    nested = []
    for name, item in kind.model_fields.items():
        if isinstance(item.annotation, type) and issubclass(item.annotation, BaseModel):
            nested.append((item.annotation, f"{prefix}{name}."))
        else:
            yield prefix + name, item
    for inner, path in nested:
        yield from config_fields(inner, path)


def flag_of(path: str) -> str:
    """The flag of a field: `--loss.ssim-weight` for loss.ssim_weight."""
    return "--" + path.replace("_", "-")


def gone_flags() -> dict[str, str]:
    """The flags of fields that are gone, with what to do now."""
    return {flag_of(path): advice for path, advice in GONE.items()}


def flags_type() -> type:
    """A TypedDict of every field, for tyro: nothing but what was named is in it, as text."""
    tables: dict[str, dict[str, typing.Any]] = {}
    for path, item in config_fields():
        if path == "seed":  # A flag of its own, in every help.
            continue
        spec = PrimitiveConstructorSpec(
            nargs=1,
            metavar=_metavar(item.annotation),
            instance_from_str=lambda words: words[0],
            is_instance=lambda value: isinstance(value, str),
            str_from_instance=lambda value: [value],
        )
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
        return ",".join(map(str, value)) or "none"
    return str(value).lower() if isinstance(value, bool) else "none" if value == "" else f"{value}"


def _metavar(kind) -> str:
    origin = get_origin(kind)
    if origin is Literal:
        return "|".join(get_args(kind))
    if origin is Annotated:
        return _metavar(get_args(kind)[0])
    if origin is tuple:
        return f"{_metavar(get_args(kind)[0])},..."
    return {bool: "true|false", int: "INT", float: "NUM"}.get(kind, "TEXT")
