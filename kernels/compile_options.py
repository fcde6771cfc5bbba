"""Options that kernels are compiled with."""


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
