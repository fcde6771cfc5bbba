"""From a scene to a trained run: the plan, losses, densification and the loop; configs and run folders are in runs/."""
