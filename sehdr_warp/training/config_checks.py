"""Which choices of a training contradict each other."""

from typing import TYPE_CHECKING

from ..errors import SehdrError

if TYPE_CHECKING:
    from .config import Config


class ConfigError(SehdrError):
    """Fields of a config contradict each other; names field, value and what is allowed."""


def check_together(config: "Config") -> None:
    """Raises ConfigError for the first fields that contradict each other."""
    model, fusion, loss = config.model, config.fusion, config.loss
    if fusion.enabled and len(fusion.exposures) < 2:
        raise ConfigError(f"fusion.exposures = {list(fusion.exposures)} is too few; a fusion needs two or more")
    learned = config.response.name == "learned"
    for path, used in {
        "fusion.enabled": fusion.enabled,
        "loss.linear_weight": loss.linear_weight > 0,
        "loss.hdr_weight": loss.hdr_weight > 0,
    }.items():
        if used and model.radiance == "display":
            raise ConfigError(f'{_shown(config, path)} needs radiance: model.radiance = "display" has none')
    for path, used in {"model.radiance": model.radiance == "display", "fusion.enabled": fusion.enabled}.items():
        if used and learned:
            raise ConfigError(f'{_shown(config, path)} needs a known response: response.name = "learned" has none')
    if loss.linear_weight > 0 and not (fusion.enabled or loss.hdr_truth):
        raise ConfigError(
            f"loss.linear_weight = {loss.linear_weight} has nothing to compare: needs fusion.enabled or loss.hdr_truth"
        )
    if loss.ldr_weight == loss.hdr_weight == loss.linear_weight == 0:
        raise ConfigError("loss.ldr_weight = 0.0 leaves nothing to compare: give loss.hdr_weight or loss.ldr_weight")
    if loss.predictor and not loss.uses_hdr:
        raise ConfigError(f"loss.predictor = {loss.predictor!r} is for nothing: loss.hdr_weight = 0.0")
    if loss.anchor_weight > 0 and not learned:
        raise ConfigError(f'loss.anchor_weight = {loss.anchor_weight} is for nothing: needs response.name = "learned"')
    if config.optimizer.means_final > config.optimizer.means:
        raise ConfigError(f"optimizer.means_final = {config.optimizer.means_final} is greater than optimizer.means")


def _shown(config: "Config", path: str) -> str:
    part, name = path.split(".")
    return f"{path} = {getattr(getattr(config, part), name)!r}"
