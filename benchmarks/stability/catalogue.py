"""All cases by group: those of `sehdr-warp check`, and those of light and training."""

from sehdr_warp.check.case import Case
from sehdr_warp.check.splat_cases import POISON_CASES, SPLAT_CASES
from sehdr_warp.errors import SehdrError

from .light_cases import LIGHT_CASES
from .training_cases import TRAINING_CASES

CASES: tuple[Case, ...] = (*SPLAT_CASES, *LIGHT_CASES, *POISON_CASES, *TRAINING_CASES)


def choose_cases(names: str | None, quick: bool = False) -> list[Case]:
    """Return the cases with these names or groups, all by default.

    Args:
        names: cases or groups, separated by commas; None chooses all.
        quick: leave out the cases that take seconds, unless they are named.

    Raises:
        SehdrError: for a name that is not known.
    """
    if names is None:
        return [case for case in CASES if case.quick or not quick]
    result: dict[str, Case] = {}
    for name in (part.strip() for part in names.split(",")):
        matches = {case.name: case for case in CASES if name in (case.group, case.name)}
        if not matches:
            names_text = ", ".join(dict.fromkeys([case.group for case in CASES] + [case.name for case in CASES]))
            raise SehdrError(f"--cases {name:.60}: no such case; choose from {names_text}")
        result |= matches
    return list(result.values())
