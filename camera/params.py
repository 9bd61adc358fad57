"""Configuration of the camera: frozen dataclasses, one for each table of a ``configs/camera`` file.

Imports neither torch nor cv2.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from camera.field_bounds import Bound, BoundedFields, Length, NotNegative, Positive, Share, Vector

SMALLEST_VIEW = math.radians(1.0)
"""Angle off the axis up to which every lens must form an image [rad]."""


def monotonic_limit(coefficients: tuple[float, ...]) -> float:
    """Return the angle off the axis at which theta_d stops increasing [rad], ``inf`` if never."""
    slope = [(2 * i + 3) * k for i, k in enumerate(coefficients)][::-1] + [1.0]
    roots = np.roots(slope)
    real = roots[np.abs(roots.imag) < 1e-12 * np.abs(roots)].real
    positive = real[real > 0.0]
    if positive.size:
        return float(np.sqrt(positive.min()))
    return math.inf


@dataclass(frozen=True)
class FisheyeParams(BoundedFields):
    """Intrinsics of a Kannala-Brandt fisheye camera.

    ``theta = atan2(sqrt(x^2 + y^2), z)``, ``theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3
    theta^6 + k4 theta^8)``, ``u = fx theta_d cos(phi) + cx``, ``v = fy theta_d sin(phi) + cy``. All
    k zero: the equidistant lens.

    Convention: pixel (0, 0) is the *centre* of the top left pixel, u to the right, v down, as in
    OpenCV, Kalibr, ROS and basalt.
    Source: Kannala and Brandt, "A generic camera model and calibration method", TPAMI 28(8), 2006,
    eq. 6."""

    width: Annotated[int, Bound(1)]  # [px]
    height: Annotated[int, Bound(1)]  # [px]
    fx: Positive  # [px/rad]
    fy: Positive  # [px/rad]
    cx: float  # [px]
    cy: float  # [px]
    k1: float = 0.0  # [rad^-2]
    k2: float = 0.0  # [rad^-4]
    k3: float = 0.0  # [rad^-6]
    k4: float = 0.0  # [rad^-8]
    fov_deg: Annotated[float, Bound(0.0, 360.0, "(]")] = (
        220.0  # full field of view, twice the largest angle off the axis [deg]
    )

    @property
    def coefficients(self) -> tuple[float, float, float, float]:
        """Distortion coefficients (k1, k2, k3, k4)."""
        return (self.k1, self.k2, self.k3, self.k4)

    @property
    def half_fov(self) -> float:
        """Largest angle off the optical axis that is inside the field of view [rad]."""
        return math.radians(self.fov_deg) / 2.0

    def __post_init__(self) -> None:
        super().__post_init__()
        t2 = SMALLEST_VIEW**2
        bend = sum(k * t2 ** (n + 1) for n, k in enumerate(self.coefficients))
        slope = SMALLEST_VIEW * (1 + bend)
        if slope * min(self.fx, self.fy) > math.hypot(self.width, self.height):
            raise ValueError(
                f"fisheye k = {self.coefficients} with fx = {self.fx}, fy = {self.fy}: a ray 1 deg"
                f" off the axis falls outside an image of {self.width} x {self.height} px; expected"
                " a lens that sees more than that"
            )
        limit = monotonic_limit(self.coefficients)
        if limit <= self.half_fov:
            raise ValueError(
                f"theta_d with k = {self.coefficients} stops growing at {math.degrees(limit):.2f}"
                " deg off the axis, inside the field of view; expected fov_deg below"
                f" {2 * math.degrees(limit):.2f}, got {self.fov_deg}"
            )


@dataclass(frozen=True)
class MountParams(BoundedFields):
    """Position and rotation of the camera on the body.

    Convention: with ``rpy_deg`` zero the camera looks down and the top of the image is the
    vehicle's front: x_c (image right) = -y_b (the vehicle's right), y_c (image down) = -x_b, z_c
    (optical axis) = -z_b. ``rpy_deg`` rotates the camera from there about the body axes, ``rot_bc =
    Rz(yaw) Ry(pitch) Rx(roll) rot_bc_down``: a negative pitch tilts it forward."""

    # lens from the centre of mass [m], body frame
    position_b: Vector = (0.0, 0.0, 0.0)
    # roll, pitch, yaw from the downward pose [deg], about body axes
    rpy_deg: Vector = (0.0, 0.0, 0.0)
    rotation_error_std: NotNegative = 0.0  # per episode and axis, unknown to the policy [rad]
    position_error_std: NotNegative = 0.0  # per episode and axis, unknown to the policy [m]


@dataclass(frozen=True)
class KeypointNoiseParams(BoundedFields):
    """Errors of the keypoints, in normalised image coordinates (1 at the edge of the field of
    view).

    ``invalid_reads`` sets the value of a keypoint outside the field of view. ``zero``: the
    principal point with validity 0, as a real detector would report it. A keypoint of the ball's
    box is valid where every side of the box that it is computed from is visible. ``edge``: its
    exact, noise-free direction at the edge, radius 1, which only poses reveal. This is meant for
    ablations, and is the default for policies exported before the rule was recorded. A dropped-out
    keypoint is zero in both modes. A wrong keypoint is at a random place in the image and valid."""

    step_std: NotNegative = 0.01  # Gaussian per step, keypoint and axis [-]
    bias_std: NotNegative = 0.001  # Gaussian per episode, keypoint and axis [-]
    drop_probability: Share = 0.0  # per step and keypoint, of being reported invalid [-]
    latency: NotNegative = (
        0.0  # age of the keypoints in the observation, fractions interpolated [policy steps]
    )
    wrong_probability: Share = 0.0  # per step and keypoint, of a false detection [-]
    held_probability: Share = 0.0  # per step, of repeating the last image's keypoints [-]
    scale_std: NotNegative = 0.0  # Gaussian per episode: relative error of the focal length [-]
    # radius beyond which nothing is visible, to imitate a narrower lens with its own calibration
    # [-]
    visible_radius: Annotated[float, Bound(0.0, 1.0, "(]")] = 1.0
    invalid_reads: Literal["edge", "zero"] = "edge"

    @property
    def history_length(self) -> int:
        """Number of entries of a latency buffer."""
        return int(-(-self.latency // 1)) + 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.invalid_reads not in ("edge", "zero"):
            raise ValueError(
                f"keypoint noise invalid_reads is {self.invalid_reads!r}; expected one of 'edge',"
                " 'zero'"
            )


@dataclass(frozen=True)
class CameraParams(BoundedFields):
    """Complete camera that a policy is trained with. An exported policy carries these values."""

    fisheye: FisheyeParams
    mount: MountParams
    noise: KeypointNoiseParams
    goal_side: Length  # side of the square on the ground whose corners are keypoints [m]
    payload_radius: Length  # radius of the ball whose bounding box gives keypoints [m]
