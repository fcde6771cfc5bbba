"""Adam of a training against torch's in float64."""

import pytest
import torch

from sehdr_warp.model.adam import BETAS, EPSILON, Adam
from sehdr_warp.rasterizer.ops.step_updates import decide_step, finiteness_of

NAMES = {"means": (7, 3), "opacity_logits": (7,), "fusion": (4, 2)}


def parameters_of(seed, device="cpu", dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(shape, generator=generator).to(device, dtype) for shape in NAMES.values()]


def adam_of(parameters, kind=Adam, **options):
    groups = zip(NAMES, parameters, (0.1, 0.02, 0.003), strict=True)
    return kind([{"name": name, "params": [values], "lr": rate} for name, values, rate in groups], **options)


@pytest.mark.parametrize("rows", [None, 5], ids=["all rows", "trained rows"])
def test_steps_are_torchs_and_only_trained_rows_move(device, rows):
    ours = [values.requires_grad_() for values in parameters_of(0, device)]
    truth = [values.requires_grad_() for values in parameters_of(0, dtype=torch.float64)]
    optimizer, reference = adam_of(ours), adam_of(truth, torch.optim.Adam, betas=BETAS, eps=EPSILON)
    optimizer.trained_rows = rows
    for seed in range(1, 6):
        for mine, true, gradient in zip(ours, truth, parameters_of(seed), strict=True):
            mine.grad, true.grad = gradient.to(device), gradient.double()
        optimizer.step()
        reference.step()
    for name, start, mine, true in zip(NAMES, parameters_of(0), ours, truth, strict=True):
        moved = len(mine) if name == "fusion" else rows
        torch.testing.assert_close(mine[:moved].cpu().double(), true[:moved], rtol=1e-5, atol=1e-6)
        assert torch.equal(mine[moved or len(mine) :].cpu(), start[moved or len(mine) :])
    assert [len(moments) for moments in optimizer.moments(ours[:1])] == [rows or 7] * 2


@pytest.mark.parametrize("overflow", [None, False, True])
@pytest.mark.parametrize("bad", [False, True])
def test_a_guarded_step_is_made_or_left_out_whole(device, overflow, bad):
    means, *_ = parameters_of(0, device)
    optimizer, before = Adam([{"name": "means", "params": [means.requires_grad_()], "lr": 0.1}]), means.detach().clone()
    loss = (means * (torch.nan if bad else 1.0)).sum()
    loss.backward()
    flag = None if overflow is None else torch.tensor(overflow, device=device)
    step_counters = torch.zeros(3, dtype=torch.int64, device=device)
    flags = decide_step(loss, finiteness_of([means.grad]), flag, step_counters)
    optimizer.step(flags)
    assert step_counters.tolist() == [bad, 0, 0]
    assert bool(flags.applied) == (not bad and not overflow) == (not torch.equal(means, before))
    assert float(optimizer.state[means]["step"]) == float(flags.applied)
