"""The report as one HTML file: what was trained, how well, where it fails, with nothing loaded from elsewhere."""

import shlex
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from sehdr_warp import __version__
from sehdr_warp.scene import Scene
from sehdr_warp.scene.camera import limited_size
from sehdr_warp.scene.exposure import shutter
from sehdr_warp.scene.lens import area_average

from .comparison import Comparison
from .diagrams import camera_map, training_svg
from .light_pictures import (
    dial,
    display_gain,
    img,
    jpeg,
    page_file,
    photographed,
    shown_photo,
    side_choices,
    whole_page,
)
from .tonemap import expose, fit_tone_map
from .ultra_hdr import MOST_STOPS, ultra_hdr

STOPS = (-4, -2, 0, 2, 4)
_PICTURE, _DIAL, _STRIP = 880, 420, 220  # Longest sides of pictures, pixels
_MOST_PHOTOS = 6  # With unexplained regions
SPACE = "\N{NARROW NO-BREAK SPACE}"


def report_page(
    run: Any,
    scene: Scene,
    comparisons: Sequence[Comparison],
    brightest: Comparison,
    *,
    held_out: bool,
    evaluation: Mapping[str, Any] | None = None,
) -> str:
    """Return the whole page as HTML.

    Args:
        run: The trained run.
        scene: What it was trained on.
        comparisons: Views to show.
        brightest: The view with the most clipped light, for the brackets.
        held_out: Whether the views were not trained on.
        evaluation: Result of evaluate(), for the table of held-out views.
    """
    gain = display_gain(run.response)
    times = {view.name: view.exposure_time for view in scene.views}
    sections = [
        _header(run, scene),
        _pictures(run, comparisons, times, held_out),
        _brackets(brightest, times[brightest.name], gain),
        _confidence(comparisons),
        _unexplained(run, scene),
        _plan(run.decisions()),
        _table(evaluation, held_out),
        _section(
            "Error against time",
            "Of all held-out photos, while it was trained.",
            _figure(_wide(training_svg(run.metrics()))),
        ),
        _map(run, comparisons),
        _footer(run, held_out),
    ]
    main, script = "\n".join(filter(None, sections)), "".join(map(page_file, ("tables.js", "light.js", "report.js")))
    body = f"<main>\n{main}\n</main>\n<script>\n{script}</script>"
    return whole_page(f"{scene.name}: sehdr-warp report", "report.css", body)


def _section(title: str, lead: str, body: str) -> str:
    """Return a section of the page; empty without a body."""
    return f"<section>\n<h2>{title}</h2>\n<p>{lead}</p>\n{body}\n</section>" if body else ""


def _figure(body: str, caption: str = "") -> str:
    note = f"\n<figcaption>{caption}</figcaption>" if caption else ""
    return f"<figure>\n{body}{note}\n</figure>" if body else ""


def _wide(body: str) -> str:
    """Wrap what a narrow window should scroll sideways rather than shrink."""
    return f'<div class="wide">{body}</div>' if body else ""


def _header(run: Any, scene: Scene) -> str:
    summary, last = run.summary(), next((line for line in reversed(run.metrics()) if "psnr_ldr" in line), {})
    camera = max((view.camera for view in scene.views), key=lambda camera: camera.width * camera.height)
    times = sorted({view.exposure_time for view in scene.train_views or scene.views})
    span = " to ".join(shutter(time) for time in sorted({times[0], times[-1]}))
    facts = {
        "photos trained on": len(scene.train_views),
        "photos held out": len(scene.test_views),
        "pixels each": f"{camera.width} \N{MULTIPLICATION SIGN} {camera.height}",
        "exposure" if run.photo_gains is None else "exposure, gains counted in": span.replace(" s to", " to"),
        "response": escape(str(run.response.name)),
        "Gaussians": f"{run.gaussian_count:,}".replace(",", SPACE),
        "steps": run.iterations,
        "training": duration(run.train_seconds),
        "held-out photos": f"{last['psnr_ldr']:.1f} dB" if "psnr_ldr" in last else None,
        "held-out HDR, mu-law": f"{last['psnr_mu']:.1f} dB" if "psnr_mu" in last else None,
    }
    items = "".join(f"<li>{name}<b>{value}</b></li>" for name, value in facts.items() if value is not None)
    notes = "".join(f"<li>{escape(note)}</li>" for note in scene.notes)
    note = f"Trained on {escape(summary['device'])}." if "device" in summary else "The training has not ended."
    return (
        f'<header>\n<p class="quiet">sehdr-warp report</p>\n<h1>{escape(scene.name)}</h1>\n'
        f'<p class="quiet">{note}</p>\n'
        f'<ul class="facts">{items}</ul>{f"<ul>{notes}</ul>" if notes else ""}\n</header>'
    )


def _pictures(run: Any, comparisons: Sequence[Comparison], times: Mapping[str, float], held_out: bool) -> str:
    """Photo, scene and truth, two at a time with a slider between them."""
    figures, gain = [], display_gain(run.response)
    for each in comparisons:
        lights = {"Photo": None, "Scene": each.hdr, "Truth": each.truth}
        lights = {name: light for name, light in lights.items() if name == "Photo" or light is not None}
        tags, size = [], _size(each.photo, _PICTURE)
        for name, light in lights.items():
            if light is None:
                data = jpeg(smaller(each.photo, _PICTURE))
            else:
                exposure = smaller(light * times[each.name], _PICTURE)
                data = ultra_hdr(exposure * gain, photographed(run, exposure))
            tags.append(img(data, f"{name} of {each.name}", size, data_name=name))
        split = '<div class="split" style="left: 50%"></div>'
        ratio = f'style="aspect-ratio: {size[0]} / {size[1]}" tabindex="0" role="group"'
        pair = f'<div class="pair" {ratio}>' + "\n".join(tags) + split + "</div>"
        figures.append(_figure(side_choices(list(lights), "Photo", "Scene") + pair, escape(each.name)))
    what = (
        "Held-out views, which the training never saw" if held_out else "Views that were trained on; none is held out"
    )
    lead = f"{what}. Drag across a picture; choose what stands on either side."
    known = any(each.truth is not None for each in comparisons)
    lead += (
        f" {'Scene and truth are' if known else 'The scene is'} Ultra HDR: light up to {MOST_STOPS:g} stops over white "
    )
    lead += "on an HDR display, on any other what the camera would have shown."
    return _section(
        "Photo, scene, truth" if known else "Photo and scene", lead, f'<div class="views">{"".join(figures)}</div>'
    )


def _brackets(comparison: Comparison, time: float, gain: float) -> str:
    sources = {"Photo alone": comparison.from_photo, "Scene": comparison.hdr, "Truth": comparison.truth}
    known = {name: light for name, light in sources.items() if light is not None}
    lights = {name: smaller(light * time, _DIAL) for name, light in known.items()}
    cells = ["<span>&nbsp;</span>", *(f"<span>{stops_text(stop)}</span>" for stop in STOPS)]
    for name, light in known.items():
        small = smaller(light, _STRIP)
        cells.append(f'<span class="name">{name}</span>')
        for stop in STOPS:
            picture = jpeg(expose(small, stop, scale=time * gain), 82)
            cells.append(img(picture, f"{name} at {stops_text(stop)}", (small.shape[1], small.shape[0])))
    lead = (
        f"View {escape(comparison.name)}, re-exposed from {shutter(time)} (0 EV) and shown as a plain display does. "
        "What the photo clipped stays flat; the scene keeps its light."
    )
    body = _figure(dial(lights, time, gain, "Scene")) + _figure(_wide(f'<div class="strip">{"".join(cells)}</div>'))
    return _section("Brackets", lead, body)


def _confidence(comparisons: Sequence[Comparison]) -> str:
    figures = [
        _figure(
            img(jpeg(smaller(np.repeat(each.confidence[..., None], 3, 2), 560)), f"confidence of {each.name}", size),
            f"{escape(each.name)}: {float((each.confidence > 0.5).mean()):.0%} of the picture above a half",
        )
        for each in comparisons
        if each.confidence is not None and (size := _size(each.photo, 560))
    ]
    if not figures:
        return ""
    ends = "<span>0: no photo tells</span><span>1: photos vouch for it</span>"
    lead = (
        "White where photos show the light unclipped and the scene agrees; a half where it is known to a factor of two."
    )
    return _section(
        "Confidence",
        lead,
        f'<div class="views">{"".join(figures)}</div><div class="scale"></div><div class="ends">{ends}</div>',
    )


def _unexplained(run: Any, scene: Scene) -> str:
    """Show the photos with the worst unexplained regions, each region in a box."""
    unexplained = run.summary().get("unexplained")
    if unexplained is None:
        return ""
    views, photos = {view.name: view for view in scene.views}, {}
    for region in unexplained["worst"]:
        if region["photo"] in views:
            photos.setdefault(region["photo"], []).append(region)
    figures = []
    for name, regions in list(photos.items())[:_MOST_PHOTOS]:
        image = shown_photo(run, views[name])
        (height, width), size = image.shape[:2], _size(image, _PICTURE)
        # Lines and letters that look the same on any size of photo.
        unit, boxes = width / 420, []
        for region in regions:
            side = region["pixels"] ** 0.5
            left, top, wide, high = region.get("box") or (
                region["column"] - side / 2,
                region["row"] - side / 2,
                side,
                side,
            )
            color = "#ffb454" if region["stops"] > 0 else "#6cc7e8"
            x, y, w, h = left - 3 * unit, top - 3 * unit, wide + 6 * unit, high + 6 * unit
            place = f'x="{x:.1f}" y="{y:.1f}" width="{w:.1f}" height="{h:.1f}"'
            boxes.append(f'<rect {place} fill="none" stroke="{color}" stroke-width="{1.6 * unit:.2f}"/>')
            below = y < 16 * unit
            at = f'x="{min(x, width - 60 * unit):.1f}" y="{y + h + 14 * unit if below else y - 5 * unit:.1f}"'
            shadow = f"fill:{color};font-size:{15 * unit:.1f}px;"
            shadow += f"paint-order:stroke;stroke:#000;stroke-width:{2.4 * unit:.2f}px"
            boxes.append(f'<text {at} style="{shadow}">{stops_text(region["stops"]).removesuffix(" EV")}</text>')
        picture = (
            img(jpeg(smaller(image, _PICTURE), 84), "", size)
            .replace("<img src=", "<image href=")
            .replace(' alt=""', "")
        )
        picture = picture.replace(f'width="{size[0]}" height="{size[1]}">', f'width="{width}" height="{height}"/>')
        label = f'role="img" aria-label="unexplained regions of {escape(name)}"'
        svg = f'<svg viewBox="0 0 {width} {height}" {label}>{picture}{"".join(boxes)}</svg>'
        figures.append(_figure(svg, f"{escape(name)}: {len(regions)} of the worst regions"))
    counted = (
        f"{unexplained['regions']} regions in {unexplained['photos']} training photos"
        if unexplained["regions"]
        else "None"
    )
    lead = f"{counted}: places that photo and scene show at least a stop apart."
    if figures:
        lead += " Amber: the photo is brighter than the scene, by so many stops; blue: darker."
    return _section("What stays unexplained", lead, f'<div class="views">{"".join(figures)}</div>')


def _plan(decisions: Sequence[Mapping]) -> str:
    rows = [(d["name"], d["choice"], d.get("reason", "")) for d in decisions]
    return _section(
        "What was left out, and why",
        "Decided before the training, from the photos.",
        _rows(("", "choice", "why"), rows),
    )


def _table(evaluation: Mapping[str, Any] | None, held_out: bool) -> str:
    if evaluation is None:
        return ""
    hdr = evaluation["protocol"]["gt-max"]
    known = hdr["psnr_mu"] is not None

    def figures(ldr: Mapping, protocol: Mapping) -> list[str]:
        light = [number(protocol["psnr_mu"], 2), number(protocol["ssim_mu"], 3)] if known else []
        return [number(ldr["psnr"], 2), number(ldr["ssim"], 3), *light]

    none = {"psnr_mu": None, "ssim_mu": None}
    rows = [[row["name"], *figures(row["ldr"], row["protocol"].get("gt-max", none))] for row in evaluation["views"]]
    titles = ["view", "photo PSNR, dB", "photo SSIM", *["HDR mu-law PSNR, dB", "HDR mu-law SSIM"] * known]
    body = _rows(titles, rows, mean=["mean", *figures(evaluation["ldr"], hdr)], first_number=1)
    regions = [
        [name, f"{values['fraction']:.1%}", number(values["psnr_ldr"], 2)]
        + [number(values["psnr_mu"]["gt-max"], 2)] * known
        for name, values in evaluation["regions"].items()
    ]
    titles = ["part of the photos", "pixels", "photo PSNR, dB", *["HDR mu-law PSNR, dB"] * known]
    body += "\n<br>\n" + _rows(titles, regions, first_number=1)
    split = "Held-out views" if held_out else "Training views, since none is held out: figures flatter"
    note = " HDR under the protocol gt-max; <code>sehdr-warp eval</code> has the others." if known else ""
    return _section("Figures", f"{split}.{note}", body)


def _map(run: Any, comparisons: Sequence[Comparison]) -> str:
    tone_map = fit_tone_map([each.hdr for each in comparisons])
    lead = (
        'From above, as the photos see it. <span style="color: var(--accent)">Amber</span>: trained on. '
        '<span style="color: var(--cool)">Blue</span>: held out.'
    )
    svg = camera_map(run, tone_map, [each.name for each in comparisons])
    return _section("Cameras", lead, _figure(svg))


def _footer(run: Any, held_out: bool) -> str:
    cameras = "" if held_out else " --cameras train"
    path = escape(shlex.quote(str(run.path)))
    return (
        f"<footer>\n<p>sehdr-warp {__version__}. Brackets as OpenEXR: <code>sehdr-warp render {path} "
        f"--out views{cameras} --evs=-4,-2,0,2,4</code></p>\n"
        "<p>Radiance is relative, and clipped light is not in the photos.</p>\n</footer>"
    )


def _rows(titles: Sequence[str], rows: Sequence[Sequence], mean: Sequence = (), first_number: int = 99) -> str:
    """Return a table; columns from first_number on hold numbers. Empty without rows."""
    if not rows:
        return ""

    def line(cells: Sequence, tag: str, mark: str = "") -> str:
        kinds = [' class="number"' * (column >= first_number) for column in range(len(cells))]
        return f"<tr{mark}>" + "".join(f"<{tag}{k}>{escape(str(c))}</{tag}>" for c, k in zip(cells, kinds)) + "</tr>"

    body = [line(row, "td") for row in rows] + [line(mean, "td", ' class="mean"')] * bool(mean)
    head = f'<div class="table"><table>\n<thead>{line(titles, "th")}</thead>'
    return f"{head}\n<tbody>{''.join(body)}</tbody>\n</table></div>"


def smaller(picture: np.ndarray, longest: int) -> np.ndarray:
    """[H, W, 3] with at most `longest` pixels on a side, each the mean of what it covers."""
    return area_average(picture, *_size(picture, longest))


def _size(picture: np.ndarray, longest: int) -> tuple[int, int]:
    """Return width and height of a picture reduced to a longest side."""
    height, width = picture.shape[:2]
    return limited_size(width, height, longest)


def stops_text(stops: float) -> str:
    """Format stops as `+2 EV`, `-1.5 EV` with a true minus sign, or `0 EV`."""
    return f"{round(stops, 1):+g} EV".replace("-", "\N{MINUS SIGN}") if stops else "0 EV"


def duration(time: float) -> str:
    """Format seconds as `45 s`, `3 min 20 s` or `2 h 5 min`."""
    minutes, rest = divmod(round(time), 60)
    if minutes < 60:
        return f"{minutes} min {rest} s" if minutes else f"{rest} s"
    return f"{minutes // 60} h {minutes % 60} min"


def number(value: float | None, digits: int) -> str:
    """Format a figure, or a dash if there is none."""
    return "\N{EN DASH}" if value is None else f"{value:.{digits}f}"
