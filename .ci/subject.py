"""Check the subject of a commit message: `component: imperative summary`, at most 72 characters.

python .ci/subject.py FILE      a message, as git's hook commit-msg passes it
python .ci/subject.py           the subject of HEAD
"""

import re
import subprocess
import sys
from pathlib import Path

LIMIT = 72
PATTERN = re.compile(r"[a-z][\w.-]*(, [a-z][\w.-]*)*: \S.*[^.\s]")


def problem_of(subject: str) -> str | None:
    """Return what is wrong with a subject, or None."""
    if subject.startswith(("Merge ", "Revert ", "fixup! ", "squash! ")):
        return None
    if len(subject) > LIMIT:
        return f"has {len(subject)} characters, at most {LIMIT} are allowed; put the reason below"
    if not PATTERN.fullmatch(subject):
        return "is not `component: summary`, such as `tiles: report overflow during emission`"
    return None


def main() -> None:
    """Exit with a message if the subject is wrong."""
    if len(sys.argv) > 1:
        text = Path(sys.argv[1]).read_text(encoding="utf-8")
    else:
        text = subprocess.run(["git", "log", "-1", "--format=%s"], capture_output=True, text=True, check=True).stdout
    subject = (text.splitlines() or [""])[0]
    if problem := problem_of(subject):
        sys.exit(f"commit subject {subject!r} {problem}")


if __name__ == "__main__":
    main()
