"""The device that a user names. torch is imported when it is looked for."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..errors import InputError

if TYPE_CHECKING:
    import torch


def pick_device(device: str | torch.device | None) -> torch.device:
    """Return the device that a user names, by default the first GPU, or the CPU if there is none.

    Raises InputError for other names than "cpu", "cuda" and "cuda:N", and if torch cannot use the device.
    """
    import torch

    if device is None:
        return torch.device("cuda:0" if torch.cuda.is_available() else "cpu")
    if not str(device).startswith(("cpu", "cuda")):
        raise InputError(f"device {device}", "is neither a CPU nor a CUDA GPU", "use cpu or cuda:N")
    try:
        result = torch.device(device)
        torch.empty(0, device=result)
    except (RuntimeError, AssertionError) as error:
        problem = f"cannot be used ({str(error).splitlines()[0]})"
        raise InputError(f"device {device}", problem, "use cpu, or cuda:N of a GPU that torch sees") from None
    return torch.device("cuda", result.index or 0) if result.type == "cuda" else result
