"""The interface of the training algorithms."""

from abc import ABC, abstractmethod
from typing import Any

from torch.optim.swa_utils import AveragedModel

from visthrow.onboard.policy import Policy
from visthrow.task import Experiment
from visthrow.training.env import ThrowEnv
from visthrow.training.ppo.network import Network


class Algorithm(ABC):
    """A training algorithm, which a trainer runs iteration by iteration.

    Its constructor takes experiment, device, seed and ranks. It builds the environment, with this
    seed, and the networks, and raises ConfigError for an experiment that the algorithm does not
    support. The caller seeds torch's generators."""

    experiment: Experiment
    env: ThrowEnv  # the training environment
    iterations: int  # number of iterations in a whole training
    samples: int  # environment steps in an iteration, over all ranks
    network: Network  # the actor
    average: AveragedModel  # mean of the actor's last weights, which is exported
    # attributes that, with the environment, hold the state on which the next iteration depends
    parts: tuple[str, ...]

    @abstractmethod
    def collect(self, done: float) -> None:
        """Fly one batch; ``done``: finished share of the training, 0 to 1, for schedules."""

    @abstractmethod
    def learn(self, done: float) -> dict[str, float]:
        """Learn from the last batch; return figures for the log, some of
        :data:`visthrow.training.progress.COLUMNS`.

        These always include the finished episodes' :meth:`ThrowEnv.episode_means`.
        """

    def export(self, contract: dict, made_by: dict) -> Policy:
        """Return the policy as a file's content."""
        state = self.average.module.state_dict()
        return Policy.from_actor_state(state, self.experiment.ppo.activation, contract, made_by)

    def take_up(self, policy: Policy) -> None:
        """Start from a policy that passed :func:`visthrow.training.trainer.adopt_layers`: load its
        weights, and its normaliser, which hardly changes afterwards.
        """
        for network in (self.network, self.average.module):
            network.take_up(policy)

    def state_dict(self) -> dict[str, Any]:
        """Return all state that the next iteration depends on, except torch's generators."""
        return {name: getattr(self, name).state_dict() for name in (*self.parts, "env")}

    def load_state_dict(self, saved: dict[str, Any], keep_throws: bool = True) -> None:
        """Restore a state of :meth:`state_dict` to the bit. Without ``keep_throws`` the episodes
        restart.
        """
        for name in (*self.parts, *["env"] * keep_throws):
            getattr(self, name).load_state_dict(saved[name])
