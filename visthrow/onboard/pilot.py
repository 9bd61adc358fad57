"""Fly a policy: compute commands from poses of vehicle, payload and goal. Onboard-safe.

The pilot calls the same functions of :mod:`visthrow.onboard.observations` and
:mod:`visthrow.onboard.actions` as the training environment, without noise. It computes on NumPy
arrays for one vehicle, and on tensors for several."""

import time
from collections.abc import Collection
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy import ndarray

from camera.arrays import Array, push
from camera.keypoints import KeypointCamera
from camera.keypoints import keypoints as keypoints_of
from camera.params import CameraParams
from visthrow import config
from visthrow.common.errors import PolicyError
from visthrow.common.free_fall import GRAVITY
from visthrow.onboard import actions as act
from visthrow.onboard import goal_motion
from visthrow.onboard import observations as ob
from visthrow.onboard.policy import Policy
from visthrow.onboard.row_keypoints import row_keypoints
from visthrow.onboard.row_policy import RowPolicy

VIEWS = {
    "pos_w": 3,
    "quat_wb": 4,
    "vel_w": 3,
    "rate_b": 3,
    "payload_w": 3,
    "goal_w": 3,
    "attached": 1,
}
"""Measurement of a step -> width."""

SHARED = ("goal_w", "attached")
"""Measurements that may have one row for all vehicles."""

JITTER = 2e-3
"""Largest timing error of a step that does not count as late [s]; the payload moves a few
millimetres in this time.
"""


@dataclass(frozen=True)
class PilotOutput:
    """The decision and the observation of one control step. NumPy, shape (E, ...)."""

    action: ndarray  # normalised, clipped, shape (E, 5)
    command: ndarray  # collective thrust [N] and body rates [rad/s], shape (E, 4)
    release: ndarray  # whether to trip the latch, shape (E,), bool
    observation: ndarray  # shape (E, D)
    # normalised image coordinates, shape (E, 8, 2); None without a camera
    keypoints: ndarray | None
    valid: ndarray | None  # which of them are visible, shape (E, 8), bool


class PolicyInput(NamedTuple):
    """The observation of one control step, and the state for the next one."""

    observation: Array  # shape (E, D)
    history: Array  # with this step in it, newest first
    answers: Array  # the vehicle's responses with this step in it, newest first
    goal_fit: Array  # sums, if the layout fits the goal
    points: Array  # keypoints; None without a camera
    valid: Array


def camera_conditions(params: CameraParams) -> dict[str, Any]:
    """Return the camera's entry in a vision policy's contract: lens, mount and sizes, without
    noise.
    """
    camera = config.to_dict(params)
    mount = {key: camera["mount"][key] for key in ("position_b", "rpy_deg")}
    same = {key: camera[key] for key in ("fisheye", "goal_side", "payload_radius")}
    return {**same, "mount": mount, "invalid_reads": camera["noise"]["invalid_reads"]}


def with_policy_rule(policy: Policy, params: CameraParams) -> CameraParams:
    """Return the camera with the policy's rule for keypoints out of view, which belongs to the
    program and not to the camera.
    """
    rule = policy.contract.get("camera", {}).get("invalid_reads", params.noise.invalid_reads)
    return replace(params, noise=replace(params.noise, invalid_reads=rule))


class Pilot:
    """A pilot of E vehicles with one policy, which stores the previous action, the history and the
    policy's memory.

    Attributes:
        policy: the policy. layout: layout of its observation. period: time between calls [s].
        lag: time from latch to separation [s].
        camera: the camera; None if the policy needs none and none was given.
        spent: durations of the observation and of the policy in the last call [s].
    """

    def __init__(
        self,
        policy: Policy,
        camera_params: CameraParams | None = None,
        count: int = 1,
        allow: Collection[str] = (),
    ):
        """Prepare a pilot from the conditions in the policy's contract.

        Raises PolicyError: an entry of the contract or a vision policy's camera is missing;
        MismatchError: the camera differs from that of the training; ValueError: count below 1.

        Args:
            policy: policy on the CPU.
            camera_params: a vision policy's camera; with a state policy keypoints are computed only
                for drawing.
            count: number E of vehicles.
            allow: parts of the camera that may differ; see :meth:`Policy.require`.
        """
        if count < 1:
            raise ValueError(f"pilot of {count} vehicles; expected 1 or more")
        contract = policy.contract
        try:
            self.layout = ob.layout_of(SimpleNamespace(**contract["observation"]))
            self._max_thrust = float(contract["action"]["max_thrust"])
            max_rate = np.array(contract["action"]["max_rate"], dtype=np.float32)
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
            camera_params = with_policy_rule(policy, camera_params)
            policy.require({"camera": camera_conditions(camera_params)}, {"camera"}, allow)
        self.policy = policy
        self.count = count
        self._network = RowPolicy(policy) if count == 1 else policy
        self._max_rate = self._native(max_rate)
        self.camera = self._camera = None
        if camera_params is not None:
            self.camera = self._camera = KeypointCamera(camera_params)
            if count == 1:
                self._camera = self.camera.convert_to_arrays()
        self.spent = (0.0, 0.0)
        first = act.hover_action(GRAVITY * mass, self._max_thrust)
        self._first = np.array([first], dtype=np.float32)
        self.start()

    def start(self) -> None:
        """Start a throw from hover; the next call fills the history."""
        count = self.count
        layout = self.layout
        self._previous = self._first.repeat(count, 0)
        self._history = self._zeros(count, 1 + layout.history, layout.payload)
        self._answers = self._zeros(count, 1 + layout.response, ob.RESPONSE)
        self._goal_fit = self._zeros(count, goal_motion.SUMS)
        self._memory = self._native(self.policy.begin(count).numpy())
        self._shown: tuple[Any, ...] = ()  # inputs of the last call
        self._fresh = self._zeros(count) == 0.0
        self._steps = 0
        # times of the rows of history and response, newest first; further rows copy the oldest [s]
        self._times: tuple[float, ...] = ()
        # release output of the action before the last one
        self._unasked = self._previous[:, 4]

    @property
    def previous_action(self) -> ndarray:
        """Return the clipped action of the last call, or that of hover before the first call, shape
        (E, 5).
        """
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
        """Return the command for one control step. Raises ValueError: an array has a wrong shape.

        Args:
            pos_w: position of the vehicle's centre of mass [m], shape (E, 3), world frame.
            quat_wb: attitude, xyzw, shape (E, 4).
            vel_w: [m/s], shape (E, 3). rate_b: [rad/s], shape (E, 3).
            payload_w: position of the payload's centre [m], shape (E, 3).
            goal_w: position of the goal [m], shape (E, 3) or (3,).
            attached: whether the payload is attached to the vehicle, shape (E,) or one for all.
            keypoints: keypoints of a detector, normalised, shape (E, 8, 2), and validity, shape
                (E, 8), instead of projections of payload and goal; only with a camera.
            now: time of this step on any clock [s], if steps may be late or missing; None if they
                are exactly one period apart.
        """
        begin = time.perf_counter()
        goal_w = np.asarray(goal_w).reshape(-1, 3)
        attached = np.asarray(attached).reshape(-1, 1)
        views = self._stack_measurements(pos_w, quat_wb, vel_w, rate_b, payload_w, goal_w, attached)
        detected = None
        if keypoints is not None:  # copies: a detector may reuse its arrays
            detected = tuple(self._native(np.array(array)) for array in keypoints)
        self._shown = views, detected
        inputs = self._see(views, detected)
        if now is not None and self._bridge_gap(now, inputs):
            inputs = self._see(views, detected)
        self._history = inputs.history
        self._answers = inputs.answers
        self._goal_fit = inputs.goal_fit
        decided = time.perf_counter()
        raw, self._memory = self._network.step(inputs.observation, self._memory)
        action = act.clip_action(raw)
        command = act.command_from_action(action, self._max_thrust, self._max_rate)
        release = act.wants_release(raw, self._threshold)
        self._unasked = self._previous[:, 4]
        self._previous = np.asarray(action)
        self._fresh = self._zeros(self.count) > 0.0
        self._steps += 1
        self.spent = (decided - begin, time.perf_counter() - decided)
        return PilotOutput(
            self._previous,
            np.asarray(command),
            np.asarray(release),
            np.asarray(inputs.observation),
            None if inputs.points is None else np.asarray(inputs.points),
            None if inputs.points is None else np.asarray(inputs.valid),
        )

    @torch.inference_mode()
    def rehearse(self) -> None:
        """Repeat the computation of the last call without an effect, so that weights and code are
        in the processor's caches for the next one.
        """
        if self._shown:
            self._network.step(self._see(*self._shown).observation, self._memory)

    def cancel_release(self) -> None:
        """Report that the release commanded by the last call was not executed; the next observation
        then contains no release, as in training.
        """
        self._previous = np.concatenate([self._previous[:, :4], self._unasked[:, None]], axis=-1)

    def _native(self, array: ndarray) -> Array:
        """Convert an array to the type of the observation's computation: a NumPy array for one
        vehicle, otherwise a tensor.
        """
        return np.asarray(array) if self.count == 1 else torch.as_tensor(array)

    def _zeros(self, *shape: int) -> Array:
        return self._native(np.zeros(shape, dtype=np.float32))

    def _bridge_gap(self, timestamp: float, inputs: PolicyInput) -> bool:
        """If earlier steps were late or missing, resample history and response to steps one period
        apart, as in training; return whether this was necessary.

        Args:
            timestamp: time of this step [s].
            inputs: the policy's input of this step.
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
            self._history = ob.resample(self._history, inputs.history[:, 0], ages, period)
            if self.layout.response:
                self._answers = ob.resample(self._answers, inputs.answers[:, 0], ages, period)
            self._steps += max(round(ages[0] / period) - 1, 0)
            times = tuple(due)
        self._times = (timestamp, *times[: rows - 1])
        return late

    def _stack_measurements(self, *views: ndarray | bool) -> list[Array]:
        """Return the measurements of one step in the order of :data:`VIEWS`, float32, E rows each.

        Raises ValueError: one has a wrong shape.
        """
        rows = []
        for (name, width), value in zip(VIEWS.items(), views):
            array = np.asarray(value)
            if array.shape != (self.count, width) and not (
                name in SHARED and array.shape == (1, width)
            ):
                raise ValueError(
                    f"{name} has shape {array.shape}; expected ({self.count}, {width})"
                )
            row = np.empty((self.count, width), np.float32)
            row[:] = array
            rows.append(self._native(row))
        return rows

    def _see(self, views: list[Array], detected: tuple[Array, Array] | None) -> PolicyInput:
        """Assemble the observation of a step from its measurements and the stored state.

        Args:
            views: measurements; see :data:`VIEWS`.
            detected: keypoints and validity from a detector; None to project goal and payload into
                the camera, if there is one.
        """
        pos, quat, vel, rate, payload, goal, attached = views
        layout = self.layout
        previous = self._native(self._previous)
        rot = ob.rotation_from_quat(quat)
        camera = self._camera
        points: Array = None
        valid: Array = None
        if detected is not None:
            points, valid = detected
        elif camera is not None:
            project = row_keypoints if self.count == 1 else keypoints_of
            points, valid = project(camera, pos, rot, goal, payload)
        part = ob.state_part(pos, goal, payload)
        if layout.name == "vision":
            part = points.reshape(len(points), -1)
        frame = ob.join_arrays([ob.vehicle_part(pos, vel, rate, rot), part])
        filled = valid
        goal_fit = self._goal_fit
        answers = self._answers
        velocity = places = earlier = None
        if layout.fits:
            passed = self._zeros(self.count) + self._steps * self.period
            goal_fit, velocity, places, frame, filled = goal_motion.update_goal_fit(
                layout, frame, valid, camera, goal_fit, passed, self._fresh
            )
        if layout.response:
            answers = push(answers, ob.answer(frame, previous), self._fresh)
            earlier = answers[:, 1:]
        carried = previous, attached[:, 0], self._history, self._fresh
        further = velocity, places, earlier
        observation, history = ob.observe(layout, frame, filled, *carried, *further)
        return PolicyInput(observation, history, answers, goal_fit, points, valid)

    @torch.inference_mode()
    def see(
        self, pos_w: ndarray, quat_wb: ndarray, payload_w: ndarray, goal_w: ndarray
    ) -> tuple[ndarray, ndarray]:
        """Return the keypoints of :meth:`act` without a decision, shape (E, 8, 2), and their
        validity, shape (E, 8).

        Raises PolicyError: there is no camera; ValueError: an array has a wrong shape.
        """
        if self.camera is None:
            raise PolicyError("this pilot has no camera")
        zero = np.zeros((self.count, 3))
        goal_w = np.asarray(goal_w).reshape(-1, 3)
        attached = np.ones((1, 1))
        measured = self._stack_measurements(pos_w, quat_wb, zero, zero, payload_w, goal_w, attached)
        pos, quat, _, _, payload, goal, _ = map(torch.as_tensor, measured)
        points, valid = keypoints_of(self.camera, pos, ob.rotation_from_quat(quat), goal, payload)
        return points.numpy(), valid.numpy()
