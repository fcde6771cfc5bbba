"""Exposure: times that are stated or estimated, stacks of several, and compensation of what a camera changed."""
