"""Cameras to render: camera paths, framing of the subject, and camera files for other programs."""
