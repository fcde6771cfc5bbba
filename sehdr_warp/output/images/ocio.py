"""Previews as a production's OpenColorIO config shows them (the extra `ocio`)."""

import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError, require_extra
from ...files import read_bytes, read_text
from .colorspace import from_rec709

_ROLE = "aces_interchange"
_LARGEST = 256 << 20  # Bytes of a config, and of a LUT


def ocio_view(config: str, view: str, gain: float = 1.0) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function from linear Rec.709 radiance [H, W, 3] to encoded values in [0, 1].

    Args:
        config: A file (.ocio, .ocioz) or a built-in config (ocio://default). Light enters as ACES2065-1, by the role
            aces_interchange.
        view: View of the default display, or "DISPLAY/VIEW".
        gain: Factor from radiance to display light, in which 1 is the photos' white.

    Raises:
        SehdrError: Without OpenColorIO.
        InputError: For a config that cannot be read, or that lacks the role, display or view.
    """
    OCIO = require_extra("PyOpenColorIO", "--ocio needs OpenColorIO", "ocio")
    # Messages quote the files, whose bytes need not be UTF-8.
    refused = (OCIO.Exception, OCIO.ExceptionMissingFile, UnicodeDecodeError)
    try:
        read, files = _open_config(OCIO, config)
        read.validate()
    except refused as error:
        raise InputError(config, f"is not an OpenColorIO config ({_line(error):.120})", "give a .ocio file") from None
    if not read.hasRole(_ROLE):
        raise InputError(config, f"has no role {_ROLE}, which previews need", "take a config for OpenColorIO 2")
    display, _, name = view.rpartition("/")
    display = display or read.getDefaultDisplay()
    for what, value, options in (
        ("display", display, list(read.getDisplays())),
        ("view", name, list(read.getViews(display))),
    ):
        if value not in options:
            raise InputError(config, f"has no {what} {value!r}", f"choose one of {', '.join(options)}")
    try:
        processor = read.getProcessor(_ROLE, display, name, OCIO.TRANSFORM_DIR_FORWARD).getDefaultCPUProcessor()
    except refused as error:
        if files is not None and files.refusal is not None:
            raise files.refusal from None
        problem = f"its view {name!r:.60} cannot be used ({_line(error):.160})"
        raise InputError(config, problem, "check the config and its LUTs") from None

    def encode(radiance: np.ndarray) -> np.ndarray:
        pixels = np.ascontiguousarray(from_rec709(radiance, "aces2065-1") * gain, np.float32)
        processor.applyRGB(pixels)
        return np.clip(np.nan_to_num(pixels), 0, 1)

    return encode


def _line(error: Exception) -> str:
    return " ".join(str(error).split())


def _check_archive(path: Path) -> None:
    """Raise InputError for an archive that is damaged, or unpacks to more than a LUT may have."""
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        problem = f"is not an archive of a config ({error!s:.80})"
        raise InputError(path, problem, "archive it again with ocioarchive") from None
    if size > _LARGEST:
        raise InputError(path, f"unpacks to {size} bytes, more than {_LARGEST}", "use the config without an archive")


def _open_config(OCIO: Any, config: str) -> tuple[Any, Any]:
    """Return a config, and what reads its LUTs; None for a built-in config and an archive, which hold theirs."""
    if config.startswith("ocio://"):
        return OCIO.Config.CreateFromFile(config), None
    path = Path(config)
    if path.suffix.lower() == ".ocioz":
        read_bytes(path, _LARGEST)
        _check_archive(path)
        return OCIO.Config.CreateFromFile(config), None
    text = read_text(path, _LARGEST)

    class Files(OCIO.PyConfigIOProxy):
        """Reads the LUTs that a config names, by our bounded reader: its own waits for pipes and ends at no size."""

        refusal: InputError | None = None

        def getConfigData(self) -> str:
            return text

        def getFastLutFileHash(self, name: str) -> str:
            """Return what identifies a file; empty if there is none."""
            if not os.path.lexists(name):
                return ""
            try:
                contents.setdefault(name, bytearray(read_bytes(Path(name), _LARGEST)))
            except InputError as error:
                # Of a name without content OpenColorIO would open the file itself.
                self.refusal, contents[name] = error, bytearray(1)
            return name

        def getLutData(self, name: str) -> bytearray:
            return contents[name]

    contents: dict[str, bytearray] = {}
    files = Files()
    OCIO.ClearAllCaches()  # It would take another file's content for that of the same name.
    read = OCIO.Config.CreateFromConfigIOProxy(files)
    read.setWorkingDir(str(path.absolute().parent))
    return read, files
