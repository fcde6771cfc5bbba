"""The stages of a splat one by one: project, order, lists, blend. What depends on how rasterize() is built inside
stands here."""

from dataclasses import dataclass

import torch

from ..kernels.constants import ALPHA_THRESHOLD, LOW_PASS, NEAR
from ..splatting.blending import blend
from ..splatting.projection import project
from ..splatting.tile_lists import TileLists, build_tile_lists, depth_order, pack_records
from .splats import Size, SplatScene
from .timing import Variant

STAGES = ("project", "project backward", "order", "order and lists", "blend forward", "blend backward")


@dataclass(frozen=True)
class Prepared:
    """What one stage hands to the next: projected geometry (leaves of its own), tile lists and the blend's inputs."""

    projected: tuple[torch.Tensor, ...]
    lists: TileLists
    blend_inputs: tuple[torch.Tensor, ...]
    options: dict


def project_scene(scene: SplatScene) -> tuple[torch.Tensor, ...]:
    """means2d, conics, depths, opacities and extents, as rasterize() has them."""
    size, (*geometry, _) = scene.size, scene.leaves
    return project(
        *geometry,
        scene.world_to_camera,
        scene.intrinsics,
        width=size.width,
        height=size.height,
        near=NEAR,
        low_pass=LOW_PASS,
        alpha_threshold=ALPHA_THRESHOLD,
        antialiased=False,
    )


def list_tiles(projected: tuple[torch.Tensor, ...], size: Size) -> tuple[tuple[torch.Tensor, ...], TileLists]:
    """pack_records()'s records and the tile lists."""
    means2d, conics, depths, opacities, extents = projected
    records = pack_records(means2d, conics, opacities, extents, ALPHA_THRESHOLD)
    return records, build_tile_lists(records, depths, extents, size.width, size.height)


def prepare(scene: SplatScene) -> Prepared:
    """Project and list once, so that each stage can be run alone."""
    size = scene.size
    with torch.no_grad():
        projected = project_scene(scene)
        records, lists = list_tiles(projected, size)
    means2d, conics, _, opacities, extents = projected
    inputs = tuple(
        tensor.detach().clone().requires_grad_() for tensor in (means2d, conics, opacities, scene.leaves[-1])
    )
    options = {
        "lists": lists,
        "records": records,
        "extents": extents,
        "width": size.width,
        "height": size.height,
        "alpha_threshold": ALPHA_THRESHOLD,
    }
    return Prepared(projected, lists, inputs, options)


def stage_variants(scene: SplatScene, prepared: Prepared) -> dict[str, Variant]:
    """One variant for each of STAGES. Each is called as rasterize() calls it, host time included."""
    cotangent = scene.cotangent()
    means2d, conics, depths, opacities, extents = prepared.projected
    generator = torch.Generator().manual_seed(2)
    sent_back = [torch.rand(t.shape, generator=generator).to(t) for t in (means2d, conics, depths, opacities)]

    def projected(_):
        with torch.no_grad():
            project_scene(scene)

    def project_forward():
        scene.clear()
        return project_scene(scene)[:4]

    def blended(_):
        with torch.no_grad():
            blend(*prepared.blend_inputs, **prepared.options)

    def blend_forward():
        for tensor in prepared.blend_inputs:
            tensor.grad = None
        return blend(*prepared.blend_inputs, **prepared.options)[0]

    return {
        "project": Variant(projected),
        "project backward": Variant(lambda outputs: torch.autograd.backward(outputs, sent_back), project_forward),
        "order": Variant(lambda _: depth_order(depths, extents)),
        "order and lists": Variant(lambda _: list_tiles(prepared.projected, scene.size)),
        "blend forward": Variant(blended),
        "blend backward": Variant(lambda image: image.backward(cotangent), blend_forward),
    }
