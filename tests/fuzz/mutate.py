"""Mutations of files: bytes for any format, numbers and words for text, nodes for JSON. All from one generator."""

import json
import random
import re
import struct

NUMBERS = (
    "0", "-0", "-1", "1", "nan", "inf", "-inf", "NaN", "Infinity", "1e308", "1e309", "-1e308", "1e-320", "2147483648",
    "-2147483649", "4294967296", "9223372036854775808", "18446744073709551616", "1" + "0" * 400, "0x10", "1_000", "½",
    "1e5", "0.5", "1e-12", "", " ", "null", "true", "[]", "{}", '"x"', "..", "/etc/passwd", "\x00", "\ud7ff", "٣",
)  # fmt: skip
VALUES = (
    None, True, False, 0, -1, 1, 2**31, 2**63, 2**64, 10**400, -(10**30), 0.0, -0.0, 1e308, 1e-320, 5e-324, 0.5,
    float("nan"), float("inf"), float("-inf"), "", "x", "nan", "1", "../x", "/etc/passwd", "a\0b", "\ud800", "é" * 3000,
    [], {}, [[]], [0], [None], {"a": 1}, [1, 2, 3], [[1.0] * 4] * 4,
)  # fmt: skip
SHAPES = (None, True, 0, 1.5, "x", [], [1, 2], [[1, 2], [3]], {}, {"a": 1})
WORDS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1)
REALS = (0.0, -0.0, float("nan"), float("inf"), float("-inf"), 1e308, -1e308, 5e-324, 1e-30, 1e30)
_TOKEN = re.compile(rb"[-+.\w]+")


def mutate(data: bytes, others: list[bytes], text: bool, rng: random.Random) -> bytes:
    """One to four mutations of a file. others: files of the same kind, for splicing. text: also as text, or as JSON."""
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        kinds = [_flip, _set_bytes, _set_word, _set_real, _delete, _repeat, _truncate, _insert]
        if text:
            kinds += [_token] * 6 + [_line] * 2
            if data[:1] in (b"{", b"["):
                kinds += [_node] * 10
        if rng.random() < 0.05:
            data = _splice(data, rng.choice(others), rng)
        else:
            data = rng.choice(kinds)(data, rng)
    return data


def misshapen(data: bytes) -> list[bytes]:
    """Every file that differs from a JSON file in one value, which is missing or of another shape."""
    files = []

    def change(node, rebuild):
        files.extend(json.dumps(rebuild(shape)).encode() for shape in SHAPES)
        if isinstance(node, dict):
            for key in node:
                files.append(json.dumps(rebuild({name: value for name, value in node.items() if name != key})).encode())
                change(node[key], lambda value, key=key: rebuild(node | {key: value}))
        elif isinstance(node, list):
            for place in range(min(len(node), 2)):
                change(node[place], lambda value, at=place: rebuild([*node[:at], value, *node[at + 1 :]]))

    change(json.loads(data), lambda value: value)
    return files


def _place(data: bytes, rng: random.Random) -> int:
    """Anywhere, but half of the time within the first 256 bytes, where headers are."""
    return rng.randrange(min(len(data), 256) if rng.random() < 0.5 else len(data)) if data else 0


def _flip(data, rng):
    at = _place(data, rng)
    return data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :] if data else data


def _set_bytes(data, rng):
    at, count = _place(data, rng), rng.choice((1, 2, 4, 16))
    return data[:at] + bytes([rng.choice((0, 0xFF, 0x7F, 0x80, rng.randrange(256)))]) * count + data[at + count :]


def _set_word(data, rng):
    at, size = _place(data, rng), rng.choice((2, 4, 8))
    word = (rng.choice(WORDS) & (1 << 8 * size) - 1).to_bytes(size, rng.choice(("little", "big")))
    return data[:at] + word + data[at + size :]


def _set_real(data, rng):
    at, layout = _place(data, rng), rng.choice("fd")
    value = rng.choice(REALS)
    value = max(-3e38, min(value, 3e38)) if layout == "f" and abs(value) < float("inf") else value
    real = struct.pack("<" + layout, value)
    return data[:at] + real + data[at + len(real) :]


def _delete(data, rng):
    at = _place(data, rng)
    return data[:at] + data[at + rng.choice((1, 2, 8, 64, 1000)) :]


def _repeat(data, rng):
    at, size = _place(data, rng), rng.choice((1, 4, 16, 200))
    return data[:at] + data[at : at + size] * rng.choice((2, 3, 50)) + data[at + size :]


def _insert(data, rng):
    at = _place(data, rng)
    return data[:at] + rng.randbytes(rng.choice((1, 3, 8, 40))) + data[at:]


def _truncate(data, rng):
    return data[: rng.randrange(len(data) + 1)]


def _splice(data, other, rng):
    return data[: _place(data, rng)] + other[_place(other, rng) :]


def _token(data, rng):
    tokens = list(_TOKEN.finditer(data[:200_000]))
    if not tokens:
        return data
    match = rng.choice(tokens)
    value = rng.choice(NUMBERS).encode("utf-8", "surrogatepass")
    return data[: match.start()] + value + data[match.end() :]


def _line(data, rng):
    lines = data.split(b"\n")
    at = rng.randrange(len(lines))
    change = rng.randrange(4)
    if change == 0:
        del lines[at]
    elif change == 1:
        lines.insert(at, lines[rng.randrange(len(lines))])
    elif change == 2:
        lines[at] = b" ".join(lines[at].split()[: rng.randrange(12)])
    else:
        lines[at] += b" " + rng.choice(NUMBERS).encode()
    return b"\n".join(lines)


def _node(data, rng):
    """Another value, a missing key or a deep nest somewhere in a JSON tree."""
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError):
        return data
    places = []

    def walk(node, depth):
        items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
        for key, value in items:
            places.append((node, key))
            if depth < 8:
                walk(value, depth + 1)

    walk(tree, 0)
    if not places:
        return json.dumps(rng.choice(VALUES)).encode()
    node, key = rng.choice(places)
    change = rng.randrange(8)
    if change == 0:
        del node[key]
    elif change == 1 and isinstance(node, dict):
        node[rng.choice(("", "x", "kind", "name", "\ud800", "n" * 5000))] = node[key]
    elif change == 2:
        for _ in range(rng.choice((1, 3, 300))):
            node[key] = [node[key]]
    elif change == 3:
        other, other_key = rng.choice(places)
        node[key] = json.loads(json.dumps(other[other_key])) if other is not node[key] else None
    else:
        node[key] = rng.choice(VALUES)
    try:
        return json.dumps(tree).encode()
    except (ValueError, RecursionError):
        return data
