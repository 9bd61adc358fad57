"""What a camera saw, as the policy is to be shown it: rays of one frame, and what they read until
the next.

A frame counts for a while, then all reads as dropped out; what is not in it at once. To a policy
that was trained with the exact direction at the edge in place of what is out of view, what was last
seen near the edge reads as its direction there."""

from collections import deque
from dataclasses import dataclass

import numpy as np
import torch
from numpy import ndarray

from camera.detectors.contours import (
    BallSeen,
    FrameDetections,
    GoalSeen,
    convert_to_training_keypoints,
)
from camera.keypoints import GOAL_KEYPOINTS, KEYPOINTS, KeypointCamera
from camera.mount import rotation_from_vector
from hil.poses.pose import Quaternion, Vector
from visthrow.common.rotations import continuous, matrix_of_quat
from visthrow.onboard.calibration import Calibration

# radius in the image beyond which what is not seen any more has left the field of view, of 1
NEAR_EDGE = 0.85
PATH = 25  # ticks that the vehicle's way is kept for: half a second

PARTS = {"goal": slice(0, GOAL_KEYPOINTS), "ball": slice(GOAL_KEYPOINTS, None)}  # of the keypoints
Corners = tuple[Vector, ...]


@dataclass(frozen=True)
class Detection:
    """One frame, plain floats as they are recorded; rays in the camera frame of training."""

    stamp: float  # of the exposure, on the runner's clock [s]
    corners: Corners | None  # unit rays to the corners of the goal square, in turn
    # unit ray to the ball's centre, and half-angle [rad]
    ball: tuple[float, float, float, float] | None

    def values(self) -> list:
        """Return it as JSON has it."""
        return [self.stamp, self.corners, self.ball]

    @classmethod
    def of(cls, values: list) -> "Detection":
        """Return the inverse of :meth:`values`."""
        stamp, corners, ball = values
        return cls(
            stamp,
            None if corners is None else tuple(map(tuple, corners)),
            None if ball is None else tuple(ball),
        )

    def frame_detections(self) -> FrameDetections:
        """Return it as `camera.detectors.contours` has it."""
        goal = None if self.corners is None else GoalSeen(np.array(self.corners), 1.0)
        ball = None if self.ball is None else BallSeen(np.array(self.ball[:3]), self.ball[3], 1.0)
        return FrameDetections(ball, goal)


class Detections:
    """Keypoints by the detections so far; ``fresh``: stamp [s], keypoints (8, 2) and validity (8,)
    of the last frame that was taken.
    """

    def __init__(self, camera: KeypointCamera, hold: float):
        """Start with nothing seen by the camera of training; ``hold``: for which a frame counts
        [s].
        """
        self._camera = camera
        self._hold = hold
        self._points = torch.zeros(KEYPOINTS, 2)
        self._valid = torch.zeros(KEYPOINTS, dtype=torch.bool)
        # of the last frame, where it holds the thing
        self._times = {"goal": -np.inf, "ball": -np.inf}
        self._newest = -np.inf
        self._turn: ndarray | None = None  # from the camera as it is mounted to that of training
        self._scale = 0.0
        self._latency = 0.0
        self._path: deque[tuple[float, ndarray, ndarray]] = deque(maxlen=PATH)
        self.fresh: tuple[float, ndarray, ndarray] | None = None

    def correct(self, calibration: Calibration) -> None:
        """Turn rays and carry them forward from now on by what a calibration found."""
        rot_cb = self._camera.rot_cb.double()
        turn = rotation_from_vector(torch.tensor(calibration.turn_b, dtype=torch.float64))
        self._turn = (rot_cb @ turn @ rot_cb.T).numpy()
        self._scale = calibration.scale
        self._latency = max(calibration.latency, 0.0)

    def note_vehicle(self, time: float, pos: Vector, quat: Quaternion) -> None:
        """Note where the vehicle is at a tick, as of the poses, for frames that are older than
        these.
        """
        self._path.append((time, np.array(pos), np.array(quat)))

    def take(self, detection: Detection, quat: Quaternion, aged: float = 0.0) -> None:
        """Take a frame in; the vehicle's attitude says which corner is which, and poses have an age
        at a tick [s].
        """
        stamp = detection.stamp
        frame = detection.frame_detections()
        rot_wb = matrix_of_quat(np.array(quat))
        if self._turn is not None and self._path:
            frame = self._carry(frame, stamp - self._latency + aged)
        points, valid = convert_to_training_keypoints(self._camera, frame, rot_wb)
        self.fresh = stamp, points.numpy(), valid.numpy()
        if stamp <= self._newest:
            return
        self._newest = stamp
        for name, part in PARTS.items():
            self._times[name] = -np.inf if getattr(frame, name) is None else stamp
            if getattr(frame, name) is not None:
                self._points[part] = points[part]
                self._valid[part] = valid[part]

    def problems(self, time: float) -> list[str]:
        """Return what speaks against a throw at a time [s]: a ball that hangs and a goal that lies
        in view are seen.
        """
        return [
            f"the pictures show no {name}"
            for name, stamp in self._times.items()
            if time - stamp > self._hold
        ]

    def _carry(self, detections: FrameDetections, when: float) -> FrameDetections:
        """Return what was seen at a time as the camera of training would see it now: the goal lies,
        the ball goes with the vehicle.
        """
        _, pos_now, quat_now = self._path[-1]
        pos, quat = self._pose(when)
        rot_now = matrix_of_quat(quat_now)
        rot = matrix_of_quat(quat)
        rot_bc = self._camera.rot_cb.double().numpy().T
        lens = self._camera.position_b.double().numpy()
        turn = self._turn
        ball = detections.ball
        goal = detections.goal
        if ball is not None:
            ray = rot_bc.T @ rot_now.T @ rot @ rot_bc @ turn @ self._rescale(ball.ray_c[None])[0]
            ball = BallSeen(ray, ball.half_angle / (1.0 + self._scale), ball.score)
        if goal is not None:
            eye = pos + rot @ lens
            rays_w = self._rescale(goal.rays_c) @ (rot @ rot_bc @ turn).T
            reach = eye[2] / np.maximum(-rays_w[:, 2:], 0.05)
            from_now = eye + reach * rays_w - (pos_now + rot_now @ lens)
            rays = from_now @ (rot_now @ rot_bc)
            goal = GoalSeen(rays / np.linalg.norm(rays, axis=1, keepdims=True), goal.score)
        return FrameDetections(ball, goal)

    def _rescale(self, rays_c: ndarray) -> ndarray:
        """Return rays, shape (N, 3), by the focal length that was found."""
        lens = self._camera.fisheye
        points, _ = lens.project_normalized(torch.from_numpy(np.ascontiguousarray(rays_c)))
        rays: ndarray = lens.unproject(lens.denormalize(points / (1.0 + self._scale)))[0].numpy()
        return rays

    def _pose(self, when: float) -> tuple[ndarray, ndarray]:
        """Return the place and the quaternion, of any length, at a time on the path, by straight
        lines; its ends beyond them.
        """
        times, places, quats = map(np.array, zip(*self._path))
        columns = np.column_stack([places, continuous(quats)])
        pose = np.array([np.interp(when, times, column) for column in columns.T])
        return pose[:3], pose[3:]

    def keypoints(self, time: float) -> tuple[ndarray, ndarray]:
        """Return keypoints at a time [s]: normalised, float32, shape (1, 8, 2), and validity, shape
        (1, 8).
        """
        points = self._points.clone()
        valid = self._valid.clone()
        for name, part in PARTS.items():
            if time - self._times[name] > self._hold:
                radius = points[part].norm(dim=-1, keepdim=True)
                edge_exit = self._camera.edge_reads and bool((radius > NEAR_EDGE).any())
                points[part] = (
                    points[part] / radius.clamp(min=1e-6)
                    if edge_exit
                    else torch.zeros_like(points[part])
                )
                valid[part] = False
        return points[None].numpy(), valid[None].numpy()
