"""A worker of `bench quality` whose trainings take no time: the seed says what becomes of a job."""

import json
import os
import signal
import sys
import time

from sehdr_warp.bench import quality_worker
from sehdr_warp.bench.quality_jobs import FORMAT
from sehdr_warp.errors import SehdrError

FINE, DIVERGES, DIES, BREAKS, SLOW = range(5)


class StubRunner:
    def run(self, job, folder):
        with open(folder.parent.parent / "ran.txt", "a") as file:
            file.write(job.name + "\n")
        seed = job.config["seed"]
        if seed == DIVERGES:
            raise SehdrError("iteration 7: 21 steps had a loss or gradient that is not finite")
        if seed == DIES:
            os.kill(os.getpid(), signal.SIGKILL)
        if seed == BREAKS:
            raise RuntimeError("out of memory")
        if seed == SLOW:
            time.sleep(2.0)
        return result(job)


def result(job, psnr: float = 30.0, seconds: float = 2.0, date: str = "2026-11-21T08:00:00+00:00") -> dict:
    """A complete result with plausible figures."""
    hdr = {"psnr_mu": psnr, "ssim_mu": 0.9, "lpips_mu": None, "views": 2, "lpips_reason": "no weights"}
    return {
        "format": FORMAT,
        "key": job.key,
        "job": job.name,
        "date": date,
        "version": "0",
        "machine": {"gpu": None, "cpu": "stub", "threads": 1},
        "shared_by": 1,
        "exposure_time": 1.0,
        "config": job.config,
        "figures": {
            "protocol": {name: dict(hdr) for name in ("gt-max", "self-max", "aligned")},
            "pu21": {"aligned": {"psnr": psnr - 3, "ssim": 0.8}},
            "ldr": {"psnr": psnr + 1, "ssim": 0.95},
            "regions": {
                "clipped": {"fraction": 0.1, "psnr_mu": {"aligned": psnr - 8}},
                "well-exposed": {"fraction": 0.9, "psnr_mu": {"aligned": psnr + 2}},
                "dark": {"fraction": 0.0, "psnr_mu": {"aligned": None}},
            },
            "confidence": {"spearman_log2": psnr / 50, "spearman_mu": 0.5, "mean": 0.8, "pixels": 10},
            "views": [],
            "train_seconds": seconds,
            "seconds_to_final": seconds / 2,
            "peak_memory_bytes": 2**20,
            "render_fps": 100.0,
            "gaussians": 5000,
            "iterations": job.config["training"]["schedule"]["iterations"],
        },
        "curve": [{"iteration": 1, "seconds": seconds / 4, "psnr_mu": psnr - 5},
                  {"iteration": 2, "seconds": seconds, "psnr_mu": psnr}],
        "complete": True,
    }  # fmt: skip


if __name__ == "__main__":
    quality_worker._runner = lambda plan: StubRunner()
    quality_worker.work(**json.loads(sys.argv[1]))
