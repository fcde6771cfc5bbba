"""The model of the paper: Gaussians, camera responses, exposure brackets, their fusion, and the field they make."""
