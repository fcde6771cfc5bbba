"""Cameras to render: paths for films, framing of the subject, and camera files for other programs."""
