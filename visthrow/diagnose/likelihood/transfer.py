"""Between the host and a GPU, by way of locked pages that torch keeps: fresh ones cost as much time
as the copy.
"""

from collections.abc import Sequence

import numpy as np
import torch
from numpy import ndarray

from visthrow.diagnose.likelihood.threads import parallel_map


def to_host(tensor: torch.Tensor) -> ndarray:
    """A tensor's values."""
    if not tensor.is_cuda:
        return tensor.numpy()
    pinned = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True)
    return pinned.copy_(tensor).numpy()


def all_to_host(tensors: Sequence[torch.Tensor]) -> list[ndarray]:
    """Values of several tensors of one kind, from a GPU in one piece: each wait for one gives
    Python away to other threads.
    """
    if not tensors or not tensors[0].is_cuda:
        return [tensor.numpy() for tensor in tensors]
    values = to_host(torch.cat([tensor.flatten() for tensor in tensors]))
    ends = np.cumsum([tensor.numel() for tensor in tensors])
    parts = np.split(values, ends[:-1])
    return [part.reshape(tensor.shape) for part, tensor in zip(parts, tensors)]


def side_by_side(parts: Sequence[ndarray], shape: tuple[int, ...], device: str) -> torch.Tensor:
    """Arrays one beside the other on a device, each padded with zeros to one shape; shape (arrays,
    *shape).
    """
    pinned = device.startswith("cuda")
    out = torch.zeros((len(parts), *shape), dtype=torch.float64, pin_memory=pinned)

    def lay(row: ndarray, part: ndarray) -> None:
        row[tuple(map(slice, part.shape))] = part

    each = map if device == "cpu" else parallel_map  # a CPU's batches are laid on all cores already
    list(each(lay, out.numpy(), parts))
    return out.to(device)
