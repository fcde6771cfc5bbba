"""Arrays in a temporary file that is mapped into memory: photos that fit on the disk and not into memory, and what
several processes of one machine read together.

The file has no name once it is open: the system removes it with the last process that uses it, however that ends.
"""

import io
import math
import mmap
import os
import pickle
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError

_LARGE = 1 << 14  # Arrays of fewer bytes are pickled
_ALIGNED = 64


class PhotoFile:
    """Room for `most` bytes of arrays in a nameless file in a folder, by default the system's for temporary files.

    Raises InputError where the folder cannot be written to, and, from keep(), where the disk is full.
    """

    def __init__(self, most: int, folder: Path | str | None = None):
        self.folder = Path(folder or tempfile.gettempdir())
        try:
            # Sparse: what is not written takes no room. Only its end is known, so that it is mapped once.
            self._file = tempfile.TemporaryFile(dir=self.folder, buffering=0)  # noqa: SIM115
            self._file.truncate(most)
        except OSError as error:
            raise self._refused(error) from None
        self.most, self.used = most, 0
        self._map = mmap.mmap(self._file.fileno(), most, access=mmap.ACCESS_COPY)
        self._bytes = np.frombuffer(self._map, np.uint8)

    def keep(self, array: np.ndarray) -> np.ndarray:
        """The same array in the file. One that is there already stays where it is."""
        if self._place(array) is not None:
            return array
        offset, data = self.used, np.ascontiguousarray(array).reshape(-1).view(np.uint8).data
        if offset + len(data) > self.most:
            raise ValueError(f"{len(data)} bytes more than the {self.most} of the file")
        done = 0
        try:
            # Written as a file and not as memory: a full disk is then an error and not the end of the process.
            while done < len(data):
                done += os.pwrite(self._file.fileno(), data[done : done + (1 << 26)], offset + done)
        except OSError as error:
            raise self._refused(error) from None
        self.used = -(-(offset + len(data)) // _ALIGNED) * _ALIGNED
        return self._array(offset, array.dtype, array.shape)

    def share(self, value: Any) -> tuple[str, int, int, int]:
        """Puts any value into the file, large arrays as they are; what taken() gives back in another process, as
        long as this one lives."""
        told = io.BytesIO()
        _Pickler(told, self).dump(value)
        kept = self.keep(np.frombuffer(told.getvalue(), np.uint8))
        place = self._place(kept)
        assert place is not None
        return f"/proc/{os.getpid()}/fd/{self._file.fileno()}", self.most, place, kept.nbytes

    def _place(self, array: np.ndarray) -> int | None:
        """Where in the file an array lies, None for one that is elsewhere."""
        offset = array.ctypes.data - self._bytes.ctypes.data
        inside = 0 <= offset <= self.most - array.nbytes and array.flags.c_contiguous
        return offset if inside else None

    def _array(self, offset: int, dtype: Any, shape: tuple[int, ...]) -> np.ndarray:
        return np.frombuffer(self._map, dtype, math.prod(shape), offset).reshape(shape)

    def _refused(self, error: OSError) -> InputError:
        remedy = "free some of the disk, name a folder with room in TMPDIR, or use smaller photos (--max-size)"
        return InputError(self.folder, f"the photos cannot be kept there ({error.strerror or error})", remedy)


def taken(told: tuple[str, int, int, int]) -> Any:
    """What another process of this user put into its file by share(); arrays stay in the file."""
    path, most, offset, size = told
    with open(path, "rb") as file:
        mapped = mmap.mmap(file.fileno(), most, access=mmap.ACCESS_COPY)
    return _Unpickler(io.BytesIO(mapped[offset : offset + size]), mapped).load()


def can_share() -> bool:
    """Whether this system lets a process open the nameless file of another."""
    return sys.platform == "linux"


class _Pickler(pickle.Pickler):
    def __init__(self, file: io.BytesIO, photos: PhotoFile):
        super().__init__(file, protocol=5)
        self.photos = photos

    def persistent_id(self, obj: Any) -> Any:
        if type(obj) is not np.ndarray or obj.nbytes < _LARGE or obj.dtype.hasobject:
            return None
        kept = self.photos.keep(obj)
        return self.photos._place(kept), kept.dtype.str, kept.shape


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, mapped: mmap.mmap):
        super().__init__(file)
        self.mapped = mapped

    def persistent_load(self, pid: Any) -> np.ndarray:
        offset, dtype, shape = pid
        return np.ndarray(shape, dtype, self.mapped, offset)


def free_bytes(folder: Path | str) -> int:
    """Bytes that the disk of a folder has left for this user; 0 where that cannot be told."""
    with suppress(OSError):
        found = os.statvfs(folder)
        return found.f_bavail * found.f_frsize
    return 0
