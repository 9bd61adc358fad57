"""The policy in flight: from poses of vehicle, payload and goal to a command. Onboard-safe.

The same functions of :mod:`visthrow.onboard.observations` and :mod:`visthrow.onboard.actions` that
the training environment calls, with a batch of one on board; only the noise is missing."""

import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

from camera.history import push
from camera.keypoints import KeypointCamera
from camera.keypoints import keypoints as seen_keypoints
from camera.params import CameraParams
from visthrow import config
from visthrow.common.errors import PolicyError
from visthrow.common.free_fall import GRAVITY
from visthrow.onboard import actions as act
from visthrow.onboard import goal_motion
from visthrow.onboard import observations as ob
from visthrow.onboard.compiled import Compiled
from visthrow.onboard.policy import Policy

VIEWS = {
    "pos_w": 3,
    "quat_wb": 4,
    "vel_w": 3,
    "rate_b": 3,
    "payload_w": 3,
    "goal_w": 3,
    "attached": 1,
}
"""What one step is shown, and the width of each: the columns of one array."""

SHARED = ("goal_w", "attached")
"""Of these one may serve all."""

JITTER = 2e-3
"""By which steps may be off their times without being counted as late [s]: the payload moves some
millimetres in it.
"""


@dataclass(frozen=True)
class PilotOutput:
    """The decision and the observation of one control step. NumPy, shape (E, ...)."""

    action: ndarray  # normalised, clipped, shape (E, 5)
    command: ndarray  # collective thrust [N] and body rates [rad/s], shape (E, 4)
    release: ndarray  # whether the latch is to trip, shape (E,), bool
    observation: ndarray  # shape (E, D)
    # normalised image coordinates, shape (E, 8, 2); None without a camera
    keypoints: ndarray | None
    valid: ndarray | None  # which of them are seen, shape (E, 8), bool


def camera_conditions(params: CameraParams) -> dict[str, Any]:
    """Return what a vision policy's contract says of the camera: lens, mount and sizes, without
    noise.
    """
    camera = config.to_dict(params)
    mount = {key: camera["mount"][key] for key in ("position_b", "rpy_deg")}
    same = {key: camera[key] for key in ("fisheye", "goal_side", "payload_radius")}
    return {**same, "mount": mount, "invalid_reads": camera["noise"]["invalid_reads"]}


def by_own_rule(policy: Policy, params: CameraParams) -> CameraParams:
    """Return a camera with the policy's own rule for what is out of view: it is the program's, not
    the camera's.
    """
    rule = policy.contract.get("camera", {}).get("invalid_reads", params.noise.invalid_reads)
    return replace(params, noise=replace(params.noise, invalid_reads=rule))


def _resampled(history: ndarray, sample: ndarray, ages: list[float], period: float) -> ndarray:
    """`visthrow.onboard.observations.resampled`, of arrays; ``sample``: history with this
    step in it.
    """
    row = torch.from_numpy(sample)[:, 0]
    return ob.resampled(torch.from_numpy(history), row, ages, period).numpy()


class Pilot:
    """Flies E vehicles with one policy; remembers the previous action, the history and the policy's
    memory.

    Attributes:
        policy: the policy. layout: of its observation. period: between two calls [s].
        lag: from latch to separation [s].
        camera: None where the policy looks at none and no camera was given.
        spent: time that the last call took for the observation and for the policy [s].
    """

    def __init__(
        self,
        policy: Policy,
        camera_params: CameraParams | None = None,
        count: int = 1,
        allow: Collection[str] = (),
    ) -> None:
        """Read the conditions of the policy's contract.

        Raises PolicyError: the contract lacks an entry, or a vision policy is given no camera;
        MismatchError: the camera is not the one that the policy was trained with; ValueError: count
        below 1.

        Args:
            policy: on the CPU.
            camera_params: a vision policy's camera; with a state policy keypoints are computed for
                whoever draws them.
            count: E. allow: parts of the camera that may differ, as of :meth:`Policy.require`.
        """
        if count < 1:
            raise ValueError(f"pilot of {count} vehicles; expected 1 or more")
        contract = policy.contract
        try:
            self.layout = ob.layout_of(SimpleNamespace(**contract["observation"]))
            self._max_thrust = float(contract["action"]["max_thrust"])
            self._max_rate = torch.tensor(contract["action"]["max_rate"], dtype=torch.float32)
            self._threshold = float(contract["release"]["threshold"])
            self.lag = float(contract["release"]["lag"])
            self.period = float(contract["control_period"])
            mass = policy.total_mass
        except (KeyError, AttributeError, TypeError) as error:
            raise PolicyError(
                f"the policy's contract is incomplete: {error!r}; it was not written by visthrow"
                " train"
            ) from error
        if self.layout.dimension != policy.obs_dim:
            raise PolicyError(
                f"layout '{self.layout.name}' has {self.layout.dimension} numbers, the network"
                f" {policy.obs_dim}"
            )
        if self.layout.name == "vision":
            if camera_params is None:
                raise PolicyError("a vision policy needs a camera; got none")
            camera_params = by_own_rule(policy, camera_params)
            policy.require({"camera": camera_conditions(camera_params)}, {"camera"}, allow)
        self.policy = policy
        self.count = count
        if camera_params is None:
            self.camera = None
        else:
            self.camera = KeypointCamera(camera_params)
        self._views = np.zeros((count, sum(VIEWS.values())), dtype=np.float32)
        self._time = np.zeros(count, dtype=np.float32)
        self._observe, self._observe_given = Compiled(self._observed), Compiled(self._observed)
        self._decide = Compiled(self._decision)
        self._later = np.zeros(count, dtype=bool)
        self.spent = (0.0, 0.0)
        first = act.hover_action(GRAVITY * mass, self._max_thrust)
        self._first = np.array([first], dtype=np.float32)
        self.start()

    def start(self) -> None:
        """Begin a throw from hover: the next call fills the history."""
        self._previous = self._first.repeat(self.count, 0)
        shape = (self.count, 1 + self.layout.history, self.layout.payload)
        self._history = np.zeros(shape, dtype=np.float32)
        shape = (self.count, 1 + self.layout.response, ob.RESPONSE)
        self._answers = np.zeros(shape, dtype=np.float32)
        self._memory = self.policy.begin(self.count).numpy()
        self._fresh = np.ones(self.count, dtype=bool)
        self._goal_fit = goal_motion.empty_sums(self.count).numpy()
        self._steps = 0
        # of the rows of history and response, newest first; rows beyond copy the oldest [s]
        self._times: tuple[float, ...] = ()
        # what the action before the last one said of the release
        self._unasked = self._previous[:, 4]

    @property
    def previous_action(self) -> ndarray:
        """Clipped action of the last call, hover before the first one, shape (E, 5)."""
        return self._previous

    @torch.inference_mode()
    def act(
        self,
        pos_w: ndarray,
        quat_wb: ndarray,
        vel_w: ndarray,
        rate_b: ndarray,
        payload_w: ndarray,
        goal_w: ndarray,
        attached: ndarray | bool = True,
        keypoints: tuple[ndarray, ndarray] | None = None,
        now: float | None = None,
    ) -> PilotOutput:
        """Decide one control step. Raises ValueError: an array of another shape.

        Args:
            pos_w: of the vehicle's centre of mass [m], shape (E, 3), world frame.
            quat_wb: attitude, xyzw, shape (E, 4).
            vel_w: [m/s], shape (E, 3). rate_b: [rad/s], shape (E, 3).
            payload_w: of the payload's centre [m], shape (E, 3).
            goal_w: [m], shape (E, 3) or (3,).
            attached: whether the payload hangs on the vehicle, shape (E,) or one for all.
            keypoints: what a detector saw, normalised, shape (E, 8, 2), and validity, shape (E, 8),
                in place of what payload and goal project to; only with a camera.
            now: time of this step on any clock [s], where steps may be late or missing; None: they
                come a period apart.
        """
        begin = time.perf_counter()
        goal_w = np.asarray(goal_w).reshape(-1, 3)
        attached = np.asarray(attached).reshape(-1, 1)
        views = self._measured(pos_w, quat_wb, vel_w, rate_b, payload_w, goal_w, attached)
        inputs = () if keypoints is None else tuple(map(np.asarray, keypoints))
        observation, *state = self._seen(views, inputs)
        if now is not None and self._bridged(now, state):
            observation, *state = self._seen(views, inputs)
        self._history, *frame = state
        if self.layout.response:
            self._answers, *frame = frame
        if self.layout.fits:
            self._goal_fit, *frame = frame
        decided = time.perf_counter()
        action, command, release, self._memory = self._decide(observation, self._memory)
        self._unasked = self._previous[:, 4]
        self._previous = action
        self._fresh = self._later
        self._steps = self._steps + 1
        points, valid = frame if frame else (None, None)
        self.spent = (decided - begin, time.perf_counter() - decided)
        return PilotOutput(action, command, release, observation, points, valid)

    def not_released(self) -> None:
        """Say that the release which the last call asked for was not done: the next call is told of
        none, as in training.
        """
        self._previous = np.concatenate([self._previous[:, :4], self._unasked[:, None]], axis=-1)

    def _seen(self, views: ndarray, inputs: tuple[ndarray, ...]) -> tuple[ndarray, ...]:
        """Return the observation of a step from its measurements and the memory; ``inputs``:
        keypoints of a detector.
        """
        carried: tuple[ndarray, ...] = (self._previous, self._history, self._fresh)
        if self.layout.response:
            carried += (self._answers,)
        if self.layout.fits:
            self._time[:] = self._steps * self.period
            carried += (self._goal_fit, self._time)
        return (self._observe_given if inputs else self._observe)(views, *carried, *inputs)

    def _bridged(self, timestamp: float, frame: Sequence[ndarray]) -> bool:
        """Make history and response those of steps a period apart, as in training; whether steps
        before this one were late or missing.

        Args:
            timestamp: of this step [s].
            frame: history and response with this step in them, newest first.
        """
        times = self._times
        period = self.period
        rows = 1 + max(self.layout.history, self.layout.response)
        ages = [timestamp - time for time in times]
        due = [
            timestamp - k * period
            for k in range(1, 1 + rows)
            if ages and k * period < ages[-1] + JITTER
        ]
        errors = [abs(time - when) for time, when in zip(times, due)]
        late = len(due) != len(times) or any(error > JITTER for error in errors)
        if late:
            self._history = _resampled(self._history, frame[0], ages, period)
            if self.layout.response:
                self._answers = _resampled(self._answers, frame[1], ages, period)
            self._steps += max(round(ages[0] / period) - 1, 0)
            times = tuple(due)
        self._times = (timestamp, *times[: rows - 1])
        return late

    def _measured(self, *views: ndarray | bool) -> ndarray:
        """Return the measurements of one step side by side, shape (E, 20): the columns of
        :data:`VIEWS`.

        Raises ValueError: one of another shape.
        """
        row = 0
        for (name, width), value in zip(VIEWS.items(), views):
            array = np.asarray(value)
            if array.shape != (self.count, width) and not (
                name in SHARED and array.shape == (1, width)
            ):
                raise ValueError(
                    f"{name} has shape {array.shape}; expected ({self.count}, {width})"
                )
            self._views[:, row : row + width] = array
            row += width
        return self._views

    def _observed(
        self, views: Tensor, previous: Tensor, history: Tensor, fresh: Tensor, *further: Tensor
    ) -> tuple[Tensor, ...]:
        """Assemble the observation, shape (E, D).

        Args:
            views: shape (E, 20). previous, history, fresh: see
                `visthrow.onboard.observations.observe`.
            further: the vehicle's response, where the layout has it; sums of the goal's fit and
                time [s], where it fits it; then keypoints and validity that a detector saw, else
                what the camera sees of goal and payload is computed, where there is one.

        Returns:
            Observation, new history, new response, new sums of the goal's fit, keypoints and
            validity; where there are any.
        """
        answers: tuple[Tensor, ...] = ()
        if self.layout.response:
            answers = further[:1]
            further = further[1:]
        pos, quat, vel, rate, payload, goal, attached = views.split(list(VIEWS.values()), -1)
        rot = ob.rotation_from_quat(quat)
        fitted = 2 if self.layout.fits else 0
        fit = further[fitted:]
        if not fit and self.camera is not None:
            fit = seen_keypoints(self.camera, pos, rot, goal, payload)
        points, valid = (fit[0], fit[1]) if fit else (None, None)
        part = ob.state_part(pos, goal, payload)
        if points is not None and self.layout.name == "vision":
            part = points.flatten(1)
        frame = torch.cat([ob.vehicle_part(pos, vel, rate, rot), part], dim=-1)
        sums: tuple[Tensor, ...] = ()
        velocity = places = None
        if fitted:
            fit_sums, time = further[:2]
            new, velocity, places, frame, valid = goal_motion.fitted_goal(
                self.layout, frame, valid, self.camera, fit_sums, time, fresh
            )
            sums = (new,)
        answers = tuple(push(buffer, ob.answer(frame, previous), fresh) for buffer in answers)
        if answers:
            earlier = answers[0][:, 1:]
        else:
            earlier = None
        observation, history = ob.observe(
            self.layout,
            frame,
            valid,
            previous,
            attached[:, 0],
            history,
            fresh,
            velocity,
            places,
            earlier,
        )
        return observation, history, *answers, *sums, *fit

    def _decision(
        self, observation: Tensor, memory: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Clipped action, command, whether a release is asked for, and the policy's memory."""
        raw, memory = self.policy.step(observation, memory)
        action = act.clip_action(raw)
        command = act.command_from_action(action, self._max_thrust, self._max_rate)
        return action, command, act.release_asked(raw, self._threshold), memory

    @torch.inference_mode()
    def see(
        self, pos_w: ndarray, quat_wb: ndarray, payload_w: ndarray, goal_w: ndarray
    ) -> tuple[ndarray, ndarray]:
        """Keypoints alone, as in :meth:`act`, without a decision: shape (E, 8, 2) and validity,
        shape (E, 8).

        Raises PolicyError: there is no camera; ValueError: an array of another shape.
        """
        if self.camera is None:
            raise PolicyError("this pilot has no camera")
        zero = np.zeros((self.count, 3))
        goal_w = np.asarray(goal_w).reshape(-1, 3)
        attached = np.ones((1, 1))
        measured = self._measured(pos_w, quat_wb, zero, zero, payload_w, goal_w, attached)
        views = torch.from_numpy(measured)
        pos, quat, _, _, payload, goal, _ = views.split(list(VIEWS.values()), -1)
        points, valid = seen_keypoints(self.camera, pos, ob.rotation_from_quat(quat), goal, payload)
        return points.numpy(), valid.numpy()
