"""Scenes small enough to train on in seconds."""

import pytest

from .toy import toy_scene


@pytest.fixture(scope="session")
def scene():
    return toy_scene()
