"""Fixed-length history of tensors, newest first, as pure functions.

No indexing by masks and no branches on data: the functions run inside a CUDA graph. Filled with the
first value on reset, so that a history never mixes two episodes and never holds zeros that were no
measurement."""

import torch
from torch import Tensor


def push(history: Tensor, new: Tensor, reset_mask: Tensor) -> Tensor:
    """Return the history with a value put in front and the oldest dropped.

    Args:
        history: Shape (E, H, ...), newest first.
        new: The newest value, shape (E, ...).
        reset_mask: Environments whose history is filled with the new value, bool, shape (E,).

    Returns:
        A new tensor, shape (E, H, ...).
    """
    front = new.unsqueeze(1)
    mask = reset_mask.reshape(-1, *(1,) * (history.dim() - 1))
    return torch.where(mask, front, torch.cat([front, history[:, :-1]], 1))


def at_latency(history: Tensor, latency: Tensor) -> Tensor:
    """Value that is ``latency`` steps old, linear between the two stored neighbours.

    Written as hat-function weights over the whole (short) history: no gather, latencies may differ
    by environment. A latency beyond the history reads its oldest value.

    Args:
        history: Floating point, shape (E, H, ...), newest first.
        latency: Age [steps], shape (E,) or scalar tensor.

    Returns:
        Shape (E, ...).
    """
    weights = latency_weights(history.shape[1], latency, history)
    weights = weights.reshape(*weights.shape, *(1,) * (history.dim() - 2))
    value = history[:, 0] * weights[:, 0]
    for age in range(1, history.shape[1]):
        value = value + history[:, age] * weights[:, age]
    return value


def latency_weights(length: int, latency: Tensor, like: Tensor) -> Tensor:
    """Weight of each stored age: shape (E, H), rows sum to 1; (1, H) for a scalar latency."""
    ages = torch.arange(length, device=like.device, dtype=like.dtype)
    age = latency.to(like.dtype).reshape(-1, 1).clamp(0.0, length - 1.0)
    return (1.0 - (ages - age).abs()).clamp(min=0.0)
