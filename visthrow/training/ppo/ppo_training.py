"""Train on the throwing task by PPO."""

import contextlib
import io
from typing import Any

import torch
from rsl_rl.algorithms import PPO

from sim.torch_bridge import ReplayedGraph
from visthrow.common.errors import ConfigError
from visthrow.task import Experiment, PPOParams
from visthrow.training.env import ThrowEnv
from visthrow.training.ppo.algorithm import Algorithm
from visthrow.training.ppo.network import CapturableGaussian, Network, average_weights
from visthrow.training.ppo.update import CapturedPPO
from visthrow.training.ranks import Ranks

AVERAGED = 10  # longest window of iterations over which the exported weights are averaged

WARM_UP_RATE = 2e-3  # learning rate while only the critic learns, which does not act


def rsl_rl_config(p: PPOParams, ranks: Ranks) -> dict:
    """Return the configuration dictionary of rsl_rl 5.5 for our parameters."""
    network = {
        "class_name": Network,
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
        "muon": p.muon,
    }
    return {
        "num_steps_per_env": p.steps,
        "algorithm": algorithm,
        "multi_gpu": ranks.rsl_rl,
        "actor": {**network, "hidden_dims": list(p.hidden), "distribution_cfg": spread},
        "critic": {**network, "hidden_dims": list(p.critic or p.hidden)},
        "obs_groups": {"actor": ["actor"], "critic": ["critic"]},
    }


class PPOTraining(Algorithm):
    """PPO on :class:`ThrowEnv` with rsl_rl's algorithm object, ``alg``."""

    parts = ("alg", "average")

    def __init__(
        self, experiment: Experiment, device: str, seed: int, ranks: Ranks, build: Any = ThrowEnv
    ):
        """Build the environment, by ``build`` with the class's arguments, and the networks."""
        p = experiment.ppo
        if (p.environments * p.steps) % p.minibatches:
            raise ConfigError(
                f"ppo: {p.environments} x {p.steps} samples do not divide into {p.minibatches}"
                " minibatches"
            )
        self.experiment = experiment
        self.device = device
        self.iterations = p.iterations
        self.samples = p.environments * p.steps * ranks.world
        self.env = env = build(experiment, device, seed)
        with contextlib.redirect_stdout(io.StringIO()):
            self.alg: CapturedPPO = PPO.construct_algorithm(
                env.get_observations(), env, rsl_rl_config(p, ranks), device
            )
        self.alg.train_mode()
        ranks.share(self.alg.actor, self.alg.critic)
        self.network = self.alg.actor
        self.average = average_weights(self.network, AVERAGED)
        self._obs = env.get_observations()
        # some solvers cannot be captured in a graph; their steps are launched one by one
        capturable = device.startswith("cuda") and env.sim.capturable
        self.rollout = ReplayedGraph(self._rollout) if capturable else self._rollout

    def _rollout(self) -> None:
        """Collect one batch."""
        obs = self._obs
        with torch.inference_mode():
            for _ in range(self.experiment.ppo.steps):
                actions = self.alg.act(obs)
                obs, reward, done, extras = self.env.step(actions)
                self.alg.process_env_step(obs, reward, done, extras)
            self.alg.compute_returns(obs)
            for key, value in obs.items():
                self._obs[key].copy_(value)

    def collect(self, done: float) -> None:
        self.env.clear_totals()
        self.rollout()

    def learn(self, done: float) -> dict[str, float]:
        p = self.experiment.ppo
        settled = min(done / p.settled, 1.0)
        self.alg.desired_kl = (1.0 - settled) * p.desired_kl + settled * p.final_kl
        self._warm_up(round(done * p.iterations))
        figures = self.alg.update()
        self.average.update_parameters(self.network)
        return {**figures, **self.env.episode_means(), "learning_rate": self.alg.learning_rate}

    def _warm_up(self, iteration: int) -> None:
        """Let only the critic learn in the first iterations, at a higher rate; afterwards both
        learn at the configured rate.
        """
        first = self.experiment.ppo.critic_first
        if first and iteration in (0, first):
            self.alg.set_rate(WARM_UP_RATE if iteration == 0 else self.experiment.ppo.learning_rate)
        self.alg.actor_learns.fill_(float(iteration >= first))

    def load_state_dict(self, saved: dict[str, Any], keep_throws: bool = True) -> None:
        super().load_state_dict(saved, keep_throws)
        for key, value in self.env.get_observations().items():
            self._obs[key].copy_(value)
