"""The eight scenes of this folder, rendered from a seed by Mitsuba 3: `python -m scenes.generator`."""
