"""Thresholds and limits of the splat, each with its reason."""

# Edge of a square tile in pixels. A row of 16 float32 is one AVX-512 register, and 16 x 16 balanced list length against
# list count best.
TILE_SIZE = 16
# Width and height in pixels of a subtile, which one warp of a GPU blends; a tile has eight of them.
SUBTILE = 8, 4
# Contributions below this opacity are left out: the step of an 8-bit display; for HDR output it can be lowered.
ALPHA_THRESHOLD = 1.0 / 255.0
# A single Gaussian never hides everything behind it: 1 / (1 - alpha) stays bounded in the backward pass.
ALPHA_MAX = 0.999
# A pixel is finished before its transmittance would fall to this value.
TRANSMITTANCE_MIN = 1.0e-4
# Variance in square pixels added to every projected Gaussian: the pixel's own footprint.
EPS2D = 0.3
# Points nearer than this to the camera plane are culled, in scene units.
NEAR_PLANE = 0.01
# The linearised projection (J) uses view rays up to this fraction of the field of view beyond the image's border.
FRUSTUM_MARGIN = 0.3
# exp(+-LOG_SCALE_MAX) bounds the scales so that squares of them stay finite in float32.
LOG_SCALE_MAX = 20.0
