"""What a training notes of each Gaussian at every step."""

import warp as wp


@wp.kernel(module="unique", module_options={"enable_backward": False})
def note_gradients(
    gradients: wp.array(dtype=wp.vec2),
    radii: wp.array(dtype=wp.float32),
    usable: wp.array(dtype=wp.float32),
    weights: wp.array(dtype=wp.float32),
    half_width: float,
    half_height: float,
    gradient_sum: wp.array(dtype=wp.float32),
    seen: wp.array(dtype=wp.float32),
):
    """Adds the lengths of the gradients by the projected centres, in units of half the image's sides, and 1, for each
    Gaussian with a radius; nothing where usable[0] is 0. weights: [N], or [0] for none."""
    i = wp.tid()
    if radii[i] > 0.0 and usable[0] != 0.0:
        gradient = gradients[i]
        x = gradient[0] * half_width
        y = gradient[1] * half_height
        # As hypot: squares of small gradients must not vanish.
        larger = wp.max(wp.abs(x), wp.abs(y))
        length = float(0.0)
        if larger > 0.0:
            length = larger * wp.sqrt((x / larger) * (x / larger) + (y / larger) * (y / larger))
        if weights.shape[0] > 0:
            length *= weights[i]
        gradient_sum[i] = gradient_sum[i] + length
        seen[i] = seen[i] + 1.0
