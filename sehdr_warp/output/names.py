"""Names of views as names of files."""

import re
from collections.abc import Sequence

# Separators, what Windows forbids, and control characters.
_FORBIDDEN = re.compile(r'[\x00-\x1f\x7f/\\:*?"<>|]')
_LONGEST = 120


def safe_names(names: Sequence[str]) -> list[str]:
    """Return file names for views that are all different, also on systems that ignore case.

    Letters that some system forbids become `_`, leading dots are dropped, names are cut at 120 bytes, and repeated
    names get a number.
    """
    cleaned = [_FORBIDDEN.sub("_", name).strip().lstrip(".").rstrip(". ") for name in names]
    # The file system's limit counts bytes, and prefixes and suffixes still come.
    cleaned = [name.encode("utf-8")[:_LONGEST].decode("utf-8", "ignore") or "view" for name in cleaned]
    reserved, taken_names, result = {name.casefold() for name in cleaned}, set(), []
    for name in cleaned:
        candidate, number = name, 2
        while candidate.casefold() in taken_names or (number > 2 and candidate.casefold() in reserved):
            candidate, number = f"{name}_{number}", number + 1
        taken_names.add(candidate.casefold())
        result.append(candidate)
    return result
