"""Averages of weights files."""

import pytest
import torch
from safetensors.torch import save_file

from priors.average import average, main
from sehdr_warp.errors import UsageError
from sehdr_warp.prior import load_prior
from sehdr_warp.prior.network import LightNetwork


def test_weights_and_deviation_scales_are_averaged_by_share(tmp_path):
    torch.manual_seed(0)
    networks = [LightNetwork(8) for _ in range(2)]
    for name, network, scale in zip("ab", networks, (0.8, 0.4), strict=True):
        tensors = {key: value.half().contiguous() for key, value in network.state_dict().items()}
        save_file(tensors, tmp_path / name, {"deviation_scale": str(scale)})
    average({tmp_path / "a": 3.0, tmp_path / "b": 1.0}, tmp_path / "mean")
    mean = load_prior(path=tmp_path / "mean")
    first, second = (network.out.weight.half().float() for network in networks)
    assert abs(mean.deviation_scale - 0.7) < 1e-4
    assert torch.allclose(mean.network.out.weight, 0.75 * first + 0.25 * second, atol=1e-3)


def test_an_average_of_nothing_is_refused(tmp_path):
    with pytest.raises(UsageError, match="no weights; name some as FILE=SHARE"):
        main(tmp_path / "mean", ())
    assert not any(tmp_path.iterdir())
