"""Stable sorts of (key, value) pairs by Warp's radix sort, safe within recordings.

Warp keeps the scratch of its sorts for each stream and lets it grow. Grown inside a recording, it would belong to that
recording's graph and still be used after the graph's end: so room is made before, by reserve().
"""

import torch
import warp as wp

from .bridge import torch_stream

_reserved: dict[tuple[int, int], int] = {}
"""By device and stream: pairs that there is room for."""


def sort_pairs(keys: torch.Tensor, values: torch.Tensor, count: int, bits: int | None = None) -> None:
    """Sorts keys[:count] and values[:count] by the keys' lowest bits (stable, all bits by default), in place.

    keys: int32 or float32, values: int32, each with room for 2 count. Raises RuntimeError within a recording that has
    no room for as many pairs.
    """
    if not count:
        return
    if keys.device.type == "cuda" and torch.cuda.is_current_stream_capturing():
        room = _reserved.get(_stream_key(keys.device), 0)
        if count > room:
            raise RuntimeError(
                f"a recording that sorts {count} pairs has room for {room}: record it with sorts={count}"
            )
    with torch_stream(keys.device):
        wp.utils.radix_sort_pairs(wp.from_torch(keys), wp.from_torch(values), count, end_bit=bits)


def sorted_places(keys: torch.Tensor, count: int, bits: int | None = None) -> torch.Tensor:
    """[count] int32 permutation that sorts keys[:count] (stable). keys has room for 2 count and is sorted in place."""
    places = torch.empty(2 * count, dtype=torch.int32, device=keys.device)
    torch.arange(count, dtype=torch.int32, device=keys.device, out=places[:count])
    sort_pairs(keys, places, count, bits)
    return places[:count]


def reserve(device: torch.device, count: int) -> None:
    """Makes room on the current stream of a CUDA device for recorded sorts of up to `count` pairs."""
    key = _stream_key(device)
    if count > _reserved.get(key, 0):
        room = count + count // 4
        keys, values = (torch.zeros(2 * room, dtype=torch.int32, device=device) for _ in range(2))
        sort_pairs(keys, values, room)
        _reserved[key] = room


def _stream_key(device: torch.device) -> tuple[int, int]:
    stream = torch.cuda.current_stream(device)
    return stream.device_index, stream.cuda_stream
