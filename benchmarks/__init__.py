"""Measuring: splats, training steps and whole trainings, against peers, with their correctness checked in the run."""
