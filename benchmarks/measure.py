"""Measure anew what the pages of docs/reports show, all by one build, and write the pages.

python -m benchmarks.measure [PAGE ...] --work measured

The commands of a page are in pages.toml; `$out` in them is a folder of this build, in which each leaves a result as
JSON and `quality` its jobs: called again, it continues with the unfinished jobs. Rows and checks of a page's results
are joined. The page of a command that fails stays as it was. Most commands need a GPU; captures need photos that are
not part of the project.
"""

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from sehdr_warp.caches import package_hash
from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.files import read_json, write_json

from .report_pages import PAGES, REPORTS, ROOT, write_readme, write_reports
from .study import run


def main(pages: tuple[str, ...] = (), /, work: Path = Path("measured")) -> None:
    """Measure for pages and write them.

    Args:
        pages: names of docs/reports; by default all that can be measured.
        work: folder of the results and jobs, which an interrupted measurement continues.
    """
    names = [name for name, page in PAGES.items() if "command" in page]
    if wrong := set(pages) - set(names):
        raise SehdrError(f"{min(wrong)} is not a page to measure; use {', '.join(names)}")
    failed = []
    for name in pages or names:
        print(f"== {name}", flush=True)
        try:
            write_json(
                REPORTS / "results" / f"{name}.json", measure(PAGES[name], work / package_hash() / name), internal=True
            )
        except SehdrError as error:
            failed.append(name)
            print(error, file=sys.stderr)
    write_reports(REPORTS)
    write_readme(ROOT / "README.md", read_json(REPORTS / "results" / "quality.json"))
    if failed:
        raise SehdrError(f"not measured, and their pages stay: {', '.join(failed)}")


def measure(page: Mapping, out: Path) -> dict:
    """Run a page's commands in the repository's root and join their results.

    Raises SehdrError if they fail or leave results of differing builds.
    """
    command = page["command"].strip()
    out.mkdir(parents=True, exist_ok=True)
    for old in out.glob("*.json"):
        old.unlink()
    # The interpreter that runs this finds the commands, and the checkout the package.
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    surroundings = os.environ | {"out": str(out.absolute()), "PATH": path}
    if subprocess.run(["sh", "-ec", command], cwd=ROOT, env=surroundings).returncode:
        raise SehdrError(f"{out}: a command of this page failed")
    results = [read_json(file) for file in sorted(out.glob("*.json"))]
    if not results or len({result["machine"].get("build") for result in results}) > 1:
        raise InputError(out, f"holds {len(results)} results, or of several builds", "measure all of a page at once")
    joined = {name: [item for result in results for item in result[name]] for name in ("rows", "checks", "notes")}
    return results[0] | joined | {"command": command}


if __name__ == "__main__":
    run(main)
