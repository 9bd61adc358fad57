"""The policy in flight: from poses of vehicle, payload and goal to a command. Onboard-safe.

The same functions of :mod:`visthrow.observations` and :mod:`visthrow.actions` that the training environment calls, with
a batch of one on board; only the noise is missing.
"""

import time
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from camera.keypoints import KeypointCamera
from camera.params import CameraParams
from visthrow import actions as act
from visthrow import config, goal_motion
from visthrow import observations as ob
from visthrow.errors import PolicyError
from visthrow.hover import GRAVITY
from visthrow.policy import Policy
from visthrow.traced import Traced


@dataclass(frozen=True)
class PilotOutput:
    """What one control step decided, and what it saw. NumPy, shape (E, ...)."""

    action: np.ndarray  # normalised, clipped, shape (E, 5)
    command: np.ndarray  # collective thrust [N] and body rates [rad/s], shape (E, 4)
    release: np.ndarray  # whether the latch is to trip, shape (E,), bool
    observation: np.ndarray  # shape (E, D)
    keypoints: np.ndarray | None  # normalised image coordinates, shape (E, 8, 2); None without a camera
    valid: np.ndarray | None  # which of them are seen, shape (E, 8), bool


def camera_conditions(params: CameraParams) -> dict[str, Any]:
    """Return what a vision policy's contract says of the camera: lens, mount and sizes, without noise."""
    camera = config.to_dict(params)
    return {
        "fisheye": camera["fisheye"],
        "mount": {key: camera["mount"][key] for key in ("position_b", "rpy_deg")},
        "goal_side": camera["goal_side"],
        "payload_radius": camera["payload_radius"],
        "invalid_reads": camera["noise"]["invalid_reads"],
    }


class Pilot:
    """Flies E vehicles with one policy; remembers the previous action and the payload's history.

    Attributes:
        policy: the policy. layout: of its observation. period: between two calls [s].
        lag: from latch to separation [s].
        camera: None where the policy looks at none and no camera was given.
        spent: time that the last call took for the observation and for the policy [s].
    """

    def __init__(self, policy: Policy, camera_params: CameraParams | None = None, count: int = 1) -> None:
        """Read the conditions of the policy's contract.

        Args:
            policy: on the CPU.
            camera_params: a vision policy's camera; with a state policy keypoints are computed for whoever draws them.
            count: E.

        Raises:
            PolicyError: The contract lacks an entry, or a vision policy is given no camera.
            MismatchError: The camera is not the one that the policy was trained with.
            ValueError: count below 1.
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
            rope = contract["rope"]
            mass = contract["vehicle"]["body"]["mass"] + rope["rope_mass"] + rope["payload_mass"]
        except (KeyError, AttributeError, TypeError) as error:
            raise PolicyError(
                f"the policy's contract is incomplete: {error!r}; it was not written by visthrow train"
            ) from error
        if self.layout.dimension != policy.obs_dim:
            raise PolicyError(
                f"layout '{self.layout.name}' has {self.layout.dimension} numbers, the network {policy.obs_dim}"
            )
        if self.layout.name == "vision":
            if camera_params is None:
                raise PolicyError("a vision policy needs a camera; got none")
            policy.require({"camera": camera_conditions(camera_params)}, sections={"camera"})
        self.policy, self.count = policy, count
        self.camera = None if camera_params is None else KeypointCamera(camera_params)
        self._look_given = Traced(self._frame_given)
        self._look, self._observe, self._decide = Traced(self._frame), Traced(self._assemble), Traced(self._decision)
        self.spent = (0.0, 0.0)
        self._first = torch.tensor([act.hover_action(GRAVITY * mass, self._max_thrust)], dtype=torch.float32)
        self.start()

    def start(self) -> None:
        """Begin a throw from hover: the next call fills the history."""
        self._previous = self._first.repeat(self.count, 1)
        self._history = torch.zeros(self.count, 1 + self.layout.history, self.layout.payload)
        self._fresh = torch.ones(self.count, dtype=torch.bool)
        self._goal_fit, self._steps = goal_motion.empty_sums(self.count), 0

    @property
    def previous_action(self) -> np.ndarray:
        """Clipped action of the last call, hover before the first one, shape (E, 5)."""
        return self._previous.numpy()

    @torch.inference_mode()
    def act(
        self,
        pos_w: np.ndarray,
        quat_wb: np.ndarray,
        vel_w: np.ndarray,
        rate_b: np.ndarray,
        payload_w: np.ndarray,
        goal_w: np.ndarray,
        attached: np.ndarray | bool = True,
        keypoints: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> PilotOutput:
        """Decide one control step.

        Args:
            pos_w: of the vehicle's centre of mass [m], shape (E, 3), world frame.
            quat_wb: attitude, xyzw, shape (E, 4).
            vel_w: [m/s], shape (E, 3). rate_b: [rad/s], shape (E, 3).
            payload_w: of the payload's centre [m], shape (E, 3).
            goal_w: [m], shape (E, 3) or (3,).
            attached: whether the payload hangs on the vehicle, shape (E,) or one for all.
            keypoints: what a detector saw, normalised, shape (E, 8, 2), and validity, shape (E, 8), in place of what payload
                and goal project to; only with a camera.

        Raises:
            ValueError: An array of another shape.
        """
        begin = time.perf_counter()
        goal_w = np.broadcast_to(np.asarray(goal_w), (self.count, 3))
        views = [self._tensor(*view) for view in (
            ("pos_w", pos_w, 3), ("quat_wb", quat_wb, 4), ("vel_w", vel_w, 3), ("rate_b", rate_b, 3),
            ("payload_w", payload_w, 3), ("goal_w", goal_w, 3),
        )]  # fmt: skip
        hangs = torch.from_numpy(np.broadcast_to(np.asarray(attached), (self.count,)).astype(np.float32))
        if keypoints is None:
            frame, *seen = self._look(*views)
        else:
            frame, *seen = self._look_given(*views, *(torch.from_numpy(np.array(given)) for given in keypoints))
        points, valid = seen or (None, None)
        further = [t for t in (valid, self._goal_velocity(frame, valid)) if t is not None]
        observation, self._history = self._observe(
            frame, self._previous, hangs, self._history, self._fresh, *further
        )
        decided = time.perf_counter()
        action, command, release = self._decide(observation)
        self._previous, self._fresh = action, torch.zeros_like(self._fresh)
        out = PilotOutput(
            action.numpy(),
            command.numpy(),
            release.numpy(),
            observation.numpy(),
            None if points is None else points.numpy(),
            None if valid is None else valid.numpy(),
        )
        self.spent = (decided - begin, time.perf_counter() - decided)
        return out

    def _frame(
        self, pos: Tensor, quat: Tensor, vel: Tensor, rate: Tensor, payload: Tensor, goal: Tensor
    ) -> tuple[Tensor, ...]:
        """Frame of the measurements, shape (E, layout.frame), and with a camera keypoints and their validity."""
        rot = ob.rotation_from_quat(quat)
        seen = () if self.camera is None else ob.vision_part(self.camera, pos, rot, goal, payload)
        part = seen[0].flatten(1) if self.layout.name == "vision" else ob.state_part(pos, goal, payload)
        return torch.cat([ob.vehicle_part(pos, vel, rate, rot), part], dim=-1), *seen

    def _frame_given(
        self, pos: Tensor, quat: Tensor, vel: Tensor, rate: Tensor, payload: Tensor, goal: Tensor, points: Tensor,
        valid: Tensor,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        """As `_frame`, with keypoints that were seen and not projected."""
        rot = ob.rotation_from_quat(quat)
        part = points.flatten(1) if self.layout.name == "vision" else ob.state_part(pos, goal, payload)
        return torch.cat([ob.vehicle_part(pos, vel, rate, rot), part], dim=-1), points, valid

    def _assemble(
        self, frame: Tensor, previous: Tensor, hangs: Tensor, history: Tensor, fresh: Tensor, *further: Tensor
    ) -> tuple[Tensor, Tensor]:
        """See `visthrow.observations.observe`; ``further`` are validity and goal velocity, where there are any."""
        valid = further[0] if self.camera is not None else None
        motion = further[-1] if self.layout.motion else None
        return ob.observe(self.layout, frame, valid, previous, hangs, history, fresh, motion)

    def _decision(self, observation: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Clipped action, command and whether a release is asked for."""
        raw = self.policy.act(observation)
        action = act.clip_action(raw)
        command = act.command_from_action(action, self._max_thrust, self._max_rate)
        return action, command, act.release_asked(raw, self._threshold)

    def _goal_velocity(self, frame: Tensor, valid: Tensor | None) -> Tensor | None:
        """Fit of the goal's velocity [m/s], shape (E, 2), with this step's frame; None where the layout has none."""
        if not self.layout.motion:
            return None
        place, weight = goal_motion.measured_goal(self.layout, frame, valid, self.camera)
        time = torch.full((self.count,), self._steps * self.period)
        self._steps += 1
        self._goal_fit, velocity = goal_motion.fit(self._goal_fit, time, place, weight, self._fresh)
        return velocity

    @torch.inference_mode()
    def see(
        self, pos_w: np.ndarray, quat_wb: np.ndarray, payload_w: np.ndarray, goal_w: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Keypoints alone, as in :meth:`act`, without a decision: shape (E, 8, 2) and validity, shape (E, 8).

        Raises:
            PolicyError: There is no camera.
            ValueError: An array of another shape.
        """
        if self.camera is None:
            raise PolicyError("this pilot has no camera")
        rot = ob.rotation_from_quat(self._tensor("quat_wb", quat_wb, 4))
        goal = self._tensor("goal_w", np.broadcast_to(np.asarray(goal_w), (self.count, 3)), 3)
        payload = self._tensor("payload_w", payload_w, 3)
        points, valid = ob.vision_part(self.camera, self._tensor("pos_w", pos_w, 3), rot, goal, payload)
        return points.numpy(), valid.numpy()

    def _tensor(self, name: str, value: np.ndarray, width: int) -> Tensor:
        array = np.array(value, dtype=np.float32)  # a copy: torch warns of read-only memory
        if array.shape != (self.count, width):
            raise ValueError(f"{name} has shape {array.shape}; expected ({self.count}, {width})")
        return torch.from_numpy(array)
