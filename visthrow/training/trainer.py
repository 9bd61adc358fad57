"""Training by rsl_rl's PPO: rollout in one CUDA graph, checkpoints that hold all state, export of the policy.

rsl_rl's own runner copies figures to the host at every step and its checkpoints leave out the environment and the random
generators; this one drives the same algorithm object without either.
"""

import contextlib
import io
import os
import time
from pathlib import Path

os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.modules.distribution import GaussianDistribution
from tensordict import TensorDict

from visthrow import config
from visthrow.common import provenance
from visthrow.common.errors import CheckpointError, ConfigError
from visthrow.common.storage import atomic_write, write_json
from visthrow.onboard.policy import Policy
from visthrow.task import Experiment, PPOParams, contract_of
from visthrow.training import protocol
from visthrow.training.env import ThrowEnv
from visthrow.training.first_order import FirstOrder

CHECKPOINT = "checkpoint.pt"
POLICY = "policy.npz"


class CapturableGaussian(GaussianDistribution):
    """rsl_rl's Gaussian with a sample that a CUDA graph can hold: torch.normal copies its spread's minimum to the host."""

    def sample(self) -> torch.Tensor:
        """Sample of the current distribution."""
        return self.mean + self.std * torch.randn_like(self.mean)


def rsl_rl_config(p: PPOParams, ranks: dict | None) -> dict:
    """Configuration dictionary of rsl_rl 5.5 for our parameters; both observation groups are named."""
    network = {
        "class_name": "MLPModel",
        "hidden_dims": list(p.hidden),
        "activation": p.activation,
        "obs_normalization": p.normalize,
    }
    spread = {"class_name": CapturableGaussian, "init_std": p.initial_std, "std_type": "log"}
    algorithm = {
        "class_name": "PPO",
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


class Trainer:
    """One training run.

    Attributes:
        env: the environment. alg: rsl_rl's PPO, whose actor first-order training trains too. iteration: iterations done.
        first_order: where that is the algorithm; else None.
        seconds: wall time spent in rollouts and in learning since the start or the resume.
    """

    def __init__(self, experiment: Experiment, device: str, seed: int, ranks: dict | None = None):
        """Build environment and algorithm.

        Args:
            experiment: the run's configuration.
            device: "cpu" or "cuda:0".
            seed: of everything random.
            ranks: rsl_rl's ``multi_gpu`` dictionary in a distributed run.
        """
        p = experiment.ppo
        if (p.environments * p.steps) % p.minibatches:
            raise ConfigError(
                f"ppo: {p.environments} x {p.steps} samples do not divide into {p.minibatches} minibatches"
            )
        rank = ranks["global_rank"] if ranks else 0
        torch.manual_seed(seed * 1000 + rank)
        if device.startswith("cuda"):
            torch.cuda.set_device(device)  # captures and synchronisation go to the current device
            torch.backends.cuda.matmul.allow_tf32 = True
        self.experiment, self.device, self.seed, self.ranks = experiment, device, seed, ranks
        self.env = ThrowEnv(experiment, device, seed * 1000 + rank)
        with contextlib.redirect_stdout(io.StringIO()):
            self.alg = PPO.construct_algorithm(self.env.get_observations(), self.env, rsl_rl_config(p, ranks), device)
        self.alg.train_mode()
        if ranks:
            self.alg.broadcast_parameters()
        self.first_order: FirstOrder | None = None
        if experiment.algorithm == "first_order":
            if ranks:
                raise ConfigError('algorithm = "first_order" trains on one device; run one process')
            self.first_order = FirstOrder(experiment, self.env, self.alg.actor)
        self._obs = self.env.get_observations()
        self._graph = None
        self.iteration = 0
        self.seconds = {"rollout": 0.0, "learning": 0.0}

    @property
    def samples_per_iteration(self) -> int:
        """Environment steps an iteration, over all ranks."""
        return self.experiment.steps_per_iteration * (self.ranks["world_size"] if self.ranks else 1)

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
        if self.first_order:
            self.first_order.rollout()
        elif not self.device.startswith("cuda"):
            self._rollout()
        elif self._graph is not None:
            self._graph.replay()
        elif self.seconds["rollout"] == 0.0:
            self._rollout()
        else:
            self.alg.storage.clear()
            torch.cuda.synchronize()
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph):
                self._rollout()
            self._graph = graph
            self._captured_std = [(n, n._std) for n in self._normalizers()]
            graph.replay()

    def _normalizers(self) -> list:
        models = (self.alg.actor, self.alg.critic)
        return [m.obs_normalizer for m in models if m.obs_normalization]

    def _learn(self) -> dict[str, float]:
        p = self.experiment.ppo
        done = min(self.iteration / self.experiment.iterations, 1.0)
        if self.first_order:
            return self.first_order.learn(done)
        self.alg.desired_kl = (1.0 - done) * p.desired_kl + done * p.final_kl
        figures = self.alg.update()
        if (
            self._graph is not None
        ):  # rsl_rl makes a new tensor of the spread; the graph reads the one it was captured with
            for normalizer, captured in self._captured_std:
                captured.copy_(normalizer._std)
                normalizer._std = captured
        return figures

    def step(self) -> dict[str, float]:
        """One iteration: rollout and update. Returns losses and the finished episodes' means."""
        self.env.clear_totals()
        start = time.perf_counter()
        self.rollout()
        if self.device.startswith("cuda"):
            torch.cuda.synchronize()
        middle = time.perf_counter()
        figures = self._learn()
        end = time.perf_counter()
        self.seconds["rollout"] += middle - start
        self.seconds["learning"] += end - middle
        self.iteration += 1
        times = {"iteration": self.iteration, "rollout_s": middle - start, "learning_s": end - middle}
        return (self._thrown() if self.first_order is None else {}) | figures | times

    def _thrown(self) -> dict[str, float]:
        """Means of the episodes that PPO's rollout finished."""
        totals = self.env.totals
        released, episodes = max(totals["released"], 1.0), max(totals["episodes"], 1.0)
        return {
            "released": totals["released"] / episodes,
            "landing_error": totals["landing_error"] / released,
            "duration": totals["duration"] / released,
            "episodes": totals["episodes"],
            "learning_rate": self.alg.learning_rate,
        }

    def actor(self):
        """The deterministic policy: function of observations (E, D) -> actions (E, 5)."""
        model = self.alg.get_policy()
        return lambda obs: model(TensorDict({"actor": obs}, batch_size=[len(obs)], device=obs.device))

    def evaluate(self, target: float, count: int = 200, seed: int = 12345) -> dict[str, float]:
        """Summary of throws from hover with the current policy; see :mod:`visthrow.training.protocol`."""
        return protocol.throw(self.experiment, self.actor(), target, count, self.device, seed).summary()

    def export(self, made_by: dict) -> Policy:
        """The policy as a file's content."""
        state = self.alg.get_policy().state_dict()
        return Policy.from_actor_state(state, self.experiment.ppo.activation, contract_of(self.experiment), made_by)

    def save(self, path: Path) -> None:
        """Write a checkpoint that a resumed run goes on from as if it had not stopped; all or nothing."""
        content = {
            "algorithm": self.alg.save(),
            "first_order": self.first_order.state_dict() if self.first_order else None,
            "iteration": self.iteration,
            "env": self.env.state_dict(),
            "seed": self.seed,
            "obs": {k: v.clone() for k, v in self._obs.items()},
            "config": config.dumps(self.experiment),
            "rng": torch.get_rng_state(),
            "cuda_rng": torch.cuda.get_rng_state(self.device) if self.device.startswith("cuda") else None,
        }
        buffer = io.BytesIO()
        torch.save(content, buffer)
        atomic_write(path, buffer.getvalue())

    def load(self, path: Path) -> None:
        """Take up a checkpoint. In a distributed run the further ranks start new episodes under new seeds.

        Raises:
            CheckpointError: a broken file, or one of another configuration or seed.
        """
        try:
            saved = torch.load(path, map_location=self.device, weights_only=True)
        except FileNotFoundError:
            raise CheckpointError(f"{path}: no checkpoint there; expected a file that `visthrow train` wrote") from None
        except Exception as error:
            raise CheckpointError(f"{path}: not a readable checkpoint ({error})") from error
        if saved["config"] != config.dumps(self.experiment) or saved["seed"] != self.seed:
            raise CheckpointError(
                f"{path}: written by a run of another configuration or seed; resume with the same ones"
            )
        self.alg.load(saved["algorithm"], None, True)
        if self.first_order:
            self.first_order.load_state_dict(saved["first_order"])
        self.iteration = saved["iteration"]
        rank = self.ranks["global_rank"] if self.ranks else 0
        if (
            rank > 0
        ):  # the checkpoint holds the first rank's environments; with them every rank would collect the same data
            torch.manual_seed((self.seed * 1000 + rank) * 100_003 + self.iteration)
            return
        self.env.load_state_dict(saved["env"])
        for key, value in saved["obs"].items():
            self._obs[key].copy_(value)
        torch.set_rng_state(saved["rng"].cpu())
        if saved["cuda_rng"] is not None and self.device.startswith("cuda"):
            torch.cuda.set_rng_state(saved["cuda_rng"].cpu(), self.device)


def finish(trainer: Trainer, folder: Path, figures: dict) -> Policy:
    """Write the policy file and the run's summary into its folder."""
    made_by = provenance.collect() | {
        "seed": trainer.seed,
        "config": config.to_dict(trainer.experiment, defaults=False),  # readable when fields come and go
        "figures": figures,
    }
    policy = trainer.export(made_by)
    policy.save(folder / POLICY)
    write_json(folder / "summary.json", {k: v for k, v in made_by.items() if k != "config"})
    return policy
