"""Shares of an environment map's light: measured by photos, a lower bound, an estimate, or filled in."""

from dataclasses import asdict, dataclass

import numpy as np


@dataclass(frozen=True)
class LightShares:
    """Parts of the light that reaches a point from all directions; they add up to 1 if there is light."""

    measured: float  # Shown by photos below their white
    bound: float  # Of clipped light, what reaches up to the photos' white: at least so much is there
    estimated: float  # Of clipped light, what the scene holds above the photos' white
    inpainted: float  # Directions that no photo shows
    clipped_known: bool  # False if the scene does not state what clipped; then measured holds the first three

    def to_dict(self) -> dict[str, float | bool | None]:
        """Return plain values; None for what is not known, and then `shown` for what photos or the file show."""
        values = asdict(self)
        if not self.clipped_known:
            values |= {"shown": self.measured, "measured": None, "bound": None, "estimated": None}
        return values

    def table(self) -> str:
        """Return the shares as lines of text."""
        rows = [(self.measured, "measured", "photos show it below their white")]
        if self.clipped_known:
            rows += [
                (self.bound, "at least", "photos clip: so much of it is certain"),
                (self.estimated, "estimated", "photos clip: above their white"),
            ]
        else:
            rows = [(self.measured, "shown by photos", "the scene does not state what of it clipped")]
        rows.append((self.inpainted, "filled in", "no photo shows it"))
        width = max(len(name) for _, name, _ in rows)
        return "\n".join(f"  {100 * share:5.1f} %  {name:{width}}  {meaning}" for share, name, meaning in rows)


def light_shares(
    radiance: np.ndarray,
    inpainted: np.ndarray,
    clipped: np.ndarray | None,
    certain: np.ndarray | None,
    weight: np.ndarray,
) -> LightShares:
    """Return the shares of an environment map's light.

    Args:
        radiance: [H, W, 3] of the scene, without what was filled in.
        inpainted: [H, W, 3] that was filled in.
        clipped: [H, W] in [0, 1], the share of a direction's light that photos clipped; None if it is not known.
        certain: [H, W] clipped light up to the photos' white, mean of channels; None if it is not known.
        weight: [H, W] solid angle of each pixel, up to scale.
    """
    light, added = (np.maximum(image, 0).mean(2) * weight for image in (radiance, inpainted))
    unsure = np.zeros_like(light) if clipped is None else light * clipped
    bound = np.zeros_like(light) if certain is None else np.minimum(certain * weight, unsure)
    total = max(float(light.sum() + added.sum()), np.finfo(np.float64).tiny)
    parts = (light - unsure).sum(), bound.sum(), (unsure - bound).sum(), added.sum()
    return LightShares(*(float(part) / total for part in parts), clipped_known=clipped is not None)
