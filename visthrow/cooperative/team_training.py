"""Train a team's policy by rsl_rl's PPO, and throw with it."""

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from visthrow.common.compute_device import allow_rounded_products
from visthrow.cooperative.team import TeamExperiment, as_flown, team_contract
from visthrow.cooperative.team_env import TeamEnv
from visthrow.onboard import actions as act
from visthrow.onboard.policy import Policy
from visthrow.training.ppo.ppo_training import PPOTraining
from visthrow.training.ranks import Ranks

ASKING = 1.0
"""Mean of the untrained policy's release output; with a lower one it would be unlikely that all
members request a release in the same step.
"""


class TeamTraining(PPOTraining):
    """PPO on :class:`TeamEnv`."""

    def __init__(self, experiment: TeamExperiment, device: str, seed: int, eager: bool = False):
        """Build environment and networks; ``eager``: do not capture rollouts in a CUDA graph."""
        torch.manual_seed(seed)
        if device.startswith("cuda"):
            torch.cuda.set_device(device)
        super().__init__(experiment, device, seed, Ranks(device), TeamEnv)
        with torch.no_grad():
            self.alg.actor.mlp[-1].bias[act.COMMANDS :: act.ACTIONS] += ASKING
        self._eager = eager

    def rollout(self) -> None:
        if self._eager:
            self._rollout()
        else:
            super().rollout()

    def collect(self, done: float) -> None:
        team = self.experiment.team
        begin, end = team.free
        share = min(max((end - done) / (end - begin), 0.0), 1.0)
        self.env.earliest.fill_(round(share * team.first_release))
        super().collect(done)

    def policy(self, made_by: dict[str, Any]) -> Policy:
        """Return the current policy."""
        return self.export(team_contract(self.experiment), made_by)

    def run(self, seconds: float, iterations: int | None = None) -> Iterator[dict[str, float]]:
        """Train for a time [s] or a number of iterations; yield the figures of each iteration.

        Without a number of iterations, schedules follow the time.
        """
        start = time.perf_counter()
        count = 0
        done = 0.0
        while done < 1.0:
            with allow_rounded_products(True):
                self.collect(done)
                figures = self.learn(done)
            count += 1
            spent = time.perf_counter() - start
            done = count / iterations if iterations else min(spent / seconds, 1.0)
            yield figures | {"iteration": count, "seconds": spent}


@torch.inference_mode()
def fly(
    experiment: TeamExperiment,
    policy: Callable[[Tensor], Tensor],
    *,
    fault: str = "none",
    target: float = 2.0,
    count: int = 200,
    device: str = "cpu",
    seed: int = 12345,
    build: Any = None,
    record: Callable[[TeamEnv], None] | None = None,
) -> dict[str, np.ndarray]:
    """Throw ``count`` times from hover at a target [m] along x, with all noise, as one batch.

    Returns the values of :attr:`TeamEnv.last` at the end of each throw; a throw without an end is
    not released.

    Args:
        experiment, fault: conditions; see :func:`visthrow.cooperative.team.as_flown`.
        policy: function of observations (E, D) -> actions (E, 5).
        target: distance [m]. count: number of throws. device: "cpu" or "cuda:0".
        seed: seed of initial states and noise.
        build: another solver of the bodies.
        record: called with the environment before each step.
    """
    devices = [device] if device.startswith("cuda") else []
    with torch.random.fork_rng(devices=devices):
        torch.manual_seed(seed)
        rows = count * experiment.team.vehicles
        env = TeamEnv(as_flown(experiment, fault), device, seed, rows, build)
        env.fix_goal(torch.tensor([target, 0.0, 0.0], device=device))
        observations = env.reset()
        results: dict[str, Tensor] = {}
        waiting = torch.ones(count, dtype=torch.bool, device=device)
        for _ in range(env.max_episode_length + 1):
            if record is not None:
                record(env)
            observations, _, _, _ = env.step(policy(observations["actor"]))
            ended = waiting & (env.last["released"] | env.last["negative"])
            for name, value in env.last.items():
                mask = ended.view(-1, *(1,) * (value.dim() - 1))
                results[name] = torch.where(mask, value, results.get(name, torch.zeros_like(value)))
            waiting &= ~ended
            if not bool(waiting.any()):
                break
    return {name: value.cpu().numpy() for name, value in results.items()}


def throw(experiment: TeamExperiment, *args: Any, **options: Any) -> dict[str, Any]:
    """Throw and return the figures; arguments: see :func:`fly`.

    ``landed`` and ``contact`` are shares of the throws. Errors [m], their bias [m], ``duration``
    [s] and ``apart`` [s] refer to throws that landed without contact. The flying load touches a
    vehicle if their distance is less than the sum of both radii.
    """
    radii = experiment.rope.payload_radius + experiment.vehicle.collision_radius
    target = options.get("target", 2.0)
    conditions = {name: options[name] for name in ("fault", "seed") if name in options}
    values = fly(experiment, *args, **options)
    return {**conditions, "target": target, **_summary(values, target, radii)}


def _summary(values: dict[str, np.ndarray], target: float, radii: float) -> dict[str, Any]:
    """Return the figures of throws from their results."""
    released = values["released"]
    touched = values["contact"] | (released & (values["clearance"] < radii))
    good = released & ~touched
    result: dict[str, Any] = {"throws": len(good)}
    result |= {"landed": float(released.mean()), "contact": float(touched.mean())}
    if not good.any():
        return result
    error = values["landing_error"][good]
    bias = values["landing_w"][good, :2].mean(0) - [target, 0.0]
    result["error_mean"] = float(error.mean())
    result["error_median"] = float(np.median(error))
    result["error_p95"] = float(np.quantile(error, 0.95))
    for name in ("duration", "apart"):
        result[f"{name}_mean"] = float(values[name][good].mean())
    result["bias"] = bias.tolist()
    return result
