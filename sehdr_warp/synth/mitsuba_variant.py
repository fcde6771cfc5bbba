"""Mitsuba 3, found and set up: which of its variants runs on this machine."""

import importlib.util
import subprocess
import sys

from ..errors import SehdrError

VARIANTS = ("cuda_ad_rgb", "llvm_ad_rgb", "scalar_rgb")
"""From the fastest: an NVIDIA GPU with OptiX in its driver, LLVM 16 or later, plain C++ on all cores."""

# An LLVM that is too old ends the whole process, and a driver without OptiX fails at the first ray: hence a process of
# its own, and a render in it.
_PROBE = """
import sys, mitsuba as mi
mi.set_variant(sys.argv[1])
scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "light": {"type": "constant"},
    "ball": {"type": "sphere"},
    "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}}})
import numpy as np
assert np.isfinite(np.array(mi.render(scene, spp=1))).all()
"""


def load_mitsuba(variant: str = "auto"):
    """The mitsuba module with a variant set: one of VARIANTS, or "auto" for the first that works here.

    Raises SehdrError where Mitsuba is missing, or the variant is unknown or does not run on this machine.
    """
    if importlib.util.find_spec("mitsuba") is None:
        raise SehdrError("Mitsuba 3 renders the scenes and is not installed; pip install 'sehdr-warp[synth]'")
    if variant not in ("auto", *VARIANTS):
        raise SehdrError(f"--variant {variant}: is not one of auto, {', '.join(VARIANTS)}")
    if variant == "auto":
        variant = next((name for name in VARIANTS[:-1] if probe(name) is None), VARIANTS[-1])
    elif (reason := probe(variant)) is not None:
        raise SehdrError(f"--variant {variant}: does not run here ({reason}); take auto or scalar_rgb")
    import mitsuba

    mitsuba.set_variant(variant)
    return mitsuba


def probe(variant: str, seconds: float = 120.0) -> str | None:
    """None where a variant renders on this machine, else why it does not, in a line."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE, variant], capture_output=True, text=True, timeout=seconds, check=False
        )
    except subprocess.TimeoutExpired:
        return f"no picture within {seconds:.0f} s"
    if done.returncode == 0:
        return None
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    telling = [line for line in lines if "rror" in line or "LLVM" in line or "could not" in line.lower()]
    return f"{(telling or lines or ['no message'])[-1]:.160}"
