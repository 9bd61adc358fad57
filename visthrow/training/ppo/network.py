"""rsl_rl's network and Gaussian as a CUDA graph can hold them, with products in bfloat16 as a switch."""

import os

os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")

import torch
import torch.nn.functional as F
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from tensordict import TensorDict
from torch import Tensor

ALIGNED = 16
"""Columns that an input is filled up to a multiple of on a GPU: tensor cores read rows of 16 bytes or multiples."""


class CapturableGaussian(GaussianDistribution):
    """rsl_rl's Gaussian with a sample that a CUDA graph can hold: torch.normal copies its spread's minimum to the host."""

    def sample(self) -> Tensor:
        """Sample of the current distribution."""
        return self.mean + self.std * torch.randn_like(self.mean)


class Network(MLPModel):
    """rsl_rl's network whose hidden layers multiply in bfloat16 where asked; weights and the last layer stay float32."""

    def __init__(self, *args, bfloat16: bool = False, **kwargs):
        super().__init__(*args, **kwargs)
        self.bfloat16 = bfloat16

    def forward(self, obs: TensorDict, masks=None, hidden_state=None, stochastic_output: bool = False) -> Tensor:
        """Output for observations; a sample of the distribution where ``stochastic_output`` is set."""
        output = self.output(self.get_latent(obs))
        if self.distribution is None or not stochastic_output:
            return output
        self.distribution.update(output)
        return self.distribution.sample()

    def prepared(self, obs: TensorDict) -> Tensor:
        """Normalised observations as :meth:`output` takes them at its fastest, on a GPU filled up with columns of zeros."""
        latent = self.get_latent(obs)
        latent = F.pad(latent, (0, -latent.shape[-1] % ALIGNED)) if latent.is_cuda else latent
        return latent.to(torch.bfloat16) if self.bfloat16 else latent

    def output(self, latent: Tensor) -> Tensor:
        """Output of the layers for normalised observations, shape (N, D) or filled up with columns of zeros."""
        first, *hidden, last = self.mlp
        filled = latent.shape[-1] - first.in_features
        weight = F.pad(first.weight, (0, filled)) if filled else first.weight
        with torch.autocast(latent.device.type, torch.bfloat16, enabled=self.bfloat16, cache_enabled=False):
            x = F.linear(latent, weight, first.bias)
            for layer in hidden:
                x = layer(x)
        return last(x.float())
