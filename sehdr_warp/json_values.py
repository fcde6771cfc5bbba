"""Values of JSON files as numbers, texts, arrays and objects; errors name the field and what stands there.

A field that is missing is a KeyError, and one with another kind of value a ValueError; damage() turns both into words.
"""

import math
import re
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

_WHOLE = 1 << 53  # Largest number up to which a float of JSON holds every whole number
_NEEDED = object()
_OF_LIBRARIES = re.compile(
    "could not convert|invalid literal|array element|cannot reshape|argument|unpack|sequence|empty iterable"
)


def description_of(value: Any) -> str:
    """Return what messages call a value: itself in up to 40 characters, null, `a list of N` or `an object`."""
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, dict):
        return "an object"
    return str(value).lower() if isinstance(value, bool) else "null" if value is None else f"{value!r:.40}"


def json_object(value: Any, name: str) -> dict[str, Any]:
    """Return a value that is an object; raise ValueError for any other."""
    if not isinstance(value, dict):
        raise ValueError(f"{name} is {description_of(value)}, not an object")
    return value


def json_list(value: Any, name: str) -> list[Any]:
    """Return a value that is a list; raise ValueError for any other."""
    if not isinstance(value, list):
        raise ValueError(f"{name} is {description_of(value)}, not a list")
    return value


def text(values: dict[str, Any], name: str, absent: Any = _NEEDED) -> str:
    """Return a field that is a text or a number, as text; `absent` where it is missing, if that is set."""
    value = values[name] if absent is _NEEDED else values.get(name, absent)
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise ValueError(f"{name} is {description_of(value)}, not a text")
    return str(value)


def number(values: dict[str, Any], name: str, absent: Any = _NEEDED) -> float:
    """Return a field that is a number, or text of one; `absent` where it is missing, if that is set.

    NaN and infinity, as Python's JSON has them, are numbers.
    """
    value = values[name] if absent is _NEEDED else values.get(name, absent)
    try:
        if isinstance(value, str | int | float) and not isinstance(value, bool):
            return float(value)
    except (ValueError, OverflowError):
        pass
    raise ValueError(f"{name} is {description_of(value)}, not a number")


def whole_number(values: dict[str, Any], name: str) -> int:
    """Return a field that is a whole number."""
    value = values[name]
    if isinstance(value, bool) or not isinstance(value, int | float) or not -_WHOLE <= value <= _WHOLE or value % 1:
        raise ValueError(f"{name} is {description_of(value)}, not a whole number")
    return int(value)


def numbers(values: dict[str, Any], name: str, *shape: int) -> "np.ndarray":
    """Return a field of numbers, in one list or in lists of lists, as float64 [shape], of which -1 is any length.

    null becomes NaN.
    """
    import numpy as np

    value = values[name]
    try:
        array = np.array(json_list(value, name), np.float64)
        if shape != (-1,) or array.ndim == 1:
            return array.reshape(shape)
    except (ValueError, TypeError, OverflowError):
        pass
    if shape == (-1,):
        expected = "one list of numbers"
    else:
        expected = f"rows of {shape[-1]} numbers" if -1 in shape else f"{' x '.join(map(str, shape))} numbers"
    raise ValueError(f"{name} {_misfit(value, shape)}, not {expected}")


def _misfit(value: Any, shape: tuple[int, ...]) -> str:
    """Return what stands in a field in place of numbers [shape]."""
    if not isinstance(value, list):
        return f"is {description_of(value)}"
    flat = _flat(value)
    odd = next((each for each in flat if isinstance(each, bool | str | dict)), None)
    if odd is not None:
        return f"holds {description_of(odd)}"
    if -1 in shape or len(flat) == math.prod(shape):
        return f"is {description_of(value)}"
    return f"holds {len(flat)} numbers"


def _flat(value: Any) -> list[Any]:
    """Return the values in nested lists, in their order."""
    flat, rest = [], [value]
    while rest:
        part = rest.pop()
        if isinstance(part, list):
            rest += reversed(part)
        else:
            flat.append(part)
    return flat


def damage(error: Exception) -> str:
    """Return what is wrong with values that a reader failed on, without Python's words."""
    line = re.sub(" <[^>]*>", "", str(error.args[0] if isinstance(error, KeyError) else error))[:120]
    if isinstance(error, KeyError):
        return line if " " in line else f"{line} is missing"
    if isinstance(error, IndexError):
        return "a list is too short"
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    if isinstance(error, TypeError | AttributeError | OverflowError) or _OF_LIBRARIES.search(line):
        return "a value is of another type"
    return line
