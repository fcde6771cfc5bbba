"""Whether what is timed is right: every timed variant against float64 truth, the CPU's kernels and the peers."""

from dataclasses import asdict, dataclass

import torch

from ..errors import SehdrError
from ..splatting.reference import rasterize_reference
from .peers import differs
from .splats import NAMES, SplatScene

IMAGE_BOUND = 1e-4
GRADIENT_BOUND = 1e-3
"""Largest relative difference, in norm over the whole tensor, of float32 from float64 truth. Alphas that fall on the
other side of the threshold make most of it; a wrong formula or a lost Gaussian is far beyond."""
REFERENCE_GAUSSIANS = 4000
"""Scenes of at most so many Gaussians are checked themselves, larger ones on a smaller one of the same density."""


@dataclass(frozen=True)
class Check:
    """One comparison: what with what, the relative difference, and the largest that passes."""

    what: str
    against: str
    scene: str
    channels: int
    difference: float
    bound: float

    @property
    def passed(self) -> bool:
        return self.difference <= self.bound

    def to_dict(self) -> dict:
        return asdict(self) | {"passed": self.passed}


def check_against_reference(name: str, render, scene: SplatScene) -> list[Check]:
    """render(scene) -> [H, W, C], its gradients, and both again by the reference in float64 on the CPU."""
    truth = scene.to("cpu", torch.float64)
    given = image_and_gradients(render, scene), image_and_gradients(render_reference, truth)
    return compare(name, "float64 reference", scene, *given)


def compare(name: str, against: str, scene: SplatScene, ours, truth) -> list[Check]:
    """Checks of an image and the gradients of NAMES, given as by image_and_gradients()."""
    labels = ["image", *(f"gradient of {leaf}" for leaf in NAMES)]
    bounds = [IMAGE_BOUND, *(GRADIENT_BOUND for _ in NAMES)]
    return [
        Check(f"{name}: {label}", against, str(scene.size), scene.channels, differs(a, b), bound)
        for label, a, b, bound in zip(labels, ours, truth, bounds, strict=True)
    ]


def image_and_gradients(render, scene: SplatScene) -> list[torch.Tensor]:
    """The image that render(scene) makes, and the gradients of scene.leaves for scene.cotangent()."""
    scene.clear()
    image = render(scene)
    image.backward(scene.cotangent())
    gradients = [leaf.grad for leaf in scene.leaves]
    scene.clear()
    return [image.detach(), *gradients]


def render_reference(scene: SplatScene) -> torch.Tensor:
    """The plain torch rasterizer, in the scene's own precision and on its device."""
    return rasterize_reference(*scene.arguments).image


def require(checks: list[dict]) -> None:
    """Raises SehdrError for the worst check that did not pass."""
    failed = [check for check in checks if not check["passed"]]
    if failed:
        worst = max(failed, key=lambda check: check["difference"] / check["bound"])
        raise SehdrError(
            f"{len(failed)} of {len(checks)} correctness checks failed; the worst: {worst['what']} of "
            f"{worst['scene']}, {worst['channels']} channels, differs from {worst['against']} by "
            f"{worst['difference']:.2e}, more than {worst['bound']:.0e}: do not use these times"
        )
