"""The radiance field that a config describes, from Gaussians or from a checkpoint."""

import torch

from ..errors import InputError
from ..model.exposure import exposure_times
from ..model.fusion import NeuralExposureFusion
from ..model.gaussians import PARAMETER_NAMES, Gaussians
from ..model.radiance_field import RadianceField
from ..response import Response
from ..scene.normalization import Normalization
from .checkpoint import Checkpoint, part_of
from .config import Config


def field_from_checkpoint(checkpoint: Checkpoint, config: Config, info: dict) -> RadianceField:
    """Return the RadianceField of a checkpoint, on the CPU; raises InputError if tensors are missing or do not fit."""
    try:
        gaussians = Gaussians(*(checkpoint.tensors[f"gaussians.{name}"] for name in PARAMETER_NAMES))
        normalization = Normalization.from_dict(info["normalization"])
        response = Response.from_dict(info["response"])
        field = assemble_field(gaussians, config, response, info["base_time"], normalization)
        learned = field.response if isinstance(field.response, torch.nn.Module) else None
        for name, part in (("fusion.", field.fusion), ("response.", learned)):
            if part is not None:
                part.load_state_dict(part_of(checkpoint.tensors, name))
    except (KeyError, ValueError, RuntimeError) as error:
        problem = f"its tensors do not fit the config ({error})"
        raise InputError(checkpoint.path, problem, "the run is damaged: train again") from None
    return field


def assemble_field(
    gaussians: Gaussians,
    config: Config,
    response: Response,
    base_time: float,
    normalization: Normalization | None = None,
) -> RadianceField:
    """Return a field of Gaussians, a response and a freshly seeded fusion as the config says."""
    fusion, options = None, config.fusion
    if options.enabled:
        scale = 1.0 / base_time if options.radiance_scale == "base" else 1.0
        times = exposure_times(base_time, options.exposures)
        fusion = NeuralExposureFusion(response, times, base_time, radiance_scale=scale, seed=config.seed)
    return RadianceField(
        gaussians,
        response,
        base_time=base_time,
        color_model=config.model.radiance,
        tone_map=config.model.tone_map,
        fusion=fusion,
        antialiased=config.model.antialiased,
        deterministic=config.deterministic,
        normalization=normalization,
    )
