"""The throwing task as Gymnasium environments: one throw, or a batch of throws.

Both wrap :class:`visthrow.training.env.ThrowEnv`, with the actor's observations and the rewards of
training. An episode ends with its release or a failure, never by truncation.
"""

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy import ndarray

from visthrow.onboard import actions as act
from visthrow.task import load_experiment
from visthrow.training.env import ThrowEnv


class ThrowVectorEnv(VectorEnv):
    """A batch of throws as a Gymnasium vector environment.

    A finished episode restarts within the same step. ``infos["final_info"]`` then holds the landing
    error [m], the duration [s] and whether the payload was released, each of shape (E,).
    """

    def __init__(
        self,
        name: str = "state",
        count: int = 64,
        device: str = "cpu",
        seed: int = 0,
        overrides: tuple[str, ...] = (),
    ):
        """Build the simulator.

        Args:
            name, overrides: configuration; see :func:`visthrow.task.load_experiment`.
            count: number of throws E.
            device: "cpu" or "cuda:0".
            seed: seed of all random draws; ``reset(seed=...)`` replaces it.
        """
        self._experiment = load_experiment(name, overrides)
        self._device = device
        self.num_envs = count
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
        self._build(seed)
        width = self._env.get_observations()["actor"].shape[1]
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (width,), np.float32)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (act.ACTIONS,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, count)
        self.action_space = batch_space(self.single_action_space, count)

    def _build(self, seed: int) -> None:
        torch.manual_seed(seed)
        self._env = ThrowEnv(self._experiment, self._device, seed, self.num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ndarray, dict[str, Any]]:
        """Start all throws, reproducibly if a seed is given."""
        super().reset(seed=seed)
        if seed is not None:
            self._build(seed)
        return self._numpy(self._env.reset()["actor"]), {}

    def step(self, actions: ndarray) -> tuple[ndarray, ndarray, ndarray, ndarray, dict[str, Any]]:
        """Fly one control period with normalised actions, shape (E, 5)."""
        flown = torch.as_tensor(np.asarray(actions, np.float32), device=self._device)
        observations, rewards, dones, _ = self._env.step(flown)
        terminated = self._numpy(dones) > 0.5
        infos: dict[str, Any] = {}
        if terminated.any():
            names = ("released", "landing_error", "duration")
            ended = {key: self._numpy(self._env.last[key]) for key in names}
            infos = {"final_info": ended, "_final_info": terminated}
        truncated = np.zeros(self.num_envs, bool)
        actor = self._numpy(observations["actor"])
        return actor, self._numpy(rewards), terminated, truncated, infos

    @staticmethod
    def _numpy(values: torch.Tensor) -> ndarray:
        return values.detach().cpu().numpy().copy()


class SingleThrowEnv(gymnasium.Env):
    """One throw as a Gymnasium environment."""

    metadata = {"render_modes": []}  # noqa: RUF012  Gymnasium reads a class attribute

    def __init__(self, name: str = "state", device: str = "cpu", overrides: tuple[str, ...] = ()):
        """Build the simulator for one throw; arguments: see :class:`ThrowVectorEnv`."""
        self._batch = ThrowVectorEnv(name, 1, device, 0, overrides)
        self.observation_space = self._batch.single_observation_space
        self.action_space = self._batch.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ndarray, dict[str, Any]]:
        """Start a throw, reproducibly if a seed is given."""
        super().reset(seed=seed)
        observations, infos = self._batch.reset(seed=seed)
        return observations[0], infos

    def step(self, action: ndarray) -> tuple[ndarray, float, bool, bool, dict[str, Any]]:
        """Fly one control period with a normalised action, shape (5,)."""
        observations, rewards, terminated, truncated, infos = self._batch.step(action[None])
        ended = {key: values[0] for key, values in infos.get("final_info", {}).items()}
        return observations[0], float(rewards[0]), bool(terminated[0]), bool(truncated[0]), ended
