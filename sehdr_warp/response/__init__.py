"""Camera responses by name: the formulae, the encodings of colour-science, and curves from files."""

from pathlib import Path

from .analytic import analytic_names, analytic_response
from .curve import Response
from .files import colour_response, response_from_file, responses_in_file
from .learned import ToneMapper
from .refined import RefinedResponse

__all__ = ["RefinedResponse", "Response", "ToneMapper", "response_by_name", "response_names", "responses_in_file"]


def response_names() -> list[str]:
    """The responses with a formula. Besides, response_by_name takes `gamma-G`, `colour:NAME` and files."""
    return list(analytic_names())


def response_by_name(text: str | Path) -> Response:
    """A response from what a user writes.

    One of response_names(); `hdr-nerf` (another name of reinhard-gamma); `gamma-G`; `colour:S-Log3` and the other
    encodings of colour-science; `FILE` or `FILE:SELECTOR` (see response_from_file), such as
    `201_CRF_data.mat:17`, `dorfCurves.txt:agfachrome-ctpreciska50Red`, `emor.txt:0.5,-0.1`, `my_camera.csv`.

    Raises SehdrError for a name that is not known, InputError for a file that cannot be used.
    """
    text = str(text).strip()
    if text.lower().startswith("colour:"):
        return colour_response(text.split(":", 1)[1])
    path, _, selector = text.rpartition(":")
    for candidate, chosen in ((text, None), (path, selector)):
        if candidate and _is_file(candidate):
            return response_from_file(Path(candidate), chosen)
    return analytic_response(text)


def _is_file(text: str) -> bool:
    try:
        return Path(text).is_file()
    except OSError:  # A name too long for the file system.
        return False
