"""Limits of a training on panoramas and wide fisheye photos."""

from ..errors import InputError
from ..runs.config import Config
from ..scene import Scene


def has_wide_views(scene: Scene, config: Config) -> bool:
    """Return whether some training views are not pinholes.

    Raises:
        InputError: if there are, and the densification needs projected centers, which only pinholes have.
    """
    wide = next((view for view in scene.train_views if not view.camera.is_pinhole), None)
    if wide is not None and config.densification.strategy != "mcmc":
        problem = f"view {wide.name} is {wide.camera.projection}, for which densification.strategy = "
        problem += f"{config.densification.strategy!r} has no projected centers"
        raise InputError(scene.name, problem, "use densification.strategy=mcmc")
    return wide is not None
