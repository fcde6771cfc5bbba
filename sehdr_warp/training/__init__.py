"""From a scene to a trained run: configs, losses, densification, the loop, checkpoints and run folders."""
