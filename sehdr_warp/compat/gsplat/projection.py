"""gsplat's projection: any of its cameras that a matrix describes, covariances, and the tiles that Gaussians touch."""

import math
from itertools import product
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from ...rasterizer.checks import check_tensors
from ...rasterizer.projection import FRUSTUM_MARGIN, ProjectedGaussians, project_to_camera
from ...rasterizer.render_options import ALPHA_THRESHOLD, RenderOptions

CameraModel = Literal["pinhole", "ortho", "fisheye"]
CAMERA_MODELS = "pinhole", "ortho", "fisheye"
SMALLEST_SIZE = 1e-30  # A size of 0 has no logarithm; its gradient is 0 as the covariance's is.
LARGEST_SIZE = 1e12  # Scene units. The squares of larger ones are not finite in an image.


def check_camera_model(camera_model: Any) -> None:
    """Raise ValueError if it is not one of CAMERA_MODELS."""
    if camera_model not in CAMERA_MODELS:
        raise ValueError(f"camera_model {camera_model!r} is none of {', '.join(CAMERA_MODELS)}")


class Culling(NamedTuple):
    """Limits beyond which Gaussians are left out.

    Attributes:
        near_plane: least depth, scene units.
        far_plane: largest depth, scene units.
        radius_clip: Gaussians whose radii in pixels are not larger are left out.
    """

    near_plane: float = 0.01
    far_plane: float = 1e10
    radius_clip: float = 0.0


def project_gaussians(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    covars: Tensor | None,
    opacities: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    eps2d: float,
    culling: Culling,
    antialiased: bool,
    camera_model: CameraModel,
) -> ProjectedGaussians:
    """Project N Gaussians to one camera, by the rasterizer's kernel if it can, else by torch's operations.

    Args:
        means: [N, 3].
        quats: [N, 4]; None with covars.
        scales: [N, 3]; None with covars.
        covars: [N, 3, 3], in place of quats and scales.
        opacities: [N].
        viewmat: [4, 4].
        K: [3, 3].
        width: of the image, pixels.
        height: of the image, pixels.
        eps2d: variance in square pixels added to each 2D Gaussian.
        culling: limits of depth and radius.
        antialiased: lower opacities so that eps2d keeps a Gaussian's energy.
        camera_model: "pinhole", "ortho" or "fisheye".
    """
    near = max(culling.near_plane, 1e-30)
    if camera_model == "pinhole" and quats is not None and scales is not None:
        intrinsics = torch.stack([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
        options = RenderOptions(width, height, near, eps2d, ALPHA_THRESHOLD, antialiased)
        log_scales = scales.abs().clamp_min(SMALLEST_SIZE).log()
        projected = project_to_camera(
            means, log_scales, quats, opacities, viewmat, intrinsics, options, differentiate_compensation=True
        )
    else:
        if covars is None:
            assert quats is not None and scales is not None
            covars = _finite_covariances(quats, scales)
        assert covars is not None
        projected = _project_covariances(
            means, covars, opacities, viewmat, K, width, height, eps2d, near, antialiased, camera_model
        )
    extents = projected.extents
    if culling.far_plane < 1e10:
        extents = extents * (projected.depths.detach() <= culling.far_plane)[:, None]
    if culling.radius_clip > 0:
        extents = extents * (extents.ceil() > culling.radius_clip).any(1, keepdim=True)
    return projected if extents is projected.extents else projected._replace(extents=extents)


def _finite_covariances(quats: Tensor, scales: Tensor) -> Tensor:
    """Return covariances [N, 3, 3], NaN for Gaussians without one, whose quaternions and scales get no gradient."""
    usable = quats.isfinite().all(1) & (scales.abs() < LARGEST_SIZE).all(1)
    quats = torch.where(usable[:, None], quats, quats.new_tensor([1.0, 0.0, 0.0, 0.0]))
    covars, _ = quat_scale_to_covar_preci(quats, torch.where(usable[:, None], scales, 1.0), compute_preci=False)
    assert covars is not None
    return torch.where(usable[:, None, None], covars, math.nan)


def _project_covariances(
    means: Tensor,
    covars: Tensor,
    opacities: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    eps2d: float,
    near_plane: float,
    antialiased: bool,
    camera_model: CameraModel,
) -> ProjectedGaussians:
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    finite = means.isfinite().all(1) & covars.isfinite().all(2).all(1) & opacities.isfinite()
    opacities = torch.where(finite, opacities, 0.0)
    centers = torch.where(finite[:, None], means, 0.0) @ rotation.T + translation
    inside = finite & (centers[:, 2] > near_plane) & viewmat.isfinite().all() & K.isfinite().all()
    # What is culled takes part as a point in front of the camera, so that its derivatives are finite.
    centers = torch.where(inside[:, None], centers, centers.new_tensor([0.0, 0.0, 1.0]))
    covars = torch.where(inside[:, None, None], covars, torch.eye(3, dtype=covars.dtype, device=covars.device))
    means2d, jacobian = _linearize(centers, K, width, height, camera_model)
    to_image = jacobian @ rotation
    covars2d = to_image @ covars @ to_image.transpose(1, 2)
    xx, xy, yy = covars2d[:, 0, 0], covars2d[:, 0, 1], covars2d[:, 1, 1]
    unblurred, xx, yy = xx * yy - xy * xy, xx + eps2d, yy + eps2d
    determinant = xx * yy - xy * xy
    inside = inside & (determinant > 0) & determinant.isfinite()
    determinant = torch.where(inside, determinant, 1.0)
    if antialiased:
        opacities = opacities * (unblurred / determinant).clamp_min(1e-12).sqrt()
    with torch.no_grad():
        cutoffs = 2 * torch.log((opacities / ALPHA_THRESHOLD).clamp_min(1.0))
        extents = (cutoffs[:, None] * torch.stack([xx, yy], 1)).clamp_min(0.0).sqrt()
        inside = inside & (opacities > ALPHA_THRESHOLD)
        size = means2d.new_tensor([width, height])
        inside = inside & ((means2d + extents > 0) & (means2d - extents < size)).all(1)
        extents = torch.where(inside[:, None], extents, 0.0)
    conics = torch.stack([yy, -xy, xx], 1) / determinant[:, None]
    return ProjectedGaussians(
        torch.where(inside[:, None], means2d, 0.0),
        torch.where(inside[:, None], conics, conics.new_tensor([1.0, 0.0, 1.0])),
        torch.where(inside, centers[:, 2], 0.0),
        torch.where(inside, opacities, 0.0),
        extents,
    )


def _linearize(centers: Tensor, K: Tensor, width: int, height: int, camera_model: CameraModel) -> tuple[Tensor, Tensor]:
    """Return the pixels [N, 2] of places in front of the camera [N, 3] and the Jacobian there [N, 2, 3]."""
    x, y, z = centers.unbind(1)
    focal, principal = torch.stack([K[0, 0], K[1, 1]]), torch.stack([K[0, 2], K[1, 2]])
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    if camera_model == "ortho":
        by_place = [one, zero, zero], [zero, one, zero]
        rays = torch.stack([x, y], 1)
    elif camera_model == "fisheye":
        squared = x * x + y * y + 1e-14
        radius = squared.sqrt()
        angle, distance = torch.atan2(radius, z), squared + z * z
        stretch = angle / radius
        slope = (z / distance - stretch) / squared
        by_place = (
            [stretch + x * x * slope, x * y * slope, -x / distance],
            [x * y * slope, stretch + y * y * slope, -y / distance],
        )
        rays = torch.stack([x, y], 1) * stretch[:, None]
    else:
        rays = torch.stack([x, y], 1) / z[:, None]
        size = K.new_tensor([width, height])
        margin = FRUSTUM_MARGIN * size / 2
        clamped_rays = torch.minimum(
            torch.maximum(rays, -(principal + margin) / focal), (size - principal + margin) / focal
        )
        by_place = [1 / z, zero, -clamped_rays[:, 0] / z], [zero, 1 / z, -clamped_rays[:, 1] / z]
    jacobian = torch.stack([torch.stack(row, 1) for row in by_place], 1) * focal[:, None]
    return rays * focal + principal, jacobian


def rotation_matrices(quats: Tensor) -> Tensor:
    """Return the rotations [..., 3, 3] of quaternions [..., 4] (w, x, y, z) of any length."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    return torch.stack(
        [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ],
        dim=-1,
    ).unflatten(-1, (3, 3))


def quat_scale_to_covar_preci(
    quats: Tensor, scales: Tensor, compute_covar: bool = True, compute_preci: bool = True, triu: bool = False
) -> tuple[Tensor | None, Tensor | None]:
    """Return covariances and their inverses.

    Args:
        quats: [..., 4] (w, x, y, z), of any length.
        scales: [..., 3].
        compute_covar: whether covariances are wanted.
        compute_preci: whether their inverses are.
        triu: whether to return the six numbers of the upper triangle, [..., 6], in place of [..., 3, 3].

    Raises:
        TypeError: for what is not a tensor.
        ValueError: for shapes, dtypes or devices that do not fit.
    """
    batch = tuple(quats.shape[:-1]) if isinstance(quats, Tensor) else ()
    check_tensors(quats=(quats, (*batch, 4)), scales=(scales, (*batch, 3)))
    rotation = rotation_matrices(quats)

    def gram(sizes: Tensor) -> Tensor:
        axes = rotation * sizes[..., None, :]
        matrix = axes @ axes.transpose(-1, -2)
        rows, columns = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)
        return matrix[..., rows, columns] if triu else matrix

    return gram(scales) if compute_covar else None, gram(1 / scales) if compute_preci else None


def fully_fused_projection(
    means: Tensor,
    covars: Tensor | None,
    quats: Tensor | None,
    scales: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    eps2d: float = 0.3,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    packed: bool = False,
    sparse_grad: bool = False,
    calc_compensations: bool = False,
    camera_model: CameraModel = "pinhole",
    opacities: Tensor | None = None,
) -> tuple[Tensor | None, ...]:
    """Project N Gaussians to C cameras.

    Args:
        means: [..., N, 3]; "..." are batch axes, which all tensors share.
        covars: [..., N, 6] (upper triangles) or [..., N, 3, 3], or None with quats and scales.
        quats: [..., N, 4].
        scales: [..., N, 3].
        viewmats: [..., C, 4, 4].
        Ks: [..., C, 3, 3].
        width: of the images, pixels.
        height: of the images, pixels.
        eps2d: variance in square pixels added to each 2D Gaussian.
        near_plane: least depth.
        far_plane: largest depth.
        radius_clip: Gaussians whose radii are not larger are left out.
        packed: return the visible Gaussians alone.
        sparse_grad: must be False.
        calc_compensations: return the factors of antialiased opacities.
        camera_model: "pinhole", "ortho" or "fisheye".
        opacities: [..., N], for tighter radii; 1 if None.

    Returns:
        radii [..., C, N, 2] int32 (0 if culled), means2d [..., C, N, 2], depths [..., C, N], conics [..., C, N, 3] and
        compensations [..., C, N] or None. If packed: batch_ids, camera_ids, gaussian_ids [nnz] and then the same with
        [nnz] rows.

    Raises:
        TypeError: for what is not a tensor.
        ValueError: for an argument that is not supported, and for shapes, dtypes or devices that do not fit.
    """
    if sparse_grad:
        raise ValueError("sparse_grad = True is not supported, expected False")
    check_camera_model(camera_model)
    if isinstance(covars, Tensor) and covars.shape[-1] == 6:
        covars = covars[..., (0, 1, 2, 1, 3, 4, 2, 4, 5)].unflatten(-1, (3, 3))
    batch = tuple(means.shape[:-2]) if isinstance(means, Tensor) else ()
    shapes: dict[str, tuple[Any, tuple[int | str, ...]]] = {"covars": (covars, (*batch, "N", 3, 3))}
    if covars is None:
        shapes = {"quats": (quats, (*batch, "N", 4)), "scales": (scales, (*batch, "N", 3))}
    if opacities is not None:
        shapes["opacities"] = opacities, (*batch, "N")
    cameras = {"viewmats": (viewmats, (*batch, "C", 4, 4)), "Ks": (Ks, (*batch, "C", 3, 3))}
    check_tensors(means=(means, (*batch, "N", 3)), **shapes, **cameras)
    alphas = torch.ones_like(means[..., 0]) if opacities is None else opacities
    indices = list(product(*map(range, (*batch, viewmats.shape[-3]))))
    if not indices:
        raise ValueError(f"viewmats has shape {list(viewmats.shape)}, expected a camera at least")
    views = [
        project_gaussians(
            means[scene], _row(quats, scene), _row(scales, scene), _row(covars, scene), alphas[scene],
            viewmats[*scene, camera], Ks[*scene, camera], width, height, eps2d=eps2d,
            culling=Culling(near_plane, far_plane, radius_clip), antialiased=calc_compensations,
            camera_model=camera_model,
        )
        for *axes, camera in indices
        for scene in (tuple(axes),)
    ]  # fmt: skip
    shape = *batch, viewmats.shape[-3]
    means2d, conics, depths, lowered, extents = (torch.stack(v).unflatten(0, shape) for v in zip(*views, strict=True))
    compensations = lowered / alphas[..., None, :].clamp_min(1e-30) if calc_compensations else None
    radii = extents.ceil().int()
    if not packed:
        return radii, means2d, depths, conics, compensations
    batch_ids, camera_ids, gaussian_ids = (radii > 0).all(-1).reshape(-1, *radii.shape[-3:-1]).nonzero(as_tuple=True)
    rows = (batch_ids * shape[-1] + camera_ids) * radii.shape[-2] + gaussian_ids
    packed_compensations = None if compensations is None else compensations.reshape(-1)[rows]
    values = (value.flatten(0, -2)[rows] for value in (radii, means2d, depths[..., None], conics))
    packed_radii, packed_means, packed_depths, packed_conics = values
    parts = packed_radii, packed_means, packed_depths[:, 0], packed_conics, packed_compensations
    return batch_ids, camera_ids, gaussian_ids, *parts


def _row(tensor: Tensor | None, place: tuple[int, ...]) -> Tensor | None:
    return None if tensor is None else tensor[place]


def isect_tiles(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    tile_size: int,
    tile_width: int,
    tile_height: int,
    sort: bool = True,
    segmented: bool = False,
    packed: bool = False,
    n_images: int | None = None,
    image_ids: Tensor | None = None,
    gaussian_ids: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the tiles that the bounding rectangles of 2D Gaussians touch.

    Args:
        means2d: [..., N, 2] or, packed, [nnz, 2].
        radii: [..., N, 2] or [nnz, 2] int32.
        depths: [..., N] or [nnz], positive.
        tile_size: in pixels.
        tile_width: tiles across.
        tile_height: tiles down.
        sort: whether to sort by image, tile and depth.
        segmented: has no effect.
        packed: whether inputs are packed.
        n_images: has no effect beside image_ids.
        image_ids: [nnz] if packed.
        gaussian_ids: has no effect.

    Returns:
        tiles_per_gauss [..., N] or [nnz] int32; isect_ids [M] int64, in bits from the highest: image, tile, 32 bits of
        the depth; flatten_ids [M] int32, the index in the flattened inputs.

    Raises:
        TypeError: for what is not a tensor.
        ValueError: for shapes, dtypes or devices that do not fit.
    """
    batch = tuple(depths.shape[:-1]) if isinstance(depths, Tensor) else ()
    check_tensors(depths=(depths, (*batch, "N")), means2d=(means2d, (*batch, "N", 2)))
    if not isinstance(radii, Tensor) or radii.shape != means2d.shape:
        problem = f"has shape {list(radii.shape)}" if isinstance(radii, Tensor) else f"is a {type(radii).__name__}"
        raise ValueError(f"radii {problem}, expected a tensor {list(means2d.shape)}")
    shape = depths.shape
    if image_ids is None:
        images = math.prod(shape[:-1])
        image_ids = torch.arange(images, device=depths.device).repeat_interleave(shape[-1]).reshape(-1)
    centers, reach, depths = means2d.detach().reshape(-1, 2), radii.reshape(-1, 2), depths.detach().reshape(-1)
    limits = torch.tensor([tile_width, tile_height], device=centers.device)
    low = ((centers - reach) / tile_size).floor().clamp_min(0).minimum(limits).long()
    high = ((centers + reach) / tile_size).ceil().clamp_min(0).minimum(limits).long()
    spans = torch.where((reach > 0).all(1, keepdim=True), (high - low).clamp_min(0), 0)
    counts = spans.prod(1)
    flatten_ids = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
    places = torch.arange(len(flatten_ids), device=counts.device) - (counts.cumsum(0) - counts)[flatten_ids]
    across = spans[flatten_ids, 0].clamp_min(1)
    tiles = (low[flatten_ids, 1] + places // across) * tile_width + low[flatten_ids, 0] + places % across
    bits = depths.float().view(torch.int32).long() & 0xFFFFFFFF
    keys = (image_ids[flatten_ids] << _tile_bits(tile_width, tile_height)) | tiles
    isect_ids = (keys << 32) | bits[flatten_ids]
    if sort:
        isect_ids, order = isect_ids.sort(stable=True)
        flatten_ids = flatten_ids[order]
    return counts.int().reshape(shape), isect_ids, flatten_ids.int()


def isect_offset_encode(isect_ids: Tensor, n_images: int, tile_width: int, tile_height: int) -> Tensor:
    """Return [C, tile_height, tile_width] int32: where each tile's intersections begin among sorted isect_ids."""
    tiles = torch.arange(n_images * tile_width * tile_height, device=isect_ids.device)
    image, tile = tiles // (tile_width * tile_height), tiles % (tile_width * tile_height)
    keys = (image << _tile_bits(tile_width, tile_height)) | tile
    offsets = torch.searchsorted((isect_ids >> 32).contiguous(), keys)
    return offsets.int().reshape(n_images, tile_height, tile_width)


def _tile_bits(tile_width: int, tile_height: int) -> int:
    return math.floor(math.log2(tile_width * tile_height)) + 1
