"""A reader of files with small real files to start from, and a folder in which one of them is damaged."""

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sehdr_warp.errors import SehdrError


@dataclass(frozen=True)
class Reader:
    """make: writes the files into an empty folder. files: globs of those that are mutated. read: what is tried, on the
    folder; on the mutated file where it is of each().

    text: the files are text. repair: after a mutation, makes good what would otherwise hide the reader behind it (a
    checksum, a length). cost: milliseconds an input, by which inputs are shared out.
    """

    make: Callable[[Path], None]
    files: tuple[str, ...]
    read: Callable[[Path], object]
    text: bool = False
    repair: Callable[[Path], None] | None = None
    cost: float = 1.0


def each(*readers: Callable[[Path], object]) -> Callable[[Path], None]:
    """Tries every reader on a file, though some raise: the first error is raised at the end."""

    def read_all(path: Path) -> None:
        problem = None
        for read in readers:
            try:
                read(path)
            except SehdrError as error:
                problem = problem or error
        if problem:
            raise problem

    read_all.alone = True
    return read_all


class Workspace:
    """A reader's files in a folder of their own, of which one at a time is changed."""

    def __init__(self, reader: Reader, folder: Path):
        self.reader, self.folder = reader, folder
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        reader.make(folder)
        self.whole = {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
        targets = sorted({path for glob in reader.files for path in folder.glob(glob) if path.is_file()})
        self.targets = {path: self.whole[path] for path in targets}
        self.changed = targets[0]
        self.times = {path: path.stat().st_mtime_ns for path in self.whole}

    def read(self) -> object:
        return self.reader.read(self.changed if hasattr(self.reader.read, "alone") else self.folder)

    def restore(self) -> None:
        paths = [Path(place, name) for place, _, names in os.walk(self.folder) for name in names]
        for path in {*paths} - self.whole.keys():
            path.unlink()
        for path, data in self.whole.items():
            if path == self.changed or not path.is_file() or path.stat().st_mtime_ns != self.times[path]:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(data)
                self.times[path] = path.stat().st_mtime_ns
