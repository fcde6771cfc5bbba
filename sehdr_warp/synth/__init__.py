"""HDR scenes with truth: rendered from a seed (Mitsuba 3), and exposed as a camera would. Imports no torch."""
