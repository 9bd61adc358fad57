"""Start throws in the training simulator with a camera calibration in hover, as the runner does.

The simulator's random draws for each vehicle and its camera are the same in the hover and in the
throw. The calibration uses the actor's measurements with their noise and the exact position of the
goal, which motion capture knows."""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from camera.keypoints import KEYPOINTS
from sim.cores import cores
from visthrow.common.errors import ConfigError
from visthrow.common.workers import run_tasks
from visthrow.onboard import actions as act
from visthrow.onboard import observations as ob
from visthrow.onboard.calibration import HOVER, SWAY, Calibration, Hovered, sway, try_calibration
from visthrow.onboard.hover import HoverController, HoverParams
from visthrow.task import Experiment, contract_of, plant_of

if TYPE_CHECKING:
    from tensordict import TensorDict

    from visthrow.training.env import ThrowEnv

SETTLE = 3.0  # time after the sway [s]; about 10 deg of its swing remain
# calibrations of half a second each that are finished before other processes would have started
TOO_FEW = 8


def start_calibrated(
    experiment: Experiment, records: list[Calibration | None] | None = None
) -> "Callable[[ThrowEnv], TensorDict]":
    """Return a function that calibrates in hover, the ``begin`` of
    :func:`visthrow.training.protocol.throw`.

    ``records`` receives the calibration of each throw, or None if the calibration failed; then the
    keypoints are not corrected. Raises ConfigError: the layout is not vision, or goals move."""
    observation = experiment.task.observation
    if observation.layout != "vision" or experiment.task.target.moves:
        raise ConfigError(
            f"calibration in hover: layout {observation.layout!r}; expected 'vision' and goals that"
            " do not move"
        )

    def begin(env: "ThrowEnv") -> "TensorDict":
        estimates = _calibrations(experiment, _hover(env))
        if records is not None:
            records[:] = estimates
        turns = [c.turn_b if c else (0.0, 0.0, 0.0) for c in estimates]
        scales = [c.scale if c else 0.0 for c in estimates]
        turn, scale = (torch.tensor(values, device=env.device) for values in (turns, scales))
        return env.begin_throws((turn, scale))

    return begin


def _hover(env: "ThrowEnv") -> list[Hovered]:
    """Hover, sway and settle; return each vehicle's measurements up to the end of the sway."""
    cfg = env.cfg
    period = env.cfg.sim.control_period
    steps = round((HOVER + SWAY) / period)
    last = round((HOVER + SWAY + SETTLE) / period)
    controller = HoverController(HoverParams(), period, env.num_envs)
    rate = torch.tensor(cfg.task.action.max_rate)
    env.reset()
    home = env.views.state["pos_w"].cpu().numpy().copy()
    rows = []
    mass = plant_of(cfg).total_mass
    for k in range(last):
        measured = _measure(env)
        command = controller.step(*measured[:3], home, mass)
        since = k * period - HOVER
        if 0.0 <= since < SWAY:
            command[:, 1:3] += sway(since)
        if k < steps:
            time = np.full(env.num_envs, k * period)
            rows.append((time, *measured[:4], command[:, 0], *measured[4:]))
        sent = torch.from_numpy(command).float()
        action = act.action_from_command(sent, cfg.task.action.max_thrust, rate)
        env.episode_length_buf.zero_()  # a hover has no time limit
        latch = -torch.ones(env.num_envs, 1)
        env.carry(torch.cat([action, latch], -1).to(env.device))
    columns = [np.stack(column, 1) for column in zip(*rows)]
    columns.append(env.views.goal_w.cpu().numpy())
    return [Hovered(*(column[i] for column in columns)) for i in range(env.num_envs)]


def _measure(env: "ThrowEnv") -> tuple[np.ndarray, ...]:
    """Return this step's measured position, attitude xyzw, velocity, body rates, keypoints
    (E, 8, 2) and validity (E, 8).
    """
    frame, valid = (part.cpu() for part in env.measured)
    vehicle = frame[:, : ob.VEHICLE].double().numpy()
    measured = ob.rotation_in(frame.double()).numpy()
    quat = Rotation.from_matrix(measured).as_quat()  # the nearest rotation
    points = frame[:, ob.VEHICLE :].unflatten(1, (KEYPOINTS, 2)).double().numpy()
    return vehicle[:, :3], quat, vehicle[:, 3:6], vehicle[:, 6:9], points, valid.numpy()


def _calibrations(experiment: Experiment, hovered: list[Hovered]) -> list[Calibration | None]:
    """Return the calibration of each hover; None where its data did not suffice."""
    solve = partial(try_calibration, camera=experiment.camera, contract=contract_of(experiment))
    processes = cores() if len(hovered) > TOO_FEW else 1
    estimates = dict(run_tasks(solve, hovered, processes, "calibrations"))
    ordered = [estimates[place] for place in range(len(hovered))]
    return [None if isinstance(one, str) else one for one in ordered]
