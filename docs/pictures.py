"""Makes the README's pictures of a report's, small: `python docs/pictures.py runs/demo/report`."""

import sys
from pathlib import Path

from PIL import Image

WIDTHS = {"comparison": 1100, "stops": 1200}


def main(report: Path, images: Path) -> None:
    images.mkdir(exist_ok=True)
    for name, width in WIDTHS.items():
        with Image.open(report / f"{name}.png") as picture:
            picture = picture.convert("RGB")
            picture.thumbnail((width, 10 * width))
            picture.save(images / f"{name}.jpg", quality=82, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(__file__).parent / "images")
