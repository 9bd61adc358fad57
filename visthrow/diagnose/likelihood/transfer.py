"""Between the host and a GPU, by way of locked pages that torch keeps: fresh ones cost as much time
as the copy.
"""

from collections.abc import Sequence

import numpy as np
import torch

from visthrow.diagnose.likelihood.threads import parallel_map

SMALL_ARRAY = 1_000_000  # numbers up to which one thread lays them


def to_host(tensor: torch.Tensor) -> np.ndarray:
    """A tensor's values."""
    if not tensor.is_cuda:
        return tensor.numpy()
    return torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True).copy_(tensor).numpy()


def all_to_host(tensors: Sequence[torch.Tensor]) -> list[np.ndarray]:
    """Values of several tensors of one kind, from a GPU in one piece: each wait for one gives
    Python away to other threads.
    """
    if not tensors or not tensors[0].is_cuda:
        return [tensor.numpy() for tensor in tensors]
    parts = np.split(
        to_host(torch.cat([tensor.flatten() for tensor in tensors])),
        np.cumsum([t.numel() for t in tensors])[:-1],
    )
    return [part.reshape(tensor.shape) for part, tensor in zip(parts, tensors)]


def side_by_side(
    parts: Sequence[Sequence[np.ndarray]], shape: tuple[int, ...], device: str
) -> torch.Tensor:
    """Arrays one beside the other on a device, each padded with zeros to one shape.

    ``parts``: of each array, what stands side by side along its last axis, of one height unless it
    is empty; ``shape``: to pad to. Returns shape (arrays, *shape)."""
    out = torch.empty(
        (len(parts), *shape), dtype=torch.float64, pin_memory=device.startswith("cuda")
    )
    rows = out.numpy()

    def lay(i: int) -> None:
        row = rows[i]
        offset = 0
        heights = (0,) * (len(shape) - 1)
        for values in parts[i]:
            if values.size:
                *heights, width = values.shape
                row[(*map(slice, heights), slice(offset, offset + width))] = values
                offset += width
        row[..., offset:] = 0.0
        for axis, height in enumerate(heights):
            row[(slice(None),) * axis + (slice(height, None),)] = 0.0

    if (
        device == "cpu" or out.numel() < SMALL_ARRAY
    ):  # batches are laid on all cores already, or it is not worth while
        for i in range(len(parts)):
            lay(i)
    else:
        parallel_map(lay, range(len(parts)))
    return out.to(device)
