"""Functions that accept both tensors and NumPy arrays, so that a batch in training and a single row
on board use the same code.

A history is newest first. Its functions neither index by masks nor branch on data, so that they run
inside a CUDA graph. On reset the history is filled with the first value: it never mixes two
episodes and never holds zeros that were not measured.

For one row, NumPy takes a fraction of torch's time. Both give the same bits: sums, products,
quotients and roots round identically, and trigonometric functions are torch's in both."""

from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

Array = Any
"""A tensor or an array. A function returns the type of its arguments."""


def wrap_for_arrays(function: Callable[..., Tensor]) -> Callable[..., np.ndarray]:
    """Wrap a function of tensors for arrays."""
    return lambda *arrays: function(*map(torch.from_numpy, arrays)).numpy()


class ArrayFunctions:
    """NumPy functions under torch's names."""

    asarray = np.asarray
    broadcast_to = np.broadcast_to
    concatenate = np.concatenate
    eye = np.eye
    finfo = np.finfo
    full_like = np.full_like
    maximum = np.maximum
    minimum = np.minimum
    ones_like = np.ones_like
    stack = np.stack
    where = np.where
    zeros_like = np.zeros_like
    atan = wrap_for_arrays(torch.atan)
    cos = wrap_for_arrays(torch.cos)
    sin = wrap_for_arrays(torch.sin)
    sqrt = np.sqrt
    linalg = SimpleNamespace(cross=wrap_for_arrays(torch.linalg.cross))


def library(array: Tensor | np.ndarray) -> Any:
    """Return the library of a tensor's or array's functions: torch or `ArrayFunctions`."""
    return torch if isinstance(array, Tensor) else ArrayFunctions


def push(history: Array, new: Array, reset_mask: Array) -> Array:
    """Return the history with a new value prepended and the oldest dropped.

    Args:
        history: Shape (E, H, ...), newest first.
        new: The newest value, shape (E, ...).
        reset_mask: Environments whose history is filled with the new value, bool, shape (E,).

    Returns:
        The new history, shape (E, H, ...).
    """
    xp = library(history)
    front = new[:, None]
    mask = reset_mask.reshape(-1, *(1,) * (history.ndim - 1))
    return xp.where(mask, front, xp.concatenate([front, history[:, :-1]], 1))


def interpolate_at_latency(history: Tensor, latency: Tensor) -> Tensor:
    """Return the value that is ``latency`` steps old, interpolated between its two neighbours.

    The sum over the whole (short) history is weighted by hat functions: it needs no gather, and
    latencies may differ by environment. A latency beyond the history gives its oldest value.

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
    """Return the weight of each stored age, shape (E, H), or (1, H) for a scalar latency. Rows sum
    to 1.
    """
    ages = torch.arange(length, device=like.device, dtype=like.dtype)
    age = latency.to(like.dtype).reshape(-1, 1).clamp(0.0, length - 1.0)
    return (1.0 - (ages - age).abs()).clamp(min=0.0)


def redraw(buffers: Mapping[str, Tensor], spreads: Mapping[str, float], fresh: Tensor) -> None:
    """Redraw buffers, shape (E, ...), in environments whose episode begins.

    ``spreads``: standard deviation of each buffer's normal noise; 0 leaves the buffer unchanged.
    ``fresh``: environments, bool, shape (E,)."""
    for name, std in spreads.items():
        if std > 0.0:
            old = buffers[name]
            trailing = (1,) * (old.dim() - 1)
            mask = fresh.view(-1, *trailing)
            torch.where(mask, torch.randn_like(old) * std, old, out=old)
