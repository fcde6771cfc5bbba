"""List the Gaussians that touch each tile, front to back.

`pack_splats` counts the tiles that each Gaussian's ellipse touches (the ellipse, not its bounding box), and a prefix
sum over the counts gives every Gaussian its range of intersections. There are two ways to lists in depth order, both by
stable sorts. With many Gaussians, these are sorted by depth, `emit_by_depth` fills their ranges in that order, and a
sort by tile keeps it: the least work for a GPU. With few, `emit_by_index` fills the ranges in their own order, and one
sort by tile and depth follows: the fewest launches. `find_tile_ranges` finds where each tile's list begins and
ends, and which subtiles of its tile each intersection touches. Backward passes write the gradients of each intersection
where it was emitted, and `gather_intersections` sums a Gaussian's, which are neighbors there, in a fixed order.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .constants import NO_AUTODIFF, SUBTILE, TILE_SIZE
from .geometry import geometry

DEPTH_BITS = 30
DEPTH_OFFSET = (127 - 40) << 23
"""Sort keys keep only the 30 bits of a float32 depth that tell depths from 2^-40 to 2^88 apart, which saves a pass of
the radix sort. Depths outside of that range compare equal."""


@cache
def tile_kernels(dtype) -> SimpleNamespace:
    """Return the kernels that pack, order and list splats, and sum gradients of intersections, for a scalar type."""
    g = geometry(dtype)
    real, vec2, vec3, vec4 = g.real, g.vec2, g.vec3, g.vec4
    reals, reals2d = wp.array(dtype=real), wp.array2d(dtype=real)
    ints, int64s = wp.array(dtype=wp.int32), wp.array(dtype=wp.int64)
    vec2s, vec4s, bools = wp.array(dtype=vec2), wp.array(dtype=vec4), wp.array(dtype=wp.bool)
    size = float(TILE_SIZE)
    # Without fused multiply-adds, which a compiler places differently in each kernel: counting and emitting must agree.
    options = NO_AUTODIFF | {"fuse_fp": False}

    @wp.func
    def tile_span(center: real, extent: real, tiles: int) -> wp.vec2i:
        # Clamped before they are integers, which hold no extent of 2^31 tiles.
        first = wp.clamp(wp.floor((center - extent) / real(size)), real(0.0), real(tiles))
        last = wp.clamp(wp.floor((center + extent) / real(size)) + real(1.0), real(0.0), real(tiles))
        return wp.vec2i(int(first), int(last))

    @wp.func
    def tile_is_touched(xy_opacity: vec4, conic_cutoff: vec4, column: int, row: int) -> bool:
        return g.ellipse_meets_rectangle(
            xy_opacity, conic_cutoff, real(column) * real(size) + real(0.5), real(row) * real(size) + real(0.5),
            real(wp.static(size - 1.0)), real(wp.static(size - 1.0)),
        )

    @wp.kernel(module="unique", module_options=options)
    def pack_splats(
        range_start: int,
        means2d: vec2s, conics: wp.array(dtype=vec3), opacities: reals, features: reals2d,
        channels: int, alpha_threshold: real, columns: int, rows: int,
        extents: vec2s, means_opacities: vec4s, conics_cutoffs: vec4s, counts: int64s, padded: vec4s,
    ):
        """Pack 2D Gaussians and count the tiles, of columns x rows, that each one touches.

        means_opacities: (x, y, opacity, half-height). conics_cutoffs: (conic a, b, c, cutoff): the ellipse in which
        alpha exceeds the threshold is where a dx^2 + 2 b dx dy + c dy^2 <= cutoff.

        extents: set to 0 for a Gaussian with a feature that is not finite, because the CPU blend multiplies what a
        pixel does not show by 0, and 0 times NaN would be visible.

        padded: [N quads], the features in quads of four numbers, of which the last are filled with zeros; or None.
        """
        i = range_start + wp.tid()
        if padded:
            quads = (channels + 3) // 4
            for quad in range(quads):
                four = vec4()
                for k in range(4):
                    if 4 * quad + k < channels:
                        four[k] = features[i, 4 * quad + k]
                        if not wp.isfinite(four[k]):
                            extents[i] = vec2(real(0.0), real(0.0))
                g.write_quad(padded, i * quads + quad, four)
        else:
            for channel in range(channels):
                if not wp.isfinite(features[i, channel]):
                    extents[i] = vec2(real(0.0), real(0.0))
        mean = means2d[i]
        conic = conics[i]
        opacity = opacities[i]
        extent = extents[i]
        cutoff = real(-1.0)
        if extent[0] > real(0.0):
            cutoff = real(2.0) * wp.log(wp.max(opacity / alpha_threshold, real(1.0)))
        xy_opacity = vec4(mean[0], mean[1], opacity, extent[1])
        conic_cutoff = vec4(conic[0], conic[1], conic[2], cutoff)
        means_opacities[i] = xy_opacity
        conics_cutoffs[i] = conic_cutoff
        touched = int(0)
        if extent[0] > real(0.0):
            across = tile_span(xy_opacity[0], extent[0], columns)
            down = tile_span(xy_opacity[1], extent[1], rows)
            for row in range(down[0], down[1]):
                for column in range(across[0], across[1]):
                    if tile_is_touched(xy_opacity, conic_cutoff, column, row):
                        touched += 1
        counts[i] = wp.int64(touched)

    @wp.kernel(module="unique", module_options=options)
    def turn_depths(
        range_start: int,
        means2d: vec2s, depths: reals, intrinsics: vec4s, axis: wp.array(dtype=vec3), along: reals,
    ):
        """Write depths along the axis, in the camera's coordinates: positive, at least a thousandth of the depths.

        The axis may have any length: its largest component counts as 1.
        """
        i = range_start + wp.tid()
        pinhole = intrinsics[0]
        mean = means2d[i]
        ray = vec3((mean[0] - pinhole[2]) / pinhole[0], (mean[1] - pinhole[3]) / pinhole[1], real(1.0))
        largest = wp.max(wp.abs(axis[0]))
        along[i] = depths[i] * wp.max(wp.dot(ray, axis[0] / largest), real(0.001))

    @wp.kernel(module="unique", module_options=options)
    def key_by_depth(
        range_start: int, depths: reals, extents: vec2s, keys: reals, indices: wp.array(dtype=int),
    ):
        """Write keys that sort Gaussians nearest first and culled ones last, and their indices."""
        i = range_start + wp.tid()
        key = depths[i]
        if not (extents[i][0] > real(0.0)):
            key = real(wp.inf)
        keys[i] = key
        indices[i] = i

    def make_emit_kernel(key, by_index: bool):
        bits = DEPTH_BITS if by_index else 0

        @wp.kernel(module="unique", module_options=options)
        def emit(
            range_start: int,
            order: ints, means_opacities: vec4s, conics_cutoffs: vec4s, extents: vec2s,
            depths: wp.array(dtype=wp.float32),
            columns: int, rows: int, cumulative_counts: int64s, max_intersections: int,
            keys: wp.array(dtype=key), gaussians: ints, overflow: bools,
        ):
            """Write the intersections of the nth Gaussian, which end at cumulative_counts[nth].

            If fewer tiles are touched than were counted, or no Gaussian is left, further intersections up to
            `max_intersections` get tile columns * rows, which does not exist. overflow: [1], whether more were counted
            than there is memory for; or None.

            keys: tiles, of Gaussians in their order, and `depths` is None. If by_index, of Gaussians by index, and
            `order` is None: tiles above DEPTH_BITS of the depth, whose bits order as positive numbers do.
            """
            nth = range_start + wp.tid()
            i = nth
            depth = key(0)
            if wp.static(by_index):
                depth_bits = wp.cast(depths[i], wp.int32) - wp.static(DEPTH_OFFSET)
                depth = key(wp.clamp(depth_bits, 0, wp.static((1 << DEPTH_BITS) - 1)))
            else:
                i = order[nth]
            no_tile = key(columns * rows) << key(wp.static(bits))
            extent = extents[i]
            entry = int(0)
            if nth > 0:
                entry = int(wp.min(cumulative_counts[nth - 1], wp.int64(max_intersections)))
            end = int(wp.min(cumulative_counts[nth], wp.int64(max_intersections)))
            if extent[0] > real(0.0) and end > entry:
                xy_opacity = means_opacities[i]
                conic_cutoff = conics_cutoffs[i]
                across = tile_span(xy_opacity[0], extent[0], columns)
                down = tile_span(xy_opacity[1], extent[1], rows)
                for row in range(down[0], down[1]):
                    for column in range(across[0], across[1]):
                        if entry < end and tile_is_touched(xy_opacity, conic_cutoff, column, row):
                            keys[entry] = (key(row * columns + column) << key(wp.static(bits))) | depth
                            gaussians[entry] = i
                            entry += 1
            while entry < end:
                keys[entry] = no_tile
                gaussians[entry] = i
                entry += 1
            count = cumulative_counts.shape[0]
            if overflow and nth == 0:
                overflow[0] = cumulative_counts[count - 1] > wp.int64(max_intersections)
            unused = wp.min(cumulative_counts[count - 1], wp.int64(max_intersections)) + wp.int64(nth)
            while unused < wp.int64(max_intersections):
                keys[int(unused)] = no_tile
                gaussians[int(unused)] = 0
                unused += wp.int64(count)

        return emit

    @wp.kernel(module="unique", module_options=options)
    def gather_intersections(
        range_start: int,
        order: ints, cumulative_counts: int64s, grad_intersections: reals2d, columns: int, sums: reals2d,
    ):
        """Write sums[order[nth]], the sum over the nth Gaussian's intersections of grad_intersections [M, columns]."""
        nth = range_start + wp.tid()
        begin = int(0)
        if nth > 0:
            begin = int(cumulative_counts[nth - 1])
        i = order[nth]
        for column in range(columns):
            total = real(0.0)
            for entry in range(begin, int(cumulative_counts[nth])):
                total += grad_intersections[entry, column]
            sums[i, column] = total

    return SimpleNamespace(
        pack_splats=pack_splats, turn_depths=turn_depths, key_by_depth=key_by_depth,
        gather_intersections=gather_intersections,
        emit_by_depth=make_emit_kernel(wp.int32, by_index=False),
        emit_by_index=make_emit_kernel(wp.int64, by_index=True),
    )


@wp.kernel(module="unique", module_options=NO_AUTODIFF)
def count_tiles(range_start: int, tiles: wp.array(dtype=wp.int32), size: int, counts: wp.array2d(dtype=wp.int32)):
    """Add to counts[c, t] how many intersections of chunk c, which has `size`, are in tile t; launched over chunks."""
    chunk = range_start + wp.tid()
    for entry in range(chunk * size, wp.min((chunk + 1) * size, tiles.shape[0])):
        counts[chunk, tiles[entry]] = counts[chunk, tiles[entry]] + 1


@wp.kernel(module="unique", module_options=NO_AUTODIFF)
def place_intersections(
    range_start: int,
    tiles: wp.array(dtype=wp.int32), emitted: wp.array(dtype=wp.int32), size: int, starts: wp.array2d(dtype=wp.int32),
    gaussians: wp.array(dtype=wp.int32), emit_indices: wp.array(dtype=wp.int32),
):
    """Sort the intersections by tile: write their Gaussians and their indices before the sort; launched over chunks.

    Those of a chunk in a tile are written from starts[chunk, tile] on, which is counted up. emitted: the Gaussians in
    the order of emission. emit_indices: [0] if none are requested.
    """
    chunk = range_start + wp.tid()
    for entry in range(chunk * size, wp.min((chunk + 1) * size, tiles.shape[0])):
        tile = tiles[entry]
        slot = starts[chunk, tile]
        starts[chunk, tile] = slot + 1
        gaussians[slot] = emitted[entry]
        if emit_indices.shape[0] > 0:
            emit_indices[slot] = entry


@cache
def tile_ranges_kernel(dtype, key, shift: int):
    """Return find_tile_ranges() for sorted keys, wp.int32 or wp.int64, with tiles above the lowest `shift` bits.

    Packed Gaussians are of one scalar type. Launched over the intersections, of which there is at least one.

    tile_ranges: [2 tiles], for each tile the first and one past the last of its intersections. subtile_masks:
    [intersections], bit k is set if the ellipse touches subtile k of the tile, SUBTILE pixels; [0] if none are
    requested. Unused intersections have a tile number beyond all: they belong to no list, and their masks are 0.
    """
    g = geometry(dtype)
    real, vec4 = g.real, g.vec4
    across, down = TILE_SIZE // SUBTILE[0], TILE_SIZE // SUBTILE[1]

    @wp.kernel(module="unique", module_options=NO_AUTODIFF)
    def find_tile_ranges(
        range_start: int,
        keys: wp.array(dtype=key), gaussians: wp.array(dtype=wp.int32), means_opacities: wp.array(dtype=vec4),
        conics_cutoffs: wp.array(dtype=vec4), columns: int, tiles: int,
        tile_ranges: wp.array(dtype=wp.int32), subtile_masks: wp.array(dtype=wp.uint8),
    ):
        entry = range_start + wp.tid()
        tile = int(keys[entry] >> key(shift))
        before = int(-1)
        if entry > 0:
            before = int(keys[entry - 1] >> key(shift))
        # Lists begin and end here, those of tiles without intersections both.
        for next_tile in range(before + 1, wp.min(tile, tiles) + 1):
            if next_tile < tiles:
                tile_ranges[2 * next_tile] = entry
            if next_tile > 0:
                tile_ranges[2 * next_tile - 1] = entry
        if entry == keys.shape[0] - 1:
            for next_tile in range(tile + 1, tiles + 1):
                if next_tile < tiles:
                    tile_ranges[2 * next_tile] = entry + 1
                if next_tile > 0:
                    tile_ranges[2 * next_tile - 1] = entry + 1
        touched = int(0)
        if tile < tiles and subtile_masks.shape[0] > 0:
            gaussian = gaussians[entry]
            xy_opacity = means_opacities[gaussian]
            conic_cutoff = conics_cutoffs[gaussian]
            row = tile // columns
            left = real((tile - row * columns) * wp.static(TILE_SIZE)) + real(0.5)
            top = real(row * wp.static(TILE_SIZE)) + real(0.5)
            for subtile in range(wp.static(across * down)):
                if g.ellipse_meets_rectangle(
                    xy_opacity, conic_cutoff,
                    left + real((subtile % wp.static(across)) * wp.static(SUBTILE[0])),
                    top + real((subtile // wp.static(across)) * wp.static(SUBTILE[1])),
                    real(wp.static(SUBTILE[0] - 1)), real(wp.static(SUBTILE[1] - 1)),
                ):
                    touched = touched | (1 << subtile)
        if subtile_masks.shape[0] > 0:
            subtile_masks[entry] = wp.uint8(touched)

    return find_tile_ranges
