"""The rule for commit subjects, as the commit hook and CI apply it."""

import runpy
from pathlib import Path

import pytest

problem_of = runpy.run_path(str(Path(__file__).resolve().parents[2] / ".ci" / "subject.py"))["problem_of"]


@pytest.mark.parametrize(
    "subject", ["tiles: report overflow", "scene, training: train on panoramas", "Merge branch 'x'", "ci: run 3.13"]
)
def test_good_subjects_are_accepted(subject):
    assert problem_of(subject) is None


@pytest.mark.parametrize(
    "subject, problem",
    [
        ("Move them from an eighth of the distance on", "is not `component: summary`"),
        ("tiles: report overflow.", "is not `component: summary`"),
        ("", "is not `component: summary`"),
        ("tiles: " + "x" * 66, "has 73 characters"),
    ],
)
def test_bad_subjects_are_refused(subject, problem):
    assert problem in problem_of(subject)
