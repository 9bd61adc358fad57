"""The paper's measurement: throws from hover at targets ahead, scored by where and when the payload lands.

Landing error is the horizontal distance of the landing point from the goal, duration the time from the policy's start to
the landing (Sec. IV-A). A throw succeeds when the payload was released and landed; one that ends otherwise has no
landing error and counts against the success rate.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from tensordict import TensorDict

from sim.params import RandomizationParams
from visthrow import config
from visthrow.task import Experiment
from visthrow.training.env import ThrowEnv

TARGETS = (1.5, 2.0, 2.5)
"""Targets along x [m]; the last lies outside the training distribution."""

LANDED = 0.95
"""Share of throws that must land before their mean error says anything of a policy."""


@dataclass(frozen=True)
class Throws:
    """Results of N throws at one target; entries of failed throws are NaN.

    Attributes:
        target: [m] along x.
        success: shape (N,), bool.
        landing_w: [m], shape (N, 2). error: [m], shape (N,). duration: [s], shape (N,). clearance: [m], shape (N,).
        smoothness: root mean square change of the normalised commands from step to step, shape (N,).
        goal_w: where a moving goal is at impact [m], shape (N, 2); None where goals stand still.
    """

    target: float
    success: np.ndarray
    landing_w: np.ndarray
    error: np.ndarray
    duration: np.ndarray
    clearance: np.ndarray
    smoothness: np.ndarray
    goal_w: np.ndarray | None = None

    def within(self, error: float) -> bool:
        """Whether they land so near on average [m], and all but one in twenty land."""
        return bool(self.success.mean() >= LANDED) and float(self.error[self.success].mean()) <= error

    def summary(self) -> dict[str, float]:
        """Mean and deviation of the successful throws, with the success rate."""
        if not self.success.any():
            return {"target": self.target, "throws": len(self.success), "success": 0.0}
        good = self.success
        goal = np.array([[self.target, 0.0]]) if self.goal_w is None else self.goal_w[good]
        bias = (self.landing_w[good] - goal).mean(axis=0)
        return {
            "target": self.target,
            "throws": len(good),
            "success": float(good.mean()),
            "error_mean": float(self.error[good].mean()),
            "error_std": float(self.error[good].std()),
            "duration_mean": float(self.duration[good].mean()),
            "duration_std": float(self.duration[good].std()),
            "bias_x": float(bias[0]),
            "bias_y": float(bias[1]),
            "clearance_min": float(self.clearance[good].min()),
            "smoothness": float(self.smoothness[good].mean()),
        }


def hover_start(experiment: Experiment) -> Experiment:
    """The experiment with its episodes started from hover; cables and payloads vary as in the experiment."""
    start = config.load(RandomizationParams, config.find("start", "hover"))
    kept = ("tether_variants", "tether_spread", "payload_variants", "payload_spread", "drag_spread")
    start = dataclasses.replace(start, **{name: getattr(experiment.task.start, name) for name in kept})
    return dataclasses.replace(experiment, task=dataclasses.replace(experiment.task, start=start))


def throw(
    experiment: Experiment, policy, target: float, count: int, device: str = "cpu", seed: int = 0,
    build: Callable[..., ThrowEnv] = ThrowEnv, begin: Callable[[ThrowEnv], TensorDict] = ThrowEnv.reset,
) -> Throws:  # fmt: skip
    """Throw ``count`` times in the training simulator, with all its noise.

    Args:
        experiment: plant, camera, task; its start is replaced by :func:`hover_start`.
        policy: function of observations (E, D) -> actions (E, 5).
        target: [m] along x.
        count: throws, flown as one batch.
        device: of the simulator and the policy.
        seed: of starts and noise; torch's generators are put back afterwards.
        build: makes the environment, as the class does.
        begin: brings it to where the throws begin and returns what is observed there.
    """
    devices = [device] if device.startswith("cuda") else []
    with torch.random.fork_rng(devices=devices), torch.inference_mode():
        torch.manual_seed(seed)
        env = build(hover_start(experiment), device, seed, count)
        env.fix_goal(torch.tensor([target, 0.0, 0.0], device=device))
        return _fly(env, policy, target, count, begin)


def _fly(env: ThrowEnv, policy, target: float, count: int, begin: Callable[[ThrowEnv], TensorDict]) -> Throws:
    observations = begin(env)
    open_ = torch.ones(count, dtype=torch.bool, device=env.device)
    kept: dict[str, torch.Tensor] = {}
    previous = env.previous_action.clone()
    change = torch.zeros(count, device=env.device)
    steps = torch.zeros(count, device=env.device)
    for _ in range(env.max_episode_length + 1):
        observations, _, done, _ = env.step(policy(observations["actor"]))
        action = env.last["action"][:, :4]
        change += open_ * (action - previous[:, :4]).square().mean(-1)
        steps += open_
        previous = env.last["action"]
        ended = open_ & (done > 0)
        for name, value in env.last.items():
            if name not in kept:
                kept[name] = torch.zeros_like(value)
            mask = ended.view(-1, *(1,) * (value.dim() - 1))
            kept[name] = torch.where(mask, value, kept[name])
        open_ &= ~ended
        if not bool(open_.any()):  # most throws take a fifth of the time limit
            break
    success = (kept["released"] & ~open_).cpu().numpy()
    blank = np.where(success, 1.0, np.nan)
    array = {k: v.cpu().numpy().astype(np.float64) for k, v in kept.items()}
    smoothness = (change / steps.clamp(min=1)).sqrt().cpu().numpy().astype(np.float64)
    return Throws(
        target,
        success,
        array["landing_w"][:, :2] * blank[:, None],
        array["landing_error"] * blank,
        array["duration"] * blank,
        array["clearance"] * blank,
        smoothness * blank,
        array["goal_w"][:, :2] * blank[:, None] if "goal_w" in array else None,
    )
