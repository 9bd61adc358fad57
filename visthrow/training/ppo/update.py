"""rsl_rl's PPO with an update that a CUDA graph can hold.

rsl_rl's update looks at the divergence and at three losses on the host in every minibatch, and so
launches each of its small operations by itself. Here the learning rate lives on the device, buffers
keep their places, and the host looks once, at the end. Formulas are those of rsl_rl 5.5."""

from itertools import chain

import torch
from rsl_rl.algorithms import PPO
from tensordict import TensorDict
from torch import Tensor

from sim.torch_bridge import captured
from visthrow.training.ppo.network import Network

SLOWEST, FASTEST = 1e-5, 1e-2  # range of the adaptive learning rate

LOSSES = ("value", "surrogate", "entropy")


class CapturedPPO(PPO):
    """rsl_rl's PPO of networks without memory and with a Gaussian whose spread is the same for all
    samples.
    """

    def __init__(self, actor: Network, critic: Network, storage, **settings):
        super().__init__(actor, critic, storage, **settings)
        self._cuda = torch.device(self.device).type == "cuda"
        self._parameters = list(chain(actor.parameters(), critic.parameters()))
        self._rate = torch.tensor([self.learning_rate], device=self.device)
        self._target_kl = torch.zeros_like(self._rate)
        self.optimizer = torch.optim.Adam(
            self._parameters, lr=self._rate, fused=True, capturable=self._cuda
        )
        samples = storage.num_envs * storage.num_transitions_per_env
        self._order = torch.zeros(samples, device=self.device, dtype=torch.long)
        self._totals = torch.zeros(len(LOSSES), device=self.device)
        self._actor_learns = True
        self._updates = 0
        self._graph: torch.cuda.CUDAGraph | None = None

    def process_env_step(
        self, obs: TensorDict, rewards: Tensor, dones: Tensor, extras: dict
    ) -> None:
        """Store one step's rewards and ends, shape (E,).

        Raises ValueError: the environment bootstraps at its time limit, which is not served here.
        """
        if "time_outs" in extras:
            raise ValueError(
                "time_outs of the environment; expected none; its time limit is an end like others"
            )
        super().process_env_step(obs, rewards, dones, extras)

    def update(self) -> dict[str, float]:
        """Descend on the stored samples, all epochs; return mean losses and the mean spread.

        From the second on a GPU replays a captured graph.
        """
        self._target_kl.fill_(self.desired_kl)
        self._order.copy_(torch.randperm(len(self._order), device=self.device))
        if not self._cuda or self._updates == 0:
            self._descend()
        else:
            if self._graph is None:  # NCCL's watchdog asks beside a capture
                self._graph = captured(self._descend, capture_error_mode="thread_local")
            self._graph.replay()
        self._updates += 1
        for model in (self.actor, self.critic):
            model.update_normalization(self.storage.observations.flatten(0, 1))
        self.storage.clear()
        spread = self.actor.distribution.log_std_param.detach().exp()
        figures = torch.cat([self._totals, self._rate, spread.mean(0, keepdim=True)]).tolist()
        *losses, self.learning_rate, mean_spread = figures
        count = self.num_learning_epochs * self.num_mini_batches
        means = {name: loss / count for name, loss in zip(LOSSES, losses)}
        return means | {"spread": mean_spread}

    def _descend(self) -> None:
        """Gather the samples in the order of the minibatches and descend on each, once an epoch."""
        storage = self.storage
        stored = (
            storage.observations,
            storage.actions,
            *storage.distribution_params,
            storage.actions_log_prob,
            storage.advantages,
            storage.returns,
            storage.values,
        )
        size = len(self._order) // self.num_mini_batches
        gathered = [values.flatten(0, 1)[self._order].split(size) for values in stored]
        self._totals.zero_()
        for _ in range(self.num_learning_epochs):
            for batch in zip(*gathered):
                self._step(*batch)

    def _step(
        self,
        obs: TensorDict,
        actions: Tensor,
        old_mean: Tensor,
        old_std: Tensor,
        old_log_probability: Tensor,
        advantage: Tensor,
        returns: Tensor,
        old_value: Tensor,
    ) -> None:
        """Make one gradient step on a minibatch, shape (N, ...)."""
        distribution = self.actor.distribution
        distribution.update(self.actor(obs))
        self._adapt_rate(distribution.kl_divergence((old_mean, old_std), distribution.params))
        ratio = (distribution.log_prob(actions)[:, None] - old_log_probability).exp()
        clipped = ratio.clamp(1.0 - self.clip_param, 1.0 + self.clip_param)
        surrogate = torch.max(-advantage * ratio, -advantage * clipped).mean()
        entropy = distribution.entropy.mean()
        value = self.critic(obs)
        error = (value - returns).square()
        if self._actor_learns:
            near = old_value + (value - old_value).clamp(-self.clip_param, self.clip_param)
            error = torch.max(error, (near - returns).square())
        error = error.mean()
        loss = self.value_loss_coef * error
        if self._actor_learns:
            loss = loss + surrogate - self.entropy_coef * entropy
        gradients = torch.autograd.grad(loss, self._parameters, allow_unused=True)
        for parameter, gradient in zip(self._parameters, gradients):
            parameter.grad = gradient
        if self.is_multi_gpu:
            self.reduce_parameters()
        for model in (self.actor, self.critic):
            torch.nn.utils.clip_grad_norm_(model.parameters(), self.max_grad_norm)
        self.optimizer.step()
        self._totals += torch.stack([error, surrogate, entropy]).detach()

    @torch.no_grad()
    def _adapt_rate(self, divergences: Tensor) -> None:
        """Make the learning rate smaller or larger by the divergences of a minibatch from its
        rollout, shape (N,).
        """
        if self.schedule != "adaptive":
            return
        divergence = divergences.mean()
        if self.is_multi_gpu:
            torch.distributed.all_reduce(divergence)
            divergence /= self.gpu_world_size
        target = self._target_kl
        slower = (self._rate / 1.5).clamp(min=SLOWEST)
        faster = (self._rate * 1.5).clamp(max=FASTEST)
        small = (divergence < 0.5 * target) & (divergence > 0.0)
        rate = torch.where(small, faster, self._rate)
        self._rate.copy_(torch.where(divergence > 2.0 * target, slower, rate))

    def hold_actor(self, held: bool) -> None:
        """Let the critic alone learn, its steps not clipped, or both."""
        if held == self._actor_learns:
            self._actor_learns = not held
            self._graph = None
            self._updates = 0

    def load(self, loaded_dict: dict, load_cfg: dict | None, strict: bool) -> bool:
        """Take up a state of :meth:`save`; the rate keeps its place on the device, graphs are
        captured anew.
        """
        result = super().load(loaded_dict, load_cfg, strict)
        self.set_rate(float(self.learning_rate))
        self._graph = None
        self._updates = 0
        return result

    def set_rate(self, rate: float) -> None:
        """Go on with this learning rate."""
        self.learning_rate = rate
        self._rate.fill_(rate)
        for group in self.optimizer.param_groups:
            group["lr"] = self._rate
