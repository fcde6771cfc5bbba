"""Arrays in a temporary file that is mapped into memory.

For photos that fit on the disk and not into memory, and for what several processes of one machine read together. The
file has no name once it is open: the system removes it with the last process that uses it, however that ends.
"""

import io
import math
import mmap
import os
import pickle
import shutil
import sys
import tempfile
import weakref
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..caches import cache_folder, usable
from ..errors import InputError
from ..limits import available_memory, format_bytes
from .types import View

_LARGE = 1 << 14  # Bytes; smaller arrays are pickled
_ALIGNED = 64
_ARRAYS = "codes", "mask", "hdr", "light_above_white"
_LEAST, _MOST_BYTES = 1 << 30, 28  # Of a file, and of a pixel in it: 16-bit codes, a mask, truth, light above white
SHARE = 0.5  # Photos of a scene stay in memory if they take at most this share of what is free


class _Map(mmap.mmap):
    owner: Any = None


class PhotoFile:
    """Space for arrays in a nameless file in a folder, by default the user's cache."""

    def __init__(self, most: int, folder: Path | str | None = None):
        """Create the file.

        Args:
            most: bytes that the file can hold.
            folder: where it lies; None is the user's cache.

        Raises:
            InputError: if the folder cannot be written to.
        """
        self.folder = Path(folder or _folder())
        try:
            # A sparse file: only what is written takes space on the disk. Its full size is set now and mapped once.
            self._file = tempfile.TemporaryFile(dir=self.folder, buffering=0)  # noqa: SIM115
            self._file.truncate(most)
        except OSError as error:
            raise self._refused(error) from None
        self.most, self.end = most, 0
        # A shared mapping, although nothing writes through it: a private one would count as memory of this process.
        self._map = _Map(self._file.fileno(), most, access=mmap.ACCESS_WRITE)
        self._map.owner = self  # The file stays open for as long as any array lies in it.
        self._start = np.frombuffer(self._map, np.uint8, 1).ctypes.data
        self.path = f"/proc/{os.getpid()}/fd/{self._file.fileno()}"
        _files.add(self)

    def keep(self, array: np.ndarray) -> np.ndarray:
        """Return the array as part of the file; one that lies there already is returned as it is.

        Raises:
            InputError: if the disk is full.
        """
        if self.place(array) is not None:
            return array
        offset, data = self.end, np.ascontiguousarray(array).reshape(-1).view(np.uint8).data
        if offset + len(data) > self.most:
            raise ValueError(f"{len(data)} bytes more than the {self.most} of the file")
        written_bytes = 0
        try:
            # Written as a file and not as memory: a full disk is then an error and not the end of the process.
            while written_bytes < len(data):
                written_bytes += os.pwrite(
                    self._file.fileno(), data[written_bytes : written_bytes + (1 << 26)], offset + written_bytes
                )
        except OSError as error:
            raise self._refused(error) from None
        self.end = -(-(offset + len(data)) // _ALIGNED) * _ALIGNED
        return self._array(offset, array.dtype, array.shape)

    def share(self, value: Any) -> tuple:
        """Put any value into the file, large arrays without a copy.

        Returns:
            A handle from which open_shared() gives the value back in another process, while this one lives.
        """
        pickled = io.BytesIO()
        _Pickler(pickled, self).dump(value)
        return self.handle(self.keep(np.frombuffer(pickled.getvalue(), np.uint8)))

    def handle(self, array: np.ndarray) -> tuple:
        """Return what another process needs to find an array of this file."""
        return self.path, self.most, self.place(array), array.dtype.str, array.shape

    def place(self, array: np.ndarray) -> int | None:
        """Return the offset of an array in the file, None for one that lies elsewhere."""
        offset = array.ctypes.data - self._start
        inside = 0 <= offset <= self.most - array.nbytes and array.flags.c_contiguous
        return offset if inside else None

    def _array(self, offset: int, dtype: Any, shape: tuple[int, ...]) -> np.ndarray:
        return np.frombuffer(self._map, dtype, math.prod(shape), offset).reshape(shape)

    def _refused(self, error: OSError) -> InputError:
        remedy = "free some of the disk, name a folder with room in TMPDIR, or use smaller photos (--max-size)"
        return InputError(self.folder, f"the photos cannot be kept there ({error.strerror or error})", remedy)


_files: weakref.WeakSet[PhotoFile] = weakref.WeakSet()


def file_of(array: np.ndarray) -> PhotoFile | None:
    """Return the file that an array lies in, None if it is in memory."""
    return next((file for file in _files if file.place(array) is not None), None)


def open_shared(handle: tuple) -> Any:
    """Return what another process of this user put into its file by share(); arrays stay in the file."""
    finder = _Unpickler(io.BytesIO())
    return _Unpickler(io.BytesIO(finder.persistent_load(handle).tobytes())).load()


def can_share() -> bool:
    """Return whether this system lets a process open the nameless file of another."""
    return sys.platform == "linux"


class _Pickler(pickle.Pickler):
    def __init__(self, file: io.BytesIO, photos: PhotoFile):
        super().__init__(file, protocol=5)
        self.photos = photos

    def persistent_id(self, obj: Any) -> Any:
        if type(obj) is not np.ndarray or obj.nbytes < _LARGE or obj.dtype.hasobject:
            return None
        file = file_of(obj) or self.photos
        return file.handle(file.keep(obj))


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO):
        super().__init__(file)
        self._maps: dict[str, mmap.mmap] = {}

    def persistent_load(self, pid: Any) -> np.ndarray:
        path, most, offset, dtype, shape = pid
        if path not in self._maps:
            with open(path, "r+b") as file:
                self._maps[path] = mmap.mmap(file.fileno(), most, access=mmap.ACCESS_WRITE)
        return np.frombuffer(self._maps[path], dtype, math.prod(shape), offset).reshape(shape)


class PhotoKeeper:
    """Keeper of a scene's photos, in memory or in a file on the disk that the system pages in as they are used."""

    def __init__(self, where: str, count: int, pixels: int):
        """Prepare for the photos of a scene.

        Args:
            where: "memory", "disk", or "auto" for the disk if the photos would take more than SHARE of the free memory.
            count: number of photos.
            pixels: of all photos together, at their full size.
        """
        self.where, self.count, self.pixels = where, count, pixels
        self.file: PhotoFile | None = None
        self.note: str | None = None

    def store(self, view: View) -> View:
        """Return the view with its arrays in their final place, which the first view's size decides.

        Raises:
            InputError: if neither memory nor disk have enough space.
        """
        arrays = {name: array for name in _ARRAYS if (array := getattr(view, name)) is not None}
        if self.note is None:
            self._decide(self.count * sum(array.nbytes for array in arrays.values()))
        if self.file is None:
            return view
        return replace(view, **{name: a if file_of(a) else self.file.keep(a) for name, a in arrays.items()})

    def _decide(self, size: int) -> None:
        free, self.note = available_memory(), ""
        if self.where == "memory" or (self.where == "auto" and size <= SHARE * free):
            return
        folder = _folder()
        disk = shutil.disk_usage(folder).free
        sizes = f"the photos take {format_bytes(size)}; {format_bytes(free)} of memory are free"
        if size > disk:
            remedy = "use smaller photos (--max-size), free some of it, or name a folder of another disk in SEHDR_CACHE"
            raise InputError(folder, f"{sizes}, and {format_bytes(disk)} of this disk", remedy)
        # Views are at most as large as their photos; masks and truth are floats.
        self.file = PhotoFile(max(_LEAST, 2 * size, self.pixels * _MOST_BYTES), folder)
        self.note = (
            f"photos: {sizes}: they are read from a nameless file in {folder}, which is deleted when this process ends"
        )


def _folder() -> Path:
    folder = cache_folder()
    if folder is None or not usable(folder):
        return Path(tempfile.gettempdir())
    return folder
