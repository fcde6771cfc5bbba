"""One tile size measured in a process of its own: `python -m sehdr_warp.bench.tile_choice 8 cpu 5k@200x200 30 3`.

TILE_SIZE is a constant that every kernel and every stage takes from kernels/constants.py when it is imported, so it is
set here before they are.
"""

import json
import sys


def main(edge: int, device: str, size: str, repetitions: int, budget: float) -> None:
    """Prints the rows of this tile size as one line of JSON."""
    from ..kernels import constants

    constants.TILE_SIZE = edge

    import torch

    from .choices import measure_tiles
    from .splats import parse_size

    place = torch.device(device)
    print(json.dumps(measure_tiles(edge, place, parse_size(size, place.type), repetitions, budget)))


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2], sys.argv[3], int(sys.argv[4]), float(sys.argv[5]))
