"""Conversion of a camera's detections to the policy's keypoints, held from frame to frame.

A frame is used for a limited time; then all keypoints count as dropped out. Keypoints that a frame
lacks drop out at once. Some policies were trained with the exact direction at the image's edge for
keypoints out of view. For them, keypoints last detected near the edge are shown at the edge in that
direction."""

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

# normalised radius in the image beyond which a lost keypoint has left the field of view
NEAR_EDGE = 0.85
PATH = 25  # ticks for which the vehicle's path is kept: half a second

PARTS = {"goal": slice(0, GOAL_KEYPOINTS), "ball": slice(GOAL_KEYPOINTS, None)}  # of the keypoints
Corners = tuple[Vector, ...]


@dataclass(frozen=True)
class Detection:
    """The detections in one frame, as recorded plain floats; rays in the camera frame of
    training.
    """

    stamp: float  # of the exposure, on the runner's clock [s]
    corners: Corners | None  # unit rays to the corners of the goal square, in turn
    # unit ray to the ball's centre, and half-angle [rad]
    ball: tuple[float, float, float, float] | None

    def values(self) -> list:
        """Return the values for JSON."""
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
        """Return the detections in the form of `camera.detectors.contours`."""
        goal = None if self.corners is None else GoalSeen(np.array(self.corners), 1.0)
        ball = None if self.ball is None else BallSeen(np.array(self.ball[:3]), self.ball[3], 1.0)
        return FrameDetections(ball, goal)


class Detections:
    """The keypoints from the detections so far; ``fresh``: stamp [s], keypoints (8, 2) and
    validity (8,) of the last frame.
    """

    def __init__(self, camera: KeypointCamera, hold: float):
        """Start without detections; ``camera``: that of training; ``hold``: time for which a
        frame is used [s].
        """
        self._camera = camera
        self._hold = hold
        self._points = torch.zeros(KEYPOINTS, 2)
        self._valid = torch.zeros(KEYPOINTS, dtype=torch.bool)
        # of the last frame, if it shows the object
        self._times = {"goal": -np.inf, "ball": -np.inf}
        self._newest = -np.inf
        self._turn: ndarray | None = None  # from the mounted camera to that of training
        self._scale = 0.0
        self._latency = 0.0
        self._path: deque[tuple[float, ndarray, ndarray]] = deque(maxlen=PATH)
        self.fresh: tuple[float, ndarray, ndarray] | None = None

    def correct(self, calibration: Calibration) -> None:
        """Correct rays from now on for the tilt, scale and latency that a calibration found."""
        rot_cb = self._camera.rot_cb.double()
        turn = rotation_from_vector(torch.tensor(calibration.turn_b, dtype=torch.float64))
        self._turn = (rot_cb @ turn @ rot_cb.T).numpy()
        self._scale = calibration.scale
        self._latency = max(calibration.latency, 0.0)

    def note_vehicle(self, time: float, pos: Vector, quat: Quaternion) -> None:
        """Record the vehicle's pose at a tick, for frames that are older than the poses."""
        self._path.append((time, np.array(pos), np.array(quat)))

    def take(self, detection: Detection, quat: Quaternion, aged: float = 0.0) -> None:
        """Process a frame; ``quat``: the vehicle's attitude, which identifies the corners;
        ``aged``: age of the poses at a tick [s].
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
        """Return the problems that forbid a throw at a time [s]: ball or goal are not detected."""
        return [
            f"the pictures show no {name}"
            for name, stamp in self._times.items()
            if time - stamp > self._hold
        ]

    def _carry(self, detections: FrameDetections, when: float) -> FrameDetections:
        """Return detections of a time as the camera of training would see them now: the goal
        lies still, the ball moves with the vehicle.
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
        """Return rays, shape (N, 3), corrected for the calibrated focal length."""
        lens = self._camera.fisheye
        points, _ = lens.project_normalized(torch.from_numpy(np.ascontiguousarray(rays_c)))
        rays: ndarray = lens.unproject(lens.denormalize(points / (1.0 + self._scale)))[0].numpy()
        return rays

    def _pose(self, when: float) -> tuple[ndarray, ndarray]:
        """Return position and quaternion (not normalised) on the path at a time, by linear
        interpolation; beyond the path, its ends.
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
