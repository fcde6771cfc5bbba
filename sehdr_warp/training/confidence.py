"""The confidence of a trained scene: measured on its training photos, kept in the run, so that renders need no photos.

RUN/confidence.safetensors holds confidence, seen, stops and clipped, [N] float32 each (see model/confidence.py), and
states the checkpoint that it belongs to: after more training it counts as absent until it is measured again.
"""

from collections.abc import Callable
from pathlib import Path

from torch import Tensor

from ..errors import InputError, SehdrError
from ..field.confidence import Evidence, gather_evidence
from ..files import atomic_path
from ..scene import Scene
from .checkpoint import Checkpoint, first_not_finite

CONFIDENCE = "confidence.safetensors"
FORMAT = "1"


def measure_confidence(run, scene: Scene) -> Evidence:
    """What the training photos of a scene say of a run's Gaussians; the run's model has their confidence from then on.

    run: a Run. scene: of its photos; its training views are looked at, without their HDR truth unless that was trained
    on.
    """
    loss = run.config.loss
    truth = loss.uses_hdr and not loss.predictor
    evidence = gather_evidence(run.model, scene.train_views, degree=run.degree, truth=truth)
    run.model.confidence = evidence.confidence()
    return evidence


def write_confidence(run, evidence: Evidence) -> Path:
    """Writes the evidence into a run's folder, in place of an earlier one. Raises SehdrError if the disk refuses."""
    from safetensors.torch import save

    tensors = {
        "confidence": evidence.confidence(),
        "seen": evidence.seen,
        "stops": evidence.stops,
        "clipped": evidence.clipped,
    }
    stated = {"format": FORMAT, "checkpoint": run.checkpoint_hash}
    data = save({name: value.float().cpu().contiguous() for name, value in tensors.items()}, stated)
    with atomic_path(run.path / CONFIDENCE, overwrite=True) as beside:
        beside.write_bytes(data)
    return run.path / CONFIDENCE


def read_confidence(folder: Path, checkpoint: Checkpoint) -> Tensor | None:
    """[N] in [0, 1] of the Gaussians of a checkpoint; None where there is none, or one of another checkpoint.

    Raises InputError for a file that is damaged.
    """
    from safetensors import SafetensorError, safe_open

    path = folder / CONFIDENCE
    if not path.is_file():
        return None
    remedy = "remove this file; `sehdr-warp report` makes it again from the photos"
    try:
        with safe_open(str(path), framework="pt") as file:
            stated = file.metadata() or {}
            if stated.get("format") != FORMAT or stated.get("checkpoint") != checkpoint.values["sha256"]:
                return None
            confidence = file.get_tensor("confidence")
    except (SafetensorError, OSError, ValueError, KeyError, RuntimeError) as error:
        raise InputError(path, f"not safetensors ({error!s:.200})", remedy) from None
    count = len(checkpoint.tensors["gaussians.means"])
    if tuple(confidence.shape) != (count,) or not confidence.is_floating_point():
        raise InputError(path, f"confidence has shape {tuple(confidence.shape)}, not {(count,)}", remedy)
    if first_not_finite({"confidence": confidence}) or not bool(((confidence >= 0) & (confidence <= 1)).all()):
        raise InputError(path, "confidence holds values outside of 0 to 1", remedy)
    return confidence.float()


def ensure_confidence(run, scene: Scene, say: Callable[[str], None]) -> None:
    """Measures the confidence of a run that has none, and keeps it in the folder where that can be written to."""
    if run.model.confidence is not None or not scene.train_views:
        return
    say("measuring confidence on the training photos")
    evidence = measure_confidence(run, scene)
    try:
        write_confidence(run, evidence)
    except SehdrError as error:
        say(f"confidence is not kept: {error}")
