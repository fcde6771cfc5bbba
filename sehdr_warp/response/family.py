"""A smooth family of cameras' curves, for photos that no response with a formula of its own explains."""

from functools import cache

import numpy as np

from .analytic import analytic_response

# x(z) = z^p (z + TOE)^q (1 + SHOULDER - z)^-r up to scale, z the encoded value: p and p + q are the log-log slopes
# below and above the toe, r the roll-off into white. Least squares in log x over codes 10 to 245 leaves 0.02 stops on
# average of DoRF's curves (Grossberg and Nayar 2004).
TOE, SHOULDER = 0.08, 0.1
# Mean of (p, q, r) over 181 of DoRF's 201 curves fitted so, and the lower Cholesky factor of their covariance.
# The 20 others are those of docs/response.md.
MEAN = np.array([0.719, 0.591, 0.351])
SPREAD = np.array([[0.608, 0.0, 0.0], [-0.842, 0.727, 0.0], [-0.049, -0.123, 0.229]])
MEMBERS = 512
# Least d ln x / dz: a curve with less is not one that a camera has (a linear one has 1 at white).
LEAST_RISE = 0.15
CODES = np.arange(256) / 255
# Curves are read between codes too, at this many steps a code: an even number has the middle between two codes.
FINE = 8
GRID = np.arange(255 * FINE + 1) / (255 * FINE)


@cache
def family_logs() -> tuple[np.ndarray, np.ndarray]:
    """[512, 2041] natural log of the exposure at each place of GRID, and d ln x / dz there, of curves drawn from the
    family's prior by a fixed seed. Below code 1 all count as it. Unit: code 128 means what it does under `camera`."""
    z = np.maximum(GRID, 1 / 255)
    terms = np.stack([np.log(z), np.log(z + TOE), -np.log(1 + SHOULDER - z)])
    rises = np.stack([1 / z, 1 / (z + TOE), 1 / (1 + SHOULDER - z)])
    draws = MEAN + np.random.default_rng(0).normal(size=(2 * MEMBERS, 3)) @ SPREAD.T
    increasing = (draws @ rises).min(1) > LEAST_RISE
    draws = draws[increasing][:MEMBERS]
    logs = draws @ terms
    middle = np.log(float(analytic_response("camera").decode(CODES[128])))
    return logs - logs[:, 128 * FINE, None] + middle, draws @ rises
