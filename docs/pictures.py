"""Makes the README's picture: trains a scene through a camera that clips, then shows what the photo lost.

python docs/pictures.py [SCENE] [RUN]       minutes on two cores; a RUN that exists is not trained again
"""

import io
import sys
from pathlib import Path

from PIL import Image, ImageChops

import sehdr_warp as sw
from sehdr_warp.output.report import compare, comparison_figure
from sehdr_warp.synth.expose import expose, exposure_ladder

PICTURE = Path(__file__).parent / "images" / "hero.jpg"
WIDTH = 1500


def main(name: str = "embedded:lamps", folder: str = "runs/hero", view: str = "") -> None:
    """Writes docs/images/hero.jpg of one held-out view of an embedded scene."""
    truth, camera = sw.load_scene(name), sw.response_by_name("camera")
    scene = expose(truth, camera, exposure_ladder(truth, camera)[2])
    run = sw.load_run(folder) if Path(folder).exists() else sw.train(scene, folder, {"response.name": "camera"})
    shown = next(each for each in scene.test_views if each.name == (view or each.name))
    figure = comparison_figure([compare(run, shown, scene.views)], shown.exposure_time, "")
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=160, facecolor="white", format="png")
    with Image.open(drawn) as picture:
        picture = picture.convert("RGB")
        content = ImageChops.difference(picture, Image.new("RGB", picture.size, "white")).getbbox()
        picture = picture.crop((0, max(0, content[1] - 8), picture.width, min(picture.height, content[3] + 8)))
        picture.thumbnail((WIDTH, WIDTH))
        picture.save(PICTURE, quality=88, optimize=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
