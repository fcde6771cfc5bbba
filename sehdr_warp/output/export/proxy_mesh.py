"""A proxy mesh of a scene: for shadows, collisions and depth tests where a program cannot use Gaussians.

Depth of the training views is fused (see depth_fusion) and scikit-image extracts the surface. Colors are the scene's
mean radiance there.
"""

import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ...errors import InputError, SehdrError, path_of, require_loaded, require_whole_number
from ...files import atomic_path, check_absent
from ...progress import track_progress
from ...runs.run import RenderableScene
from ...scene import Camera
from ...splats.usd import pxr, writing_usd
from ...subsets import evenly
from ..cameras.scene_cameras import split_or_all, training_cameras
from ..images.display import encode_srgb
from ..world_transform import WorldTransform, scene_up, world_transform
from .depth_fusion import (
    MOST_VIEWS,
    depth_views,
    fuse_depth,
    marching_cubes_function,
    mesh_bounds,
    nearest_values,
    points_of_view,
    voxel_centers,
    zero_surface,
)
from .splat_edits import Box, Sphere, read_region

log = logging.getLogger(__name__)
SUFFIXES = (".obj", ".usda", ".usdc")
RESOLUTIONS = 16, 512
_FEWEST_VIEWS = 2  # Views that must have measured a voxel
_LEAST_PART = 0.01  # Share of all triangles that a connected part needs to stay
_CHECKED = 3  # Held-out views that the mesh's depth is compared in
# Triangles are left out that are nearer to a Gaussian of a light than _REACH standard deviations and _CLEAR voxels. Of
# each vertex the _NEAREST Gaussians are compared, because the nearest one may be small.
_REACH, _CLEAR, _NEAREST = 2.0, 1.5, 8
_UPRIGHT = np.cos(np.radians(20))  # Cosine to +Y of the normal of a floor, and of up in a file that may have a floor
_LEVEL = 1.0  # Degrees to which a floor counts as level
_COARSE = 0.1  # Voxels by which rounded coordinates may move a vertex without a warning
_CLOSE = 0.03  # Relative difference of depth that counts as agreement


@dataclass(frozen=True)
class Ground:
    """A floor: the lowest large level part of a mesh, in upright coordinates."""

    height: float  # Of the plane where x and z are 0
    normal: np.ndarray  # [3] unit vector, upwards
    share: float  # Share of the mesh's area

    @property
    def tilt(self) -> float:
        """Angle to level, degrees."""
        return float(np.degrees(np.arccos(np.clip(self.normal[1], -1, 1))))

    def corners(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return the corners [4, 3] of the plane above a box, counterclockwise as seen from above."""
        x, z = np.array([low[0], low[0], high[0], high[0]]), np.array([low[2], high[2], high[2], low[2]])
        return np.stack([x, self.height - (self.normal[0] * x + self.normal[2] * z) / self.normal[1], z], axis=1)


@dataclass(frozen=True)
class ProxyMesh:
    """A triangle mesh in the coordinates of a file."""

    vertices: np.ndarray  # [V, 3] float32
    faces: np.ndarray  # [F, 3] int32, counterclockwise as seen from outside
    radiance: np.ndarray  # [V, 3] float32, scene-linear Rec.709
    voxel: float  # Longest side of a voxel
    ground: Ground | None = None  # The floor, if one was found


def write_proxy_mesh(
    run: RenderableScene,
    path: Path | str,
    *,
    resolution: int = 160,
    crop: str | None = None,
    axes: str = "upright",
    up: str | Sequence[float] | None = None,
    scale: float | None = None,
    overwrite: bool = False,
) -> Path:
    """Write a mesh of a scene's surfaces, and log how far its depth agrees with that of the scene.

    Lights that write_lights() would write are left out, because the mesh would block them.

    An OpenUSD file holds `/World/Proxy` with radiance as displayColor and, if +Y is up and a floor was found, a level
    plane `/World/Ground`. An OBJ file holds both as objects, with display colors.

    Args:
        run: A trained run, with training cameras.
        path: The file: .obj, .usda or .usdc.
        resolution: Voxels along the longest side of the meshed box, 16 to 512. Memory grows with its cube.
        crop: Region to mesh, as "box:x0,y0,z0,x1,y1,z1" or "sphere:x,y,z,radius" in the file's coordinates; by
            default what most photos show, without what is far behind.
        axes: As in world_transform.
        up: As in world_transform.
        scale: As in world_transform.
        overwrite: Replace a file that exists.

    Returns:
        The path.

    Raises:
        InputError: For an unknown suffix, or if the file exists.
        SehdrError: If scikit-image or OpenUSD is missing, for values out of range, or if there is no surface.
    """
    require_loaded("load_run", run)
    path, region = path_of(path, "path"), check_mesh(path, resolution, crop, overwrite)
    transform = world_transform(run, axes, up=up, scale=scale)
    mesh = proxy_mesh(run, transform, up=up, resolution=resolution, region=region)
    with atomic_path(path, overwrite) as temporary:
        if path.suffix.lower() == ".obj":
            _write_obj(temporary, mesh, transform, run)
        else:
            with writing_usd(path):
                _write_usd(temporary, mesh, transform)
    log.info("%s: %d triangles, voxels of %.3g", path.name, len(mesh.faces), mesh.voxel)
    far = float(np.abs(mesh.vertices).max())
    step = far * 1e-6 if path.suffix.lower() == ".obj" else float(np.spacing(np.float32(far)))  # OBJ has six digits.
    if step > _COARSE * mesh.voxel:
        text = "%s: coordinates up to %.4g are too large for its numbers, which move vertices by about %.2g; %s"
        log.warning(text, path.name, far, step, "use --axes upright, which puts the scene at the origin")
    if mesh.ground is not None:
        log.info("%s", _ground_line(mesh.ground, transform, scene_up(run)))
    _log_agreement(mesh, run, transform)
    return path


def check_mesh(path: Path | str, resolution: int, crop: str | None, overwrite: bool) -> Box | Sphere | None:
    """Return the region to mesh; raise the errors of write_proxy_mesh() that need no scene."""
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        kind = path.suffix or "a file without a suffix"
        raise InputError(path, f"a mesh is not written as {kind}", f"use one of {', '.join(SUFFIXES)}")
    require_whole_number(resolution, "resolution")
    if not RESOLUTIONS[0] <= resolution <= RESOLUTIONS[1]:
        raise SehdrError(f"resolution {resolution} is not between {RESOLUTIONS[0]} and {RESOLUTIONS[1]} voxels")
    region = None if crop is None else read_region(crop)
    marching_cubes_function()
    if path.suffix.lower() != ".obj":
        pxr("Usd")
    check_absent(path, overwrite)
    return region


def proxy_mesh(
    run: RenderableScene,
    transform: WorldTransform,
    *,
    up: str | Sequence[float] | None = None,
    resolution: int = 160,
    region: Box | Sphere | None = None,
) -> ProxyMesh:
    """Return the mesh of a run in the coordinates that a transform leads to; arguments as in write_proxy_mesh."""
    cameras = training_cameras(run)
    if not cameras:
        raise SehdrError(f"{run.path}: has no training cameras whose depth could be fused")
    cameras = evenly(cameras, MOST_VIEWS)
    rendered = [depth_views(run, camera, transform) for _, camera in track_progress("depth of views", cameras, log)]
    views = [view for faces in rendered for view in faces]
    low, high = mesh_bounds(views, region)
    longest = float((high - low).max()) / resolution
    # The last voxels end at the box, so along the shorter sides they are a little narrower.
    counts = np.maximum(np.ceil((high - low) / longest - 1e-9), 2).astype(int)
    voxel, shape = (high - low) / counts, tuple((counts + 1).tolist())
    distance, weight, radiance = fuse_depth(views, low, voxel, shape)
    if isinstance(region, Sphere):
        outside = ~region.contains(voxel_centers(low, voxel, shape).reshape(-1, 3)).reshape(shape)
        weight[outside] = 0
    vertices, faces = zero_surface(distance, weight >= min(_FEWEST_VIEWS, len(cameras)), voxel)
    faces = _without_lights(run, transform, vertices + low, faces, longest)
    colors = nearest_values(radiance, vertices / voxel)
    vertices, faces, colors = _large_parts(vertices + low, faces, colors)
    places = np.array([view.camera.position for view in views])
    stands = (transform.rotation @ scene_up(run, up))[1] > _UPRIGHT
    ground = find_ground(vertices, faces, places, longest) if stands else None
    return ProxyMesh(vertices.astype(np.float32), faces.astype(np.int32), colors.astype(np.float32), longest, ground)


def _without_lights(
    run: RenderableScene, transform: WorldTransform, vertices: np.ndarray, faces: np.ndarray, voxel: float
) -> np.ndarray:
    """Return the triangles that are not at Gaussians of the scene's lights, whose light they would block."""
    from scipy.spatial import KDTree

    lights = run.find_lights() if run.clipped_share() is not None else []
    if not lights:
        return faces
    gaussians, normalization = run.field.gaussians, run.field.normalization
    members = torch.cat([light.members for light in lights]).to(gaussians.means.device)
    means = normalization.scene_points(gaussians.means[members].cpu().numpy())
    scale = normalization.unit * transform.scale
    reach = _REACH * scale * gaussians.log_scales[members].exp().amax(1).cpu().numpy() + _CLEAR * voxel
    distance, nearest = KDTree(transform.points(means)).query(vertices, k=min(_NEAREST, len(means)))
    at_light = (distance < reach[nearest]).reshape(len(vertices), -1).any(1)[faces].any(1)
    if at_light.any():
        text = "left out: %d of %d triangles at the scene's lights (%d), whose light they would block"
        log.info(text, at_light.sum(), len(faces), len(lights))
    return faces[~at_light]


def _large_parts(
    vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a mesh without connected parts that have less than _LEAST_PART of the triangles."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_array((np.ones(len(edges), bool), (edges[:, 0], edges[:, 1])), shape=(len(vertices),) * 2)
    part = connected_components(graph, directed=False)[1][faces[:, 0]]
    faces = faces[np.bincount(part)[part] >= _LEAST_PART * len(faces)]
    if not len(faces):
        raise SehdrError("there is no surface to mesh: only scattered pieces; take another --crop, or train longer")
    corners, faces = np.unique(faces, return_inverse=True)
    return vertices[corners], faces.reshape(-1, 3), colors[corners]


def find_ground(vertices: np.ndarray, faces: np.ndarray, cameras: np.ndarray, voxel: float) -> Ground | None:
    """Return the floor of an upright mesh: the lowest of its large level parts, below the cameras [C, 3]."""
    corners = vertices[faces]
    normals, middles = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), corners.mean(axis=1)
    lengths = np.linalg.norm(normals, axis=1)
    areas = lengths / 2
    level = (normals[:, 1] > _UPRIGHT * np.maximum(lengths, 1e-20)) & (middles[:, 1] < np.percentile(cameras[:, 1], 10))
    if areas[level].sum() < 0.02 * areas.sum():
        return None
    low = middles[level, 1].min()
    bins = ((middles[level, 1] - low) / voxel).astype(int)
    profile = np.convolve(np.bincount(bins, areas[level]), np.ones(5), "same")
    peak = int(np.flatnonzero(profile >= profile.max() / 3)[0])
    while peak + 1 < len(profile) and profile[peak + 1] > profile[peak]:
        peak += 1
    near_peak = np.flatnonzero(level)[np.abs(bins - peak) <= 2]
    if areas[near_peak].sum() < 0.02 * areas.sum():
        return None
    root, points = np.sqrt(areas[near_peak]), middles[near_peak]
    matrix = np.stack([points[:, 0], points[:, 2], np.ones(len(points))], axis=1)
    slope_x, slope_z, height = np.linalg.lstsq(matrix * root[:, None], points[:, 1] * root, rcond=None)[0]
    normal = np.array([-slope_x, 1.0, -slope_z])
    normal /= np.linalg.norm(normal)
    if normal[1] < _UPRIGHT:  # Level pieces at several heights, as of stairs
        return None
    return Ground(float(height), normal, float(areas[near_peak].sum() / areas.sum()))


def mesh_depth(mesh: ProxyMesh, camera: Camera) -> np.ndarray:
    """Return the depth [H, W] of a mesh in a camera of its coordinates, 0 where nothing is; from points on triangles.

    Triangles are about as large as voxels, so a few points on each cover every pixel of a small picture.
    """
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    depth = np.full(camera.height * camera.width, np.inf)
    steps = 5
    for i in range(steps):
        for j in range(steps - i):
            a, b = (i + 1 / 3) / steps, (j + 1 / 3) / steps
            points = corners[:, 0] * (1 - a - b) + corners[:, 1] * a + corners[:, 2] * b
            row, column, z, inside = camera.project(points)
            np.minimum.at(depth, (row[inside] * camera.width + column[inside]).astype(int), z[inside])
    return np.where(np.isfinite(depth), depth, 0).reshape(camera.height, camera.width)


def _log_agreement(mesh: ProxyMesh, run: RenderableScene, transform: WorldTransform) -> None:
    """Compare the depth of mesh and scene in a few held-out views, and log it."""
    cameras = evenly(split_or_all(run, "test"), _CHECKED)
    low, high = mesh.vertices.min(0) - mesh.voxel, mesh.vertices.max(0) + mesh.voxel
    differences, total = [np.zeros(0)], 0
    for view in (view for camera in cameras for view in depth_views(run, camera, transform, 120)):
        points, depth = points_of_view(view), view.depth.numpy()
        inside = ((points >= low) & (points <= high)).all(axis=1)
        pixels = tuple(index[inside] for index in np.nonzero(depth))
        of_mesh, of_scene = mesh_depth(mesh, view.camera)[pixels], depth[pixels]
        total += len(of_mesh)
        differences.append((np.abs(of_mesh - of_scene) / of_scene)[of_mesh > 0])
    values = np.concatenate(differences)
    if values.size:
        text = "depth beside the scene, %d views: %.1f %% off in the median, %.0f %% within 3 %%, %.0f %% not covered"
        close = float((values < _CLOSE).mean())
        log.info(text, len(cameras), 100 * float(np.median(values)), 100 * close, 100 * (1 - len(values) / total))


def _ground_line(ground: Ground, transform: WorldTransform, up_of_photos: np.ndarray) -> str:
    """Return a line about a floor, with the option that makes it level for all files, unless it may be a wall."""
    line = f"ground: at y = {ground.height:.3g}, {ground.tilt:.1f} degrees off level, {ground.share:.0%} of the surface"
    normal = transform.rotation.T @ ground.normal
    cosine = float(normal @ up_of_photos)
    if cosine < _UPRIGHT:
        degrees = np.degrees(np.arccos(max(cosine, -1.0)))
        return f"{line}; {degrees:.0f} degrees from up by the photos: if this is a wall or a ceiling, leave --up out"
    if ground.tilt < _LEVEL:
        return line
    up = ",".join(f"{value:.4f}" for value in normal)
    return f"{line}; --up={up} levels it, here and for render, export and envmap"


def _write_obj(path: Path, mesh: ProxyMesh, transform: WorldTransform, run: RenderableScene) -> None:
    """Write an OBJ file with vertex colors, in sRGB with the exposure of the photos."""
    colors = encode_srgb(np.clip(mesh.radiance * run.base_time, 0, 1))
    with path.open("w", encoding="utf-8") as file:
        world_matrix = json.dumps(transform.matrix.tolist())
        file.write(f"# sehdr-warp proxy mesh\n# sehdr:world_matrix {world_matrix}\no Proxy\n")
        np.savetxt(file, np.hstack([mesh.vertices, colors]), "v %.6g %.6g %.6g %.4f %.4f %.4f")
        np.savetxt(file, mesh.faces + 1, "f %d %d %d")
        if mesh.ground is not None:
            file.write("o Ground\n")
            np.savetxt(file, mesh.ground.corners(mesh.vertices.min(0), mesh.vertices.max(0)), "v %.6g %.6g %.6g")
            file.write("f {} {} {} {}\n".format(*(len(mesh.vertices) + 1 + np.arange(4))))


def _write_usd(path: Path, mesh: ProxyMesh, transform: WorldTransform) -> None:
    """Write an OpenUSD layer; radiance is the displayColor of the mesh."""
    Usd, UsdGeom, Sdf, Vt, Gf = (pxr(name) for name in ("Usd", "UsdGeom", "Sdf", "Vt", "Gf"))
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    world = UsdGeom.Xform.Define(stage, "/World")
    stage.SetDefaultPrim(world.GetPrim())
    matrix = Gf.Matrix4d(transform.matrix.T.tolist())  # USD's matrices act on row vectors.
    world.GetPrim().CreateAttribute("sehdr:worldMatrix", Sdf.ValueTypeNames.Matrix4d, True).Set(matrix)
    meshes = [("Proxy", mesh.vertices, mesh.faces)]
    if mesh.ground is not None:
        corners = mesh.ground.corners(mesh.vertices.min(0), mesh.vertices.max(0))
        meshes.append(("Ground", corners, np.arange(4)[None]))
    for name, vertices, faces in meshes:
        prim = UsdGeom.Mesh.Define(stage, f"/World/{name}")
        points = np.ascontiguousarray(vertices, np.float32)
        prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
        prim.CreateFaceVertexCountsAttr(Vt.IntArray(len(faces), faces.shape[1]))
        prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(faces.reshape(-1), np.int32)))
        prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        prim.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(0), points.max(0)])))
        if name == "Proxy":
            prim.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(Vt.Vec3fArray.FromNumpy(mesh.radiance))
    stage.GetRootLayer().Save()
