"""Give advice on a finished training in plain words, each with the command to type."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

STILL_RISING = 0.2  # dB that held-out photos gained in the last third of a training that was too short
UNFINISHED = 0.5  # dB gained there from which blur, and not movement, explains what differs from the photos
FALLING = 0.5  # dB that they lost since their best, in a training that was too long for so few photos
EXPOSURE_JUMP = (
    0.4  # Stops by which a whole photo is brighter or darker than the scene if its exposure is not as stated
)
_FEW_PHOTOS = 30
_MANY_REGIONS = 5  # Unexplained regions for each photo, on average, that say that something moved
_REGION_STOPS = 1.5  # Median difference of the worst regions from which things moved rather than blurred


def advice(path: Path, summary: Mapping[str, Any], train_photos: int, scene: str = "SCENE") -> list[str]:
    """Return lines of advice on a finished training; none if nothing stands out.

    Args:
        path: Folder of the run.
        summary: Run.summary() with the list of evaluations as "metrics".
        train_photos: Number of photos that were trained on.
        scene: Where the photos are, for the commands.
    """
    run, iterations = shlex.quote(str(path)), int(summary["iteration"])
    again = f"sehdr-warp train {shlex.quote(scene)} --out {run} --overwrite"
    points = [(line["iteration"], line["psnr_ldr"]) for line in summary["metrics"] if line.get("split") == "test"]
    points = [(iteration, decibels) for iteration, decibels in points if decibels is not None]
    lines, gain = [], 0.0
    if len(points) >= 3:
        earlier = [decibels for iteration, decibels in points if iteration <= iterations * 2 / 3 + 1]
        gain = points[-1][1] - max(earlier, default=points[0][1])
        best = max(points, key=lambda point: point[1])
        if gain > STILL_RISING:
            command = f"sehdr-warp train --resume --out {run} --iterations {2 * iterations}"
            lines.append(f"held-out photos still gained {gain:.1f} dB at the end; more steps help: {command}")
        elif best[1] - points[-1][1] > FALLING:
            lines.append(
                f"held-out photos were {best[1] - points[-1][1]:.1f} dB better at iteration {best[0]}: {train_photos} "
                f"photos hold no more; add photos from other places, or stop there: {again} --iterations {best[0]}"
            )
        elif train_photos < _FEW_PHOTOS and points[-1][1] < 25:
            lines.append(
                f"{train_photos} photos are few: more from places between them, and nearer, would help most: {again}"
            )
    if gain < UNFINISHED:
        if jump := _exposure_jump(summary.get("brightness_offsets") or {}, again):
            lines.append(jump)
        elif movement := _movement(summary.get("unexplained"), train_photos, again):
            lines.append(movement)
    return lines


def _exposure_jump(offsets: Mapping[str, float], again: str) -> str | None:
    """Return advice on photos whose brightness differs from the scene's as a whole."""
    jumps = sorted((name for name in offsets if abs(offsets[name]) >= EXPOSURE_JUMP), key=lambda n: -abs(offsets[n]))
    if not jumps:
        return None
    names = ", ".join(f"{name} {offsets[name]:+.1f}" for name in jumps[:3]) + (", ..." if len(jumps) > 3 else "")
    what = f"{len(jumps)} photo{'s are' if len(jumps) > 1 else ' is'} brighter or darker than the scene as a whole"
    remedy = f"state their exposure times in exposures.json beside the photos, or leave them out: {again}"
    return f"{what} (stops: {names}), as where exposure or sun changed: {remedy}"


def _movement(unexplained: Mapping[str, Any] | None, train_photos: int, again: str) -> str | None:
    """Return advice on masks if photos differ from the scene in many places by more than blur explains."""
    worst: Sequence[Mapping[str, Any]] = (unexplained or {}).get("worst", ())
    if not worst or unexplained is None or unexplained["regions"] < _MANY_REGIONS * max(train_photos, 1):
        return None
    stops = sorted(abs(region["stops"]) for region in worst)
    if stops[len(stops) // 2] < _REGION_STOPS:
        return None
    photos = list(dict.fromkeys(region["photo"] for region in worst))
    names = ", ".join(photos[:3]) + (", ..." if len(photos) > 3 else "")
    text = "photos and scene differ in many places, as where people or leaves move"
    return f"{text} (worst in {names}): paint these black in masks/PHOTO.png beside the photos: {again}"
