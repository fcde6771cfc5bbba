"""Names of the properties of a PLY file of Gaussians."""

DEGREE_0_NAMES = [
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
]
"""Names of the properties of Gaussians without higher harmonics, in the order of the reference release."""
