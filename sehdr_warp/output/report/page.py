"""The report as one HTML file: what was trained, how well, where it fails, with nothing loaded from elsewhere."""

import shlex
from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import Any

import numpy as np
from markupsafe import Markup

from ... import __version__
from ...model.lights import Light
from ...progress import format_duration
from ...runs.run import Run
from ...scene import Scene
from ...scene.camera import limited_size
from ...scene.exposure.times import shutter
from ...scene.images.downsampling import area_average
from ..html import EMPTY, join, markup, page_file, whole_page, with_code
from ..images.display import expose
from ..images.ldr_files import jpeg
from ..images.tonemap import fit_tone_map
from ..images.ultra_hdr import MOST_STOPS, ultra_hdr
from ..light_pictures import SPLIT, dial, img, jpeg_source, photo_for_display, side_choices, simulated_photo
from ..lighting.lights import lights_by_name, uncertain_lights
from ..lighting.unit import luminance_of_one, read_light_unit
from ..world_transform import WorldTransform, world_transform
from .comparison import Comparison, first_picture
from .diagrams import camera_map, training_svg

STOPS = (-4, -2, 0, 2, 4)
_PICTURE, _DIAL, _STRIP = 880, 420, 220  # Longest sides of pictures, pixels
_MOST_PHOTOS = 6  # With unexplained regions
_MOST_LIGHTS = 12  # In the table
SPACE = "\N{NARROW NO-BREAK SPACE}"


def report_page(
    run: Run,
    scene: Scene,
    comparisons: Sequence[Comparison],
    brightest: Comparison,
    *,
    held_out: bool,
    evaluation: Mapping[str, Any] | None = None,
    lights: Sequence[Light] = (),
) -> str:
    """Return the whole page as HTML.

    Args:
        run: The trained run.
        scene: What it was trained on.
        comparisons: Views to show.
        brightest: The view with the most light above white, for the first picture and the brackets.
        held_out: Whether the views were not trained on.
        evaluation: Result of evaluate(), for the table of held-out views.
        lights: The lights of the scene, as from run.find_lights().
    """
    sections = [
        _header(run, scene, _first_picture(brightest)),
        _pictures(run, comparisons, held_out),
        _brackets(brightest),
        _lights(lights, luminance_of_one(run), world_transform(run)) if lights else EMPTY,
        _confidence(comparisons),
        _unexplained_regions(run, scene),
        _plan(run.decisions()),
        _table(evaluation, held_out),
        _section(
            "PSNR over time", "Of all held-out photos, while it was trained.", _figure(training_svg(run.metrics()))
        ),
        _map(run, comparisons),
        _footer(run, held_out),
    ]
    body = markup("<main>\n{}\n</main>", join(filter(None, sections), "\n"))
    script = "".join(map(page_file, ("tables.js", "light.js", "report.js")))
    return whole_page(f"{scene.name}: sehdr-warp report", page_file("report.css"), body, [script])


def _section(title: str, lead: str | Markup, body: Markup) -> Markup:
    """Return a section of the page; empty without a body."""
    return markup("<section>\n<h2>{}</h2>\n<p>{}</p>\n{}\n</section>", title, lead, body) if body else EMPTY


def _figure(body: Markup, caption: str = "") -> Markup:
    note = markup("\n<figcaption>{}</figcaption>", caption) if caption else EMPTY
    return markup("<figure>\n{}{}\n</figure>", body, note) if body else EMPTY


def _views(figures: Sequence[Markup]) -> Markup:
    return markup('<div class="views">{}</div>', join(figures))


def _header(run: Run, scene: Scene, picture: Markup) -> Markup:
    """Return title, first picture and figures of the training."""
    summary, last = run.summary(), next((line for line in reversed(run.metrics()) if "psnr_ldr" in line), {})
    camera = max((view.camera for view in scene.views), key=attrgetter("pixel_count"))
    of_one_size = len({view.codes.shape for view in scene.views}) == 1
    times = sorted({view.exposure_time for view in scene.train_views or scene.views})
    span = " to ".join(shutter(time) for time in sorted({times[0], times[-1]})).replace(" s to", " to")
    exposure = "exposure" if run.exposure_compensation is None else "exposure, compensated"
    facts = {
        "photos trained on": len(scene.train_views),
        "photos held out": len(scene.test_views),
        f"pixels {'each' if of_one_size else 'at most'}": f"{camera.width} \N{MULTIPLICATION SIGN} {camera.height}",
        exposure: span.replace(" s", "\N{NO-BREAK SPACE}s"),
        "response": run.response.name,
        "Gaussians": f"{run.gaussian_count:,}".replace(",", SPACE),
        "steps": run.iterations,
        "training": format_duration(run.train_seconds),
        "radiance of 1, cd/m\N{SUPERSCRIPT TWO}": None if (unit := luminance_of_one(run)) is None else f"{unit:.4g}",
        "held-out photos": _decibels(last, "psnr_ldr"),
        "held-out HDR, mu-law": _decibels(last, "psnr_mu"),
    }
    items = join(markup("<li>{}<b>{}</b></li>", name, value) for name, value in facts.items() if value is not None)
    # A response that was guessed is named when the photos are read again, so that only the training noted its doubt.
    notes = join(markup("<li>{}</li>", with_code(note)) for note in dict.fromkeys((*run.notes(), *scene.notes)))
    device = summary.get("device")
    return markup(
        '<header>\n<p class="quiet">sehdr-warp report</p>\n<h1>{}</h1>\n<p class="quiet">{}</p>\n'
        '</header>\n{}\n<ul class="facts">{}</ul>{}',
        scene.name,
        f"Trained on {device}." if device else "The training has not ended.",
        picture,
        items,
        markup("<ul>{}</ul>", notes) if notes else EMPTY,
    )


def _pictures(run: Run, comparisons: Sequence[Comparison], held_out: bool) -> Markup:
    """Photo, scene and truth, two at a time with a slider between them."""
    figures = []
    for each in comparisons:
        lights = {"Photo": None, "Scene": each.hdr, "Truth": each.truth}
        lights = {name: light for name, light in lights.items() if name == "Photo" or light is not None}
        tags, size = [], _size(each.photo, _PICTURE)
        for name, light in lights.items():
            if light is None:
                data = jpeg(smaller(each.photo, _PICTURE))
            else:
                exposure = smaller(light * each.exposure_time, _PICTURE)
                data = ultra_hdr(exposure * each.gain, simulated_photo(run, exposure))
            tags.append(img(data, f"{name} of {each.name}", size, data_name=name))
        pair = '<div class="pair" style="aspect-ratio: {} / {}" tabindex="0" role="group">{}{}</div>'
        choices = side_choices(list(lights), "Photo", "Scene")
        figures.append(_figure(choices + markup(pair, *size, join(tags, "\n"), SPLIT), each.name))
    what = (
        "Held-out views, which the training never saw" if held_out else "Views that were trained on; none is held out"
    )
    lead = f"{what}. Drag across a picture; choose what stands on either side."
    has_truth = any(each.truth is not None for each in comparisons)
    subject = "Scene and truth are" if has_truth else "The scene is"
    lead += f" {subject} Ultra HDR: light up to {MOST_STOPS:g} stops over white on an HDR display, "
    lead += "on any other what the camera would have shown."
    return _section("Photo, scene, truth" if has_truth else "Photo and scene", lead, _views(figures))


def _first_picture(comparison: Comparison) -> Markup:
    """Return the picture that a reader sees first: photo and scene side by side, as dark as shows their difference."""
    stops, title, lead = first_picture(comparison)
    figures = []
    for name, light in (("Photo", comparison.from_photo), ("Scene", comparison.hdr)):
        small = smaller(light, _PICTURE)
        picture = jpeg(expose(small, stops, scale=comparison.scale))
        caption = f"{name} at {stops_text(stops)}"
        figures.append(_figure(img(picture, caption, (small.shape[1], small.shape[0])), caption))
    return _section(title, lead, _views(figures))


def _brackets(comparison: Comparison) -> Markup:
    time = comparison.exposure_time
    sources = {"Photo alone": comparison.from_photo, "Scene": comparison.hdr, "Truth": comparison.truth}
    present = {name: light for name, light in sources.items() if light is not None}
    lights = {name: smaller(light * time, _DIAL) for name, light in present.items()}
    cells = [markup("<span>&nbsp;</span>"), *(markup("<span>{}</span>", stops_text(stop)) for stop in STOPS)]
    for name, light in present.items():
        small = smaller(light, _STRIP)
        cells.append(markup('<span class="name">{}</span>', name))
        for stop in STOPS:
            picture = jpeg(expose(small, stop, scale=comparison.scale), 82)
            cells.append(img(picture, f"{name} at {stops_text(stop)}", (small.shape[1], small.shape[0])))
    lead = (
        f"View {comparison.name}, re-exposed from {shutter(time)} (0 EV) and shown as a plain display does. "
        "What the photo clipped stays flat; the scene keeps its light."
    )
    body = _figure(dial(lights, time, comparison.gain, "Scene")) + _figure(
        markup('<div class="strip">{}</div>', join(cells))
    )
    return _section("Brackets", lead, body)


def _lights(lights: Sequence[Light], unit: float | None, transform: WorldTransform) -> Markup:
    """Return the table of the lights that photos clip, with places in the coordinates of exported files.

    unit: cd/m^2 of a radiance of 1, None if it is not known.
    """
    rows, by_name = [], lights_by_name(lights)
    # Photos walk around a light without a share, however bright it is.
    without_share = [name for name, light in by_name.items() if not light.share][:_MOST_LIGHTS]
    names = {*list(by_name)[: _MOST_LIGHTS - len(without_share)], *without_share}
    listed = {name: light for name, light in by_name.items() if name in names}
    for name, light in listed.items():
        radiances = (float((unit or 1.0) * np.mean(values)) for values in (light.radiance, light.lower_bound))
        sides = light.shape.size if light.shape.kind == "rect" else light.shape.size[:1]
        size = f"{SPACE}\N{MULTIPLICATION SIGN}{SPACE}".join(_rounded(transform.scale * side) for side in sides)
        place = ",\N{NO-BREAK SPACE}".join(map(_rounded, transform.points(light.shape.position)))
        figures = (f"{light.share:.1%}", *map(_rounded, radiances), number(light.deviation, 1))
        rows.append((name, light.shape.kind, size, place, *figures))
    measure = "radiance" if unit is None else "cd/m\N{SUPERSCRIPT TWO}"
    titles = ("name", "shape", "size", "place", "share of light", measure, "certain at least", "deviation, stops")
    lead = (
        "Lamps, windows and other areas that photos clip, by their share of light. Their radiance is an estimate "
        "with a deviation; what photos show as white is certain. Places are upright, as in exported files. Share: of "
        "the light at the default place of envmap."
    )
    if len(lights) > _MOST_LIGHTS:
        others = ", and lights that photos walk around" * bool(without_share)
        lead += f" {len(listed)} of {len(lights)}: the largest shares{others}."
    lead = " ".join([lead, *(f"{sentence}." for sentence in uncertain_lights(listed))])
    return _section("Lights", lead, _rows(titles, rows, first_number=4))


def _confidence(comparisons: Sequence[Comparison]) -> Markup:
    figures = [
        _figure(
            img(jpeg(smaller(np.repeat(each.confidence[..., None], 3, 2), 560)), f"confidence of {each.name}", size),
            f"{each.name}: {float((each.confidence > 0.5).mean()):.0%} of the picture above a half",
        )
        for each in comparisons
        if each.confidence is not None and (size := _size(each.photo, 560))
    ]
    if not figures:
        return EMPTY
    scale = markup(
        '<div class="scale"></div><div class="ends"><span>0: no photo shows it</span>'
        "<span>1: photos show it and agree</span></div>"
    )
    lead = (
        "White where photos show the light unclipped and the scene agrees; a half where it is known to a factor of two."
    )
    return _section("Confidence", lead, _views(figures) + scale)


def _unexplained_regions(run: Run, scene: Scene) -> Markup:
    """Show the photos with the worst unexplained regions, each region in a box."""
    unexplained = run.summary().get("unexplained")
    if unexplained is None:
        return EMPTY
    views, photos = {view.name: view for view in scene.views}, {}
    for region in unexplained["worst"]:
        if region["photo"] in views:
            photos.setdefault(region["photo"], []).append(region)
    figures = []
    for name, regions in list(photos.items())[:_MOST_PHOTOS]:
        svg = _boxed_photo(photo_for_display(run, views[name]), name, regions)
        figures.append(_figure(svg, f"{name}: {len(regions)} of the worst regions"))
    summary = (
        f"{unexplained['regions']} regions in {unexplained['photos']} training photos"
        if unexplained["regions"]
        else "None"
    )
    lead = f"{summary}: places that photo and scene show at least a stop apart."
    if figures:
        lead += " Amber: the photo is brighter than the scene, by so many stops; blue: darker."
    return _section("What stays unexplained", lead, _views(figures))


def _boxed_photo(image: np.ndarray, name: str, regions: Sequence[Mapping]) -> Markup:
    """Draw a photo with a box around each region, and the stops beside it."""
    height, width = image.shape[:2]
    unit, boxes = width / 420, []  # Lines and letters look the same on any size of photo.
    for region in regions:
        left, top, wide, high = region["box"]
        color = "#ffb454" if region["stops"] > 0 else "#6cc7e8"
        x, y, w, h = left - 3 * unit, top - 3 * unit, wide + 6 * unit, high + 6 * unit
        rect = '<rect x="{:.1f}" y="{:.1f}" width="{:.1f}" height="{:.1f}" fill="none" stroke="{}" '
        rect += 'stroke-width="{:.2f}"/>'
        boxes.append(markup(rect, x, y, w, h, color, 1.6 * unit))
        text = '<text x="{:.1f}" y="{:.1f}" style="fill:{};font-size:{:.1f}px;font-weight:600;paint-order:stroke;'
        text += 'stroke:#000;stroke-width:{:.2f}px">{}</text>'
        baseline = y + h + 14 * unit if y < 16 * unit else y - 5 * unit
        stops = stops_text(region["stops"]).removesuffix(" EV")
        left = min(max(x, 3 * unit), width - 60 * unit)  # Whole letters, although boxes may reach beyond the photo
        boxes.append(markup(text, left, baseline, color, 15 * unit, 2.4 * unit, stops))
    source = jpeg_source(jpeg(smaller(image, _PICTURE), 84))
    return markup(
        '<svg viewBox="0 0 {width} {height}" role="img" aria-label="unexplained regions of {name}">'
        '<image href="{source}" width="{width}" height="{height}"/>{boxes}</svg>',
        width=width,
        height=height,
        name=name,
        source=source,
        boxes=join(boxes),
    )


def _plan(decisions: Sequence[Mapping]) -> Markup:
    rows = [(d["name"], d["choice"], d.get("reason", "")) for d in decisions]
    return _section(
        "What was decided, and why",
        "Before the training, from the photos.",
        _rows(("", "choice", "why"), rows),
    )


def _table(evaluation: Mapping[str, Any] | None, held_out: bool) -> Markup:
    if evaluation is None:
        return EMPTY
    hdr = evaluation["protocol"]["gt-max"]
    has_hdr = hdr["psnr_mu"] is not None

    def figures(ldr: Mapping, protocol: Mapping) -> list[str]:
        light = [number(protocol["psnr_mu"], 2), number(protocol["ssim_mu"], 3)] if has_hdr else []
        return [number(ldr["psnr"], 2), number(ldr["ssim"], 3), *light]

    none = {"psnr_mu": None, "ssim_mu": None}
    rows = [[row["name"], *figures(row["ldr"], row["protocol"].get("gt-max", none))] for row in evaluation["views"]]
    titles = ["view", "photo PSNR, dB", "photo SSIM", *["HDR mu-law PSNR, dB", "HDR mu-law SSIM"] * has_hdr]
    body = _rows(titles, rows, mean=["mean", *figures(evaluation["ldr"], hdr)], first_number=1)
    regions = [
        [name, f"{values['fraction']:.1%}", number(values["psnr_ldr"], 2)]
        + [number(values["psnr_mu"]["gt-max"], 2)] * has_hdr
        for name, values in evaluation["regions"].items()
    ]
    titles = ["part of the photos", "pixels", "photo PSNR, dB", *["HDR mu-law PSNR, dB"] * has_hdr]
    body += markup("\n<br>\n") + _rows(titles, regions, first_number=1)
    split = "Held-out views" if held_out else "Training views, since none is held out: figures are too high"
    note = markup(" HDR under the protocol gt-max; <code>sehdr-warp eval</code> has the others.") if has_hdr else EMPTY
    return _section("Figures", markup("{}.{}", split, note), body)


def _map(run: Run, comparisons: Sequence[Comparison]) -> Markup:
    gain = float(np.median([each.scale for each in comparisons]))
    tone_map = fit_tone_map([each.hdr for each in comparisons], [each.alpha for each in comparisons], gain)
    lead = markup(
        'From above, as the photos see it. <span style="color: var(--accent)">Amber</span>: trained on. '
        '<span style="color: var(--cool)">Blue</span>: held out.'
    )
    svg = camera_map(run, tone_map, [each.name for each in comparisons])
    return _section("Cameras", lead, _figure(svg))


def _footer(run: Run, held_out: bool) -> Markup:
    return markup(
        "<footer>\n<p>sehdr-warp {}. Brackets as OpenEXR: <code>sehdr-warp render {} --out views{} --evs=-4,-2,0,2,4"
        "</code></p>\n<p>{}, and clipped light is not in the photos.</p>\n</footer>",
        __version__,
        shlex.quote(str(run.path)),
        "" if held_out else " --cameras train",
        read_light_unit(run) or "Radiance is relative",
    )


def _rows(titles: Sequence[str], rows: Sequence[Sequence], mean: Sequence = (), first_number: int = 99) -> Markup:
    """Return a table; columns from first_number on hold numbers. Empty without rows."""
    if not rows:
        return EMPTY

    def line(cells: Sequence, plain: str, numeric: str) -> Markup:
        templates = [numeric if column >= first_number else plain for column in range(len(cells))]
        return join(markup(template, cell) for template, cell in zip(templates, cells, strict=True))

    cell = "<td>{}</td>", '<td class="number">{}</td>'
    head = markup("<tr>{}</tr>", line(titles, "<th>{}</th>", '<th class="number">{}</th>'))
    body = [markup("<tr>{}</tr>", line(row, *cell)) for row in rows]
    body += [markup('<tr class="mean">{}</tr>', line(mean, *cell))] if mean else []
    template = '<div class="table"><table>\n<thead>{}</thead>\n<tbody>{}</tbody>\n</table></div>'
    return markup(template, head, join(body))


def smaller(picture: np.ndarray, longest: int) -> np.ndarray:
    """[H, W, 3] with at most `longest` pixels on a side, each the mean of what it covers."""
    return area_average(picture, *_size(picture, longest))


def _size(picture: np.ndarray, longest: int) -> tuple[int, int]:
    """Return width and height of a picture reduced to a longest side."""
    return limited_size(picture.shape[1], picture.shape[0], longest)


def stops_text(stops: float) -> str:
    """Format stops as `+2 EV`, `-1.5 EV` with a true minus sign, or `0 EV`."""
    return f"{round(stops, 1):+g} EV".replace("-", "\N{MINUS SIGN}") if stops else "0 EV"


def number(value: float | None, digits: int) -> str:
    """Format a figure, or a dash if there is none."""
    return "\N{EN DASH}" if value is None else f"{value:.{digits}f}"


def _rounded(value: float) -> str:
    """Format a figure with three digits, without powers of ten from 0.0001 on."""
    rounded = float(f"{value:.3g}")
    return f"{rounded:,.0f}".replace(",", SPACE) if abs(rounded) >= 1000 else f"{rounded:g}"


def _decibels(line: Mapping[str, Any], key: str) -> str | None:
    value = line.get(key)
    return None if value is None else f"{value:.1f} dB"
