"""gsplat's projection: any of its cameras that a matrix describes, and covariances."""

import math
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

from ...rasterizer.checks import check_tensors, is_not_negative, real
from ...rasterizer.projection import FRUSTUM_MARGIN, ProjectedGaussians, project_to_camera
from ...rasterizer.render_options import ALPHA_THRESHOLD, RenderOptions, image_size
from ...rasterizer.torch_contract import torch_operation
from .inputs import View, split_views
from .splats import JoinedSplats

CameraModel = Literal["pinhole", "ortho", "fisheye"]
CAMERA_MODELS = get_args(CameraModel)
SMALLEST_SIZE = 1e-30  # A size of 0 has no logarithm; its gradient is 0 as the covariance's is.
LARGEST_SIZE = 1e12  # Scene units. The squares of larger ones are not finite in an image.


class ProjectionOptions(NamedTuple):
    """The arguments of a projection that are not tensors.

    Attributes:
        width: of the images, pixels.
        height: of the images, pixels.
        near_plane: least depth, scene units.
        far_plane: largest depth, scene units.
        radius_clip: Gaussians whose radii in pixels are not larger are left out.
        eps2d: variance in square pixels added to each 2D Gaussian.
        antialiased: lower opacities so that eps2d keeps a Gaussian's energy.
        camera_model: one of CAMERA_MODELS.
    """

    width: int
    height: int
    near_plane: float
    far_plane: float
    radius_clip: float
    eps2d: float
    antialiased: bool
    camera_model: CameraModel

    def checked(self) -> "ProjectionOptions":
        """Return the options with sizes as plain integers; raise TypeError or ValueError for values out of range."""
        if self.camera_model not in CAMERA_MODELS:
            raise ValueError(f"camera_model {self.camera_model!r} is none of {', '.join(CAMERA_MODELS)}")
        for name in ("near_plane", "far_plane", "radius_clip"):
            real(name, getattr(self, name), lambda number: not math.isnan(number), "a number")
        real("eps2d", self.eps2d, is_not_negative, "a number from 0")
        width, height = image_size(self.width, self.height)
        return self._replace(width=width, height=height)


def project_gaussians(view: View, options: ProjectionOptions) -> ProjectedGaussians:
    """Project the N Gaussians of a view, by the rasterizer's kernel if it can, else by torch's operations."""
    near_plane = max(options.near_plane, 1e-30)
    if options.camera_model == "pinhole" and view.quats is not None and view.scales is not None:
        K, size = view.K, (options.width, options.height)
        intrinsics = torch.stack([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
        log_scales = view.scales.abs().clamp_min(SMALLEST_SIZE).log()
        projected = project_to_camera(
            *(view.means, log_scales, view.quats, view.opacities, view.viewmat, intrinsics),
            RenderOptions(*size, near_plane, options.eps2d, ALPHA_THRESHOLD, options.antialiased),
            differentiate_compensation=True,
        )
    else:
        projected = _project_covariances(view, options._replace(near_plane=near_plane))
    extents = projected.extents
    if options.far_plane < 1e10:
        extents = extents * (projected.depths.detach() <= options.far_plane)[:, None]
    if options.radius_clip > 0:
        extents = extents * (extents.ceil() > options.radius_clip).any(1, keepdim=True)
    return projected._replace(extents=extents)


def _finite_covariances(quats: Tensor, scales: Tensor) -> Tensor:
    """Return covariances [N, 3, 3], NaN for Gaussians without one, whose quaternions and scales get no gradient."""
    usable = quats.isfinite().all(1) & (scales.abs() < LARGEST_SIZE).all(1)
    quats = torch.where(usable[:, None], quats, quats.new_tensor([1.0, 0.0, 0.0, 0.0]))
    covars, _ = quat_scale_to_covar_preci(quats, torch.where(usable[:, None], scales, 1.0), compute_preci=False)
    assert covars is not None
    return torch.where(usable[:, None, None], covars, math.nan)


def _project_covariances(view: View, options: ProjectionOptions) -> ProjectedGaussians:
    means, opacities, viewmat, K, covars = view.means, view.opacities, view.viewmat, view.K, view.covars
    if covars is None:
        assert view.quats is not None and view.scales is not None
        covars = _finite_covariances(view.quats, view.scales)
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    finite = means.isfinite().all(1) & covars.isfinite().all(2).all(1) & opacities.isfinite()
    opacities = torch.where(finite, opacities, 0.0)
    centers = torch.where(finite[:, None], means, 0.0) @ rotation.T + translation
    inside = finite & (centers[:, 2] > options.near_plane) & viewmat.isfinite().all() & K.isfinite().all()
    # What is culled takes part as a point in front of the camera, so that its derivatives are finite.
    centers = torch.where(inside[:, None], centers, centers.new_tensor([0.0, 0.0, 1.0]))
    covars = torch.where(inside[:, None, None], covars, torch.eye(3, dtype=covars.dtype, device=covars.device))
    means2d, jacobian = _linearize(centers, K, options)
    to_image = jacobian @ rotation
    covars2d = to_image @ covars @ to_image.transpose(1, 2)
    xx, xy, yy = covars2d[:, 0, 0], covars2d[:, 0, 1], covars2d[:, 1, 1]
    unblurred, xx, yy = xx * yy - xy * xy, xx + options.eps2d, yy + options.eps2d
    determinant = xx * yy - xy * xy
    inside = inside & (determinant > 0) & determinant.isfinite()
    determinant = torch.where(inside, determinant, 1.0)
    if options.antialiased:
        opacities = opacities * (unblurred / determinant).clamp_min(1e-12).sqrt()
    with torch.no_grad():
        cutoffs = 2 * torch.log((opacities / ALPHA_THRESHOLD).clamp_min(1.0))
        extents = (cutoffs[:, None] * torch.stack([xx, yy], 1)).clamp_min(0.0).sqrt()
        inside = inside & (opacities > ALPHA_THRESHOLD)
        size = means2d.new_tensor([options.width, options.height])
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


def _linearize(centers: Tensor, K: Tensor, options: ProjectionOptions) -> tuple[Tensor, Tensor]:
    """Return the pixels [N, 2] of places in front of the camera [N, 3] and the Jacobian there [N, 2, 3]."""
    x, y, z = centers.unbind(1)
    focal, principal = torch.stack([K[0, 0], K[1, 1]]), torch.stack([K[0, 2], K[1, 2]])
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    if options.camera_model == "ortho":
        by_place = [one, zero, zero], [zero, one, zero]
        rays = torch.stack([x, y], 1)
    elif options.camera_model == "fisheye":
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
        size = K.new_tensor([options.width, options.height])
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


@torch_operation
def quat_scale_to_covar_preci(
    quats: Tensor, scales: Tensor, compute_covar: bool = True, compute_preci: bool = True, triu: bool = False
) -> tuple[Tensor | None, Tensor | None]:
    """Return covariances and their inverses.

    Args:
        quats: [..., 4] (w, x, y, z), of any length.
        scales: [..., 3].
        compute_covar: whether to return covariances, else None.
        compute_preci: whether to return their inverses, else None.
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


@torch_operation
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
    options = ProjectionOptions(
        *(width, height, near_plane, far_plane, radius_clip, eps2d, calc_compensations, camera_model)
    ).checked()
    if isinstance(covars, Tensor) and covars.shape[-1:] == (6,):
        covars = covars[..., (0, 1, 2, 1, 3, 4, 2, 4, 5)].unflatten(-1, (3, 3))
    if opacities is None:
        check_tensors(means=(means, (*means.shape[:-1], 3) if isinstance(means, Tensor) else ("N", 3)))
        opacities = torch.ones_like(means[..., 0])
    views = split_views(means, quats, scales, covars, opacities, None, None, viewmats, Ks, None, None)
    projections = [project_gaussians(view, options) for view in views]
    if calc_compensations:
        projections = [
            projected._replace(opacities=projected.opacities / view.opacities.clamp_min(1e-30))
            for projected, view in zip(projections, views, strict=True)
        ]
    splats = JoinedSplats.of(projections, packed, viewmats.shape[:-2])
    means2d, conics, depths, compensations, _ = splats.all
    values = splats.radii, means2d, depths, conics, compensations if calc_compensations else None
    return (*splats.ids(viewmats.shape[-3]), *values) if packed else values
