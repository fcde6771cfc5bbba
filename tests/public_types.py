"""Types of every public name: pyright and mypy read this file strictly, and nothing runs it."""

from pathlib import Path
from typing import Any, assert_type

import numpy as np
import torch

import sehdr_warp as sw
from sehdr_warp.compat import gsplat
from sehdr_warp.rasterizer import CudaGraphRunner, HarmonicsGradients, Program, ssim_map
from sehdr_warp.scene import look_at
from sehdr_warp.synth.expose import expose, exposure_ladder

# Scenes and responses.
scene = sw.load_scene("photos", max_size=800)
assert_type(scene, sw.Scene)
assert_type(scene.views[0], sw.View)
camera = scene.views[0].camera
assert_type(camera, sw.Camera)
assert_type(camera.resized(1920, 1080), sw.Camera)
assert_type(sw.embedded_scenes(), tuple[str, ...])
assert_type(sw.load_cameras("cameras.json"), list[tuple[str, sw.Camera]])
response = sw.response_by_name("srgb")
assert_type(look_at((0.0, 0.0, 4.0), up=np.array([0.0, 1.0, 0.0])), np.ndarray)
assert_type(exposure_ladder(scene, response), tuple[float, ...])
assert_type(expose(scene, response, 0.5, glare=1.0), sw.Scene)
assert_type(response, sw.Response)
assert_type(response.encode(torch.zeros(3)), torch.Tensor)
assert_type(response.encode(0.5), np.ndarray)
assert_type(response.decode([0.1, 0.5]), np.ndarray)
assert_type(response.decode(torch.zeros(3)), torch.Tensor)
assert_type(response.to_dict(), dict[str, Any])
assert_type(sw.response_names(), dict[str, str])
assert_type(sw.calibrate("stack", times=[0.1, 0.2]), sw.Response)

# Trainings.
config = sw.load_config("default", {"loss.ssim_weight": 0.3})
assert_type(config, sw.Config)
assert_type(config.loss.ssim_weight, float)
assert_type(sw.preset_names(), list[str])
plan = sw.make_plan(scene, config)
assert_type(plan, sw.Plan)
assert_type(plan.config, sw.Config)
trainer = sw.create_trainer(scene, "run", config)
assert_type(trainer, sw.Trainer)
for progress in trainer:
    assert_type(progress, sw.TrainingProgress)
    assert_type(progress.psnr, float)
    assert_type(progress.gaussians, int)
run = sw.train(scene, "run", config)
assert_type(run, sw.Run)
assert_type(trainer.run, sw.Run)
points, colors = sw.match_points(scene, 1000)
assert_type(points, np.ndarray)

# What is trained.
assert_type(sw.load_run("run"), sw.Run)
splats = sw.load_splats("scene.ply")
assert_type(splats, sw.Splats)
assert_type(sw.merge_scenes(run, splats), sw.MergedScene)
assert_type(run.render(camera).hdr, torch.Tensor)
assert_type(run.metrics(), list[dict[str, Any]])
assert_type(run.decisions(), list[dict[str, Any]])
assert_type(run.summary(), dict[str, Any])
assert_type(run.render_ldr(camera, 0.01), torch.Tensor)
assert_type(run.render_confidence(camera), torch.Tensor | None)
assert_type(sw.render_views(run, "views", evs=(-2, 0, 2)), list[Path])
assert_type(sw.write_environment_map(splats, "light.exr", inpaint=True), Path)
assert_type(sw.export(run, "scene.ply", edits=sw.SplatEdits(crop="sphere:0,0,0,1", min_views=2)), Path)
assert_type(sw.write_scene_page(run, "scene.html"), Path)
assert_type(sw.write_lights(run, "lights.usda"), list[Path])
assert_type(sw.meter(run, "r_1", (12, 10), luminance=100.0).luminance, float)
assert_type(sw.write_orientation(run, up=(0, 0, 1), scale=0.4), Path)
cameras = [each for _, each in sw.select_cameras(run, "orbit", count=24)]
assert_type(sw.write_film(run, "orbit.mp4", cameras, transfer="hlg"), Path)
assert_type(sw.write_report(run, scene, "report"), list[Path])
assert_type(sw.write_proxy_mesh(run, "room.obj", resolution=80), Path)
assert_type(sw.write_brackets("out", {"a": np.zeros((2, 2, 3))}, 0.01, cameras={"a": camera}), list[Path])
assert_type(sw.evaluate(run, scene), dict[str, Any])
assert_type(sw.evaluate_folder("pictures", scene), dict[str, Any])
compared = sw.compare_runs([run, run])
assert_type(len(compared), int)

try:
    sw.load_config("no such preset")
except sw.InputError as error:
    problem: sw.SehdrError = error

# The rasterizer.
image = torch.zeros(3, 4)
rendering = sw.rasterize(image, image, image, image[0], image, image, image[0], 64, 48, depth=True)
assert_type(rendering, sw.Rendering)
assert_type(rendering.image, torch.Tensor)
assert_type(rendering.depth, torch.Tensor | None)
assert_type(rendering.intersection_count, int)
around = sw.rasterize_directions(image, image, image, image[0], image, image[0], image, focal_length=60.0)
assert_type(around, tuple[torch.Tensor, torch.Tensor])
assert_type(sw.ssim(image, image), torch.Tensor)
assert_type(ssim_map(image, image), torch.Tensor)
assert_type(sw.spherical_harmonics(0, image, image, image[0]), torch.Tensor)
assert_type(HarmonicsGradients(image, image, image, 0).basis, torch.Tensor)
runner = CudaGraphRunner("cuda:0")
assert_type(runner.run("key", lambda: image), torch.Tensor)


@sw.differentiable
def attenuate(program: Program, radiance: torch.Tensor, *, density: float) -> torch.Tensor:
    return program.empty_output(radiance.shape)


@sw.differentiable
def split(program: Program, radiance: torch.Tensor) -> tuple[torch.Tensor, ...]:
    return program.empty_output(radiance.shape), program.empty_output(radiance.shape)


assert_type(attenuate(image, density=0.5), torch.Tensor)
assert_type(split(image), tuple[torch.Tensor, ...])

# gsplat's names.
result = gsplat.rasterization(image, image, image, image[0], image, image, image, 64, 48, absgrad=True)
assert_type(result, tuple[torch.Tensor, torch.Tensor, dict[str, Any]])
strategy = gsplat.DefaultStrategy(absgrad=True)
assert_type(strategy.initialize_state(scene_scale=1.0), dict[str, Any])
strategies: list[gsplat.Strategy] = [strategy, gsplat.MCMCStrategy(cap_max=1000)]
parameters = {"means": torch.nn.Parameter(image)}
optimizers = {name: torch.optim.Adam([value]) for name, value in parameters.items()}
strategy.check_sanity(parameters, optimizers)
state = strategy.initialize_state(scene_scale=1.0)
assert_type(state, dict[str, Any])
strategy.step_pre_backward(torch.nn.ParameterDict(parameters), optimizers, state, 0, result[2])
strategy.step_post_backward(parameters, optimizers, state, 0, result[2], packed=True)
gsplat.MCMCStrategy().step_post_backward(parameters, optimizers, {}, 0, result[2], lr=1e-4)
gsplat.SelectiveAdam([image], eps=1e-15, betas=(0.9, 0.999)).step(image[0])
assert_type(gsplat.spherical_harmonics(0, image, image), torch.Tensor)
assert_type(gsplat.compute_relocation(image[0], image, image[0]), tuple[torch.Tensor, torch.Tensor])
assert_type(gsplat.isect_offset_encode(image[0], 1, 4, 3), torch.Tensor)
assert_type(gsplat.isect_tiles(image, image, image[0], 16, 4, 3), tuple[torch.Tensor, torch.Tensor, torch.Tensor])
assert_type(
    gsplat.rasterize_to_indices_in_range(0, 9, image, image, image, image, 64, 48, 16, image, image),
    tuple[torch.Tensor, torch.Tensor, torch.Tensor],
)
assert_type(
    gsplat.rasterize_to_pixels(image, image, image, image, 64, 48, 16, image, image), tuple[torch.Tensor, torch.Tensor]
)
assert_type(gsplat.quat_scale_to_covar_preci(image, image), tuple[torch.Tensor | None, torch.Tensor | None])
assert_type(
    gsplat.fully_fused_projection(image, None, image, image, image, image, 64, 48), tuple[torch.Tensor | None, ...]
)
