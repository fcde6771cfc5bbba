"""Which choices of a training contradict each other."""

from typing import TYPE_CHECKING

from ..errors import SehdrError

if TYPE_CHECKING:
    from .config import Config


class ConfigError(SehdrError):
    """A field of a config has a value that cannot be used; names field, value and what is allowed."""


def check_together(config: "Config") -> None:
    """Raises ConfigError for the first fields that contradict each other."""
    model, fusion, loss = config.model, config.fusion, config.loss
    if fusion.enabled and len(fusion.exposures) < 2:
        raise ConfigError(f"fusion.exposures = {list(fusion.exposures)} is too few; a fusion needs two or more")
    if model.radiance == "display" and fusion.enabled:
        raise ConfigError('fusion.enabled = true needs radiance: model.radiance = "display" has none')
    if model.radiance == "display" and loss.linear_weight > 0:
        raise ConfigError(
            f'loss.linear_weight = {loss.linear_weight} needs radiance: model.radiance = "display" has none'
        )
    if loss.linear_weight > 0 and not (fusion.enabled or loss.hdr_truth):
        raise ConfigError(
            f"loss.linear_weight = {loss.linear_weight} has nothing to compare: needs fusion.enabled or loss.hdr_truth"
        )
    if model.radiance == "display" or model.tone_map == "gaussian":
        # Both encode before they composite: no pixel's exposure is known.
        for field_set, shown in (
            (loss.domain == "mu-law", 'loss.domain = "mu-law"'),
            (loss.highlight_weight > 0, f"loss.highlight_weight = {loss.highlight_weight}"),
        ):
            if field_set:
                raise ConfigError(f'{shown} needs model.tone_map = "pixel" and a model.radiance other than "display"')
    if model.far_points >= config.densification.max_gaussians:
        raise ConfigError(
            f"model.far_points = {model.far_points} leaves no room below densification.max_gaussians = "
            f"{config.densification.max_gaussians}"
        )
    if config.densification.strategy != "gradient":
        for name in ("slope_corrected", "revised_opacity"):
            if getattr(config.densification, name):
                raise ConfigError(
                    f'densification.{name} = true is for nothing: needs densification.strategy = "gradient"'
                )
    if loss.hdr_weight > 0 and model.radiance == "display":
        raise ConfigError(f'loss.hdr_weight = {loss.hdr_weight} needs radiance: model.radiance = "display" has none')
    if loss.ldr_weight == loss.hdr_weight == loss.linear_weight == 0:
        raise ConfigError("loss.ldr_weight = 0.0 leaves nothing to compare: give loss.hdr_weight or loss.ldr_weight")
    if loss.predictor and not loss.uses_hdr:
        raise ConfigError(f"loss.predictor = {loss.predictor!r} is for nothing: loss.hdr_weight = 0.0")
    if config.response.form == "mlp":
        _check_learned(config)
    elif loss.anchor_weight > 0:
        raise ConfigError(f'loss.anchor_weight = {loss.anchor_weight} is for nothing: needs response.form = "mlp"')
    if config.response.refine:
        _check_refined(config)
    if loss.harmonics_weight > 0 and config.schedule.harmonics_on_demand:
        raise ConfigError(
            f"loss.harmonics_weight = {loss.harmonics_weight} is a mean over all degrees, which "
            "schedule.harmonics_on_demand = true does not hold"
        )
    if config.optimizer.means_final > config.optimizer.means:
        raise ConfigError(f"optimizer.means_final = {config.optimizer.means_final} is greater than optimizer.means")


def _check_learned(config: "Config") -> None:
    """What needs a curve that is known before the training goes without one."""
    needs_curve = {
        "model.radiance": config.model.radiance == "display",
        "fusion.enabled": config.fusion.enabled,
        "schedule.coarse_levels": config.schedule.coarse_levels > 0,
        "loss.domain": config.loss.domain == "mu-law",
        "loss.highlight_weight": config.loss.highlight_weight > 0,
        "densification.slope_corrected": config.densification.slope_corrected,
    }
    for path, needed in needs_curve.items():
        if needed:
            part, name = path.split(".")
            value = getattr(getattr(config, part), name)
            raise ConfigError(f'{path} = {value!r} needs a known response: response.form = "mlp" has none')


def _check_refined(config: "Config") -> None:
    """What uses the curve elsewhere than on a rendered exposure would use the uncorrected one."""
    for path, clash in {
        'response.form = "mlp"': config.response.form == "mlp",
        'model.radiance = "display"': config.model.radiance == "display",
        "fusion.enabled = true": config.fusion.enabled,
    }.items():
        if clash:
            raise ConfigError(f"response.refine = true corrects a curve, which {path} leaves no room for")
