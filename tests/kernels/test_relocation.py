"""Relocation of Gaussians on the device: shares of opacity by equation 9, and rows in their slots."""

import math
from fractions import Fraction

import pytest
import torch

from sehdr_warp.rasterizer.ops.relocation import (
    MOST_COPIES,
    SampledRows,
    copy_rows,
    count_copies,
    number_slots,
    scale_rows,
    share_opacities,
)


def test_shares_are_those_of_equation_9(device):
    opacities = torch.tensor([0.3, 0.9, 0.3, 0.999, 0.006, 0.5], device=device)
    copies = torch.tensor([1, 4, 0, 80, 2, 19], dtype=torch.int32, device=device)
    logits, log_scales = torch.logit(opacities), torch.zeros(6, 3, device=device)
    before = logits.clone()
    share_opacities(logits, log_scales, copies, least=0.005)
    parts = (copies + 1).clamp_max(MOST_COPIES).double()
    part = 1 - (1 - opacities.double()) ** (1 / parts)
    total = torch.zeros_like(part)
    for row, (each, count) in enumerate(zip(part.tolist(), parts.long().tolist(), strict=True)):
        terms = [(i, k) for i in range(1, count + 1) for k in range(i)]
        exact = (
            Fraction(each) ** (k + 1) * math.comb(i - 1, k) * (-1) ** k / Fraction(math.sqrt(k + 1)) for i, k in terms
        )
        total[row] = float(sum(exact))
    shrink = (opacities.double() / total).clamp(1e-3, 1)
    expected = torch.where(copies > 0, part.clamp(0.005, 1 - 1e-6), opacities.double())
    torch.testing.assert_close(torch.sigmoid(logits.double()), expected, rtol=1e-5, atol=0)
    torch.testing.assert_close(log_scales.double(), shrink.log()[:, None].expand(6, 3), rtol=1e-4, atol=1e-6)
    assert logits[2] == before[2] and not log_scales[2].any()
    # So many of them together are as opaque as the one was.
    together = 1 - (1 - torch.sigmoid(logits.double())) ** parts
    torch.testing.assert_close(together[:2], opacities[:2].double(), rtol=1e-5, atol=0)


@pytest.mark.parametrize("logit", [-math.inf, -100.0, 100.0, math.inf])
def test_extreme_opacities_are_shared_in_finite_numbers(device, logit):
    logits, log_scales = torch.full((2,), logit, device=device), torch.zeros(2, 3, device=device)
    share_opacities(logits, log_scales, torch.tensor([1, 60], dtype=torch.int32, device=device), least=0.005)
    assert logits.isfinite().all() and log_scales.isfinite().all()
    assert (torch.sigmoid(logits) > 0.0049).all() and (log_scales <= 0).all()


def scalar(value, device):
    return torch.tensor(value, device=device)


def test_slots_are_those_of_the_dead_and_then_of_the_new(device):
    dead = torch.tensor([False, True, True, False, True], device=device)
    slots, gone = number_slots(dead, 2)
    assert slots.tolist() == [-1, 0, 1, -1, 2, 3, 4] and int(gone) == 3
    slots, gone = number_slots(~dead & dead, 0)
    assert slots.tolist() == [-1] * 5 and int(gone) == 0


def test_rows_are_copied_to_their_slots_alone(device):
    for shape in ((), (3,), (2, 3), (0, 3)):
        start = torch.arange(5.0, device=device).view(5, *[1] * len(shape)).expand(5, *shape).contiguous()

        def expected(*rows, start=start, shape=shape):
            return start.new_tensor(rows).view(5, *[1] * len(shape)).expand(5, *shape)

        # More tensors than one launch takes.
        values, changed = [start.clone() for _ in range(8)], torch.zeros(5, dtype=torch.bool, device=device)
        slots = torch.tensor([-1, 2, -1, 1, 0], dtype=torch.int32, device=device)
        begin, end = scalar(1, device), scalar(3, device)
        copy_rows(values, [10 + each[:2] for each in values], slots, begin, end, changed=changed)
        assert all(torch.equal(each, expected(0, 11, 2, 10, 4)) for each in values)
        assert changed.tolist() == [False, True, False, True, False]
        for total, rows in ((1.0, (0, 2, 2, 0, 4)), (0.0, (0, 1, 2, 3, 4))):
            values, chosen = start.clone(), torch.tensor([0, 2], device=device)
            sampled = SampledRows(chosen, torch.tensor(total, dtype=torch.float64, device=device))
            copy_rows([values], [values], slots, begin, end, samples=sampled)
            assert torch.equal(values, expected(*rows))


def test_copies_are_counted_of_the_slots_there_are(device):
    sampled = SampledRows(torch.tensor([2, 0, 2, 1], device=device), torch.ones((), dtype=torch.float64, device=device))
    changed = torch.zeros(4, dtype=torch.bool, device=device)
    copies = count_copies(sampled, scalar(5, device), scalar(8, device), changed)
    assert copies.tolist() == [1, 0, 2, 0] and changed.tolist() == [True, False, True, False]
    for begin, end, sources in ((5, 4, sampled), (0, 4, SampledRows(sampled.rows, 0 * sampled.total))):
        changed.zero_()
        assert (
            not count_copies(sources, scalar(begin, device), scalar(end, device), changed).any() and not changed.any()
        )


def test_marked_rows_alone_are_scaled(device):
    which = torch.tensor([True, False, True], device=device)
    values = [torch.ones(3, *shape, device=device) for shape in ((), (3,), (15, 3), (0, 3), (4,), (1, 3), (2,))]
    scale_rows(values, which, 0.25)
    assert all((each[which] == 0.25).all() and (each[1] == 1).all() for each in values)
    values[1][0, 0] = torch.inf
    scale_rows(values, which, 0.0)
    assert all(not each[which].any() and (each[1] == 1).all() for each in values)
