"""Light inside pages: JPEG, and float pictures for a dial, as text that stands in the page."""

import base64
import zlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from markupsafe import Markup

from ..model.color_models import rec709_of
from ..scene import View
from .html import EMPTY, data_block, join, markup
from .images.display import display_gain, encode_srgb

if TYPE_CHECKING:
    from ..runs.run import RenderableScene

SPLIT = markup('<div class="split" style="left: 50%"></div>')  # The handle between two pictures
_DIAL_STOPS = 8.0  # Range of the dial
CURVE_STOPS, CURVE_SIZE = (-20.0, 20.0), 1024  # As light.js has them


def curve_table(response: Any) -> str:
    """Return a response over CURVE_STOPS of exposure, evenly sampled, as half floats in base64.

    Pages draw the camera's look with it. It is green's if a learned response differs by channel.
    """
    exposures = 2.0 ** np.linspace(*CURVE_STOPS, CURVE_SIZE)
    values = np.asarray(response.encode(exposures[:, None].repeat(3, 1)))[:, 1]
    return base64.b64encode(values.astype("<f2").tobytes()).decode()


def photo_light(run: "RenderableScene", view: View) -> np.ndarray:
    """Return [H, W, 3] linear Rec.709 radiance that a photo alone gives: the run's response inverted."""
    light = np.asarray(run.response.decode(view.image), np.float32) / view.exposure_time
    if run.color_matrix is None:
        return light
    return rec709_of(torch.from_numpy(light), run.color_matrix, run.response.white / run.base_time).cpu().numpy()


def photo_for_display(run: "RenderableScene", view: View) -> np.ndarray:
    """Return [H, W, 3] in [0, 1] as a photo is looked at: encoded values, or light in a RAW photo's colors as sRGB."""
    if run.color_matrix is None:
        return view.image
    return simulated_photo(run, photo_light(run, view) * view.exposure_time)


def simulated_photo(run: "RenderableScene", exposure: np.ndarray) -> np.ndarray:
    """Return [H, W, 3] in [0, 1]: Rec.709 exposures as a photo of the run would show them (see photo_for_display)."""
    if run.color_matrix is None:
        return np.clip(run.response.encode(exposure), 0, 1)
    return encode_srgb(exposure * np.float32(display_gain(run.response)))


def img(data: bytes, alternative: str, size: tuple[int, int], **attributes: str) -> Markup:
    """Return an <img> that holds a JPEG; size is width and height."""
    extra = join(markup(' {}="{}"', name.replace("_", "-"), value) for name, value in attributes.items())
    template = '<img src="{}" alt="{}" width="{}" height="{}"{}>'
    return markup(template, jpeg_source(data), alternative, *size, extra)


def jpeg_source(data: bytes) -> str:
    """Return the data URL of a JPEG."""
    return "data:image/jpeg;base64," + base64.b64encode(data).decode()


def packed_light(light: np.ndarray) -> str:
    """Return [H, W, 3] as deflated half floats in base64, which light.js unpacks."""
    half = np.clip(light, 0, np.finfo(np.float16).max).astype("<f2")
    return base64.b64encode(zlib.compress(half.tobytes(), 9)).decode()


def dial(lights: Mapping[str, np.ndarray], base_time: float, gain: float, right: str) -> Markup:
    """Return HTML that shows pictures of one size under one exposure dial, two of them side by side.

    Args:
        lights: Name -> [H, W, 3] exposures at the base time.
        base_time: Seconds.
        gain: See display_gain.
        right: Name of the picture on the right.
    """
    height, width = next(iter(lights.values())).shape[:2]
    blocks = join(data_block(packed_light(light), data_light=name) + "\n" for name, light in lights.items())
    pair = len(lights) > 1
    return markup(
        """<div class="dial" data-width="{width}" data-height="{height}" data-time="{time!r}" data-grey="{grey!r}" \
style="--ratio: {ratio:.4f}">
{blocks}{sides}<div class="stage"><canvas width="{width}" height="{height}"></canvas>{split}</div>
<p class="exposure">Exposure <input type="range" min="-{stops}" max="{stops}" step="0.05" value="0" \
aria-label="exposure in stops"><output>0 EV</output></p>
</div>""",
        width=width,
        height=height,
        time=float(base_time),
        grey=float(gain),
        ratio=width / height,
        blocks=blocks,
        sides=side_choices(list(lights), next(iter(lights)), right) if pair else EMPTY,
        split=SPLIT if pair else EMPTY,
        stops=_DIAL_STOPS,
    )


def side_choices(names: list[str], left: str, right: str) -> Markup:
    """Return the two <select> elements that choose what stands left and right of a split."""
    selects = []
    for side, selected in (("left", left), ("right", right)):
        options = (markup("<option{}>{}</option>", EMPTY if n != selected else markup(" selected"), n) for n in names)
        selects.append(markup('<select aria-label="{}">{}</select>', side, join(options)))
    return markup('<div class="sides">{}</div>\n', join(selects))
