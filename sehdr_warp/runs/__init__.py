"""Files of a training: its config, its run folder, checkpoints, and the loaded run."""
