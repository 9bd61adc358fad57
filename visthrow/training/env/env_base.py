"""ThrowEpisodes: the common base of the environments of one vehicle and of a team."""

from typing import ClassVar

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from camera import arrays
from sim.params import GRAVITY
from sim.torch_bridge import TorchViews
from visthrow.onboard import actions as act
from visthrow.onboard import observations as ob
from visthrow.task import Experiment, plant_of, rewards


class ThrowEpisodes(VecEnv):
    """Episodes of a batch of vehicles: commands with noise, rewards while carrying, and statistics
    of finished episodes.

    A subclass sets ``cfg``, ``views`` and ``layout``.
    """

    cfg: Experiment
    views: TorchViews
    layout: ob.Layout
    results: ClassVar = {
        "released": "episodes",
        "landing_error": "released",
        "duration": "released",
    }
    """Sum over finished episodes (errors [m], durations [s]) -> count for its mean."""

    def _allocate(self, like: Tensor) -> None:
        """Allocate weights, limits and the buffers of an episode that are not in the simulator;
        ``like``: a tensor with one number for each vehicle.
        """
        task = self.cfg.task
        rows = len(like)
        self.max_thrust: float | Tensor = task.action.max_thrust
        hover = act.hover_action(GRAVITY * plant_of(self.cfg).total_mass, task.action.max_thrust)
        self.start_action = like.new_tensor(hover)
        self.max_rate = like.new_tensor(task.action.max_rate)
        self.rate_weights = like.new_tensor(task.reward.rate_command)
        self.change_weights = like.new_tensor(task.reward.command_change)
        self.episode_length_buf = like.new_zeros(rows, dtype=torch.long)
        self.buffers = {
            "previous": like.new_zeros(rows, act.ACTIONS),
            "history": like.new_zeros(rows, 1 + self.layout.history, self.layout.payload),
            "true_history": like.new_zeros(rows, 1 + self.layout.history, 3),
            "frame_bias": like.new_zeros(rows, ob.VEHICLE + 5),
            "command_bias": like.new_zeros(rows, act.COMMANDS),
            "totals": like.new_zeros(1 + len(self.results), dtype=torch.float64),
        }
        self.last: dict[str, Tensor] = {}
        self._goal: Tensor | None = None

    @property
    def previous_action(self) -> Tensor:
        """Return the clipped action of the last step, shape (E, 5)."""
        return self.buffers["previous"]

    def fix_goal(self, goal_w: Tensor) -> None:
        """Use one goal [m], shape (3,), for all episodes from the next reset on."""
        self._goal = goal_w

    def clear_totals(self) -> None:
        """Reset the sums over finished episodes to zero."""
        self.buffers["totals"].zero_()

    def episode_means(self) -> dict[str, float]:
        """Return means over the episodes finished since :meth:`clear_totals`, and their number."""
        names = ("episodes", *self.results)
        totals = dict(zip(names, self.buffers["totals"].tolist(), strict=True))
        means = {name: totals[name] / max(totals[of], 1.0) for name, of in self.results.items()}
        return means | {"episodes": totals["episodes"]}

    def get_observations(self) -> TensorDict:
        """Return a copy of the current observations."""
        return self._observations.clone()

    def _command(self, actions: Tensor) -> Tensor:
        """Set the commands from unclipped actions, with noise; return the clipped actions."""
        action = act.clip_action(actions)
        bias = self.buffers["command_bias"]
        noise = torch.randn_like(bias) * self.cfg.task.noise.command_step
        noisy = action[:, : act.COMMANDS] + noise + bias
        command = act.command_from_action(noisy, self.max_thrust, self.max_rate)
        self.views.command.copy_(command)
        return action

    def _count(self, done: Tensor, *more: Tensor) -> None:
        """Add the episodes that ended in the last step to the sums; ``more``: terms of the sums
        that a subclass has in addition.
        """
        hit = self.last["released"].float()
        parts = [done.float(), hit, self.last["landing_error"] * hit, self.last["duration"] * hit]
        self.buffers["totals"] += torch.stack([*parts, *more]).sum(-1, dtype=torch.float64)

    def _carry_reward(self, action: Tensor, payload_vel_w: Tensor) -> Tensor:
        """Return the reward of a step with the payload attached, shape (E,)."""
        p = self.cfg.task.reward
        state = self.views.state
        reward = rewards.kinetic(p, state["vel_w"], state["rate_b"], payload_vel_w)
        reward = reward + rewards.command(p, action, self.rate_weights)
        return reward + rewards.change(p, action, self.previous_action, self.change_weights)

    def _restart(self, fresh: Tensor) -> None:
        """Restart the episodes where ``fresh``, bool, shape (E,), and draw their biases."""
        noise = self.cfg.task.noise
        self.episode_length_buf.masked_fill_(fresh, 0)
        previous = self.previous_action
        torch.where(fresh[:, None], self.start_action, previous, out=previous)
        spreads = {"frame_bias": noise.observation_bias, "command_bias": noise.command_bias}
        arrays.redraw(self.buffers, spreads, fresh)

    def _state_frame(self, pose: Tensor, goal_w: Tensor) -> Tensor:
        """Return the state frame of a pose sample and a goal, shape (E, 20)."""
        offset = ob.state_part(pose[:, :3], goal_w, pose[:, ob.VEHICLE :])
        return torch.cat([pose[:, : ob.VEHICLE], offset], dim=-1)

    def _measure(self, frame: Tensor) -> Tensor:
        """Return a state frame with the noise of a step and the episode's biases added."""
        noise = torch.randn_like(frame) * self.cfg.task.noise.observation_step
        return frame + noise + self.buffers["frame_bias"]
