"""rsl_rl's PPO with an update that a CUDA graph can hold."""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain

import torch
from rsl_rl.algorithms import PPO
from tensordict import TensorDict
from torch import Tensor
from torch.distributions import Normal

from sim.torch_bridge import captured
from visthrow.training.ppo.network import Network

SLOWEST, FASTEST = 1e-5, 1e-2  # range of the adaptive learning rate


class CapturedPPO(PPO):
    """rsl_rl's PPO of networks without memory and with a Gaussian whose spread is the same for all
    samples.

    Log-probabilities of a rollout are computed at its end, samples are gathered in the order of the
    minibatches once for all epochs, the critic works on a stream of its own, and the adaptive
    learning rate lives on the device."""

    def __init__(self, actor: Network, critic: Network, storage, **settings):
        super().__init__(actor, critic, storage, **settings)
        make = {"device": self.device, "dtype": torch.float32}
        self._cuda = torch.device(self.device).type == "cuda"
        self._spread = actor.distribution.log_std_param
        self._layers = [
            w for w in chain(actor.parameters(), critic.parameters()) if w is not self._spread
        ]
        self.rate, self.target_kl = (
            torch.tensor([self.learning_rate], **make),
            torch.tensor([self.desired_kl], **make),
        )
        self.actor_learns = torch.ones(
            1, **make
        )  # 0 holds the actor still, to the bit, while the critic learns
        self.optimizer = torch.optim.Adam(
            [self._spread, *self._layers], lr=self.rate, fused=True, capturable=self._cuda
        )
        samples = storage.num_envs * storage.num_transitions_per_env
        actions = storage.actions.shape[-1]
        self._minibatch = samples // self.num_mini_batches
        self._order = torch.zeros(samples, device=self.device, dtype=torch.long)
        storage.distribution_params = tuple(
            torch.zeros(storage.actions.shape, **make) for _ in range(2)
        )
        self._old_std = torch.ones(actions, **make)
        self._totals = torch.zeros(3, **make)
        self._updates = 0
        self._graph: torch.cuda.CUDAGraph | None = None
        self._aside = torch.cuda.Stream(self.device) if self._cuda else None

    @contextmanager
    def _on_side_stream(self) -> Iterator[None]:
        """Launch on a stream of its own on a GPU, after what was launched before; :meth:`join`
        waits for it.
        """
        if self._aside is None:
            yield
            return
        self._aside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self._aside):
            yield

    def join(self) -> None:
        """Let what is launched from here on wait for the critic."""
        if self._aside is not None:
            torch.cuda.current_stream().wait_stream(self._aside)

    def act(self, obs: TensorDict) -> Tensor:
        """Sample actions, shape (E, A), and store what the rollout's end needs of them; the critic
        works beside the simulation.
        """
        storage = self.storage
        observation = storage.observations[storage.step]
        for group, values in obs.items():  # one by one: copied at once they took four times as long
            observation[group].copy_(values)
        with self._on_side_stream():
            storage.values[storage.step].copy_(self.critic(observation).detach())
        actions = self.actor(obs, stochastic_output=True).detach()
        storage.actions[storage.step].copy_(actions)
        storage.distribution_params[0][storage.step].copy_(self.actor.output_mean)
        return actions

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
        storage = self.storage
        storage.rewards[storage.step].copy_(rewards[:, None])
        storage.dones[storage.step].copy_(dones[:, None])
        storage.step += 1

    @torch.no_grad()
    def compute_returns(self, obs: TensorDict) -> None:
        """Log-probabilities, returns and advantages of the stored steps, in place."""
        storage = self.storage
        self.join()
        following = self.critic(obs)
        self._old_std.copy_(self._std())
        normal = Normal(storage.distribution_params[0], self._old_std, validate_args=False)
        log_probability = normal.log_prob(storage.actions).sum(-1, keepdim=True)
        storage.actions_log_prob.copy_(log_probability)
        advantage = torch.zeros_like(following)
        for k in reversed(range(storage.num_transitions_per_env)):
            goes_on = 1.0 - storage.dones[k].float()
            error = storage.rewards[k] + goes_on * self.gamma * following - storage.values[k]
            advantage = error + goes_on * self.gamma * self.lam * advantage
            following = storage.values[k]
            storage.returns[k].copy_(advantage + following)
        torch.sub(storage.returns, storage.values, out=storage.advantages)
        storage.advantages.sub_(storage.advantages.mean()).div_(storage.advantages.std() + 1e-8)

    def _std(self) -> Tensor:
        """Spread of the actions, shape (A,)."""
        return self._spread.detach().clamp(*self.actor.distribution.log_std_range).exp()

    def update(self) -> dict[str, float]:
        """All epochs over the stored samples; returns mean losses.

        From the second on a GPU replays a captured graph.
        """
        self.target_kl.fill_(self.desired_kl)
        self._order.copy_(torch.randperm(len(self._order), device=self.device))
        if not self._cuda or self._updates == 0:
            self._epochs()
        else:
            if self._graph is None:
                self._graph = captured(
                    self._epochs, capture_error_mode="thread_local"
                )  # NCCL's watchdog asks beside
            self._graph.replay()
        self._updates += 1
        for model in (self.actor, self.critic):
            model.update_normalization(self.storage.observations.flatten(0, 1))
        self.storage.clear()
        figures = torch.cat([self._totals, self.rate, self._std()]).tolist()
        value, surrogate, entropy, self.learning_rate, *spreads = figures
        count = self.num_learning_epochs * self.num_mini_batches
        return {
            "value": value / count,
            "surrogate": surrogate / count,
            "entropy": entropy / count,
            "spread": sum(spreads) / len(spreads),  # NaN where one is
        }

    def _epochs(self) -> None:
        """Gather the samples in the order of the minibatches and descend on each, once an epoch."""
        storage = self.storage
        obs = storage.observations.flatten(0, 1)
        stored = (
            storage.actions,
            storage.distribution_params[0],
            storage.actions_log_prob,
            storage.advantages,
            storage.returns,
            storage.values,
        )
        with torch.no_grad():
            gathered = [model.prepared(obs)[self._order] for model in (self.actor, self.critic)]
            gathered += [t.flatten(0, 1)[self._order] for t in stored]
        batches = list(zip(*(part.split(self._minibatch) for part in gathered)))
        self._totals.zero_()
        for _ in range(self.num_learning_epochs):
            for actor_input, critic_input, *samples in batches:
                self._descend(actor_input, critic_input, samples)

    def _descend(self, actor_input: Tensor, critic_input: Tensor, samples: list[Tensor]) -> None:
        """Take one gradient step on a minibatch of the networks' inputs and the samples."""
        # so are their gradients: one multiplies while the other moves memory
        with self._on_side_stream():
            value = self.critic.output(critic_input)
        mean = self.actor.output(actor_input)
        self.join()
        actions, old_mean, old_log_probability, advantage, returns, old_value = samples
        std = self._spread.clamp(*self.actor.distribution.log_std_range).exp()
        normal = Normal(mean, std, validate_args=False)
        log_probability = normal.log_prob(actions).sum(-1, keepdim=True)
        ratio = (log_probability - old_log_probability).exp()
        clipped = ratio.clamp(1.0 - self.clip_param, 1.0 + self.clip_param)
        surrogate = torch.max(-advantage * ratio, -advantage * clipped).mean()
        step = (value - old_value).clamp(-self.clip_param, self.clip_param)
        error = (value - returns).square()
        largest = torch.max(error, (old_value + step - returns).square())
        error = torch.where(self.actor_learns > 0.0, largest, error).mean()
        entropy = normal.entropy().sum(-1).mean()
        gain = surrogate - self.entropy_coef * entropy
        total = self.actor_learns[0] * gain + self.value_loss_coef * error
        self._adapt_rate(mean.detach(), std.detach(), old_mean)
        self._totals += torch.stack([error, surrogate, entropy]).detach()
        parameters = [self._spread, *self._layers]
        for parameter, gradient in zip(parameters, torch.autograd.grad(total, parameters)):
            parameter.grad = gradient
        if self.is_multi_gpu:
            self.reduce_parameters()
        for model in (self.actor, self.critic):
            torch.nn.utils.clip_grad_norm_(model.parameters(), self.max_grad_norm)
        self.optimizer.step()

    @torch.no_grad()
    def _adapt_rate(self, mean: Tensor, std: Tensor, old_mean: Tensor) -> None:
        """Make the learning rate smaller or larger by the divergence of a minibatch from its
        rollout; means of shape (N, A), spread of shape (A,).
        """
        if self.schedule != "adaptive":
            return
        square = (self._old_std / std).square()
        moved = ((old_mean - mean) / std).square().mean(0)
        divergence = 0.5 * (square + moved - 1.0 - square.log()).sum()
        if self.is_multi_gpu:
            torch.distributed.all_reduce(divergence)
            divergence /= self.gpu_world_size
        slower = (self.rate / 1.5).clamp(min=SLOWEST)
        faster = (self.rate * 1.5).clamp(max=FASTEST)
        small = (divergence < 0.5 * self.target_kl) & (divergence > 0.0)
        rate = torch.where(small, faster, self.rate)
        self.rate.copy_(torch.where(divergence > 2.0 * self.target_kl, slower, rate))

    def load(self, loaded_dict: dict, load_cfg: dict | None, strict: bool) -> bool:
        """Take up a state of :meth:`save`; the rate keeps its place on the device, graphs are
        captured anew.
        """
        result = super().load(loaded_dict, load_cfg, strict)
        self.set_rate(float(self.learning_rate))
        self._graph, self._updates = None, 0
        return result

    def set_rate(self, rate: float) -> None:
        """Go on with this learning rate."""
        self.learning_rate = rate
        self.rate.fill_(rate)
        for group in self.optimizer.param_groups:
            group["lr"] = self.rate
