"""Cameras of walks around something, with a known up direction."""

import math

import numpy as np

from sehdr_warp.scene import Camera, look_at


def photos(up, positions, target, *, roll=0.0, turned=0, seed=0):
    """Cameras that look at a target; hands roll by some degrees, and some hold the camera upright."""
    random = np.random.default_rng(seed)
    cameras = []
    for index, position in enumerate(positions):
        pose = look_at(position, target, up=up)
        angle = math.radians(random.normal(0, roll) + (90 if turned and index % turned == 0 else 0))
        turn = np.eye(4)
        turn[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        cameras.append(Camera(32, 24, 40, 40, 16, 12, turn @ pose))
    return cameras


def degrees(a, b=(0.0, 0.0, 1.0)):
    """Return the angle between two directions; the second is +Z by default."""
    return math.degrees(math.acos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))


def ring(count, radius, height, span=360):
    azimuth = np.radians(np.linspace(0, span, count, endpoint=False))
    return np.stack([radius * np.cos(azimuth), np.full(count, height), radius * np.sin(azimuth)], axis=1)
