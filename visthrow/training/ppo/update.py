"""rsl_rl's PPO with an update that a CUDA graph can capture."""

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import Tensor

from sim.torch_bridge import ReplayedGraph
from visthrow.training.ppo.network import MuonAdam, Network

# limits of the adaptive learning rate
SLOWEST = 1e-5
FASTEST = 1e-2


class CapturedPPO(PPO):
    """rsl_rl's PPO for feedforward networks, with the learning rate in device memory."""

    def __init__(self, actor: Network, critic: Network, storage, muon: bool = False, **settings):
        """Take rsl_rl's settings; ``muon``: see :class:`PPOParams`."""
        super().__init__(actor, critic, storage, **settings)
        device = self.device
        self._cuda = torch.device(device).type == "cuda"
        self._parameters = [*actor.parameters(), *critic.parameters()]
        self.rate = torch.tensor([self.learning_rate], device=device)
        self.target_kl = torch.tensor([self.desired_kl], device=device)
        # at 0 the actor stays constant, to the bit, while the critic learns
        self.actor_learns = torch.ones(1, device=device)
        options = {"lr": self.rate, "fused": True, "capturable": self._cuda}
        if muon:
            matrices = actor.matrices + critic.matrices
            self.optimizer = MuonAdam(self._parameters, matrices, **options)
        else:
            self.optimizer = torch.optim.Adam(self._parameters, **options)
        self._totals = torch.zeros(3, device=device)
        self._capture()

    def _capture(self) -> None:
        """Prepare updates: on a GPU the next is launched, later ones are replayed from a graph."""
        self.descend = ReplayedGraph(self._epochs) if self._cuda else self._epochs

    def compute_returns(self, obs: TensorDict) -> None:
        """Compute returns and advantages in place, because captured graphs read this memory."""
        advantages = self.storage.advantages
        super().compute_returns(obs)
        self.storage.advantages = advantages.copy_(self.storage.advantages)

    def update(self) -> dict[str, float]:
        """Learn from the stored samples in all epochs; return mean losses."""
        self.target_kl.fill_(self.desired_kl)
        self.descend()
        for model in (self.actor, self.critic):
            model.update_normalization(self.storage.observations.flatten(0, 1))
        self.storage.clear()
        spread = self.actor.distribution.log_std_param.detach().exp().mean()
        *totals, self.learning_rate, spread = torch.cat(
            [self._totals, self.rate, spread[None]]
        ).tolist()
        count = self.num_learning_epochs * self.num_mini_batches
        losses = zip(("value", "surrogate", "entropy"), totals)
        return {name: total / count for name, total in losses} | {"spread": spread}

    def _epochs(self) -> None:
        """Take a gradient step on each minibatch of the samples, in each epoch."""
        self._totals.zero_()
        for batch in self.storage.mini_batch_generator(
            self.num_mini_batches, self.num_learning_epochs
        ):
            self._descend(batch)

    def _descend(self, batch: RolloutStorage.Batch) -> None:
        """Take one gradient step on a minibatch."""
        distribution = self.actor.distribution
        distribution.update(self.actor(batch.observations))
        value = self.critic(batch.observations)
        log_prob = distribution.log_prob(batch.actions)[:, None]
        ratio = (log_prob - batch.old_actions_log_prob).exp()
        clipped = ratio.clamp(1.0 - self.clip_param, 1.0 + self.clip_param)
        cost = -batch.advantages
        surrogate = torch.max(cost * ratio, cost * clipped).mean()
        step = (value - batch.values).clamp(-self.clip_param, self.clip_param)
        error = (value - batch.returns).square()
        clipped_error = (batch.values + step - batch.returns).square()
        largest = torch.max(error, clipped_error)
        error = torch.where(self.actor_learns > 0.0, largest, error).mean()
        entropy = distribution.entropy.mean()
        gain = surrogate - self.entropy_coef * entropy
        total = self.actor_learns[0] * gain + self.value_loss_coef * error
        self._adapt_rate(batch.old_distribution_params)
        self._totals += torch.stack([error, surrogate, entropy]).detach()
        gradients = torch.autograd.grad(total, self._parameters)
        for parameter, gradient in zip(self._parameters, gradients):
            parameter.grad = gradient
        if self.is_multi_gpu:
            self.reduce_parameters()
        for model in (self.actor, self.critic):
            torch.nn.utils.clip_grad_norm_(model.parameters(), self.max_grad_norm)
        self.optimizer.step()

    @torch.no_grad()
    def _adapt_rate(self, old_distribution: tuple[Tensor, ...]) -> None:
        """Adapt the learning rate to the divergence of the policy on a minibatch from that of the
        rollout, whose means and spreads have shape (N, A).
        """
        if self.schedule != "adaptive":
            return
        distribution = self.actor.distribution
        divergence = distribution.kl_divergence(old_distribution, distribution.params).mean()
        if self.is_multi_gpu:
            torch.distributed.all_reduce(divergence)
            divergence /= self.gpu_world_size
        slower = (self.rate / 1.5).clamp(min=SLOWEST)
        faster = (self.rate * 1.5).clamp(max=FASTEST)
        small = (divergence < 0.5 * self.target_kl) & (divergence > 0.0)
        rate = torch.where(small, faster, self.rate)
        self.rate.copy_(torch.where(divergence > 2.0 * self.target_kl, slower, rate))

    state_dict = PPO.save

    def load_state_dict(self, saved: dict) -> None:
        """Restore a state of :meth:`state_dict`; the learning rate stays in the same device memory,
        and graphs are captured again.
        """
        self.load(saved, None, True)
        self.set_rate(float(self.learning_rate))
        self._capture()

    def set_rate(self, rate: float) -> None:
        """Set the learning rate of the next steps."""
        self.learning_rate = rate
        self.rate.fill_(rate)
        for group in self.optimizer.param_groups:
            group["lr"] = self.rate
