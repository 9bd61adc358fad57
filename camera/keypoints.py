"""Keypoints of the vision policy: corners of the goal square and the bounding box of the ball.

`keypoints` computes them for a batch of thousands in the training environment;
`visthrow.onboard.row_keypoints` computes them on arrays for the single vehicle of the HIL runner.
"""

import copy

import torch
from torch import Tensor

from camera.arrays import Array, library
from camera.fisheye import AXIS_EPSILON, Fisheye
from camera.mount import nominal_rot_cb, points_c_from_w, rotate, rotation_from_vector
from camera.params import CameraParams

GOAL_KEYPOINTS = 4
PAYLOAD_KEYPOINTS = 4
KEYPOINTS = GOAL_KEYPOINTS + PAYLOAD_KEYPOINTS
"""Number of keypoints, K = 8: 0 to 3 are the goal corners, 4 to 7 belong to the payload's box."""

MAX_SINE = 0.99
"""Largest sine of the ball's half-angle. It keeps the box finite if the lens touches or enters the
ball.
"""


DIRECTION_EPSILON = 1e-10
"""Added to the squared sine of the ball's angle off the axis, so that the box's derivative behind
the lens stays finite in float32.
"""


class KeypointCamera:
    """A camera with its constants on one device, created before a CUDA graph is captured.

    Attributes:
        params: The configuration.
        fisheye: The lens.
        rot_cb: Nominal extrinsic rotation, body to camera, shape (3, 3).
        position_b: Nominal lens position [m], shape (3,), body frame.
        radius: Radius of the ball [m]; shape (E,) if it differs between vehicles.
        square_w: Goal corners relative to the goal [m], shape (4, 3), world frame.
        edge_reads: Whether a point outside the field of view is moved to its edge (else to zero).
    """

    def __init__(
        self,
        params: CameraParams,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ):
        """Put the constants on the device."""
        self.params = params
        self.fisheye = Fisheye(params.fisheye)
        self.rot_cb = nominal_rot_cb(params.mount).to(device=device, dtype=dtype)
        self.position_b = torch.tensor(params.mount.position_b, device=device, dtype=dtype)
        self.radius: float | Tensor = params.payload_radius
        self.square_w = goal_square(params.goal_side).to(device=device, dtype=dtype)
        self.edge_reads = params.noise.invalid_reads == "edge"
        self._axes = torch.eye(2, 3, device=device, dtype=dtype)
        self.fisheye.normalize(self.position_b[:2])  # caches the lens constants on this device

    def convert_to_arrays(self) -> "KeypointCamera":
        """Return a copy of the camera with its constants as NumPy arrays."""
        camera = copy.copy(self)
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                setattr(camera, name, value.numpy())
        return camera

    def extrinsics(self, rotation_error: Tensor, position_error: Tensor) -> tuple[Tensor, Tensor]:
        """Return the extrinsics with an error for each environment:

        ``rot_bc = exp(rotation_error) rot_bc_nominal``, in the body frame.

        Args:
            rotation_error: Rotation vectors [rad], shape (E, 3), body frame.
            position_error: Offsets [m], shape (E, 3), body frame.

        Returns:
            rot_cb, shape (E, 3, 3), and position_b [m], shape (E, 3): the ``extrinsics`` of
            `keypoints`.
        """
        # rot_bc = turn @ nominal, hence rot_cb = nominal @ turn^T
        turn = rotation_from_vector(rotation_error)
        return rotate(turn, self.rot_cb.expand(turn.shape)), self.position_b + position_error


def goal_square(side: float) -> Tensor:
    """Return the goal square's corners from its centre [m], float64, shape (4, 3), world frame.

    Convention: (+x, +y), (+x, -y), (-x, -y), (-x, +y): clockwise seen from above. In the image of a
    downward camera whose vehicle faces +x, they are top left, top right, bottom right, bottom left.
    Sides are parallel to the world's axes."""
    h = side / 2.0
    return torch.tensor(
        [[h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0], [-h, h, 0.0]], dtype=torch.float64
    )


def goal_corners_w(goal_w: Array, square_w: Array) -> Array:
    """Return the corners of the square around the goal, at z = 0 for any height of the goal.

    Args:
        goal_w: Goal [m], shape (E, 2) or (E, 3), world frame.
        square_w: `goal_square` on the goal's device [m], shape (4, 3).

    Returns:
        Corners [m], shape (E, 4, 3), world frame, in the order of `goal_square`.
    """
    xp = library(goal_w)
    flat = goal_w[:, None, :2] + square_w[:, :2]
    heights = xp.broadcast_to(square_w[:, 2:], (*flat.shape[:2], 1))
    return xp.concatenate([flat, heights], -1)


def ball_extremes_c(
    fisheye: Fisheye,
    ball_c: Tensor,
    radius: float | Tensor,
    axes: Tensor | None = None,
) -> Tensor:
    """Return the rays to the leftmost, topmost, rightmost and bottommost point of a ball's outline
    in the image.

    The outline of a ball of radius r at distance d is the cone of half-angle ``a = asin(r / d)``
    about its centre's ray c. This is exact in every direction, beyond 90 deg too. The image
    coordinate u increases fastest along its gradient on the sphere, so its extremes are at the rays
    ``cos(a) c -+ sin(a) grad u / |grad u|``; v is treated in the same way. With ``rho = theta_d``,
    ``s = sin(theta)``, ``g = rho / s``, ``q = (rho' cos(theta) - g) / s^2``: ``grad u = (g + q
    c_x^2, q c_x c_y, -rho' c_x)``. The gradient is evaluated at the centre, so the ray's position
    on the outline is accurate to first order in a. The extreme value is stationary and therefore
    accurate to second order. At a rope's length (0.38 m) the error of the box is at most 2.2e-4 in
    normalised coordinates.

    Args:
        fisheye: The lens.
        ball_c: Centre of the ball [m], shape (E, 3), camera frame.
        radius: Radius of the ball [m], one or shape (E,).
        axes: eye(2, 3) on the ball's device, if it exists already.

    Returns:
        Unit rays, shape (E, 4, 3), camera frame: left, top, right, bottom.
    """
    if axes is None:
        axes = torch.eye(2, 3, device=ball_c.device, dtype=ball_c.dtype)
    x, y, z = ball_c.unbind(-1)
    distance = (x * x + y * y + z * z + AXIS_EPSILON).sqrt()
    centre = ball_c / distance.unsqueeze(-1)
    theta, s, _ = fisheye.angle(centre, DIRECTION_EPSILON)
    sine = (radius / distance).clamp(max=MAX_SINE)
    cosine = (1.0 - sine * sine).sqrt()
    g = fisheye.radius_from_angle(theta) / s
    slope = fisheye.slope_from_angle(theta)
    q = (slope * centre[:, 2] - g) / (s * s)
    lateral = centre[:, :2]
    tangent = torch.cat([lateral * q.unsqueeze(-1), -slope.unsqueeze(-1)], -1)
    # gradients of u and v, shape (E, 2, 3)
    gradient = lateral.unsqueeze(-1) * tangent.unsqueeze(-2) + g[:, None, None] * axes
    tx, ty, tz = gradient.unbind(-1)
    size = (tx * tx + ty * ty + tz * tz + AXIS_EPSILON).sqrt()
    step = gradient * (sine.unsqueeze(-1) / size).unsqueeze(-1)
    middle = (centre * cosine.unsqueeze(-1)).unsqueeze(-2)
    return torch.cat([middle - step, middle + step], -2)


def box_midpoints(extremes: Array) -> Array:
    """Return the edge midpoints of the axis-aligned box through four extreme points.

    They depend only on the four numbers of a box, so that a detector can replace the projection.
    Unlike the corners they are on or near the ball's outline, so that the visibility of each can be
    tested by the field of view.

    Args:
        extremes: Image points left, top, right, bottom, shape (E, 4, 2).

    Returns:
        Midpoints of the left, top, right and bottom edge, shape (E, 4, 2).
    """
    low = extremes[:, 0, 0]
    top = extremes[:, 1, 1]
    right = extremes[:, 2, 0]
    bottom = extremes[:, 3, 1]
    u = (low + right) * 0.5
    v = (top + bottom) * 0.5
    middles = library(extremes).stack([low, v, u, top, right, v, u, bottom], -1)
    return middles.reshape(-1, 4, 2)


def correct_keypoints(
    camera: KeypointCamera,
    points: Tensor,
    valid: Tensor,
    turn_b: Tensor,
    scale: Tensor,
) -> tuple[Tensor, Tensor]:
    """Correct keypoints for known errors of the cameras' rotations and focal lengths: return the
    keypoints that the nominal camera would measure.

    Args:
        camera: The nominal camera.
        points: Normalised [-], shape (E, K, 2). valid: shape (E, K), bool.
        turn_b: Rotation vectors of the cameras' rotation errors [rad], shape (E, 3), body frame.
        scale: Relative errors of their focal lengths [-], shape (E,).

    Returns:
        Points [-], shape (E, K, 2), and validity, shape (E, K). A point outside the nominal field
        of view is invalid and zero.
    """
    plane = points / (1.0 + scale[:, None, None])
    rays_c, _ = camera.fisheye.unproject(camera.fisheye.denormalize(plane))
    turn_c = camera.rot_cb @ rotation_from_vector(turn_b) @ camera.rot_cb.T
    rays_c = rays_c @ turn_c.transpose(-1, -2)
    projected, visible = camera.fisheye.project_normalized(rays_c, clip=True)
    valid = valid & visible
    return projected * valid.unsqueeze(-1), valid


def payload_keypoints(camera: KeypointCamera, ball_c: Tensor) -> tuple[Tensor, Tensor]:
    """Return the payload's keypoints, as a detector's box around the ball would give them.

    Args:
        camera: The camera.
        ball_c: Centre of the ball [m], shape (E, 3), camera frame.

    Returns:
        Normalised edge midpoints (left, top, right, bottom) [-], shape (E, 4, 2), and validity,
        shape (E, 4): whether the outline's point on that side is inside the field of view and on
        the sensor. Extremes beyond the field of view are first clipped to its edge.
    """
    rays = ball_extremes_c(camera.fisheye, ball_c, camera.radius, camera._axes)
    extremes, valid = camera.fisheye.project_normalized(rays, clip=True)
    return box_midpoints(extremes), valid


def keypoints(
    camera: KeypointCamera,
    pos_w: Tensor,
    rot_wb: Tensor,
    goal_w: Tensor,
    payload_w: Tensor,
    extrinsics: tuple[Tensor, Tensor] | None = None,
) -> tuple[Tensor, Tensor]:
    """Return the keypoints of goal and payload without noise.

    Args:
        camera: The camera, on the device of the other arguments.
        pos_w: Centre of mass of the vehicle [m], shape (E, 3), world frame.
        rot_wb: Attitude, body to world, shape (E, 3, 3).
        goal_w: Goal [m], shape (E, 2) or (E, 3), world frame; the corners lie on z = 0.
        payload_w: Centre of the ball [m], shape (E, 3), world frame.
        extrinsics: rot_cb and position_b for each environment (`KeypointCamera.extrinsics`); by
            default the nominal mount.

    Returns:
        Keypoints [-], shape (E, 8, 2), normalised image coordinates (x right, y down, 1 at the edge
        of the field of view), goal corners first (order of `goal_square`), then the payload's box
        (left, top, right, bottom); and validity (bool), shape (E, 8). With ``invalid_reads =
        "edge"`` an invalid corner is moved to the edge along its direction, and an invalid side of
        the box is the side of the outline clipped to the edge. With ``"zero"`` both are zero, and
        the midpoint of a side is valid if that side and the two adjacent sides, which give its
        other coordinate, are visible.
    """
    rot_cb, position_b = (camera.rot_cb, camera.position_b) if extrinsics is None else extrinsics
    corners_w = goal_corners_w(goal_w, camera.square_w)
    points_w = torch.cat([corners_w, payload_w.unsqueeze(-2)], -2)
    points_c = points_c_from_w(points_w, pos_w, rot_wb, rot_cb, position_b)
    rays_c = ball_extremes_c(camera.fisheye, points_c[:, 4], camera.radius, camera._axes)
    marks_c = torch.cat([points_c[:, :4], rays_c], -2)
    projected, valid = camera.fisheye.project_normalized(marks_c, clip=True)
    points = torch.cat([projected[:, :4], box_midpoints(projected[:, 4:])], -2)
    return apply_invalid_rule(camera, points, valid)


def apply_invalid_rule(camera: KeypointCamera, points: Array, valid: Array) -> tuple[Array, Array]:
    """Apply ``invalid_reads`` to points that are clipped to the edge.

    Args:
        camera: The camera.
        points: Normalised keypoints [-], shape (E, 8, 2): corners, then the box.
        valid: Whether the corner or side is in the field of view, shape (E, 8).

    Returns:
        Keypoints and validity as `keypoints` returns them.
    """
    if camera.edge_reads:
        return points, valid
    xp = library(points)
    box = valid[:, GOAL_KEYPOINTS:]
    across = box[:, :2] & box[:, 2:]
    flanks, ends = across[:, :1], across[:, 1:]  # left and right, top and bottom
    whole = box & xp.concatenate([ends, flanks, ends, flanks], 1)
    valid = xp.concatenate([valid[:, :GOAL_KEYPOINTS], whole], 1)
    return xp.where(valid[..., None], points, 0.0), valid
