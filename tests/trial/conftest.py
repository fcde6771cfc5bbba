"""A prepared folder for each case, and the table of the trial."""

import json
import os
import shutil
from pathlib import Path

import pytest

from benchmarks.report_tables import trial_table
from benchmarks.results import markdown_table
from tests.fuzz.run import provenance_of, read_values, store_values

from .harness import COMMANDS, SEED, TRAIN, VIEW, browse, call, load


@pytest.fixture(scope="session")
def prepared(tmp_path_factory) -> Path:
    """Photos, a run, a set with truth, and all that commands make of them; how long and how many changes each takes."""
    folder = tmp_path_factory.mktemp("trial") / "space"
    folder.mkdir()
    load(folder)
    changes = {name: call(*words, folder=folder).changes for name, words in COMMANDS.items()}
    again = call(*TRAIN, "--overwrite", "-q", folder=folder)
    anew = call(*[word if word != "run" else "new" for word in TRAIN], "-q", folder=folder)
    shutil.rmtree(folder / "new")
    for suffix in (".glb", ".spz", ".sog", ".compressed.ply"):
        assert call("export", "run", "--out", f"files/a{suffix}", folder=folder).code == 0
    viewed = call(*VIEW, folder=folder, prepare=browse(folder, ever=False))
    changes |= {"train": again.changes, "train anew": anew.changes, "view": viewed.changes}
    shutil.rmtree(folder / "tmp")
    (folder / "run" / "took.json").write_text(json.dumps(again.seconds))
    (folder / "run" / "changes.json").write_text(json.dumps(changes))
    return folder


@pytest.fixture
def space(prepared, tmp_path) -> Path:
    """A copy of it to spoil."""
    return shutil.copytree(prepared, tmp_path / "space", symlinks=True)


KINDS = {"tracebacks": "Traceback", "hangs": "hangs for", "programs": "STARTED"}
"""What a failed case did, by words of its report; any other lost something, or did not say what it should."""


@pytest.hookimpl(trylast=True)
def pytest_terminal_summary(terminalreporter):
    """A line for each family, and the file that SEHDR_TRIAL_JSON names, where other families stay."""
    rows = {}
    for outcome in ("passed", "failed", "error"):
        for report in terminalreporter.stats.get(outcome, ()):
            if "tests/trial/" in report.nodeid and (report.when == "call" or outcome == "error"):
                name = report.nodeid.partition("::")[2].partition("[")[0].removeprefix("test_").replace("_", " ")
                row = rows.setdefault(
                    name, dict.fromkeys(("cases", *KINDS, "lost", "seconds", "longest"), 0) | {"family": name}
                )
                row["cases"] += 1
                row["seconds"], row["longest"] = row["seconds"] + report.duration, max(row["longest"], report.duration)
                if outcome != "passed":
                    row[next((kind for kind, word in KINDS.items() if word in report.longreprtext), "lost")] += 1
                row |= dict(report.user_properties)
    if rows:
        terminalreporter.write_sep("=", f"the trial, seed {SEED}")
        terminalreporter.write_line(markdown_table(*trial_table(rows.values())))
        used = sum(os.times()[:4])  # On a busy machine the seconds of the table say little.
        terminalreporter.write_line(f"{used:.0f} s of processor time, those of pytest and all that it started")
        if path := os.environ.get("SEHDR_TRIAL_JSON"):
            known = {row["family"]: row for row in read_values(Path(path)).get("rows", [])}
            store_values(
                Path(path), rows=[*(known | rows).values()], seed=SEED, **provenance_of("pytest -m trial tests/trial")
            )
