"""What type checkers see of the public names: pyright reads this file strictly, and nothing runs it."""

from typing import Any, assert_type

import torch

import sehdr_warp as sw
from sehdr_warp.compat.gsplat import DefaultStrategy, rasterization
from sehdr_warp.rasterizer import Program

scene = sw.load_scene("photos", max_size=800)
assert_type(scene, sw.Scene)
assert_type(scene.views[0], sw.View)
assert_type(scene.views[0].camera, sw.Camera)

config = sw.load_config("default")
assert_type(config, sw.Config)
assert_type(config.loss.ssim_weight, float)

training = sw.create_trainer(scene, "run", config)
for step in training:
    assert_type(step, sw.Step)
    assert_type(step.psnr, float)
run = sw.train(scene, "run", config)
assert_type(run, sw.Run)
assert_type(sw.load_run("run"), sw.Run)
assert_type(run.render(scene.views[0].camera).hdr, torch.Tensor)

image = torch.zeros(3, 4)
rendering = sw.rasterize(image, image, image, image[0], image, image, image[0], 64, 48)
assert_type(rendering, sw.Rendering)
assert_type(rendering.image, torch.Tensor)
assert_type(sw.ssim(image, image), torch.Tensor)
assert_type(sw.spherical_harmonics(0, image, image, image[0]), torch.Tensor)
assert_type(sw.response_by_name("srgb"), sw.Response)
assert_type(sw.response_names(), dict[str, str])


@sw.differentiable
def attenuate(program: Program, radiance: torch.Tensor, *, density: float) -> torch.Tensor:
    return program.write(radiance.shape)


assert_type(attenuate(image, density=0.5), torch.Tensor)
colors, alphas, meta = rasterization(image, image, image, image[0], image, image, image, 64, 48, absgrad=True)
assert_type(colors, torch.Tensor)
strategy = DefaultStrategy(absgrad=True)
assert_type(strategy.initialize_state(scene_scale=1.0), dict[str, Any])
