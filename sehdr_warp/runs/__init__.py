"""What a training reads and leaves: its config, its run folder, checkpoints, and the loaded run."""
