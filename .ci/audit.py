"""Compares the pins of constraints.txt with stored lists of known holes, without a network: PyPA's advisory database,
or the versions that PyUp's Safety DB lists (free for uses that are not commercial; a month behind).

git clone --depth 1 https://github.com/pypa/advisory-database
git clone --depth 1 https://github.com/pyupio/safety-db
python .ci/audit.py advisory-database
python .ci/audit.py safety-db
"""

import json
import sys
from datetime import UTC, datetime
from pathlib import Path

import yaml
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from packaging.version import Version

PINS = Path(__file__).resolve().parents[1] / "constraints.txt"


def holes(advisory: dict, name: str, version: Version) -> bool:
    """Whether an advisory (the OSV schema) is about this version of a package."""
    for affected in advisory.get("affected", ()):
        if canonicalize_name(affected["package"]["name"]) != name or advisory.get("withdrawn"):
            continue
        if str(version) in affected.get("versions", ()):
            return True
        for each in affected.get("ranges", ()):
            inside = False
            for event in each["events"] if each["type"] == "ECOSYSTEM" else ():
                (kind, limit), *_ = event.items()
                reached = version > Version(limit) if kind == "last_affected" else version >= Version(limit)
                inside = (kind == "introduced") if reached else inside
            if inside:
                return True
    return False


def read_pins() -> list[tuple[str, str]]:
    """Name and version of each pin."""
    lines = (line.partition(";")[0].strip() for line in PINS.read_text().splitlines())
    pairs = (line.split("==") for line in lines if "==" in line)
    return [(canonicalize_name(name), version) for name, version in pairs]


def safety(listed: Path) -> int:
    """Look for the pins in Safety DB's versions by package."""
    values = json.loads(listed.read_text(encoding="utf-8"))
    day = datetime.fromtimestamp(values.pop("$meta")["timestamp"], UTC).date()
    by_name = {canonicalize_name(name): ranges for name, ranges in values.items()}
    pins, hits, about = read_pins(), 0, 0
    for name, version in pins:
        about += len(by_name.get(name, ()))
        for each in by_name.get(name, ()):
            if SpecifierSet(each).contains(version, prereleases=True):
                print(f"{name}=={version}: {each}")
                hits += 1
    print(f"{len(pins)} pins, {about} ranges about them, of {day}: {hits} holes")
    return int(hits > 0)


def main(database: Path) -> int:
    if (listed := database / "data" / "insecure.json").is_file():
        return safety(listed)
    stored, hits = sorted((database / "vulns").glob("*/*.yaml")), 0
    if not stored:
        sys.exit(f"{database}: holds no advisories; clone https://github.com/pypa/advisory-database")
    by_name: dict[str, list[dict]] = {}
    pins = read_pins()
    pinned, newest = {name for name, _ in pins}, ""
    for path in stored:
        if canonicalize_name(path.parent.name) in pinned:
            advisory = yaml.load(path.read_text(encoding="utf-8"), yaml.CSafeLoader)
            by_name.setdefault(canonicalize_name(path.parent.name), []).append(advisory)
            newest = max(newest, str(advisory["modified"])[:10])
    for name, version in pins:
        for advisory in by_name.get(name, ()):
            if holes(advisory, name, Version(version)):
                print(f"{name}=={version}: {advisory['id']} {', '.join(advisory.get('aliases', ()))}")
                hits += 1
    count = sum(map(len, by_name.values()))
    print(f"{len(pins)} pins, {count} advisories about them, the newest of {newest or 'no day'}: {hits} holes")
    return int(hits > 0)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
