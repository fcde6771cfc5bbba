"""HDR-NeRF in plain torch, for reference: what the field compares with, at its own speed.

Source: Huang et al., HDR-NeRF: High Dynamic Range Neural Radiance Fields (CVPR 2022), on NeRF (Mildenhall et al., ECCV
2020). Sizes, rates and weights are those of the paper and its configs. Assumed here: depths are uniform between bounds
taken from the scene's points, or from where the cameras look (the authors use normalised device coordinates, or bounds
by hand); positions are brought into [-1, 1] by a common shift and scale before they are encoded; the tone mappers
start rising. On a GPU products of matrices round their factors to TF32, as the authors' torch 1.9 did by default.
"""

import math
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from ..errors import InputError, SehdrError
from ..evaluation.metrics import psnr
from ..evaluation.protocols import tone_map
from ..field.radiance_field import LOG_EXPOSURE_LIMIT, RenderedView
from ..response import ToneMapper, response_by_name
from ..scene import Camera, Scene
from ..training.initialization import DEPTH_RANGE, check_scene, focus_distance

BEST = 100.0
"""Identical images count this many dB, as in the trainings of Gaussians."""


@dataclass(frozen=True)
class HdrNerfSettings:
    """Sizes and rates; the defaults are the paper's.

    depth, width: hidden layers of the trunk and their units; the input joins again after half of them. samples,
    more_samples: stratified ones a ray for the coarse field, and those drawn by importance for the fine one. rays: a
    step. positions, directions: octaves of the encodings. rate falls to a tenth in decay_steps, exponentially.
    unit_weight, unit_value: of the unit exposure loss, which fixes the scale: f(1) = unit_value. The paper takes 0.5
    for photos, and for its synthetic scenes 0.73, which is the true curve's value there.
    """

    depth: int = 8
    width: int = 256
    samples: int = 64
    more_samples: int = 128
    rays: int = 1024
    positions: int = 10
    directions: int = 4
    rate: float = 5e-4
    decay_steps: int = 500_000
    unit_weight: float = 0.5
    unit_value: float = 0.5
    rays_at_once: int = 4096


def unit_value(response: str) -> float:
    """What the unit exposure loss holds on to where the response is known: its value there, as the paper does for its
    synthetic scenes, within what a sigmoid reaches; 0.5 for "auto"."""
    if response == "auto":
        return HdrNerfSettings.unit_value
    return float(np.clip(response_by_name(response).encode(1.0), 0.005, 0.995))


class HdrNerf(nn.Module):
    """One field: position and direction to density and log radiance, and a tone mapper for each channel.

    forward(points [R, S, 3] in [-1, 1], directions [R, 3] of length 1) gives densities [R, S] > 0 and log radiance
    [R, S, 3]. Densities are softplus(x - 1) (Mip-NeRF) where the authors' are ReLU: those may start at 0 everywhere,
    and stay there. seed: of the tone mapper; the other weights come from torch's own generator.
    """

    def __init__(self, settings: HdrNerfSettings, seed: int = 0):
        super().__init__()
        self.settings, width = settings, settings.width
        points, directions = 3 + 6 * settings.positions, 3 + 6 * settings.directions
        self.skip = settings.depth // 2 + 1
        sizes = [points, *[width] * (settings.depth - 1)]
        self.trunk = nn.ModuleList(
            nn.Linear(size + (points if layer == self.skip else 0), width) for layer, size in enumerate(sizes)
        )
        self.density = nn.Linear(width, 1)
        self.feature = nn.Linear(width, width)
        self.view = nn.Linear(width + directions, width // 2)
        self.log_radiance = nn.Linear(width // 2, 3)
        self.tone_mapper = ToneMapper(width // 2, seed)

    def forward(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        encoded = encoding(points, self.settings.positions)
        hidden = encoded
        for layer, linear in enumerate(self.trunk):
            if layer == self.skip:
                hidden = torch.cat([encoded, hidden], dim=-1)
            hidden = linear(hidden).relu()
        towards = encoding(directions, self.settings.directions)[:, None].expand(-1, points.shape[1], -1)
        seen = self.view(torch.cat([self.feature(hidden), towards], dim=-1)).relu()
        log_radiance = self.log_radiance(seen).clamp(-LOG_EXPOSURE_LIMIT, LOG_EXPOSURE_LIMIT)
        return functional.softplus(self.density(hidden)[..., 0] - 1), log_radiance


def encoding(values: Tensor, octaves: int) -> Tensor:
    """[..., D] and the sines and cosines of 2^k of it, k from 0 to octaves - 1: [..., D (1 + 2 octaves)]."""
    angles = values[..., None] * 2.0 ** torch.arange(octaves, dtype=values.dtype, device=values.device)
    return torch.cat([values, angles.sin().flatten(-2), angles.cos().flatten(-2)], dim=-1)


def ray_weights(densities: Tensor, depths: Tensor) -> Tensor:
    """What each sample [R, S] gives to its ray: alpha times the transmittance before it (NeRF, equation 3). The last
    sample reaches to infinity."""
    steps = torch.cat([depths.diff(dim=1), torch.full_like(depths[:, :1], 1e10)], dim=1)
    passed = torch.exp(-densities * steps)
    before = torch.cat([torch.ones_like(passed[:, :1]), passed[:, :-1].cumprod(dim=1)], dim=1)
    return (1 - passed) * before


def stratified_depths(near: float, far: float, rays: int, samples: int, generator: torch.Generator | None, device):
    """[R, S] ascending depths, one evenly drawn in each of S equal parts; the parts' middles without a generator."""
    if generator is None:
        place = torch.full((rays, samples), 0.5, device=device)
    else:
        place = torch.rand(rays, samples, generator=generator, device=device)
    return near + (far - near) * (torch.arange(samples, device=device) + place) / samples


def importance_depths(depths: Tensor, weights: Tensor, count: int, generator: torch.Generator | None) -> Tensor:
    """[R, count] depths drawn from the weights [R, S] of samples at depths [R, S], even between the samples' middles;
    without a generator at even steps of the distribution (NeRF, section 5.2)."""
    edges = 0.5 * (depths[:, 1:] + depths[:, :-1])
    inner = weights[:, 1:-1] + 1e-5
    cumulative = functional.pad((inner / inner.sum(dim=1, keepdim=True)).cumsum(dim=1), (1, 0))
    if generator is None:
        drawn = ((torch.arange(count, device=depths.device) + 0.5) / count).expand(len(depths), count)
    else:
        drawn = torch.rand(len(depths), count, generator=generator, device=depths.device)
    above = torch.searchsorted(cumulative, drawn.contiguous(), right=True).clamp(1, edges.shape[1] - 1)
    low, high = cumulative.gather(1, above - 1), cumulative.gather(1, above)
    part = ((drawn - low) / (high - low).clamp_min(1e-8)).clamp(0, 1)
    start, end = edges.gather(1, above - 1), edges.gather(1, above)
    return start + part * (end - start)


@dataclass(frozen=True)
class Bounds:
    """Where a scene is: near and far depths along the rays (world units), and the shift and scale into [-1, 1]."""

    near: float
    far: float
    centre: tuple[float, float, float]
    radius: float

    @staticmethod
    def of(scene: Scene) -> "Bounds":
        views = scene.train_views
        positions = np.stack([view.camera.position for view in views])
        distance = focus_distance(views)
        near, far = (factor * distance for factor in DEPTH_RANGE)
        if len(scene.points):
            ranges = np.linalg.norm(scene.points[None] - positions[:, None], axis=2)
            near, far = 0.7 * float(np.quantile(ranges, 0.005)), 1.3 * float(np.quantile(ranges, 0.995))
        centre = positions.mean(0)
        spread = float(np.linalg.norm(positions - centre, axis=1).max())
        return Bounds(near, far, tuple(centre.tolist()), spread + far)


class HdrNerfRun:
    """A trained HDR-NeRF, with what an evaluation asks of a run.

    history: a line for each test of the held-out views: iteration, seconds (of training alone), psnr_ldr, psnr_mu.
    """

    gaussian_count = 0

    def __init__(self, fields: nn.ModuleList, bounds: Bounds, base_time: float, device: torch.device):
        self.fields, self.bounds, self.device = fields, bounds, device
        self.exposure_time = base_time
        self.iterations, self.train_seconds = 0, 0.0
        self.history: list[dict] = []

    @property
    def response(self) -> ToneMapper:
        """What the fine field learned in place of the camera's curve."""
        return self.fields[-1].tone_mapper

    def metrics(self) -> list[dict]:
        return self.history

    @torch.no_grad()
    def render(self, camera: Camera) -> RenderedView:
        """HDR radiance [H, W, 3], alpha [H, W] and depth [H, W] from a camera; samples in the middle of their parts."""
        hdr, _, alpha, depth = self._image(camera, self.exposure_time)
        return RenderedView(hdr, alpha, depth)

    @torch.no_grad()
    def render_ldr(self, camera: Camera, exposure_time: float | None = None) -> Tensor:
        """[H, W, 3] in [0, 1]: the simulated photo of exposure_time seconds, by default the training's median."""
        return self._image(camera, exposure_time or self.exposure_time)[1]

    def _image(self, camera: Camera, exposure_time: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        origins, directions = (torch.tensor(rays, device=self.device) for rays in camera_rays(camera))
        log_time = torch.full((len(origins), 1), math.log(exposure_time), device=self.device)
        step, rows = self.fields[0].settings.rays_at_once, []
        with _tf32():
            for start in range(0, len(origins), step):
                part = slice(start, start + step)
                rows.append(self.trace(origins[part], directions[part], log_time[part], None)[-1])
        hdr, encoded, alpha, depth = (torch.cat(values) for values in zip(*rows, strict=True))
        size = camera.height, camera.width
        ahead = torch.tensor(camera.world_to_camera[2, :3], dtype=torch.float32, device=self.device)
        # Along the camera's axis, as for Gaussians, and only where there is something.
        depth = torch.where(alpha > 1e-3, depth * (directions @ ahead) / alpha.clamp_min(1e-3), 0.0)
        return hdr.reshape(*size, 3), encoded.reshape(*size, 3), alpha.reshape(size), depth.reshape(size)

    def trace(self, origins: Tensor, directions: Tensor, log_time: Tensor, generator: torch.Generator | None):
        """For the coarse and the fine field: radiance [R, 3], encoded values [R, 3], coverage [R], distance [R] times
        coverage, of rays [R, 3] with log exposure times [R, 1]."""
        settings, bounds = self.fields[0].settings, self.bounds
        centre = torch.tensor(bounds.centre, dtype=torch.float32, device=self.device)
        depths = stratified_depths(bounds.near, bounds.far, len(origins), settings.samples, generator, self.device)
        seen = []
        for field in self.fields:
            points = (origins[:, None] + directions[:, None] * depths[..., None] - centre) / bounds.radius
            densities, log_radiance = field(points, directions)
            weights = ray_weights(densities, depths)
            values = log_radiance.exp(), field.tone_mapper.encode_log(log_radiance + log_time[:, None])
            images = [(weights[..., None] * value).sum(dim=1) for value in values]
            seen.append((*images, weights.sum(dim=1), (weights * depths).sum(dim=1)))
            if field is self.fields[0]:
                more = importance_depths(depths, weights.detach(), settings.more_samples, generator)
                depths = torch.cat([depths, more], dim=1).sort(dim=1).values
        return seen


def camera_rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions of the rays through the pixels' centres, row by row: [H W, 3] float32 each."""
    rows, columns = np.indices((camera.height, camera.width)).reshape(2, -1) + 0.5
    x, y = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    directions = np.stack([x, y, np.ones_like(x)], axis=1) @ camera.world_to_camera[:3, :3]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.broadcast_to(camera.position, directions.shape)
    return origins.astype(np.float32), directions.astype(np.float32)


def train_hdr_nerf(
    scene: Scene,
    *,
    iterations: int | None = None,
    seconds: float | None = None,
    device: str | torch.device = "cpu",
    seed: int = 0,
    settings: HdrNerfSettings | None = None,
    evaluate_at: Iterable[int] = (),
) -> HdrNerfRun:
    """Trains HDR-NeRF on the photos of the training views; their HDR truth is not looked at.

    iterations, seconds: when to stop, whichever comes first; at least one is needed (the paper takes 200 000
    iterations). evaluate_at: iterations that test the held-out views, besides the last; they cost no training seconds.

    Raises InputError for a scene that cannot be trained on, SehdrError if the training diverges.
    """
    if iterations is None and seconds is None:
        raise ValueError("say when to stop: iterations or seconds")
    check_scene(scene)
    settings, device = settings or HdrNerfSettings(), torch.device(device)
    # The fields' start is drawn from torch's own generator, whose state is put back.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        fields = nn.ModuleList([HdrNerf(settings, seed), HdrNerf(settings, seed + 1)]).to(device)
    base_time = float(np.median([view.exposure_time for view in scene.train_views]))
    run = HdrNerfRun(fields, Bounds.of(scene), base_time, device)
    rays = _training_rays(scene, device)
    generator = torch.Generator(device=device).manual_seed(seed)
    optimizer = torch.optim.Adam(fields.parameters(), lr=settings.rate)
    evaluate_at = set(evaluate_at)
    while not _finished(run, iterations, seconds):
        started = time.perf_counter()
        with _tf32():
            loss = _step(run, rays, optimizer, generator)
        if run.iterations % 100 == 0 and not math.isfinite(float(loss)):
            raise SehdrError(f"HDR-NeRF diverged by iteration {run.iterations}; lower its rate or check the cameras")
        if seconds is not None or run.iterations in evaluate_at or run.iterations == iterations:
            _wait(device)
        run.train_seconds += time.perf_counter() - started
        if run.iterations in evaluate_at:
            _evaluate(run, scene)
    if not run.history or run.history[-1]["iteration"] != run.iterations:
        _evaluate(run, scene)
    return run


def _step(run: HdrNerfRun, rays: tuple[Tensor, ...], optimizer: torch.optim.Adam, generator) -> Tensor:
    """One step on rays drawn from all photos: squared error of both fields, and the unit exposure loss of both."""
    settings = run.fields[0].settings
    run.iterations += 1
    for group in optimizer.param_groups:
        group["lr"] = settings.rate * 0.1 ** (run.iterations / settings.decay_steps)
    chosen = torch.randint(len(rays[0]), (settings.rays,), generator=generator, device=run.device)
    origins, directions, log_time, photo = (values[chosen] for values in rays)
    loss = photo.new_zeros(())
    for field, (_, encoded, _, _) in zip(run.fields, run.trace(origins, directions, log_time, generator), strict=True):
        unit = (field.tone_mapper.encode_log(photo.new_zeros(1, 3)) - settings.unit_value).square().mean()
        loss = loss + (encoded - photo).square().mean() + settings.unit_weight * unit
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    optimizer.step()
    return loss.detach()


def _training_rays(scene: Scene, device: torch.device) -> tuple[Tensor, ...]:
    """Origins [P, 3], directions [P, 3], log exposure times [P, 1], encoded values [P, 3] of all pixels that count."""
    parts = []
    for view in scene.train_views:
        counts = slice(None) if view.mask is None else view.mask.ravel() > 0.5
        origins, directions = (rays[counts] for rays in camera_rays(view.camera))
        times = np.full((len(origins), 1), math.log(view.exposure_time), dtype=np.float32)
        parts.append((origins, directions, times, view.image.reshape(-1, 3)[counts]))
    if not sum(len(part[0]) for part in parts):
        raise InputError(scene.name, "the masks leave no pixel of the training views", "correct the masks")
    return tuple(torch.tensor(np.concatenate(arrays), device=device) for arrays in zip(*parts, strict=True))


def _finished(run: HdrNerfRun, iterations: int | None, seconds: float | None) -> bool:
    return (iterations is not None and run.iterations >= iterations) or (
        seconds is not None and run.train_seconds >= seconds
    )


@torch.no_grad()
def _evaluate(run: HdrNerfRun, scene: Scene) -> None:
    """Adds a line to the history: means over the held-out views, as the trainings of Gaussians report them."""
    scores: dict[str, list[float]] = {}
    for view in scene.test_views:
        hdr, encoded, _, _ = run._image(view.camera, view.exposure_time)
        mask = None if view.mask is None else torch.tensor(view.mask, device=run.device)
        photo = torch.tensor(view.image, device=run.device)
        scores.setdefault("psnr_ldr", []).append(min(psnr(encoded, photo, mask), BEST))
        if view.hdr is not None:
            images = tone_map("gt-max", hdr, torch.tensor(view.hdr, device=run.device), mask)
            scores.setdefault("psnr_mu", []).append(min(psnr(*images, mask), BEST))
    line = {"iteration": run.iterations, "seconds": round(run.train_seconds, 3), "split": "test"}
    line |= {name: round(sum(values) / len(values), 4) for name, values in scores.items()} | {"gaussians": 0}
    run.history.append(line)


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


@contextmanager
def _tf32() -> Iterator[None]:
    """Within the block products of float32 matrices on a GPU round their factors to TF32, in the whole process."""
    matmul = torch.backends.cuda.matmul
    name, value = ("fp32_precision", "tf32") if hasattr(matmul, "fp32_precision") else ("allow_tf32", True)
    before = getattr(matmul, name)
    setattr(matmul, name, value)
    try:
        yield
    finally:
        setattr(matmul, name, before)
