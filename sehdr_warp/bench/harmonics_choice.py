"""The degree of the harmonics as a choice: what a small trained model loses, and saves, with each lower one."""

import tempfile
from pathlib import Path

import torch

from ..field.radiance_field import CameraTensors, RadianceField
from ..scene import load_scene
from ..splatting import GraphRecorder
from ..training.config_files import load_config
from ..training.heldout import evaluate_views
from ..training.train import train
from .peers import differs
from .timing import Variant, time_variants

HIGHEST = 3


def harmonics_rows(device: torch.device, iterations: int, repetitions: int, budget: float) -> list[dict]:
    """A row for each degree: PSNR on the held-out views of the embedded scene, the largest relative difference of an
    HDR view from that of degree 3, and the time of a photo and of its gradients.

    One model of degree 3 is trained (preset `fast`, so many iterations) and shown with fewer degrees: what a lower
    degree would have learned instead is not in it, so its loss is an upper bound.
    """
    scene = load_scene("embedded")
    config = load_config(
        "fast",
        {
            "model.harmonics_degree": HIGHEST,
            "schedule.iterations": iterations,
            "schedule.evaluate_at": [iterations],
            "schedule.checkpoint_every": iterations,
        },
    )
    with tempfile.TemporaryDirectory() as scratch:
        field = train(scene, Path(scratch) / "run", config, device=device, quiet=True).model
    variants = {degree: Variant(*_photo(field, scene, degree)) for degree in range(HIGHEST + 1)}
    timings = time_variants(variants, device, repetitions=repetitions, budget=budget)
    cameras = [view.camera for view in scene.test_views]
    full = [field.render(camera, degree=HIGHEST).hdr for camera in cameras]
    rows = []
    for degree, timing in timings.items():
        scores = evaluate_views(field, scene.test_views, degree)
        views = [field.render(camera, degree=degree).hdr for camera in cameras]
        row = {"stage": "harmonics", "choice": "harmonics", "value": str(degree), "default": degree == HIGHEST}
        row |= {"gaussians": field.gaussians.count, "psnr_ldr": scores["psnr_ldr"], "psnr_hdr": scores["psnr_mu"]}
        row["image_error"] = max(map(differs, views, full))
        rows.append(row | timing.to_dict() | {"times_default": timing.median / timings[HIGHEST].median})
    return rows


def _photo(field: RadianceField, scene, degree: int):
    """run and prepare of a photo of the first view and its gradients."""
    leaves = [leaf.requires_grad_() for leaf in field.gaussians.parameters()]
    camera = CameraTensors.of(scene.test_views[0].camera, field.gaussians.means.device)

    def clear():
        for leaf in leaves:
            leaf.grad = None

    def photo(capacity: int | None = None):
        photo = field.photograph(camera, field.base_time, degree=degree, capacity=capacity)
        photo.encoded.sum().backward()
        return photo.rendering

    if camera.intrinsics.device.type == "cpu":
        return (lambda _: photo()), clear
    # As in a training step: recorded, so that the time is the GPU's own.
    capacity = photo().entry_count * 5 // 4

    def recorded():
        clear()
        return photo(capacity).image.detach()

    recorded()  # loads the kernels, which a recording cannot
    recorder = GraphRecorder(camera.intrinsics.device)
    return (lambda _: recorder.run("photo", recorded)), (lambda: None)
