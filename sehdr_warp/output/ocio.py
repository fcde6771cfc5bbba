"""Previews as a production's OpenColorIO config shows them (the extra `ocio`)."""

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.files import read_bytes

from .colorspace import from_rec709

_ROLE = "aces_interchange"


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
    try:
        OCIO: Any = import_module("PyOpenColorIO")  # Its stubs lack what it loads from its library.
    except ImportError:
        raise SehdrError("--ocio needs OpenColorIO; run `pip install sehdr-warp[ocio]`") from None
    if not config.startswith("ocio://"):
        read_bytes(Path(config))
    try:
        read = OCIO.Config.CreateFromFile(config)
        read.validate()
    except (OCIO.Exception, OCIO.ExceptionMissingFile) as error:
        reason = " ".join(str(error).split())
        raise InputError(config, f"is no OpenColorIO config ({reason:.120})", "give a .ocio file") from None
    if not read.hasRole(_ROLE):
        raise InputError(config, f"has no role {_ROLE}, by which light enters", "take a config for OpenColorIO 2")
    display, _, name = view.rpartition("/")
    display = display or read.getDefaultDisplay()
    for what, value, known in (
        ("display", display, list(read.getDisplays())),
        ("view", name, list(read.getViews(display))),
    ):
        if value not in known:
            raise InputError(config, f"has no {what} {value!r}", f"choose one of {', '.join(known)}")
    processor = read.getProcessor(_ROLE, display, name, OCIO.TRANSFORM_DIR_FORWARD).getDefaultCPUProcessor()

    def encode(radiance: np.ndarray) -> np.ndarray:
        pixels = np.ascontiguousarray(from_rec709(radiance, "aces2065-1") * gain, np.float32)
        processor.applyRGB(pixels)
        return np.clip(np.nan_to_num(pixels), 0, 1)

    return encode
