"""Run one training: iterations of an algorithm, evaluations, checkpoints, and the trained
policy.
"""

import dataclasses
import io
import math
import time
from pathlib import Path

import torch

from visthrow import config
from visthrow.common import provenance
from visthrow.common.compute_device import allow_rounded_products
from visthrow.common.errors import CheckpointError, MismatchError, TrainError
from visthrow.common.storage import atomic_write, write_json
from visthrow.onboard.policy import Policy
from visthrow.task import Experiment, contract_of
from visthrow.task.measurement import TARGETS, Throws, as_flown
from visthrow.training import protocol
from visthrow.training.distillation import Distillation
from visthrow.training.first_order.first_order_training import FirstOrder
from visthrow.training.ppo.ppo_training import PPOTraining
from visthrow.training.ranks import Ranks

ALGORITHMS = {
    "ppo": PPOTraining,
    "first_order": FirstOrder,
    "distillation": Distillation,
}
CHECKPOINT = "checkpoint.pt"
POLICY = "policy.npz"
SUMMARY = "summary.json"
EVALUATION = "evaluation.json"
"""Files in a run's folder: state after the last iteration, policy, figures of a finished run, and
figures of a run that was stopped.
"""

# override that replaces the configuration's schedule in a training that starts from a policy
ADAPTATION = 'ppo="ppo/adapt.toml"'

EVALUATED = 200  # throws in an evaluation
EVALUATION_SEED = 12345  # seed of its starts and noise
FINAL = 5  # factor on the number of throws in the evaluation at the end of a training

TASK = ("observation", "action", "control_period")
"""Parts of a policy's contract on which its network depends; plant, camera and release may differ
from those of its training.
"""


def coarsen(experiment: Experiment) -> Experiment:
    """Return the experiment with fewer rope segments and longer steps for a faster training, in
    which throws land at nearly the same places. With other engines than ``chain`` the experiment is
    unchanged, as their ropes may be unstable in longer steps.
    """
    if experiment.sim.solver != "chain":
        return experiment
    p = experiment.first_order if experiment.algorithm == "first_order" else experiment.ppo
    rope = experiment.rope
    sim = experiment.sim
    segments = min(p.segments or rope.segments, rope.segments)
    rope = dataclasses.replace(rope, segments=segments)
    sim = dataclasses.replace(sim, substep=max(p.substep, sim.substep))
    return dataclasses.replace(experiment, rope=rope, sim=sim)


def adopt_layers(experiment: Experiment, policy: Policy) -> Experiment:
    """Return the experiment with the policy's layers for the actor, for a training that starts from
    the policy.

    Raises MismatchError: the task's observations or actions differ from the policy's; the message
    names every difference."""
    try:
        follow_vehicle = ("observation.latency", "action.max_thrust", "action.max_rate")
        policy.require(contract_of(experiment), TASK, follow_vehicle)
    except MismatchError as error:
        raise MismatchError(f"--from: the task of this run is not the policy's; {error}") from None
    if (policy.estimator is None) == (experiment.algorithm == "distillation"):
        kinds = ("without", "with") if policy.estimator is None else ("with", "without")
        raise MismatchError(
            f'--from: the policy is one {kinds[0]} a memory; algorithm = "{experiment.algorithm}"'
            f" trains those {kinds[1]}"
        )
    p = experiment.ppo
    hidden = tuple(len(bias) for bias in policy.biases[:-1])
    layers = {"hidden": hidden, "critic": p.critic or p.hidden, "activation": policy.activation}
    return dataclasses.replace(
        experiment, ppo=dataclasses.replace(p, **layers, normalize=policy.mean is not None)
    )


FINITE = {"value", "surrogate", "entropy", "spread", "cost", "gradient_norm"}
"""Figures of an iteration that stop the training if they are not finite."""


class Trainer:
    """One training run.

    Attributes:
        algorithm: the training algorithm. iteration: number of finished iterations.
        seconds: wall time of rollouts and of learning since the start or the resume [s].
    """

    def __init__(self, experiment: Experiment, device: str, seed: int, ranks: Ranks | None = None):
        """Build the algorithm and seed all random generators."""
        ranks = ranks or Ranks(device)
        seed_of_rank = seed * 1000 + ranks.rank
        torch.manual_seed(seed_of_rank)
        if device.startswith("cuda"):
            torch.cuda.set_device(device)  # captures and synchronisation go to the current device
        self.experiment = experiment
        self.device = device
        self.seed = seed
        self.ranks = ranks
        algorithm = ALGORITHMS[experiment.algorithm]
        self.algorithm = algorithm(coarsen(experiment), device, seed_of_rank, ranks)
        self.iteration = 0
        self.seconds = {"rollout": 0.0, "learning": 0.0}

    @property
    def _on_gpu(self) -> bool:
        return self.device.startswith("cuda")

    @allow_rounded_products(True)
    def step(self) -> dict[str, float]:
        """Run one iteration; return losses, the finished episodes' means, ``rollout_s`` and
        ``learning_s`` [s].
        """
        start = time.perf_counter()
        done = min(self.iteration / self.algorithm.iterations, 1.0)
        self.algorithm.collect(done)
        if self._on_gpu:
            torch.cuda.synchronize()
        middle = time.perf_counter()
        figures = self.algorithm.learn(done)
        self._check_losses(figures)
        rollout = middle - start
        learning = time.perf_counter() - middle
        self.seconds["rollout"] += rollout
        self.seconds["learning"] += learning
        self.iteration += 1
        return figures | {
            "rollout_s": rollout,
            "learning_s": learning,
            "iteration": self.iteration,
        }

    def _check_losses(self, figures: dict[str, float]) -> None:
        """Raise TrainError if a loss or spread is not finite in any process."""
        broken = [
            f"{name} {figures[name]}"
            for name in FINITE & figures.keys()
            if not math.isfinite(figures[name])
        ]
        if self.ranks.agree(int(bool(broken))):
            what = ", ".join(sorted(broken)) or "a loss of another process"
            raise TrainError(
                f"iteration {self.iteration + 1}: {what} is not finite, expected finite numbers;"
                " is task.reward.scale or a learning rate too large? The last checkpoint is of an"
                " earlier iteration"
            )

    def throw(
        self,
        target: float,
        count: int = EVALUATED,
        experiment: Experiment | None = None,
    ) -> Throws:
        """Throw from hover with the current policy; see :mod:`visthrow.training.protocol`.

        Args:
            target: distance along x [m].
            count: number of throws.
            experiment: conditions of the throws; default those of the training.
        """
        policy = self.algorithm.export(contract_of(self.experiment), {}).to(self.device)
        conditions = experiment or self.experiment
        return protocol.throw(
            conditions, policy.actor(count), target, count, self.device, EVALUATION_SEED
        )

    def final_throws(self) -> dict[str, list[Throws]]:
        """Throw :data:`FINAL` times :data:`EVALUATED` at each target; return the throws by
        conditions.

        ``flown``: the conditions of ``visthrow compare``. ``trained``: the conditions of the
        training with its faults, if these differ.
        """
        conditions = {"flown": as_flown(self.experiment)}
        if self.experiment.flown:
            conditions["trained"] = self.experiment
        return {
            name: [self.throw(target, FINAL * EVALUATED, experiment=e) for target in TARGETS]
            for name, e in conditions.items()
        }

    def save(self, path: Path) -> None:
        """Write a checkpoint with the complete state of all processes, so that a resumed run
        continues as if it had not stopped. The file is written whole or not at all.
        """
        state = {
            "algorithm": self.algorithm.state_dict(),
            "rng": torch.get_rng_state(),
            "cuda_rng": torch.cuda.get_rng_state(self.device) if self._on_gpu else None,
        }
        ranks = self.ranks.gather(state)
        if not self.ranks.lead:
            return
        content = {
            "ranks": ranks,
            "iteration": self.iteration,
            "seed": self.seed,
            "config": config.dumps(self.experiment),
        }
        buffer = io.BytesIO()
        torch.save(content, buffer)
        atomic_write(path, buffer.getvalue())

    def load(self, path: Path) -> None:
        """Restore this process's part of a checkpoint. A process without a part starts new
        episodes with a new seed.

        Raises CheckpointError: the file cannot be read, or its configuration or seed differs.
        """
        try:
            saved = torch.load(path, map_location=self.device, weights_only=True)
        except Exception as error:
            raise CheckpointError(f"{path}: not a readable checkpoint ({error})") from error
        written = saved["config"] + f"seed = {saved['seed']}\n"
        expected = config.dumps(self.experiment) + f"seed = {self.seed}\n"
        if written != expected:
            differ = sorted(set(written.splitlines()) ^ set(expected.splitlines()))
            raise CheckpointError(
                f"{path}: written by a run of another configuration or seed, or by another version"
                f" of visthrow; lines that differ: {'; '.join(differ)}"
            )
        self.iteration = saved["iteration"]
        rank = self.ranks.rank
        has_state = rank < len(saved["ranks"])
        state = saved["ranks"][rank if has_state else 0]
        self.algorithm.load_state_dict(state["algorithm"], keep_throws=has_state)
        if not has_state:  # it would collect the same data as the process whose state it has
            torch.manual_seed((self.seed * 1000 + rank) * 100_003 + self.iteration)
            return
        torch.set_rng_state(state["rng"].cpu())
        if state["cuda_rng"] is not None and self._on_gpu:
            torch.cuda.set_rng_state(state["cuda_rng"].cpu(), self.device)


def finish(trainer: Trainer, folder: Path, figures: dict, finished: bool = True) -> Policy:
    """Write the policy and its figures into the run's folder: as a summary if the run finished,
    otherwise as an evaluation.
    """
    made_by = provenance.collect() | {
        "seed": trainer.seed,
        "config": config.to_dict(
            trainer.experiment, defaults=False
        ),  # readable after a change of the fields
        "figures": figures,
    }
    policy = trainer.algorithm.export(contract_of(trainer.experiment), made_by)
    policy.save(folder / POLICY)
    write_json(
        folder / (SUMMARY if finished else EVALUATION),
        {k: v for k, v in made_by.items() if k != "config"},
    )
    if finished:
        (folder / EVALUATION).unlink(missing_ok=True)
    return policy
