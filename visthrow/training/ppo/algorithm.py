"""What every training algorithm is to the trainer that drives it."""

from abc import ABC, abstractmethod
from typing import Any

from torch.optim.swa_utils import AveragedModel

from visthrow.onboard.policy import Policy
from visthrow.task import Experiment
from visthrow.training.env import ThrowEnv
from visthrow.training.ppo.network import Network


class Algorithm(ABC):
    """A training algorithm, driven an iteration at a time.

    Its constructor takes experiment, device, seed and ranks, builds environment, of this seed, and
    networks, and raises ConfigError for what it cannot train. torch's generators are the caller's
    to seed."""

    experiment: Experiment
    env: ThrowEnv  # that it learns in
    iterations: int  # of a whole training
    samples: int  # environment steps an iteration, over all ranks
    network: Network  # the actor, and the mean of its last weights, which is exported
    average: AveragedModel
    # attributes whose state the next iteration depends on, besides the environment's
    parts: tuple[str, ...]

    @abstractmethod
    def collect(self, done: float) -> None:
        """Fly one batch; ``done``: share of the whole training that lies behind, 0 to 1, for
        schedules.
        """

    @abstractmethod
    def learn(self, done: float) -> dict[str, float]:
        """Learn from the last batch; returns figures for the log, of
        :data:`visthrow.training.progress.COLUMNS` those that there are.

        Always there are the finished episodes' :meth:`ThrowEnv.episode_means`.
        """

    def export(self, contract: dict, made_by: dict) -> Policy:
        """Return the policy as a file's content."""
        state = self.average.module.state_dict()
        return Policy.from_actor_state(state, self.experiment.ppo.activation, contract, made_by)

    def take_up(self, policy: Policy) -> None:
        """Start from a policy that :func:`visthrow.training.trainer.adopt_layers` found to fit: its
        weights, and its normaliser, which hardly moves from there.
        """
        for network in (self.network, self.average.module):
            network.take_up(policy)

    def state_dict(self) -> dict[str, Any]:
        """Tensors and numbers that the next iteration depends on, besides torch's generators."""
        return {name: getattr(self, name).state_dict() for name in (*self.parts, "env")}

    def load_state_dict(self, saved: dict[str, Any], keep_throws: bool = True) -> None:
        """Restore a state of :meth:`state_dict`, bit for bit. Without ``keep_throws`` episodes
        start anew.
        """
        for name in (*self.parts, *["env"] * keep_throws):
            getattr(self, name).load_state_dict(saved[name])
