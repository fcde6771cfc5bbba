"""Thresholds and limits of the splat and options that kernels are compiled with, each with its reason."""

# Edge of a square tile in pixels. A row of 16 float32 is one AVX-512 register, and 16 x 16 balanced list length against
# list count best.
TILE_SIZE = 16
# Width and height in pixels of a subtile, which one warp of a GPU blends; a tile has eight of them.
SUBTILE = 8, 4
# Contributions below this opacity are left out: the step of an 8-bit display.
ALPHA_THRESHOLD = 1.0 / 255.0
# A single Gaussian never hides everything behind it: 1 / (1 - alpha) stays bounded in the backward pass.
ALPHA_MAX = 0.999
# A pixel is finished before its transmittance would fall to this value.
TRANSMITTANCE_MIN = 1.0e-4
# Variance in square pixels added to every projected Gaussian: the pixel's own footprint.
EPS2D = 0.3
# Points nearer than this to the camera plane are culled, in scene units.
NEAR_PLANE = 0.01
# The linearized projection (J) uses view rays up to this fraction of half the image beyond the image's border.
FRUSTUM_MARGIN = 0.3
# exp(+-LOG_SCALE_MAX) bounds the scales so that squares of them stay finite in float32.
LOG_SCALE_MAX = 20.0


def cpu_flags(depth: int = 6) -> str:
    """Return flags of Warp's CPU compiler: everything is inlined, and vectors are found `depth` operations deep.

    Depth 4 would cost the blend 30 %, 7 its backward pass 20 %, 8 SSIM 80 %. Kernels of different depths are compiled
    on different threads' headers and wait for each other.
    """
    inlined = "-march=native -mllvm=-inline-threshold=9000 -mllvm=-inline-cold-callsite-threshold=3000"
    return f"{inlined} -mllvm=-slp-recursion-max-depth={depth}"


FUSED = " -ffp-contract=fast"  # Fused multiply-adds, for kernels that work on rows of pixels.
NO_AUTODIFF = {"enable_backward": False, "cpu_compiler_flags": cpu_flags()}
"""For kernels whose adjoint Warp need not generate."""
