"""Make the paper's measurement in the training simulator: throws from hover, scored by
:mod:`visthrow.task.measurement`.
"""

from collections.abc import Callable

import numpy as np
import torch
from tensordict import TensorDict

from visthrow.task import Experiment
from visthrow.task.measurement import Throws, hover_start
from visthrow.training.env import ThrowEnv


def throw(
    experiment: Experiment,
    policy,
    target: float,
    count: int,
    device: str,
    seed: int,
    build: Callable[..., ThrowEnv] = ThrowEnv,
    begin: Callable[[ThrowEnv], TensorDict] = ThrowEnv.reset,
) -> Throws:
    """Throw ``count`` times in the training simulator, with all its noise, as one batch.

    Args:
        experiment: its start is replaced by :func:`~visthrow.task.measurement.hover_start`.
        policy: function of observations (E, D) -> actions (E, 5), on the device.
        target: distance along x [m].
        count: number of throws.
        device: "cpu" or "cuda:0".
        seed: seed of starts and noise; torch's generators are restored afterwards.
        build: builds the environment, with the class's arguments.
        begin: brings the environment to the start of the throws; returns the observations there.
    """
    devices = [device] if device.startswith("cuda") else []
    with torch.random.fork_rng(devices=devices), torch.inference_mode():
        torch.manual_seed(seed)
        env = build(hover_start(experiment), device, seed, count)
        env.fix_goal(torch.tensor([target, 0.0, 0.0], device=device))
        return _fly(env, policy, target, count, begin)


def _fly(
    env: ThrowEnv, policy, target: float, count: int, begin: Callable[[ThrowEnv], TensorDict]
) -> Throws:
    observations = begin(env)
    previous = env.previous_action.clone()
    open_ = torch.ones(count, dtype=torch.bool, device=env.device)
    results: dict[str, torch.Tensor] = {}
    change, steps = torch.zeros(2, count, device=env.device)
    for _ in range(env.max_episode_length + 1):
        observations, _, done, _ = env.step(policy(observations["actor"]))
        action = env.last["action"]
        change += open_ * (action - previous)[:, :4].square().mean(-1)
        steps += open_
        previous = action
        ended = open_ & (done > 0)
        for name, value in env.last.items():
            trailing = (1,) * (value.dim() - 1)
            mask = ended.view(-1, *trailing)
            results[name] = torch.where(mask, value, results.get(name, value))
        open_ &= ~ended
        if not bool(open_.any()):  # most throws take a fifth of the time limit
            break
    results["smoothness"] = (change / steps.clamp(min=1)).sqrt()
    landed = results["released"] & ~open_
    success = landed.cpu().numpy()

    measured = {}
    for name, tensor in results.items():
        measured[name] = tensor.double().cpu().numpy()
        measured[name][~success] = np.nan
    return Throws(
        target,
        success,
        measured["landing_w"][:, :2],
        measured["landing_error"],
        measured["duration"],
        measured["clearance"],
        measured["smoothness"],
        measured["goal_w"][:, :2] if "goal_w" in measured else None,
    )
