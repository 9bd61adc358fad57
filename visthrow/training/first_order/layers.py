"""The network along flights, forward and backward a step at a time.

Flights are long and what a derivative by a state is worth is known only once all later steps are done; so the network's own derivatives
are products with one vector a step, and those by its weights are products over all steps at the end.
"""

import torch
from torch import Tensor, nn

from visthrow.training.ppo.network import Network


class Layers:
    """What a network's layers made of the steps of flights, shape (T, E, N) each, and derivatives by it.

    Attributes:
        action: output. by_action: derivatives by it. by_seen: those by the observations of the last step that :meth:`back` was called for.
    """

    def __init__(self, network: Network, obs: Tensor):
        """Make room for observations, shape (T, E, D)."""
        self._network, self._linear = network, [layer for layer in network.mlp if isinstance(layer, nn.Linear)]
        self._inner, self._by_inner = ([obs.new_zeros(*obs.shape[:2], layer.out_features) for layer in self._linear] for _ in range(2))
        self._slope = [torch.zeros_like(inner) for inner in self._inner[:-1]]
        self._first = torch.zeros_like(self._linear[0].weight)  # with the normaliser's spread
        self.action, self.by_action, self.by_seen = self._inner[-1], self._by_inner[-1], torch.zeros_like(obs[0])

    def forward(self, k: int, seen: Tensor) -> Tensor:
        """Actions of step k, shape (E, 5), for observations, shape (E, D)."""
        x = self._network.obs_normalizer(seen)
        for layer, inner in zip(self._linear, self._inner):
            torch.addmm(layer.bias, x, layer.weight.T, out=inner[k])
            x = self._network.mlp[1](inner[k]) if inner is not self.action else inner[k]
        return x

    def prepare(self, steps: int) -> None:
        """Begin a way back from this step."""
        for inner, slope in zip(self._inner, self._slope):
            with torch.enable_grad():
                inner = inner[:steps].detach().requires_grad_()
                slope[:steps] = torch.autograd.grad(self._network.mlp[1](inner).sum(), inner)[0]
        normalizer = self._network.obs_normalizer
        spread = normalizer.std + normalizer.eps if self._network.obs_normalization else 1.0
        self._first.copy_(self._linear[0].weight.detach() / spread)
        self.by_seen.zero_()

    def back(self, k: int) -> None:
        """From derivatives by the actions of step k to those by its observations."""
        for i in range(len(self._linear) - 1, 0, -1):
            out = self._by_inner[i - 1][k]
            torch.mm(self._by_inner[i][k], self._linear[i].weight, out=out).mul_(self._slope[i - 1][k])
        torch.mm(self._by_inner[0][k], self._first, out=self.by_seen)

    def gradients(self, seen: Tensor, shares: Tensor) -> None:
        """Give the weights their derivatives; flights, shape (E,), count by these shares. seen: the first observations, shape (T, E, D)."""
        x, steps = self._network.obs_normalizer(seen), len(seen)
        for layer, inner, by_inner in zip(self._linear, self._inner, self._by_inner):
            by = (by_inner[:steps] * shares[:, None]).flatten(0, 1)
            layer.weight.grad, layer.bias.grad = by.mT @ x.flatten(0, 1), by.sum(0)
            x = self._network.mlp[1](inner[:steps])
