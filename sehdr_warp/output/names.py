"""Names of views as names of files."""

import re
from collections.abc import Sequence

# Separators, what Windows forbids, and control characters.
_FORBIDDEN = re.compile(r'[\x00-\x1f\x7f/\\:*?"<>|]')
_LONGEST = 120


def safe_names(names: Sequence[str]) -> list[str]:
    """File names for views, all different, also where upper and lower case are one: what some system forbids becomes
    `_`, leading dots go, 120 bytes are the most, and of equal names the later ones get a number."""
    cleaned = [_FORBIDDEN.sub("_", name).strip().lstrip(".").rstrip(". ") for name in names]
    # The file system's limit counts bytes, and prefixes and suffixes still come.
    cleaned = [name.encode("utf-8")[:_LONGEST].decode("utf-8", "ignore") or "view" for name in cleaned]
    wanted, taken, result = {name.casefold() for name in cleaned}, set(), []
    for name in cleaned:
        candidate, number = name, 2
        while candidate.casefold() in taken or (number > 2 and candidate.casefold() in wanted):
            candidate, number = f"{name}_{number}", number + 1
        taken.add(candidate.casefold())
        result.append(candidate)
    return result
