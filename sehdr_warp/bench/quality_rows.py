"""The results of `bench quality`: reading them, and what makes two of them comparable."""

from collections.abc import Callable, Sequence
from pathlib import Path

from .quality_jobs import LEARNED, RESPONSES, read_failure, read_job, read_result


def collect(out: Path) -> tuple[list[dict], list[tuple[str, str]]]:
    """Every complete result in the job folders, without its single views, and (job, error) of every failed one."""
    rows, failures = [], []
    for folder in sorted((out / "jobs").glob("*")) if (out / "jobs").is_dir() else ():
        result, failure = read_result(folder), read_failure(folder)
        if result is not None:
            figures = {name: value for name, value in result["figures"].items() if name != "views"}
            rows.append(result | {"figures": figures})
        elif failure is not None:
            failures.append((read_job(folder).label, failure["error"]))
    return rows, failures


def newest(rows: Sequence[dict]) -> tuple[list[dict], int]:
    """Of results for one place in the table (config changed in between), the newest; and how many were left out."""
    kept: dict[tuple, dict] = {}
    for row in sorted(rows, key=lambda row: row["date"]):
        kept[(*axes(row), iterations(row), method(row), knowledge(row))] = row
    keys = {row["key"] for row in kept.values()}
    return [row for row in rows if row["key"] in keys], len(rows) - len(keys)


def axes(row: dict) -> tuple:
    """What two results must share to be compared: photos, views, seed and kind of device."""
    config = row["config"]
    scene, photo = config["scene"], config["photo"]
    noise = tuple(photo["noise"] or ())
    places = (
        scene["name"],
        scene["max_size"],
        photo["curve"],
        photo["exposure"],
        photo["count"],
        photo["factor"],
        noise,
    )
    return (*places, config["seed"], config["device"])


def method(row: dict) -> str:
    return row["config"]["method"]["name"]


def iterations(row: dict) -> int:
    return row["config"]["training"]["schedule"]["iterations"]


def line_name(row: dict, rows: Sequence[dict]) -> str:
    """The method, with its iterations where it was trained in several lengths."""
    lengths = {iterations(other) for other in rows if method(other) == method(row)}
    return method(row) if len(lengths) == 1 else f"{method(row)} {iterations(row):,}"


def grouped(rows: Sequence[dict], key: Callable) -> dict:
    """Rows by key, keys sorted."""
    found: dict = {}
    for row in rows:
        found.setdefault(key(row), []).append(row)
    return {name: found[name] for name in sorted(found)}


def knowledge(row: dict) -> str:
    """known, blind, or learned, where the curve is learned with the scene and was not told either way."""
    learned = row["config"]["training"]["response"]["name"] == "learned"
    return LEARNED if learned else row["config"]["response"]


def by_table(rows: Sequence[dict]) -> dict[tuple[str, str, str], list[dict]]:
    """The results of each table by (device, curve, known or blind). One with a learned response stands in both: it is a
    rival of those that were told the curve and of those that were not. Where there is no other, the key
    ends in "learned".
    """
    found: dict = {}
    for (device, curve), members in grouped(rows, lambda row: (row["config"]["device"], _curve(row))).items():
        learned = [row for row in members if knowledge(row) == LEARNED]
        told = [name for name in sorted(RESPONSES) if any(knowledge(row) == name for row in members)]
        for name in told or [LEARNED]:
            others = [row for row in members if knowledge(row) == name != LEARNED]
            found[device, curve, name] = others + learned
    return found


def exposure(row: dict) -> int:
    return row["config"]["photo"]["exposure"]


def _curve(row: dict) -> str:
    return row["config"]["photo"]["curve"]
