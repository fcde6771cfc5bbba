"""Readers of data folders, one for each layout (COLMAP, nerfstudio, LLFF, OpenSfM, photos), and of camera files."""
