"""Between the host and a GPU, by way of locked pages that torch keeps: fresh ones cost as much time as the copy."""

from collections.abc import Sequence

import numpy as np
import torch

from visthrow.diagnose.threads import each


def to_host(tensor: torch.Tensor) -> np.ndarray:
    """A tensor's values."""
    if not tensor.is_cuda:
        return tensor.numpy()
    return torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True).copy_(tensor).numpy()


def side_by_side(parts: Sequence[Sequence[np.ndarray]], shape: tuple[int, ...], device: str) -> torch.Tensor:
    """Arrays one beside the other on a device, each padded with zeros to one shape.

    Args:
        parts: of each array, what stands side by side along its last axis.
        shape: to pad to.
        device: where to.

    Returns:
        Shape (arrays, *shape).
    """
    out = torch.empty((len(parts), *shape), dtype=torch.float64, pin_memory=device.startswith("cuda"))
    rows = out.numpy()

    def lay(i: int) -> None:
        rows[i] = 0.0
        at = 0
        for values in parts[i]:
            *heights, width = values.shape
            rows[i][(*map(slice, heights), slice(at, at + width))] = values
            at += width

    if device == "cpu":  # on whose cores batches are laid side by side already
        for i in range(len(parts)):
            lay(i)
    else:
        each(lay, range(len(parts)))
    return out.to(device)
