"""Completion of the command line by a shell."""

import pytest

from .refusals import call


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_can_complete(shell, capsys):
    assert call("completion", shell) == 0
    text = capsys.readouterr().out
    assert all(word in text for word in ("sehdr-warp", "render", "ssim-weight", "quiet", "verbose", "debug"))
