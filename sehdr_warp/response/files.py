"""Responses from files (EMoR, DoRF, CSV, JSON), and the camera encodings of colour-science."""

import re
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError, SehdrError, nearest
from ..files import read_json, read_text
from ..json_values import damage, numbers
from ..sandbox import mat_arrays, read_sandboxed
from .curve import Response
from .table import ChannelResponse, TabulatedResponse

MAX_BYTES = 64 * 2**20  # Of a text file; all of DoRF has 5 MB.


def response_from_file(path: Path, selector: str | None = None) -> Response:
    """Read the curve in a file; `selector` is the part after the last colon of `FILE:SELECTOR`.

    201_CRF_data.mat and dorfCurves.txt (DoRF; exposures and values normalized to [0, 1]): an index from 0, or a
    curve's name where the file holds names. emor.txt (f = f0 + sum c_i h_i) and invemor.txt (the same for the inverse):
    coefficients c_1,c_2,... separated by commas, none for the mean curve. CSV or text: two columns, exposure and value,
    or four, exposure, red, green and blue; an optional line of headings, `#` comments. JSON: {"exposures": [...],
    "values": [...]} or Response.to_dict's. A `.cube` LUT of one dimension: from light to codes, or with the selector
    `decode` from codes to light.

    Raises:
        InputError: for a file that is missing, too large, of another content, or whose curve cannot be used.
    """
    suffix = path.suffix.lower()
    text = "" if suffix in (".mat", ".json") else read_text(path, MAX_BYTES)
    if text.lstrip()[:2] in ("E ", "E=", "B ", "B=") and "(1)" in text:
        return _emor(path, text, selector)
    if suffix == ".mat" or _is_dorf(text):
        return _select(path, responses_in_file(path), selector)
    if suffix == ".cube":
        return _cube(path, text, selector)
    if selector is not None:
        raise InputError(path, f"holds one curve, and {selector!r} asks for one of several", "leave out the selector")
    return _json_curve(path) if suffix == ".json" else _text_curve(path, text)


def responses_in_file(path: Path | str) -> list[Response]:
    """Read every curve of a DoRF file (.mat with B and I of [curves, samples], or dorfCurves.txt).

    Raises:
        InputError: for any other file.
    """
    path = Path(path)
    if path.suffix.lower() == ".mat":
        return _dorf_mat(path)
    text = read_text(path, MAX_BYTES)
    if _is_dorf(text):
        return _dorf_text(path, text)
    raise InputError(path, "is not a DoRF file", "give 201_CRF_data.mat or dorfCurves.txt")


def colour_response(encoding: str) -> Response:
    """Return a camera or display encoding of colour-science by name (`S-Log3`; case, blanks, hyphens do not matter).

    The exposure axis is scene reflectance as that encoding defines it (0.18 is middle gray); values are limited to
    [0, 1]. Sampled once at 32 points an octave, 24 octaves below white.

    Raises:
        SehdrError: for an unknown name, or an encoding that is not a camera's (undefined values, or white beyond 2^20).
    """
    import colour
    from colour.utilities import suppress_warnings
    from scipy.optimize import bisect

    names = {_key(name): name for name in reversed(list(colour.CCTF_ENCODINGS))}
    name = names.get(_key(encoding))
    if name is None:
        near = nearest(_key(encoding), names)
        hint = f"did you mean {names[near]}?" if near else "colour.CCTF_ENCODINGS lists them"
        raise SehdrError(f"response 'colour:{encoding:.60}': colour-science has no such encoding; {hint}")

    # Of HLG and PQ colour-science knows a camera's encoding of scene light and a display's of its own: the camera's.
    encoding_of = colour.OETFS.get(name, colour.CCTF_ENCODINGS[name])

    def encode(exposure):
        with np.errstate(all="ignore"), suppress_warnings(colour_warnings=True):
            return np.asarray(encoding_of(np.asarray(exposure, np.float64)), np.float64)

    # White: between the first of these stops at which the encoding reaches 1, and the one before.
    bright = np.exp2(np.linspace(-10, 20, 30 * 32 + 1))
    reached = np.flatnonzero(encode(bright) >= 1.0)
    if not len(reached) or reached[0] == 0:
        raise SehdrError(f"response 'colour:{encoding}': the encoding does not pass 1 below 2^20; take another")
    white: Any = bisect(lambda exposure: float(encode(exposure)) - 1.0, *bright[reached[0] - 1 : reached[0] + 1])
    exposures = np.concatenate([[0.0], white * np.exp2(np.arange(-24 * 32, 1) / 32)])
    # At exactly 0 a pure logarithm gives -infinity: black.
    values = np.nan_to_num(encode(exposures), neginf=0.0, nan=np.nan).clip(0.0, 1.0)
    values[-1] = 1.0
    return TabulatedResponse(f"colour:{name}", exposures, values)


def _key(name: str) -> str:
    return "".join(letter for letter in name.lower() if letter.isalnum())


def _numbers(path: Path, text: str) -> np.ndarray:
    try:
        return np.array(text.split(), dtype=np.float64)
    except ValueError as error:
        raise InputError(path, f"holds no plain numbers ({error})", "give the file as published") from error


def _select(path: Path, curves: list[Response], selector: str | None) -> Response:
    if selector is None:
        raise InputError(path, f"holds {len(curves)} curves", f"say which, as {path.name}:INDEX or {path.name}:NAME")
    selection = selector.strip().lower()
    for index, curve in enumerate(curves):
        if selection in (curve.name.lower(), str(index)):
            return curve
    raise InputError(path, f"has no curve {selector!r}", f"give an index from 0 to {len(curves) - 1}, or a name")


def _dorf_mat(path: Path) -> list[Response]:
    arrays = read_sandboxed(mat_arrays, path, "DoRF's B and I", "give 201_CRF_data.mat")
    values, exposures = arrays["B"], arrays["I"]
    if values.ndim != 2 or values.shape != exposures.shape:
        raise InputError(path, f"B is {values.shape} and I is {exposures.shape}", "give both as [curves, samples]")
    numbered = enumerate(zip(exposures, values, strict=True))
    return [TabulatedResponse(f"dorf:{index}", *curve, source=f"{path}:{index}") for index, curve in numbered]


def _is_dorf(text: str) -> bool:
    lines = text.split("\n", 6)
    return len(lines) > 5 and lines[2].strip() == "I =" and lines[4].strip() == "B ="


def _dorf_text(path: Path, text: str) -> list[Response]:
    """Read six lines a curve: name, kind, "I =", exposures, "B =", values."""
    lines = [line for line in text.splitlines() if line.strip()]
    curves = []
    for index in range(-(-len(lines) // 6)):
        name, _, i, exposures, b, values = (*lines[6 * index : 6 * index + 6], *[""] * 5)[:6]
        if (i.strip(), b.strip()) != ("I =", "B ="):
            raise InputError(path, f"curve {index} lacks its 'I =' or 'B =' line", "give dorfCurves.txt as published")
        columns = _numbers(path, exposures), _numbers(path, values)
        curves.append(TabulatedResponse(name.strip(), *columns, source=f"{path}:{index}"))
    return curves


def _emor(path: Path, text: str, selector: str | None) -> Response:
    """Read sections "E =", "f0 =", "h(1)=", ... of equal length, or "B =", "g0 =", "hinv(1)=" ... of the inverse."""
    rows = [_numbers(path, body) for body in re.split(r"^[^=\n]*=", text, flags=re.MULTILINE)[1:]]
    if len(rows) < 3 or len({len(row) for row in rows}) != 1:
        problem = "is not EMoR's layout of sections of one length"
        raise InputError(path, problem, "give emor.txt or invemor.txt as published")
    axis, mean, *bends = rows
    weights = _numbers(path, (selector or "").replace(",", " "))
    if len(weights) > len(bends) or not np.isfinite(weights).all():
        problem = f"selector {selector!r} is not a list of up to {len(bends)} finite numbers"
        raise InputError(path, problem, "separate coefficients by commas, as emor.txt:0.5,-0.1")
    curve = (mean + weights @ np.array(bends[: len(weights)]).reshape(-1, len(mean))).clip(0.0, 1.0)
    inverse = text.lstrip().startswith("B")
    name = ("invemor" if inverse else "emor") + (f":{selector}" if selector else "")
    columns = (np.maximum.accumulate(curve), axis) if inverse else (axis, curve)
    return TabulatedResponse(name, *columns, source=str(path))


def _json_curve(path: Path) -> Response:
    remedy = 'give {"exposures": [...], "values": [...]}'
    fields = read_json(path)
    try:
        if "kind" in fields:
            return Response.from_dict(fields)
        exposures, values = (numbers(fields, key, -1) for key in ("exposures", "values"))
    except SehdrError as error:
        raise InputError(path, str(error), remedy) from error
    except (KeyError, ValueError) as error:
        raise InputError(path, f"has no two lists of numbers ({damage(error)})", remedy) from error
    return TabulatedResponse(str(fields.get("name", path.name)), exposures, values, source=str(path))


def _cube(path: Path, text: str, selector: str | None) -> Response:
    """Read an Iridas/Adobe `.cube` LUT of one dimension; its axis is light, or codes if the selector is `decode`."""
    remedy = "give a LUT of one dimension from light to codes, or one from codes to light as FILE.cube:decode"
    if "LUT_3D_SIZE" in text:
        raise InputError(path, "is a LUT of three dimensions, which mixes channels", remedy)
    if selector not in (None, "decode"):
        raise InputError(path, f"selector {selector!r:.40} is not 'decode'", remedy)
    from colour.io.luts.iridas_cube import read_LUT_IridasCube

    try:
        lut = read_LUT_IridasCube(path)
        low, high = np.asarray(lut.domain, np.float64)
        table = np.asarray(lut.table, np.float64).reshape(-1, 3)
    except (ValueError, IndexError, KeyError, AssertionError, TypeError) as error:
        raise InputError(path, f"cannot be read as a .cube LUT ({error!s:.80})", remedy) from None
    axis = np.linspace(low, high, len(table))
    exposures, values = (table.T, axis.T) if selector == "decode" else (axis.T, table.T)
    if np.ptp(exposures, axis=0).max() == 0 and np.ptp(values, axis=0).max() == 0:
        return TabulatedResponse(path.name, exposures[0], values[0], source=str(path))
    return ChannelResponse(path.name, exposures, values, source=str(path))


def _text_curve(path: Path, text: str) -> Response:
    rows = []
    for number, line in enumerate(text.splitlines(), 1):
        cells = re.split(r"[\s,;]+", line.partition("#")[0].strip(" \t,;"))
        if cells == [""]:
            continue
        if len(cells) not in (2, 4) or (rows and len(cells) != len(rows[0])):
            remedy = "give two, exposure and value, or four, exposure, red, green and blue"
            raise InputError(path, f"line {number} has {len(cells)} columns", remedy)
        try:
            rows.append([float(cell) for cell in cells])
        except ValueError:
            if rows:  # Else these are headings.
                raise InputError(path, f"line {number} is {line.strip()[:40]!r}", "give numbers alone") from None
    if rows and len(rows[0]) == 4:
        exposures, *values = np.array(rows).T
        return ChannelResponse(path.name, [exposures] * 3, values, source=str(path))
    return TabulatedResponse(path.name, *np.array(rows).reshape(-1, 2).T, source=str(path))
