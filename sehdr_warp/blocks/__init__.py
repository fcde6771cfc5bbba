"""Scenes too large for one training: blocks of space, each trained as a run of its own, and merged into one run."""
