"""Command lines of `python -m benchmarks` in this process."""

from functools import partial

from benchmarks.__main__ import main

from .. import refusals

call = partial(refusals.call, main=main)
refused = partial(refusals.refused, main=main, program="python -m benchmarks")
