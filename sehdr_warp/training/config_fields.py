"""The fields of a config one by one: their names, help and flags, and what became of those of earlier versions."""

import typing
from collections.abc import Iterator
from typing import Annotated, Literal, TypedDict, get_args, get_origin

import tyro
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from tyro.constructors import PrimitiveConstructorSpec

from .config import Config

_DEFAULT = "it always is what the default was: leave it out"
_LOST = "it gained nothing: leave it out"
GONE = {
    "model.dropout": _LOST,
    "model.far_points": _LOST,
    "model.low_pass": _DEFAULT,
    "model.initial_opacity": _DEFAULT,
    "model.initial_scale": _DEFAULT,
    "response.form": 'write response.name = "learned" for mlp, nothing for curve',
    "response.width": _DEFAULT,
    "response.refine": _LOST,
    "response.refine_after": _LOST,
    "response.refine_weight": _LOST,
    "fusion.sigma": _DEFAULT,
    "fusion.width": _DEFAULT,
    "fusion.hidden_layers": _DEFAULT,
    "fusion.evaluation": _DEFAULT,
    "loss.interval": _LOST,
    "loss.highlight_weight": _LOST,
    "loss.highlight_stops": _LOST,
    "loss.highlight_expected": _LOST,
    "loss.harmonics_weight": _LOST,
    "loss.scale_weight": _LOST,
    "loss.knee": _DEFAULT,
    "loss.domain": _DEFAULT,
    "loss.hdr_domain": _DEFAULT,
    "loss.linear_detach": _DEFAULT,
    "loss.anchor_value": _DEFAULT,
    "densification.contribution": _LOST,
    "densification.contribution_at": _LOST,
    "densification.slope_corrected": _LOST,
    "densification.revised_opacity": _LOST,
    "optimizer.refinement": _LOST,
    "optimizer.final_factor": _LOST,
    "optimizer.decay_from": _LOST,
    "optimizer.visible_only": _LOST,
    "schedule.stated_for": "iteration numbers are for 30000 iterations: scale them",
    "schedule.harmonics_on_demand": _LOST,
    "schedule.harmonics_gain": _LOST,
    "schedule.coarse_levels": _LOST,
    "schedule.coarse_every": _LOST,
    "schedule.early_stop": "the plan chooses the iterations: leave it out",
    "schedule.early_stop_every": _LOST,
    "schedule.early_stop_gain": _LOST,
    "schedule.early_stop_on": _LOST,
    "schedule.nonfinite_limit": _DEFAULT,
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


def value_of(path: str, text: str):
    """A field's value as it was written behind its flag; the config then checks it.

    Text stands as it is, lists are separated by commas, and everything else is written as in TOML.
    """
    from .config_files import toml_value

    kind = dict(config_fields())[path].annotation
    if get_origin(kind) is tuple:
        inner = get_args(kind)[0]
        return [item if is_text(inner) else toml_value(item) for item in map(str.strip, text.split(",")) if item]
    return text if is_text(kind) else toml_value(text)


def is_text(kind) -> bool:
    """Whether values of a type are text."""
    kind = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    return kind is str or get_origin(kind) is Literal


def flags_type() -> type:
    """A TypedDict of every field, for tyro: nothing but what was named is in it, as text."""
    tables: dict[str, dict[str, typing.Any]] = {}
    for path, item in config_fields():
        if path == "seed":  # A flag of its own, in every help.
            continue
        default = shown(item.default)
        spec = PrimitiveConstructorSpec(
            nargs=1,
            metavar=_metavar(item.annotation),
            instance_from_str=lambda words: words[0],
            is_instance=lambda value: isinstance(value, str),
            str_from_instance=lambda value: [value],
        )
        told = tyro.conf.arg(
            help=" ".join((item.description or "").split()), help_behavior_hint=f"(default: {default})"
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


def shown(value) -> str:
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
