"""PPO in rsl_rl's terms as a chain of device operations: the rollout is one CUDA graph, the update another.

rsl_rl's update looks at the KL divergence and at three losses on the host in every minibatch and launches each of its small
operations by itself; on a large GPU that takes longer than the arithmetic. :class:`CapturedPPO` computes the same, with
fixed shapes, buffers that keep their places and nothing read on the host before the end.
"""

import contextlib
import io
import math
import os
import time
from itertools import chain

os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")

import torch
import torch.nn.functional as F
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from tensordict import TensorDict
from torch import Tensor

from visthrow.common.errors import ConfigError
from visthrow.onboard.policy import Policy
from visthrow.task import Experiment, PPOParams
from visthrow.training.env import ThrowEnv

RATES = (1e-5, 1e-2)
"""Range of the adaptive learning rate, rsl_rl's."""

ALIGNED = 16
"""Columns that an input of the network is filled up to a multiple of in an update: tensor cores read rows of 16 bytes."""


class CapturableGaussian(GaussianDistribution):
    """rsl_rl's Gaussian with a sample that a CUDA graph can hold: torch.normal copies its spread's minimum to the host."""

    def sample(self) -> Tensor:
        """Sample of the current distribution."""
        return self.mean + self.std * torch.randn_like(self.mean)

    @property
    def log_std(self) -> Tensor:
        """Logarithm of the spread, shape (A,), with its gradient."""
        return self.log_std_param.clamp(*self.log_std_range)


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
        """Normalised observations as :meth:`output` takes them at its fastest, filled up with columns of zeros."""
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


class CapturedPPO(PPO):
    """rsl_rl's PPO of networks without memory, with an update that the host looks at once.

    Values and log-probabilities of a rollout are computed in a few large pieces at its end, samples are gathered in the
    order of the minibatches once for all epochs, and the adaptive learning rate lives on the device.
    """

    def __init__(self, actor: Network, critic: Network, storage, **settings):
        super().__init__(actor, critic, storage, **settings)
        self._cuda = torch.device(self.device).type == "cuda"
        self._parameters = list(chain(self.actor.parameters(), self.critic.parameters()))
        self.rate = torch.tensor(self.learning_rate, device=self.device)
        self.target_kl = torch.tensor(self.desired_kl, device=self.device)
        self.optimizer = torch.optim.Adam(self._parameters, lr=self.rate, fused=True, capturable=self._cuda)
        shape = storage.actions.shape
        storage.distribution_params = tuple(torch.zeros(shape, device=self.device) for _ in range(2))
        samples = storage.num_envs * storage.num_transitions_per_env
        self._order = torch.zeros(samples, dtype=torch.long, device=self.device)
        self._sums = torch.zeros(3, device=self.device)
        self._updates = 0
        self._graph: torch.cuda.CUDAGraph | None = None

    def act(self, obs: TensorDict) -> Tensor:
        """Sample actions, shape (E, A), and store what the rollout's end needs of them."""
        storage = self.storage
        actions = self.actor(obs, stochastic_output=True).detach()
        storage.observations[storage.step].copy_(obs)
        storage.actions[storage.step].copy_(actions)
        storage.distribution_params[0][storage.step].copy_(self.actor.output_mean)
        return actions

    def process_env_step(self, obs: TensorDict, rewards: Tensor, dones: Tensor, extras: dict) -> None:
        """Store one step's rewards and ends, shape (E,).

        Raises:
            ValueError: the environment bootstraps at its time limit, which is not served here.
        """
        if "time_outs" in extras:
            raise ValueError("time_outs of the environment: expected none; its time limit is an end like others")
        storage = self.storage
        storage.rewards[storage.step].copy_(rewards[:, None])
        storage.dones[storage.step].copy_(dones[:, None])
        storage.step += 1

    def compute_returns(self, obs: TensorDict) -> None:
        """Values, log-probabilities, returns and advantages of the stored steps, in place."""
        storage, advantages = self.storage, self.storage.advantages
        flat = storage.observations.flatten(0, 1)
        parts = [self.critic.output(self.critic.prepared(part)) for part in flat.split(self._minibatch)]
        storage.values.copy_(torch.cat(parts).view_as(storage.values))
        mean, spread = storage.distribution_params
        log_std = self.actor.distribution.log_std
        spread.copy_(log_std.exp().expand_as(spread))
        storage.actions_log_prob.copy_(log_probability(storage.actions, mean, log_std)[..., None])
        super().compute_returns(obs)
        advantages.copy_(storage.advantages)
        storage.advantages = advantages

    @property
    def _minibatch(self) -> int:
        return len(self._order) // self.num_mini_batches

    def update(self) -> dict[str, float]:
        """All epochs over the stored samples; returns mean losses. From the second on a GPU replays a captured graph."""
        self.target_kl.fill_(self.desired_kl)
        self._order.copy_(torch.randperm(len(self._order), device=self.device))
        if not self._cuda or self.is_multi_gpu or self._updates == 0:
            self._epochs()
        else:
            if self._graph is None:
                torch.cuda.synchronize()
                self._graph = torch.cuda.CUDAGraph()
                with torch.cuda.graph(self._graph):
                    self._epochs()
            self._graph.replay()
        self._updates += 1
        self._update_normalizers()
        self.storage.clear()
        *losses, self.learning_rate = torch.cat([self._sums, self.rate[None]]).tolist()
        count = self.num_learning_epochs * self.num_mini_batches
        return {name: total / count for name, total in zip(("value", "surrogate", "entropy"), losses)}

    def _epochs(self) -> None:
        """Gather the samples in the order of the minibatches and descend on each, once an epoch."""
        storage = self.storage
        obs = storage.observations.flatten(0, 1)
        with torch.no_grad():
            gathered = [model.prepared(obs)[self._order] for model in (self.actor, self.critic)]
            gathered += [
                stored.flatten(0, 1)[self._order]
                for stored in (storage.actions, storage.actions_log_prob, storage.advantages, storage.returns, storage.values)
            ]
            gathered.append(storage.distribution_params[0].flatten(0, 1)[self._order])
        batches = list(zip(*(part.split(self._minibatch) for part in gathered)))
        self._sums.zero_()
        for _ in range(self.num_learning_epochs):
            for batch in batches:
                self._descend(*batch)

    def _descend(
        self, seen: Tensor, known: Tensor, actions: Tensor, old: Tensor, advantage: Tensor, returns: Tensor, values: Tensor,
        old_mean: Tensor,
    ) -> None:  # fmt: skip
        """One gradient step on a minibatch of N samples: networks' inputs, actions (N, A), and columns (N, 1)."""
        mean, value = self.actor.output(seen), self.critic.output(known)
        log_std = self.actor.distribution.log_std
        if self.schedule == "adaptive":
            self._adapt(old_mean, mean.detach(), log_std.detach())
        ratio = (log_probability(actions, mean, log_std) - old[:, 0]).exp()
        clipped = ratio.clamp(1.0 - self.clip_param, 1.0 + self.clip_param)
        surrogate = torch.max(-advantage[:, 0] * ratio, -advantage[:, 0] * clipped).mean()
        value_loss = (value - returns).square()
        if self.use_clipped_value_loss:
            near = values + (value - values).clamp(-self.clip_param, self.clip_param)
            value_loss = torch.max(value_loss, (near - returns).square())
        value_loss = value_loss.mean()
        entropy = (log_std + 0.5 * math.log(2.0 * math.pi * math.e)).sum()
        loss = surrogate + self.value_loss_coef * value_loss - self.entropy_coef * entropy
        for parameter, gradient in zip(self._parameters, torch.autograd.grad(loss, self._parameters)):
            parameter.grad = gradient
        if self.is_multi_gpu:
            self.reduce_parameters()
        for model in (self.actor, self.critic):
            torch.nn.utils.clip_grad_norm_(model.parameters(), self.max_grad_norm)
        self.optimizer.step()
        self._sums += torch.stack([value_loss, surrogate, entropy]).detach()

    @torch.no_grad()
    def _adapt(self, old_mean: Tensor, mean: Tensor, log_std: Tensor) -> None:
        """rsl_rl's schedule: a lower rate where the step from the rollout's policy is too long, a higher where too short.

        The divergence is the Gaussians' of old to new mean and spread, their spreads the same for all samples.
        """
        std = log_std.exp()
        ratio = (self.storage.distribution_params[1][0, 0] / std).square()
        moved = ((old_mean - mean) / std).square().mean(0)
        kl = 0.5 * (ratio + moved - 1.0 - ratio.log()).sum()  # in this order exactly 0, as rsl_rl's, where nothing moved
        if self.is_multi_gpu:
            torch.distributed.all_reduce(kl)
            kl /= self.gpu_world_size
        lower, higher = (self.rate / 1.5).clamp(min=RATES[0]), (self.rate * 1.5).clamp(max=RATES[1])
        short = (kl < self.target_kl / 2.0) & (kl > 0.0)
        self.rate.copy_(torch.where(kl > self.target_kl * 2.0, lower, torch.where(short, higher, self.rate)))

    def _update_normalizers(self) -> None:
        """rsl_rl's update of the observations' statistics; it makes a new tensor of the spread, graphs read the old one."""
        obs = self.storage.observations.flatten(0, 1)
        for model in (self.actor, self.critic):
            if model.obs_normalization:
                captured = model.obs_normalizer._std
                model.update_normalization(obs)
                model.obs_normalizer._std = captured.copy_(model.obs_normalizer._std)

    def load(self, loaded_dict: dict, load_cfg: dict | None, strict: bool) -> bool:
        """Take up a state of :meth:`save`; the rate keeps its place on the device, graphs are captured anew."""
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


def log_probability(actions: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Log-density of a Gaussian without correlations, shape (...,). actions, mean: shape (..., A). log_std: shape (A,)."""
    deviation = (actions - mean) * (-log_std).exp()
    return -0.5 * deviation.square().sum(-1) - (log_std + 0.5 * math.log(2.0 * math.pi)).sum()


def rsl_rl_config(p: PPOParams, ranks: dict | None) -> dict:
    """Configuration dictionary of rsl_rl 5.5 for our parameters; both observation groups are named."""
    network = {
        "class_name": Network,
        "hidden_dims": list(p.hidden),
        "activation": p.activation,
        "obs_normalization": p.normalize,
        "bfloat16": p.products == "bfloat16",
    }
    spread = {"class_name": CapturableGaussian, "init_std": p.initial_std, "std_type": "log"}
    algorithm = {
        "class_name": CapturedPPO,
        "num_learning_epochs": p.epochs,
        "num_mini_batches": p.minibatches,
        "learning_rate": p.learning_rate,
        "schedule": p.schedule,
        "desired_kl": p.desired_kl,
        "gamma": p.discount,
        "lam": p.gae_lambda,
        "clip_param": p.clip,
        "entropy_coef": p.entropy,
        "value_loss_coef": p.value_coefficient,
        "max_grad_norm": p.max_grad_norm,
        "use_clipped_value_loss": True,
    }
    return {
        "num_steps_per_env": p.steps,
        "actor": {**network, "distribution_cfg": spread},
        "critic": network,
        "algorithm": algorithm,
        "obs_groups": {"actor": ["actor"], "critic": ["critic"]},
        "multi_gpu": ranks,
    }


class PPOTraining:
    """PPO on :class:`ThrowEnv`, as the trainer drives it; see :class:`visthrow.training.trainer.Algorithm`.

    Attributes:
        alg: rsl_rl's algorithm object.
    """

    def __init__(self, experiment: Experiment, device: str, seed: int, ranks: dict | None = None):
        """Build environment and networks.

        Args:
            experiment: the run's configuration.
            device: "cpu" or "cuda:0".
            seed: of the environment; torch's own generators are the caller's to seed.
            ranks: rsl_rl's ``multi_gpu`` dictionary in a distributed run.

        Raises:
            ConfigError: samples that do not divide into minibatches.
        """
        p = experiment.ppo
        if (p.environments * p.steps) % p.minibatches:
            raise ConfigError(f"ppo: {p.environments} x {p.steps} samples do not divide into {p.minibatches} minibatches")
        self.experiment, self.device = experiment, device
        self.iterations = p.iterations
        self.samples = p.environments * p.steps * (ranks["world_size"] if ranks else 1)
        self.env = ThrowEnv(experiment, device, seed)
        with contextlib.redirect_stdout(io.StringIO()):
            self.alg: CapturedPPO = PPO.construct_algorithm(self.env.get_observations(), self.env, rsl_rl_config(p, ranks), device)
        self.alg.train_mode()
        if ranks:
            self.alg.broadcast_parameters()
        self._obs = self.env.get_observations()
        self._graph: torch.cuda.CUDAGraph | None = None
        self._rollouts = 0

    def _rollout(self) -> None:
        obs = self._obs
        with torch.inference_mode():
            for _ in range(self.experiment.ppo.steps):
                actions = self.alg.act(obs)
                obs, reward, done, extras = self.env.step(actions)
                self.alg.process_env_step(obs, reward, done, extras)
            self.alg.compute_returns(obs)
            for key, value in obs.items():
                self._obs[key].copy_(value)

    def rollout(self) -> None:
        """Collect one batch: eagerly the first time (everything is allocated then), from a captured graph afterwards."""
        if not self.device.startswith("cuda") or self._rollouts == 0:
            self._rollout()
        else:
            if self._graph is None:
                self.alg.storage.clear()
                torch.cuda.synchronize()
                self._graph = torch.cuda.CUDAGraph()
                with torch.cuda.graph(self._graph):
                    self._rollout()
            self._graph.replay()
        self._rollouts += 1

    def step(self, done: float) -> dict[str, float]:
        """One iteration, rollout and update, at this share of the training; returns its figures."""
        p = self.experiment.ppo
        self.env.clear_totals()
        start = time.perf_counter()
        self.rollout()
        if self.device.startswith("cuda"):
            torch.cuda.synchronize()
        middle = time.perf_counter()
        self.alg.desired_kl = (1.0 - done) * p.desired_kl + done * p.final_kl
        figures = self.alg.update()
        end = time.perf_counter()
        times = {"rollout_s": middle - start, "learning_s": end - middle}
        return {**figures, **self.env.episode_means(), "learning_rate": self.alg.learning_rate, **times}

    def act(self, obs: Tensor) -> Tensor:
        """Deterministic actions, shape (E, 5), of the current policy for the actor's observations, shape (E, D)."""
        return self.alg.actor(TensorDict({"actor": obs}, batch_size=[len(obs)], device=obs.device))

    def export(self, contract: dict, made_by: dict) -> Policy:
        """The policy as a file's content."""
        return Policy.from_actor_state(self.alg.actor.state_dict(), self.experiment.ppo.activation, contract, made_by)

    def state_dict(self) -> dict:
        """All that the next iteration depends on, besides torch's generators."""
        return {"networks": self.alg.save(), "env": self.env.state_dict(), "obs": {k: v.clone() for k, v in self._obs.items()}}

    def load_state_dict(self, saved: dict, own_throws: bool = True) -> None:
        """Take up a state of :meth:`state_dict`; its environment too where ``own_throws`` is set."""
        self.alg.load(saved["networks"], None, True)
        if own_throws:
            self.env.load_state_dict(saved["env"])
            for key, value in saved["obs"].items():
                self._obs[key].copy_(value)
