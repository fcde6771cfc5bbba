"""Devices by name."""

import pytest

from sehdr_warp.errors import InputError
from sehdr_warp.runs.run import load_run


@pytest.mark.parametrize("name", ["gpu", "mps", "cuda:99"])
def test_devices_that_torch_cannot_use_are_named(embedded_run, name):
    with pytest.raises(InputError, match=f"device {name}: (is neither a CPU nor|cannot be used)"):
        load_run(embedded_run, device=name)
