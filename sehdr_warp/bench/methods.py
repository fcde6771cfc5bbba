"""The methods that `bench quality` compares: a preset over our kernels each, or a training of its own, and variants."""

import re
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from ..errors import InputError, SehdrError
from ..training.config_files import toml_value


@dataclass(frozen=True)
class Method:
    """What is trained, and on what.

    name: in tables and on the command line. preset: of load_config.
    truth: it gets the HDR truth of the training views; all others never see it.
    blind: whether a run without the response makes sense (one that takes nothing from the photos has no use for it).
    base: the method this is a variant of; overrides: dotted fields of the config and their values, on top of the
        preset's.
    """

    name: str
    preset: str
    truth: bool = False
    blind: bool = True
    base: str | None = None
    overrides: dict = field(default_factory=dict)


METHODS = {
    method.name: method
    for method in (
        Method("default", "default"),
        Method("paper", "paper"),
        Method("paper-truth", "paper-truth", truth=True),
        Method("hdr-gs", "hdr-gs"),
        Method("hdr-gs-truth", "hdr-gs-truth", truth=True),
        Method("gauss-hdr", "gauss-hdr"),
        Method("3dgs", "3dgs"),
        Method("predicted", "predicted"),
        Method("truth", "truth", truth=True, blind=False),
    )
}
UPPER_BOUND = "truth"
"""U: 3DGS trained on the HDR truth, which every method is compared with."""


def choose_methods(names: Iterable[str], variants: Sequence[str] = (), file: Path | None = None) -> list[Method]:
    """The methods asked for, then their variants, in order; a name that comes twice is an error.

    names: of METHODS, other presets of load_config, or TOML files with a preset of one's own.
    variants: `NAME:BASE:field=value,field=value`, BASE a name as above, values as in TOML (plain words need no quotes).
    file: TOML with a table for each variant: `base` (default: "default") and the fields that differ.

    Raises SehdrError or InputError naming what is wrong. Fields and values themselves are checked by load_config.
    """
    chosen = [method_by_name(name) for name in names]
    chosen += [_parse_variant(text) for text in variants]
    chosen += [] if file is None else _read_variants(file)
    if not chosen:
        raise SehdrError(f"no method is asked for; choose from {', '.join(METHODS)}, or give a variant")
    seen = set()
    for method in chosen:
        if method.name in seen:
            raise SehdrError(f"method {method.name} is asked for twice; give each variant a name of its own")
        seen.add(method.name)
    return chosen


def method_by_name(name: str) -> Method:
    """A method of METHODS, or one that trains any other preset or TOML file on photos alone."""
    from ..training.config_files import preset_names

    if name in METHODS:
        return METHODS[name]
    if name in preset_names():
        return Method(name, name)
    if name.endswith(".toml"):
        path = Path(name)
        if not path.is_file():
            raise InputError(path, "no such file", "give a TOML file with a preset, or the name of a method")
        return Method(path.stem, str(path.absolute()))
    raise SehdrError(f"method {name!r} is unknown; choose from {', '.join(METHODS)}, or give a TOML file")


def _parse_variant(text: str) -> Method:
    name, _, rest = text.partition(":")
    base, _, settings = rest.partition(":")
    # Values may hold commas (lists): a new field starts where a name and an equals sign follow.
    items = [item.partition("=") for item in re.split(r",(?=\s*[A-Za-z_][\w.]*\s*=)", settings) if item.strip()]
    if not name or not base or not items or not all(equals for _, equals, _ in items):
        raise SehdrError(f"--variant {text}: not NAME:BASE:field=value,...; write no-clip:default:loss.clipping=false")
    return _variant(name, base, {key.strip(): toml_value(value.strip()) for key, _, value in items})


def _read_variants(path: Path) -> list[Method]:
    remedy = 'write tables such as [no-clip] with base = "default" and loss.clipping = false'
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", "give a TOML file of variants") from None
    except ValueError as error:
        raise InputError(path, f"not valid TOML ({error})", remedy) from None
    for name, table in tables.items():
        if not isinstance(table, dict) or not isinstance(table.get("base", ""), str):
            raise InputError(path, f"{name} is not a variant", remedy)
    return [_variant(name, table.pop("base", "default"), dict(_flat(table))) for name, table in tables.items()]


def _flat(table: dict, prefix: str = ""):
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def _variant(name: str, base: str, overrides: dict) -> Method:
    method = method_by_name(base)
    return replace(method, name=name, base=method.name, overrides=method.overrides | overrides)
