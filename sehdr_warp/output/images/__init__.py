"""Image files (OpenEXR, Radiance, PNG, JPEG, Ultra HDR), and the color spaces and tone maps they are written in."""
