"""Compares the pins of constraints.txt with a stored copy of PyPA's advisory database, without a network.

git clone --depth 1 https://github.com/pypa/advisory-database
python .ci/audit.py advisory-database
"""

import sys
from pathlib import Path

import yaml
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


def main(database: Path) -> int:
    stored, hits = sorted((database / "vulns").glob("*/*.yaml")), 0
    if not stored:
        sys.exit(f"{database}: holds no advisories; clone https://github.com/pypa/advisory-database")
    by_name: dict[str, list[dict]] = {}
    lines = (line.partition(";")[0].strip() for line in PINS.read_text().splitlines())
    pins = [line.split("==") for line in lines if "==" in line]
    pinned, newest = {canonicalize_name(name) for name, _ in pins}, ""
    for path in stored:
        if canonicalize_name(path.parent.name) in pinned:
            advisory = yaml.load(path.read_text(encoding="utf-8"), yaml.CSafeLoader)
            by_name.setdefault(canonicalize_name(path.parent.name), []).append(advisory)
            newest = max(newest, str(advisory["modified"])[:10])
    for name, version in pins:
        for advisory in by_name.get(canonicalize_name(name), ()):
            if holes(advisory, canonicalize_name(name), Version(version)):
                print(f"{name}=={version}: {advisory['id']} {', '.join(advisory.get('aliases', ()))}")
                hits += 1
    count = sum(map(len, by_name.values()))
    print(f"{len(pins)} pins, {count} advisories about them, the newest of {newest or 'no day'}: {hits} holes")
    return int(hits > 0)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
