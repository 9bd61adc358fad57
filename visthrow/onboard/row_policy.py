"""A policy for one vehicle on NumPy arrays, with the same actions as in torch up to rounding.
Onboard-safe.

Most of the time goes into reading the weights. They are stored in the order in which the product
with a row reads them."""

from collections.abc import Callable

import numpy as np
import torch.nn.functional as F
from numpy import ndarray
from torch import Tensor

from camera.arrays import wrap_for_arrays
from visthrow.onboard.estimator import Estimator
from visthrow.onboard.policy import ACTIVATIONS, Policy

Layer = tuple[ndarray, ndarray]
"""Weight (in, out) and bias (out,)."""


def _layer(weight: Tensor, bias: Tensor) -> Layer:
    return np.ascontiguousarray(weight.numpy().T), bias.numpy()


def _apply(layer: Layer, row: ndarray) -> ndarray:
    weight, bias = layer
    return row @ weight + bias


def _elu(x: ndarray) -> ndarray:
    return np.maximum(x, 0.0) + (np.exp(np.minimum(x, 0.0)) - 1.0)


def _sigmoid(x: ndarray) -> ndarray:
    """Return the logistic function, computed without overflow."""
    return 0.5 + 0.5 * np.tanh(0.5 * x)


def _activation(name: str) -> Callable[[ndarray], ndarray]:
    """Return an activation by rsl_rl's name."""
    if name == "elu":
        return _elu
    return wrap_for_arrays(getattr(F, ACTIVATIONS[name]["torch"]))


class RowPolicy:
    """A `visthrow.onboard.policy.Policy` for a single row."""

    def __init__(self, policy: Policy):
        """Copy the weights of a policy that is on the CPU."""
        *hidden, self._last = map(_layer, policy.weights, policy.biases)
        self._hidden = hidden
        self._activation = _activation(policy.activation)
        self._normalizer: Layer | None = None
        if policy.mean is not None and policy.std is not None:
            self._normalizer = policy.mean.numpy(), policy.std.numpy() + policy.eps
        self._estimator = None
        if policy.estimator is not None:
            self._estimator = RowEstimator(policy.estimator)

    def step(self, obs: ndarray, memory: ndarray) -> tuple[ndarray, ndarray]:
        """Return action and new memory of `Policy.step`, all of shape (1, ...)."""
        x = obs
        if self._estimator is not None:
            x, memory = self._estimator.step(obs, memory)
        if self._normalizer is not None:
            mean, std = self._normalizer
            x = (x - mean) / std
        for layer in self._hidden:
            x = self._activation(_apply(layer, x))
        return _apply(self._last, x), memory


class RowEstimator:
    """A `visthrow.onboard.estimator.Estimator` for a single row."""

    def __init__(self, estimator: Estimator):
        """Copy the weights."""
        e = estimator
        self._mean = e.mean.numpy()
        self._std = e.std.numpy()
        first = _layer(e.encoder_weight, e.encoder_bias)
        self._encoder = [first, *(_layer(weight, bias) for weight, bias in e.inner)]
        self._input = _layer(e.input_weight, e.input_bias)
        self._recurrent = _layer(e.memory_weight, e.memory_bias)
        self._output = _layer(e.output_weight, e.output_bias)
        self._kept = e.kept.numpy()
        self._width = e.memory

    def step(self, obs: ndarray, memory: ndarray) -> tuple[ndarray, ndarray]:
        """Return estimate and new memory of `Estimator.step`, all of shape (1, ...)."""
        width = self._width
        x = (obs - self._mean) / self._std
        for layer in self._encoder:
            x = _elu(_apply(layer, x))
        new = _apply(self._input, x)
        old = _apply(self._recurrent, memory)
        gates = _sigmoid(new[:, : 2 * width] + old[:, : 2 * width])
        reset = gates[:, :width]
        update = gates[:, width:]
        candidate = np.tanh(new[:, 2 * width :] + reset * old[:, 2 * width :])
        memory = candidate + update * (memory - candidate)
        padded = np.append(obs, np.zeros((1, 1), obs.dtype), axis=1)
        return padded[:, self._kept] + _apply(self._output, memory), memory
