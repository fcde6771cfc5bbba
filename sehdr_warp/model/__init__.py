"""The model of the paper: Gaussians, exposure brackets, their fusion, and the field they make."""
