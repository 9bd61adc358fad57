"""Variants of rsl_rl's network and Gaussian that a CUDA graph can capture, with optional bfloat16
products.
"""

import math
import os
from collections.abc import Iterable
from typing import Any

os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from tensordict import TensorDict
from torch import Tensor
from torch.optim.swa_utils import AveragedModel

from visthrow.onboard.policy import RSL_RL_EPS, Policy

# count of observations that a loaded policy's normaliser is assumed to have seen: about as many as
# in its training; the file does not state the number
OBSERVED = 10**8


def normalizer_state(mean: Tensor, std: Tensor) -> dict[str, Tensor]:
    """Return the state of rsl_rl's normaliser after :data:`OBSERVED` observations of this mean and
    spread, shape (D,).
    """
    state = {"_mean": mean, "_std": std, "_var": std.square()}
    return {name: value[None] for name, value in state.items()} | {"count": torch.tensor(OBSERVED)}


class CapturableGaussian(GaussianDistribution):
    """rsl_rl's Gaussian with a sampling method that a CUDA graph can capture; torch.normal copies
    the minimum of the spread to the host.
    """

    def sample(self) -> Tensor:
        """Return a sample of the current distribution."""
        return self.mean + self.std * torch.randn_like(self.mean)


class Network(MLPModel):
    """rsl_rl's network with optional bfloat16 products in the hidden layers; the weights and the
    last layer remain float32.
    """

    def __init__(self, *args, bfloat16: bool = False, **kwargs):
        super().__init__(*args, **kwargs)
        self.bfloat16 = bfloat16

    def forward(
        self, obs: TensorDict, masks=None, hidden_state=None, stochastic_output: bool = False
    ) -> Tensor:
        """Return the output for observations; with ``stochastic_output`` a sample of the
        distribution.
        """
        *layers, last = self.mlp
        latent = self.get_latent(obs)
        with torch.autocast(latent.device.type, torch.bfloat16, enabled=self.bfloat16):
            for layer in layers:
                latent = layer(latent)
        output = last(latent.float())
        if self.distribution is None or not stochastic_output:
            return output
        self.distribution.update(output)
        return self.distribution.sample()

    def update_normalization(self, obs: TensorDict) -> None:
        """Update the observations' statistics as rsl_rl does, but in place: captured graphs read
        the old tensor of the spread.
        """
        if self.obs_normalization:
            captured = self.obs_normalizer._std
            super().update_normalization(obs)
            self.obs_normalizer._std = captured.copy_(self.obs_normalizer._std)

    @torch.no_grad()
    def take_up(self, policy: Policy) -> None:
        """Start from a policy with the same layers: load its weights, and its normaliser, which
        hardly changes afterwards.
        """
        layers = self._linear_layers()
        for layer, weight, bias in zip(layers, policy.weights, policy.biases, strict=True):
            layer.weight.copy_(weight)
            layer.bias.copy_(bias)
        if policy.mean is not None:
            self.obs_normalizer.load_state_dict(
                normalizer_state(policy.mean, policy.std + (policy.eps - RSL_RL_EPS))
            )

    def _linear_layers(self) -> list[torch.nn.Linear]:
        return [layer for layer in self.mlp if isinstance(layer, torch.nn.Linear)]

    @property
    def matrices(self) -> list[Tensor]:
        """Return the weight matrices of the hidden layers."""
        return [layer.weight for layer in self._linear_layers()[:-1]]


class MuonAdam(torch.optim.Adam):
    """Adam, with Muon for weight matrices: they step along their orthogonalised momentum, at the
    same learning rate. ``zero_grad`` does not reset the gradients of the matrices; zero the
    gradients through the network.

    Source: K. Jordan et al., Muon, 2024; step size: Liu et al., arXiv:2502.16982."""

    def __init__(self, parameters: Iterable[Tensor], matrices: Iterable[Tensor], **options: Any):
        """Optimise the ``matrices`` among the parameters by Muon and the others by Adam with these
        ``options``.
        """
        self._matrices = list(matrices)
        taken = set(map(id, self._matrices))
        super().__init__([p for p in parameters if id(p) not in taken], **options)
        rule = {"weight_decay": 0.0, "adjust_lr_fn": "match_rms_adamw"}
        self._muon = torch.optim.Muon(self._matrices, lr=1.0, **rule)

    @torch.no_grad()
    def step(self, closure: None = None) -> None:
        """Take one step of both optimisers."""
        super().step()
        before = [matrix.clone() for matrix in self._matrices]
        self._muon.step()
        # a captured graph needs the rate on the device, which Muon does not support: scale its
        # steps of rate 1
        for matrix, old in zip(self._matrices, before):
            matrix.copy_(torch.lerp(old, matrix, self.param_groups[0]["lr"]))

    def state_dict(self) -> dict:
        """Return the state of both optimisers."""
        return super().state_dict() | {"muon": self._muon.state_dict()}

    def load_state_dict(self, state_dict: dict) -> None:
        """Restore a state of :meth:`state_dict`."""
        entries = dict(state_dict)
        self._muon.load_state_dict(entries.pop("muon"))
        super().load_state_dict(entries)


def cosine_rate(
    optimizer: torch.optim.Optimizer, done: float, highest: float, lowest: float
) -> float:
    """Set and return the learning rate after a share ``done`` of the training, which falls from the
    highest to the lowest one as half a cosine.
    """
    rate = lowest + 0.5 * (highest - lowest) * (1.0 + math.cos(math.pi * done))
    for group in optimizer.param_groups:
        group["lr"] = rate
    return rate


def average_weights(module: torch.nn.Module, window: int) -> AveragedModel:
    """Return the running mean of a module's weights over the last quarter of its updates, at most
    ``window`` of them.

    Averaging removes the noise of single gradient steps, which would bias the throws. Source:
    Polyak and Juditsky, SIAM J. Control and Optimization 30(4), 1992."""

    def move_mean(mean: Tensor, current: Tensor, updates: Tensor) -> Tensor:
        return mean + (current - mean) * torch.clamp(4.0 / (updates + 4.0), min=1.0 / window)

    return AveragedModel(module, avg_fn=move_mean)
