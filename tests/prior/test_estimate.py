"""Estimates of clipped light: sizes, combination with what files state, and weights files that cannot be used."""

import math

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from sehdr_warp.errors import InputError
from sehdr_warp.prior import LightPrior, coarse_size, combined_estimates, load_prior
from sehdr_warp.prior.estimate import ESTIMATE_DEVIATION, LARGE_DEVIATION_POWER, VARIANCE_SHARE, WEIGHTS, LightEstimate
from sehdr_warp.prior.network import LightNetwork


def photo(height=20, width=30):
    """Exposure and clipped values of a photo with a lamp."""
    exposure = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(0)) * 0.5
    clipped = torch.zeros(height, width, 3, dtype=torch.bool)
    clipped[5:9, 10:16] = True
    return torch.where(clipped, 1.0, exposure), clipped


def small_prior(scale=1.0):
    torch.manual_seed(0)
    return LightPrior(LightNetwork(4), scale)


@pytest.mark.parametrize(
    ("size", "coarse"), [((20, 30), (20, 30)), ((1, 1), (1, 1)), ((3000, 4000), (120, 160)), ((5000, 3), (160, 1))]
)
def test_large_photos_are_seen_smaller_and_small_ones_as_they_are(size, coarse):
    assert coarse_size(*size) == coarse


@pytest.mark.parametrize("size", [(1, 1), (3, 50), (20, 30), (170, 33)])
def test_any_size_is_estimated(size):
    exposure, clipped = torch.rand(*size, 3), torch.ones(*size, 3, dtype=torch.bool)
    estimate = small_prior().estimate(exposure, clipped)
    assert estimate.mean.shape == estimate.deviation.shape == (*coarse_size(*size), 3)
    assert (estimate.mean >= 0).all() and (estimate.deviation > 0).all()


@pytest.mark.parametrize(("scale", "power"), [(0.5, 1.0), (3.0, LARGE_DEVIATION_POWER)])
def test_estimates_are_there_where_the_photo_clips_alone(scale, power):
    exposure, clipped = photo()
    known = combined_estimates(exposure, clipped, small_prior(scale))
    assert torch.equal(known.certainty > 0, clipped) and torch.equal(known.log_light[..., 3:] > 0, clipped)
    estimate = small_prior(scale).estimate(exposure, clipped)
    inside = clipped[..., 0]
    deviation = math.log(2) * estimate.deviation[inside]
    expected = math.log(2) * estimate.mean[inside] + VARIANCE_SHARE * deviation.square() / 2
    assert torch.allclose(known.log_light[..., :3][inside].float(), expected, rtol=2e-3)
    # Large deviations are widened, but the light that is expected does not rise with that.
    widened = math.log(2) * estimate.deviation[inside] ** power
    assert torch.allclose(1 / known.certainty[inside].float(), widened, rtol=2e-3)


def test_what_a_file_states_counts_by_its_precision():
    exposure, clipped = photo()
    limits = torch.where(clipped, 8.0, 0.0)
    alone = combined_estimates(exposure, clipped, None, limits, 0.25)
    assert torch.allclose(alone.log_light[6, 12].float(), torch.tensor(3 * [math.log(8)] + 3 * [4.0]), rtol=1e-3)
    assert torch.allclose(alone.certainty[6, 12].float(), torch.tensor(4.0), rtol=1e-3)
    sure, unsure = (
        combined_estimates(exposure, clipped, small_prior(), limits, d).log_light[6, 12, 0] for d in (0.01, 100.0)
    )
    assert sure == pytest.approx(math.log(8), abs=1e-2)
    assert unsure == pytest.approx(
        float(combined_estimates(exposure, clipped, small_prior()).log_light[6, 12, 0]), rel=1e-2
    )


class FixedPrior:
    """A prior that is least sure of what it finds brightest."""

    def __init__(self, expected):
        self.expected = expected

    def estimate(self, exposure, clipped):
        deviation = 0.3 + self.expected / 4
        return LightEstimate(self.expected - VARIANCE_SHARE * deviation**2 * math.log(2) / 2, deviation)


def test_photos_that_hold_a_light_agree_on_the_mean_of_their_expected_light():
    # Each pixel is what another photo expects of one lamp: 16 times white, within a factor of four.
    stops = 4 + 2 * torch.randn(100, 100, 3, generator=torch.Generator().manual_seed(0)).clamp(-2, 2)
    clipped = torch.ones(100, 100, 3, dtype=torch.bool)
    known = combined_estimates(clipped.float(), clipped, FixedPrior(stops.clamp_min(0)))
    light, weight = known.log_light[..., :3].double(), known.log_light[..., 3:].double().square()
    agreed = float((weight * light).sum() / weight.sum()) / math.log(2)
    assert agreed == pytest.approx(math.log2(torch.exp2(stops.clamp_min(0)).mean()), abs=0.25)
    # Weights by deviations would lose two stops of it.
    weight = known.certainty.double().square()
    assert float((weight * light).sum() / weight.sum()) / math.log(2) < agreed - 2


def test_what_a_file_states_holds_by_its_deviation_beside_the_prior():
    exposure, clipped = photo()
    limits = torch.where(clipped, 8.0, 0.0)
    alone, both = (
        combined_estimates(exposure, clipped, p, limits, 0.05).log_light[6, 12] for p in (None, small_prior())
    )
    assert alone[3] == pytest.approx(20, rel=1e-2) and both[0] == pytest.approx(math.log(8), abs=0.02)
    weight = 20**2 + math.sqrt(8) / (ESTIMATE_DEVIATION * math.log(2)) ** 2
    assert both[3] == pytest.approx(math.sqrt(weight), rel=1e-2)


def test_nothing_known_is_precision_zero():
    exposure, clipped = photo()
    for limits in (None, torch.zeros(20, 30, 3)):
        known = combined_estimates(exposure, clipped, None, limits, 0.3)
        assert (known.log_light == 0).all() and (known.certainty == 0).all()


def test_weights_come_back_as_they_were_written(tmp_path):
    network = LightNetwork(4).half()
    save_file(network.state_dict(), tmp_path / "w.safetensors", {"deviation_scale": "1.5"})
    exposure, clipped = photo()
    ours, loaded = LightPrior(network.float(), 1.5), load_prior(path=tmp_path / "w.safetensors")
    assert torch.equal(ours.estimate(exposure, clipped).deviation, loaded.estimate(exposure, clipped).deviation)


def test_weights_that_cannot_be_used_are_one_line(tmp_path):
    broken = {name: value.clone() for name, value in LightNetwork(4).half().state_dict().items()}
    for scale in ("nan", "inf", "-0.7", "0"):
        save_file(broken, tmp_path / f"scale {scale}.safetensors", metadata={"deviation_scale": scale})
    broken["out.bias"][0] = math.nan
    save_file(broken, tmp_path / "nan.safetensors")
    save_file({"out.weight": torch.zeros(6, 4, 1, 1)}, tmp_path / "few.safetensors")
    (tmp_path / "text.safetensors").write_bytes(b"not weights" * 9)
    (tmp_path / "large.safetensors").write_bytes(bytes(3_000_001))
    names = {"missing": "missing", "text": "is not the weights", "few": "is not the weights"}
    names |= dict.fromkeys(
        (f"scale {scale}" for scale in ("nan", "inf", "-0.7", "0")), "deviation_scale .* not a positive number"
    )
    for name, problem in (names | {"nan": "not finite", "large": "bytes"}).items():
        with pytest.raises(InputError, match=problem) as error:
            load_prior(path=tmp_path / f"{name}.safetensors")
        assert f"{name}.safetensors" in str(error.value) and "light-prior=false" in str(error.value)
        assert "\n" not in str(error.value)


def test_estimates_do_not_depend_on_the_number_type_of_the_mask():
    exposure, clipped = photo()
    one = combined_estimates(exposure, clipped, small_prior(), torch.from_numpy(np.zeros((20, 30, 3), np.float16)), 0.2)
    assert torch.equal(one.log_light, combined_estimates(exposure, clipped, small_prior()).log_light)


def lit(surround, radius, noise=0.05):
    """A disk that clips before a surround of some exposure."""
    y, x = torch.meshgrid(torch.arange(96), torch.arange(96), indexing="ij")
    clipped = ((y - 40) ** 2 + (x - 50) ** 2 < radius**2)[..., None].expand(-1, -1, 3)
    grain = torch.exp(noise * torch.randn(96, 96, 3, generator=torch.Generator().manual_seed(0)))
    return torch.where(clipped, 1.0, (surround * grain).clamp_max(0.99)), clipped


def test_the_weights_of_the_package_are_small_and_know_lamps_from_white_walls():
    assert WEIGHTS.stat().st_size <= 2_000_000
    prior = load_prior()

    def stops(exposure, clipped):
        return float(prior.estimate(exposure, clipped).mean[clipped].mean())

    wall = stops(torch.ones(96, 96, 3), torch.ones(96, 96, 3, dtype=torch.bool))
    lamp = stops(*lit(0.05, 4))
    assert wall < 1 and lamp > wall + 1


def grain(*size, seed=0):
    return torch.rand(*size, generator=torch.Generator().manual_seed(seed))


def page():
    """A printed page on a table, lit to a little above white."""
    picture = 0.15 + 0.05 * grain(120, 160, 1).expand(-1, -1, 3)
    letters = torch.nn.functional.interpolate((grain(1, 1, 60, 80) > 0.75).float(), size=(120, 160))[0, 0] > 0
    inside = torch.zeros(120, 160, dtype=torch.bool)
    inside[25:95, 45:115] = True
    picture[20:100, 40:120] = 1.05
    picture[letters & inside] = 0.08
    return picture


def snow():
    """Snow to a little above white below a sky."""
    relief = torch.nn.functional.interpolate(grain(1, 1, 20, 26), size=(120, 160), mode="bicubic")[0, 0]
    picture = (0.75 + 0.35 * relief + 0.05 * grain(120, 160, seed=1))[..., None] * torch.tensor([0.96, 0.98, 1.0])
    picture[:40] = torch.tensor([0.25, 0.4, 0.7])
    return picture


def leds():
    """Blue LEDs that clip one channel."""
    y, x = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
    picture = torch.full((120, 160, 3), 0.02)
    for column in range(20, 150, 25):
        square = ((x - column) ** 2 + (y - 60) ** 2)[..., None]
        picture += torch.exp(-square / torch.tensor([40.0, 40, 18])) * torch.tensor([0.02, 0.1, 1.6])
    return picture


@pytest.mark.parametrize("make", [page, snow, leds])
def test_white_things_and_small_leds_do_not_become_lamps(make):
    prior, picture = load_prior(), make()
    clipped = picture >= 1
    estimate = prior.estimate(picture.clamp_max(1), clipped)
    lamp = prior.estimate(*lit(0.05, 4)).mean[lit(0.05, 4)[1]].mean()
    mean, deviation = estimate.mean[clipped], estimate.deviation[clipped]
    assert mean.mean() < lamp - 1
    off = (mean - picture[clipped].log2()).abs() / deviation
    assert off.mean() < 2 and off.quantile(0.9) < 3  # Wrong by up to two stops, and the deviation says so.


def test_deviations_of_the_package_are_wide_where_it_must_guess():
    exposure, clipped = lit(0.05, 4)
    estimate = load_prior().estimate(exposure, clipped)
    assert float(estimate.deviation[clipped].mean()) > 0.3
