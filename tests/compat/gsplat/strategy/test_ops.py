"""Operations of strategies by themselves."""

import pytest
import torch

from sehdr_warp.compat.gsplat.strategy import ops

from .test_base import model


def test_operations_of_strategies_alone_change_statistics_too():
    params, optimizers, _, _ = model(count=4)
    means, state = params["means"].detach().clone(), {"age": torch.tensor([1.0, 2.0, 3.0, 4.0])}
    mask = torch.tensor([False, True, False, False])
    ops.duplicate(params=params, optimizers=optimizers, state=state, mask=mask)
    ops.remove(params=params, optimizers=optimizers, state=state, mask=torch.tensor([True, False, False, False, False]))
    assert torch.equal(params["means"].detach(), means[[1, 2, 3, 1]]) and state["age"].tolist() == [2, 3, 4, 2]
    ops.split(params=params, optimizers=optimizers, state=state, mask=mask, revised_opacity=True)
    assert state["age"].tolist() == [2, 4, 2, 3, 3]
    together = 1 - (1 - params["opacities"].detach().sigmoid()[3:]).prod()
    assert float(together) == pytest.approx(0.5)
    ops.reset_opa(params=params, optimizers=optimizers, state=state, value=0.1)
    assert float(params["opacities"].detach().sigmoid().max()) == pytest.approx(0.1)
    ops.sample_add(params, optimizers, state, n=2)
    assert state["age"].tolist() == [2, 4, 2, 3, 3, 0, 0]
    params["opacities"].data[:3], state["age"], state["binoms"] = -20.0, torch.arange(1.0, 8.0), torch.ones(5, 5)
    ops.relocate(params, optimizers, state, mask=params["opacities"].detach() < -9)
    assert bool(state["binoms"].all())
    assert state["age"][:3].tolist() == [1, 2, 3] and bool((state["age"][3:] == 0).any())


@pytest.mark.parametrize("operation", [ops.duplicate, ops.split, ops.remove, ops.relocate])
def test_what_is_no_mask_or_opacity_is_named(operation):
    params, optimizers, _, _ = model(count=4)
    for mask, message in (
        (torch.tensor([1, 0, 0, 0]), r"mask is torch\.int64, expected torch\.bool"),
        (torch.ones(3, dtype=torch.bool), r"mask has shape \[3\], expected \[4\]"),
        ([True] * 4, "mask is a list"),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            operation(params, optimizers, {}, mask)
    with pytest.raises(ValueError, match="value 1.2 is not above 0 and at most 1"):
        ops.reset_opa(params, optimizers, {}, 1.2)
