"""Quaternion, covariance and ellipse math of the splat, written once for float32 and float64."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .constants import TILE_SIZE


def vector(length: int, dtype):
    """Return the Warp vector type with `length` components of `dtype`."""
    return wp.types.vector(length=length, dtype=dtype)


def matrix(rows: int, columns: int, dtype):
    """Return the Warp matrix type with `rows` x `columns` components of `dtype`."""
    return wp.types.matrix(shape=(rows, columns), dtype=dtype)


@wp.func
def pixel_of_thread(thread: int, columns: int) -> wp.vec3i:
    """Return tile, x and y of a thread: pixels go tile by tile, so that neighbors read the same list."""
    tile = thread // (TILE_SIZE * TILE_SIZE)
    pixel = thread - tile * (TILE_SIZE * TILE_SIZE)
    x = (tile % columns) * TILE_SIZE + pixel % TILE_SIZE
    return wp.vec3i(tile, x, (tile // columns) * TILE_SIZE + pixel // TILE_SIZE)


WRITE_QUAD = """
#if defined(__CUDA_ARCH__)
    reinterpret_cast<float4*>(quads.data)[i] = make_float4(quad[0], quad[1], quad[2], quad[3]);
#else
    quads.data[i] = quad;
#endif
"""


@cache
def geometry(dtype) -> SimpleNamespace:
    """Return types and the functions below for one scalar type (wp.float32 or wp.float64)."""
    real = dtype
    vec3, vec4, mat33 = vector(3, dtype), vector(4, dtype), matrix(3, 3, dtype)

    @wp.func
    def rotation_from_quaternion(quaternion: vec4) -> mat33:
        """Rotation matrix of a quaternion (w, x, y, z) of any length; zero gives the identity, with gradient 0."""
        largest = wp.max(
            wp.max(wp.abs(quaternion[0]), wp.abs(quaternion[1])), wp.max(wp.abs(quaternion[2]), wp.abs(quaternion[3]))
        )
        # A constant rescaling keeps the squared length inside the float range without entering the derivative.
        enlarge = wp.where(largest < real(1.0e-10), real(1.0e18), real(1.0))
        rescale = wp.where(largest > real(1.0e10), real(1.0e-18), enlarge)
        q = quaternion * rescale
        length_squared = wp.dot(q, q)
        is_zero = length_squared < real(1.0e-30)
        inverse_length = wp.where(is_zero, real(0.0), real(1.0) / wp.sqrt(wp.where(is_zero, real(1.0), length_squared)))
        w = wp.where(is_zero, real(1.0), q[0] * inverse_length)
        x = q[1] * inverse_length
        y = q[2] * inverse_length
        z = q[3] * inverse_length
        return mat33(
            real(1.0) - real(2.0) * (y * y + z * z), real(2.0) * (x * y - w * z), real(2.0) * (x * z + w * y),
            real(2.0) * (x * y + w * z), real(1.0) - real(2.0) * (x * x + z * z), real(2.0) * (y * z - w * x),
            real(2.0) * (x * z - w * y), real(2.0) * (y * z + w * x), real(1.0) - real(2.0) * (x * x + y * y),
        )

    @wp.func
    def ellipse_meets_rectangle(
        xy_opacity: vec4, conic_cutoff: vec4, left: real, top: real, width: real, height: real,
    ) -> bool:
        """Return whether the ellipse a dx^2 + 2 b dx dy + c dy^2 <= cutoff around (x, y) touches the rectangle.

        Its values are (x, y, ...) and (a, b, c, cutoff). The form is smallest on one of the edges nearest to the
        center. A small allowance keeps rounding from dropping a border pixel.
        """
        a = conic_cutoff[0]
        b = conic_cutoff[1]
        c = conic_cutoff[2]
        x0 = left - xy_opacity[0]
        x1 = x0 + width
        y0 = top - xy_opacity[1]
        y1 = y0 + height
        nearest_x = wp.clamp(real(0.0), x0, x1)
        nearest_y = wp.clamp(real(0.0), y0, y1)
        best_y = wp.clamp(-b / c * nearest_x, y0, y1)
        best_x = wp.clamp(-b / a * nearest_y, x0, x1)
        along_vertical = a * nearest_x * nearest_x + real(2.0) * b * nearest_x * best_y + c * best_y * best_y
        along_horizontal = a * best_x * best_x + real(2.0) * b * best_x * nearest_y + c * nearest_y * nearest_y
        return wp.min(along_vertical, along_horizontal) <= conic_cutoff[3] * real(1.0001) + real(1.0e-3)

    @wp.func
    def splat_exponent(a: real, b: real, c: real, dx: real, dy: real) -> real:
        """Return the logarithm of a 2D Gaussian's value at offset (dx, dy), at most 0 whatever the rounding."""
        return wp.min(real(-0.5) * (a * dx * dx + c * dy * dy) - b * dx * dy, real(0.0))

    if dtype is wp.float32:

        @wp.func_native(WRITE_QUAD)
        def write_quad(quads: wp.array(dtype=vec4), i: int, quad: vec4):
            """Write four numbers, on CUDA by one access."""

    else:

        @wp.func
        def write_quad(quads: wp.array(dtype=vec4), i: int, quad: vec4):
            """Write four numbers."""
            quads[i] = quad

    return SimpleNamespace(
        real=real, vec2=vector(2, dtype), vec3=vec3, vec4=vec4, mat33=mat33, mat44=matrix(4, 4, dtype),
        rotation_from_quaternion=rotation_from_quaternion, ellipse_meets_rectangle=ellipse_meets_rectangle,
        splat_exponent=splat_exponent, write_quad=write_quad,
    )
