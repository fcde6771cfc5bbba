"""A prepared folder for each case, and the table of the trial."""

import json
import shutil
from collections import defaultdict
from pathlib import Path

import pytest

from .harness import COMMANDS, TRAIN, call, load


@pytest.fixture(scope="session")
def prepared(tmp_path_factory) -> Path:
    """Photos, a run, a set with truth, and all that commands make of them; how long and how many changes each takes."""
    folder = tmp_path_factory.mktemp("trial") / "space"
    folder.mkdir()
    load(folder)
    changes = {name: call(*words, folder=folder).changes for name, words in COMMANDS.items()}
    again = call(*TRAIN, "--overwrite", "-q", folder=folder)
    (folder / "run" / "took.json").write_text(json.dumps(again.seconds))
    (folder / "run" / "changes.json").write_text(json.dumps(changes | {"train": again.changes}))
    return folder


@pytest.fixture
def space(prepared, tmp_path) -> Path:
    """A copy of it to spoil."""
    return shutil.copytree(prepared, tmp_path / "space", symlinks=True)


@pytest.hookimpl(trylast=True)
def pytest_terminal_summary(terminalreporter):
    """Cases, failures and seconds of each family."""
    rows = defaultdict(lambda: [0, 0, 0.0, 0.0])
    for outcome in ("passed", "failed", "error"):
        for report in terminalreporter.stats.get(outcome, ()):
            if "tests/trial/" in report.nodeid and (report.when == "call" or outcome == "error"):
                row = rows[report.nodeid.partition("::")[2].partition("[")[0].removeprefix("test_").replace("_", " ")]
                row[0] += 1
                row[1] += outcome != "passed"
                row[2], row[3] = row[2] + report.duration, max(row[3], report.duration)
    if rows:
        terminalreporter.write_sep("=", "the trial")
        terminalreporter.write_line(f"{'family':<64}{'cases':>6}{'failed':>8}{'seconds':>9}{'longest':>9}")
        total = [sum(row[i] for row in rows.values()) for i in range(3)]
        for name, row in (*sorted(rows.items()), ("all", [*total, max(row[3] for row in rows.values())])):
            terminalreporter.write_line(f"{name:<64}{row[0]:>6}{row[1]:>8}{row[2]:>9.1f}{row[3]:>9.1f}")
