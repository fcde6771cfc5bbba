"""Files of Gaussians and proxy meshes for other programs, and edits of Gaussians on their way into a file."""
