"""Camera responses by name: formulae, the encodings of colour-science, and curves from files.

Listing their names loads no torch.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import InputError
from .names import DESCRIPTIONS

if TYPE_CHECKING:
    from .curve import Response
    from .files import responses_in_file
    from .learned import ToneMapper

__all__ = ["Response", "ToneMapper", "response_by_name", "response_names", "responses_in_file", "responses_named"]


def __getattr__(name: str):
    if name not in ("Response", "ToneMapper", "responses_in_file"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from . import analytic, files, learned  # All: Response.from_dict() knows the kinds whose modules are loaded.

    globals().update(Response=analytic.Response, ToneMapper=learned.ToneMapper)
    globals().update(responses_in_file=files.responses_in_file)
    return globals()[name]


def response_names() -> dict[str, str]:
    """Return the responses with a formula, each with a line that says what it is for."""
    return dict(DESCRIPTIONS)


def response_by_name(text: str | Path) -> "Response":
    """Return the response of a name or file, as a user writes it.

    Args:
        text: one of response_names(); `gamma-G`; `colour:S-Log3` and the like; `FILE` or `FILE:SELECTOR` (see
            response_from_file), such as `my_camera.csv`, `201_CRF_data.mat:17` or `emor.txt:0.5,-0.1`.

    Raises:
        SehdrError: for a name that is not known.
        InputError: for a file that cannot be used.
    """
    from .analytic import analytic_response
    from .files import colour_response, response_from_file

    text = str(text).strip()
    if text.lower().startswith("colour:"):
        return colour_response(text.split(":", 1)[1])
    if _is_file(text):
        return response_from_file(Path(text))
    path, _, selector = text.rpartition(":")
    return response_from_file(Path(path), selector) if _is_file(path) else analytic_response(text)


def responses_named(text: str | Path) -> "list[Response]":
    """Return every curve of a file that holds many, or the one that response_by_name returns."""
    from .files import responses_in_file

    if _is_file(str(text)):
        try:
            return responses_in_file(text)
        except InputError:
            pass  # A file of one curve: response_by_name reads it, or says what is wrong with it.
    return [response_by_name(text)]


def _is_file(text: str) -> bool:
    try:
        return Path(text).is_file()
    except OSError:  # A name too long for the file system.
        return False
