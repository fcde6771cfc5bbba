"""gsplat's own example trains on these kernels after a change of imports, with both strategies."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(os.environ.get("SEHDR_GSPLAT", "/no/checkout")) / "examples"


@pytest.mark.skipif(
    not (EXAMPLES / "simple_trainer.py").is_file(), reason="set SEHDR_GSPLAT to a checkout of gsplat 1.5.3"
)
@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_its_trainer_trains(strategy):
    command = [sys.executable, "-m", "tests.compat.gsplat.simple_trainer", str(EXAMPLES), strategy]
    results = []
    for steps in ("12", "50"):
        done = subprocess.run([*command, steps, "--max-size", "64"], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        results.append(json.loads(done.stdout.splitlines()[-1]))
    assert results[1]["ssim"] > results[0]["ssim"] + 0.003 and results[1]["num_GS"] > 1000
