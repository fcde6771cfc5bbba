"""Diagrams of the report as SVG: held-out PSNR against time, and where the photos were taken."""

import base64
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup
from PIL import Image

from ...runs.run import RenderableScene
from ...scene import Camera
from ...scene.camera_focus import camera_positions
from ...subsets import evenly
from ..cameras.framing import visible_surface
from ..cameras.scene_cameras import split_or_all
from ..html import EMPTY, join, markup
from ..images.ldr_files import quantize
from .charts import PANELS, training_points

LINE, COLORS = "var(--line)", ("var(--accent)", "var(--cool)")  # Of style.css
_MAP_VIEWS, _MAP_SIZE, _SAMPLES = 12, 640, 200


def training_svg(metrics: Sequence[Mapping]) -> Markup:
    """Plot held-out PSNR in dB against training seconds, a line for each of PANELS; empty without figures."""
    from matplotlib.ticker import MaxNLocator

    lines = {title: points for key, title in PANELS.items() if (points := training_points(metrics, key))}
    if not lines:
        return EMPTY
    seconds, decibels = zip(*(point for line in lines.values() for point in line))
    least, steps = min(decibels), [1, 2, 5, 10]
    times = MaxNLocator(6, steps=steps).tick_values(0, max(seconds) or 1.0)
    # At least 2 dB, so that all levels are whole: others are wider than the space beside the plot.
    levels = MaxNLocator(6, steps=steps, integer=True).tick_values(least, max(*decibels, least + 2))

    def place(seconds: float, decibels: float) -> tuple[float, float]:
        return 40 + 440 * seconds / times[-1], 250 - 215 * (decibels - levels[0]) / (levels[-1] - levels[0])

    elements = []
    for level in levels:
        y = place(0, level)[1]
        grid = '<path d="M40 {:.1f}H480" stroke="{}"/><text x="0" y="{:.1f}">{:g} dB</text>'
        elements.append(markup(grid, y, LINE, y + 4, level))
    for time in times:
        x, anchor = place(time, levels[0])[0], "start" if time == 0 else "end" if time == times[-1] else "middle"
        elements.append(markup('<text x="{:.1f}" y="272" text-anchor="{}">{:g} s</text>', x, anchor, time))
    for left, color, (title, line) in zip((40, 200), COLORS, lines.items()):
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in (place(*point) for point in line))
        elements.append(markup('<polyline points="{}" fill="none" stroke="{}" stroke-width="2"/>', path, color))
        dot = '<circle cx="{:.1f}" cy="{:.1f}" r="2.5" fill="{}"/>'
        elements += [markup(dot, *place(*point), color) for point in line]
        elements.append(
            markup('<text x="{}" y="14" style="fill:{}">{}: {:.1f} dB</text>', left, color, title, line[-1][1])
        )
    return _svg(484, 280, "Held-out PSNR against training time", elements)


def camera_map(run: RenderableScene, tone_map: Any, names: Sequence[str] = ()) -> Markup:
    """Draw the scene from above as its training photos show it, with training and held-out cameras, some with `names`.

    Returns SVG, empty if there are no cameras; `tone_map` converts radiance [N, 3] to sRGB.
    """
    entries = run.cameras
    if not entries:
        return EMPTY
    cameras = [entry.camera for entry in entries]
    up = -np.mean([camera.world_to_camera[1, :3] for camera in cameras], axis=0)
    up /= max(float(np.linalg.norm(up)), 1e-9)
    east = cameras[0].world_to_camera[0, :3] - up * (up @ cameras[0].world_to_camera[0, :3])
    east /= max(float(np.linalg.norm(east)), 1e-9)
    plane = np.stack([east, np.cross(up, east)])  # Away from the first camera is up on the page.
    positions = camera_positions(cameras) @ plane.T
    points, colors = _visible_points(split_or_all(run, "train"), run, up)
    ground = points @ plane.T
    spread = np.concatenate([positions, np.percentile(ground, (2, 98), axis=0)] if len(ground) else [positions])
    low, high = spread.min(axis=0), spread.max(axis=0)
    margin = 0.08 * max(float((high - low).max()), 1e-6)
    low, size = low - margin, float((high - low).max()) + 2 * margin
    width, height = (_MAP_SIZE * (high - low + margin) / size).tolist()

    def place(at: np.ndarray) -> np.ndarray:
        return (at - low) / size * [1, -1] * _MAP_SIZE + [0, height]

    elements = [_ground(place(ground), tone_map(colors), round(width), round(height))] if len(ground) else []
    for entry, at in zip(entries, place(positions)):
        camera, color = entry.camera, COLORS[entry.split != "train"]
        across = camera.width / camera.fx / 2
        corners = [plane @ (camera.world_to_camera[:3, :3].T @ [side * across, 0, 1]) for side in (-1, 1)]
        ends = [at + 26 * corner * [1, -1] / max(np.linalg.norm(corner), 1e-9) for corner in corners]
        wedge = " ".join(f"{x:.1f},{y:.1f}" for x, y in (at, *ends))
        elements.append(
            markup(
                '<g fill="{color}" stroke="{color}"><title>{name} ({split})</title>'
                '<polygon points="{wedge}" fill-opacity="0.18"/><circle cx="{x:.1f}" cy="{y:.1f}" r="3"/></g>',
                color=color,
                name=entry.name,
                split=entry.split,
                wedge=wedge,
                x=at[0],
                y=at[1],
            )
        )
        if entry.name in names:
            style = "fill:var(--ink);stroke:var(--ground);stroke-width:3px;paint-order:stroke"
            label = '<text x="{:.1f}" y="{:.1f}" style="{}">{}</text>'
            elements.append(markup(label, at[0] + 7, at[1] - 6, style, entry.name))
    return _svg(round(width), round(height), "Cameras from above", elements)


def _visible_points(cameras: Sequence[Camera], run: RenderableScene, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points of the scene [N, 3] and their radiance, from small renders of some cameras.

    What lies higher than the cameras, such as a ceiling, is left out.
    """
    views = evenly(cameras, _MAP_VIEWS)
    small = [view.resized(_SAMPLES, max(1, round(_SAMPLES * view.height / view.width))) for view in views]
    points, light = map(np.concatenate, zip(*(visible_surface(run, each, 0.9) for each in small), strict=True))
    below = points @ up < max(float(view.position @ up) for view in views)
    order = np.argsort(points[below] @ up)
    return points[below][order], light[below][order]


def _ground(at: np.ndarray, colors: np.ndarray, width: int, height: int) -> Markup:
    """Draw points, in pixels, as an SVG <image>; later points cover earlier ones."""
    inside = ((at >= 0) & (at < [width - 1, height - 1])).all(axis=1)
    column, row = at[inside].astype(int).T
    picture = np.zeros((height, width, 4), np.uint8)
    codes = quantize(colors[inside])
    for x, y in ((0, 0), (1, 0), (0, 1), (1, 1)):
        picture[row + y, column + x] = np.append(codes, np.full((len(codes), 1), 170, np.uint8), axis=1)
    buffer = io.BytesIO()
    Image.fromarray(picture).quantize(128).save(buffer, "PNG", optimize=True)
    source = "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()
    return markup('<image href="{}" width="{}" height="{}"/>', source, width, height)


def _svg(width: int, height: int, title: str, parts: Sequence[Markup]) -> Markup:
    template = '<svg class="diagram" viewBox="0 0 {} {}" role="img" aria-label="{}">\n{}\n</svg>'
    return markup(template, width, height, title, join(parts, "\n"))
