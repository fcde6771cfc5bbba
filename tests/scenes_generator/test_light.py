"""Maps of the light at four places: those that come with the scenes, and what the generator refuses."""

import numpy as np
import pytest
from scipy.ndimage import uniform_filter

from benchmarks.irradiance import read_light_maps
from scenes.generator.__main__ import main
from scenes.generator.light import PLACES, render_light
from scenes.generator.recipes import RECIPES
from scenes.generator.render import load_mitsuba
from sehdr_warp.errors import InputError, SehdrError
from sehdr_warp.output.lighting.environment_map import latlong
from sehdr_warp.scene import embedded_folder, embedded_scenes, load_scene

SCENES = [name for name in RECIPES if name in embedded_scenes()]


@pytest.mark.parametrize("name", SCENES)
def test_the_first_map_shows_what_the_nearest_view_does(name):
    """Units and directions agree; views are filtered by a denoiser, and some cameras stand aside of the place."""
    maps = read_light_maps(embedded_folder(f"embedded:{name}"))
    assert len(maps) == len(PLACES) and all(0.02 < each.coverage.mean() < 0.98 for each in maps)
    first = maps[0]
    views = load_scene(f"embedded:{name}", response="srgb").views
    view = min(views, key=lambda view: np.linalg.norm(view.camera.position - first.position))
    camera, height = view.camera, first.coverage.shape[0]
    x, y, z = np.moveaxis(latlong(2 * height) @ camera.world_to_camera[:3, :3].T, 2, 0)
    column, row = (camera.fx * x / z + camera.cx).astype(int), (camera.fy * y / z + camera.cy).astype(int)
    edge = 8
    inside = (z > 0) & (first.coverage == 1) & (column >= edge) & (row >= edge)
    inside &= (column < camera.width - edge) & (row < camera.height - edge)
    blurred = uniform_filter(view.hdr.mean(2), 6)
    photo_light, mapped = (
        np.log(blurred[row[inside], column[inside]] + 1e-4),
        np.log(first.radiance.mean(2)[inside] + 1e-4),
    )
    assert inside.sum() > 300
    assert np.corrcoef(photo_light, mapped)[0, 1] > 0.6
    assert abs(np.median(photo_light - mapped)) < 0.15


def test_refusals(tmp_path, truth):
    mi = pytest.importorskip("mitsuba") and load_mitsuba("scalar_rgb")
    with pytest.raises(SehdrError, match="need cuda_ad_rgb or llvm_ad_rgb"):
        render_light(mi, RECIPES["night"], truth[0], 4)
    with pytest.raises(SystemExit, match="take one of study"):
        main(["light", "castle", "--folder", str(tmp_path)])


def test_a_set_of_another_recipe_is_refused(truth):
    class Traces:
        """The part of Mitsuba that is used before the set is known."""

        variant = staticmethod(lambda: "llvm_ad_rgb")

    with pytest.raises(InputError, match="is a set of 'flat', not of night"):
        render_light(Traces, RECIPES["night"], truth[0], 4)
