"""How far above white light is expected to be where photos clip, as far as the photos themselves tell."""

import math
from collections.abc import Sequence

import numpy as np

from ..response import Response
from ..scene import View
from .config import LossConfig
from .losses import CODE

CHANNEL_PARTS = (0.39, 0.61, 1.0)
"""Of loss.highlight_stops, where one, two and three channels of a pixel clip: a channel that clips alone is seldom
far above white. Fitted, together with the default of highlight_stops, to four of the embedded scenes."""
LONG_TAIL = 2.0
"""Stops; a tail that is longer says no more. Chosen with CHANNEL_PARTS."""


def expected_excess(views: Sequence[View], response: Response, loss: LossConfig) -> tuple[float, float, float] | None:
    """Stops over white that light is expected at where one, two and three channels of a pixel clip.

    views: the training photos; response: the curve that decodes them.

    loss.highlight_stops times CHANNEL_PARTS, and shorter in proportion where tail_stops is below LONG_TAIL: a wall that
    is just too bright clips much, but hardly. None where the prior has no weight, or nothing clips; with
    loss.highlight_expected "fixed", highlight_stops for all three.
    """
    if loss.highlight_weight == 0:
        return None
    if loss.highlight_expected == "fixed":
        return (loss.highlight_stops,) * 3
    tail = tail_stops(views, response)
    if tail == 0:
        return None
    most = loss.highlight_stops * min(tail / LONG_TAIL, 1.0)
    return tuple(part * most for part in CHANNEL_PARTS)


def tail_stops(views: Sequence[View], response: Response) -> float:
    """The mean excess over white, in stops, of an exponential tail through two shares of the photos' values: S_0, which
    clips, and S_1, which shows at least half of white's exposure. 0 where nothing clips; infinity where nothing lies
    between, or everything clips.

    With light above white / 2 distributed as exp(-s / T) in stops s, S_1 / S_0 = exp(1 / T), so T = 1 / ln(S_1 / S_0).
    The whole photo counts, every channel by itself; values outside a mask do not.
    """
    half = float(response.encode(response.white / 2))
    clipped = bright = 0
    for view in views:
        values = view.image if view.mask is None else view.image[view.mask > 0]
        clipped += int(np.count_nonzero(values >= 1 - CODE / 2))
        bright += int(np.count_nonzero(values >= half))
    if clipped == 0:
        return 0.0
    return math.inf if bright <= clipped else 1 / math.log(bright / clipped)
