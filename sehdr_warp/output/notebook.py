"""Display of a run in a notebook: its figures, and a view under an exposure slider that needs no kernel."""

from typing import TYPE_CHECKING

import numpy as np

from ..progress import format_duration
from .html import markup, page_file, whole_page
from .images.display import display_gain
from .light_pictures import dial

if TYPE_CHECKING:
    from ..runs.run import Run

_LONGEST = 420  # Pixels of a side of the picture, which the notebook keeps
_STYLE = "body { padding: 12px; font-size: 13px; } canvas { display: block; width: 100%; border-radius: 3px; }"
_STYLE += " p { margin: 0 0 8px; color: #8a8783; } .exposure { display: grid; grid-template-columns: auto 1fr 9.5em;"
_STYLE += " gap: 14px; align-items: center; margin: 8px 0 0; } output { text-align: right; }"


def run_html(run: "Run") -> str:
    """Return HTML of a run: one frame with all it needs, which static pages of a notebook show too."""
    entries = run.cameras
    opening = next((entry for entry in entries if entry.split == "test"), entries[0] if entries else None)
    figures = [f"{run.gaussian_count:,} Gaussians", f"{run.iterations} steps", format_duration(run.train_seconds)]
    scores = [line["psnr_ldr"] for line in run.metrics() if "psnr_ldr" in line]
    figures += [f"held-out PSNR {score:.1f} dB" for score in scores[-1:]]
    figures += [f"view {opening.name}"] if opening else []
    body, height = markup("<p><b>{}</b> &middot; {}</p>", run.scene_name, " · ".join(figures)), 72
    if opening is not None:
        camera = opening.camera.within(_LONGEST)
        light = run.render(camera).hdr.cpu().numpy() * np.float32(run.base_time)
        body += dial({"scene": light}, run.base_time, display_gain(run.response), "scene")
        height += 34 + round(_LONGEST * camera.height / camera.width)
    script = "".join(map(page_file, ("tables.js", "light.js")))
    script += "document.querySelectorAll('.dial').forEach(startDial);"
    return markup(
        '<iframe srcdoc="{}" width="{}" height="{}" sandbox="allow-scripts allow-downloads" '
        'style="border: 0; border-radius: 6px; max-width: 100%"></iframe>',
        str(whole_page(run.scene_name, _STYLE, body, [script])),
        _LONGEST + 24,
        height,
    )
