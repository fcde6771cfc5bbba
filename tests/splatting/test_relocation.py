"""What moves Gaussians on the device: shares as equation 9 has them, and rows in their places."""

import torch

from sehdr_warp.splatting.relocation import MOST_COPIES, copy_rows, relocation_sums, share_opacities


def test_shares_are_those_of_equation_9(device):
    opacities = torch.tensor([0.3, 0.9, 0.3, 0.999, 0.006, 0.5], device=device)
    copies = torch.tensor([1, 4, 0, 80, 2, 19], device=device)
    logits, log_scales = torch.logit(opacities), torch.zeros(6, 3, device=device)
    before = logits.clone()
    share_opacities(logits, log_scales, copies, least=0.005)
    parts = (copies + 1).clamp_max(MOST_COPIES).double()
    part = 1 - (1 - opacities.double()) ** (1 / parts)
    powers = part[:, None] ** torch.arange(1, MOST_COPIES + 1, device=device)
    total = (relocation_sums(logits.device)[parts.long() - 1] * powers).sum(1)
    shrink = (opacities.double() / total).clamp(1e-3, 1)
    expected = torch.where(copies > 0, part.clamp(0.005, 1 - 1e-6), opacities.double())
    torch.testing.assert_close(torch.sigmoid(logits.double()), expected, rtol=1e-5, atol=0)
    torch.testing.assert_close(log_scales.double(), shrink.log()[:, None].expand(6, 3), rtol=1e-4, atol=1e-6)
    assert logits[2] == before[2] and not log_scales[2].any()
    # So many of them together are as opaque as the one was.
    together = 1 - (1 - torch.sigmoid(logits.double())) ** parts
    torch.testing.assert_close(together[:2], opacities[:2].double(), rtol=1e-5, atol=0)


def test_rows_are_copied_to_their_places_alone(device):
    for shape in ((), (3,), (2, 3), (0, 3)):
        values = torch.arange(5.0, device=device).view(5, *[1] * len(shape)).expand(5, *shape).contiguous()
        copy_rows(values, torch.tensor([-1, 4, -1, 0, -1], device=device), values)
        assert torch.equal(values, values.new_tensor([0, 4, 2, 0, 4]).view(5, *[1] * len(shape)).expand(5, *shape))
        copy_rows(values, torch.tensor([1, -1, -1, -1, 0], device=device), values[1:3] + 10)
        assert torch.equal(values, values.new_tensor([12, 4, 2, 0, 14]).view(5, *[1] * len(shape)).expand(5, *shape))
