"""Fit the goal's position, and its velocity if it moves, from the actor's measurements.

Onboard-safe.

A history of a few goal measurements does not suffice: with the paper's noise (0.01 m in each step)
four of them, 20 ms apart, determine the velocity to 0.2 m/s, which is 0.15 m at the landing.
Therefore each control step yields one measured goal position in the world, and the actor observes
the slope of the weighted least-squares line through all of them since the start of the throw. A
prior pulls the slope to zero and matters in the first few steps. The state layout sums its measured
positions. The vision layout intersects the ray of each visible corner with the ground and weights a
corner by its accuracy at that distance.

In a ``located`` layout the actor observes the mean goal of all steps. A vision layout also contains
the positions of keypoints according to the nominal camera, so that the network need not learn the
lens but only its errors. The goal is the mean over all steps of the throw, weighted by accuracy:
noise averages out, and the goal is known while it is out of view. An invisible corner is replaced
by the projection of the fitted goal.

Source: weighted linear regression with a Gaussian prior on the slope (ridge), with sums that are
carried from step to step."""

from typing import NamedTuple

import torch
from torch import Tensor

from camera.arrays import Array, library
from camera.keypoints import GOAL_KEYPOINTS, KeypointCamera, goal_corners_w
from camera.mount import points_c_from_w, rotate
from visthrow.onboard.observations import VEHICLE, Layout, rotation_in

SUMS = 7  # number of carried sums: w, w t, w t^2, w x, w y, w t x, w t y
# standard deviation of a measured goal position in the state layout, the sum of three measurements
# of 0.01 m each [m]
POSITION_SIGMA = 0.017
# standard deviation of a corner's ray from camera and attitude [rad]: 0.01 of a half field of view
# of 110 degrees
ANGLE_SIGMA = 0.02
# prior standard deviation of each component of the velocity, for speeds uniform up to 1 m/s [m/s]
SPEED_SIGMA = 0.4
GRAZING = 0.1  # sine of the smallest angle below the horizon at which a ray is used


def empty_sums(count: int, device: str | torch.device = "cpu") -> Tensor:
    """Return the sums before the first step, shape (E, 7)."""
    return torch.zeros(count, SUMS, device=device)


def fit(
    sums: Array, time: Array, goal_xy: Array, weight: Array, fresh: Array
) -> tuple[Array, Array]:
    """Add one step's goal to the sums and return the velocity so far.

    Args:
        sums: sums of the earlier steps, shape (E, 7).
        time: time since the start of the throw [s], shape (E,).
        goal_xy: measured goal [m], shape (E, 2), world frame.
        weight: its inverse variance [1/m^2], shape (E,); 0 if the goal was not visible.
        fresh: whether a throw begins at this step, bool, shape (E,).

    Returns:
        The new sums and the velocity [m/s], shape (E, 2), world frame.
    """
    xp = library(sums)
    t = time[:, None]
    w = weight[:, None]
    wt = w * t
    new = xp.concatenate([w, wt, wt * t, w * goal_xy, wt * goal_xy], -1)
    sums = xp.where(fresh[:, None], 0.0, sums) + new
    total = sums[:, :1]
    first = sums[:, 1:2]
    second = sums[:, 2:3]
    place = sums[:, 3:5]
    moved = sums[:, 5:7]
    mean = first / total.clip(min=1e-9)
    velocity = (moved - mean * place) / ((second - mean * first).clip(min=0.0) + SPEED_SIGMA**-2)
    return sums, velocity


def place(sums: Array, time: Array, velocity: Array | None = None) -> Array:
    """Return the goal's present position from all steps so far [m], shape (E, 2), world frame; 0 if
    it was never visible. ``velocity``: velocity of a moving goal [m/s], shape (E, 2).
    """
    total = sums[:, :1].clip(min=1e-9)
    mean = sums[:, 3:5] / total
    if velocity is None:
        return mean
    return mean + velocity * (time[:, None] - sums[:, 1:2] / total) * (sums[:, :1] > 0.0)


def measure_goal(
    layout: Layout, frame: Array, valid: Array | None, camera: KeypointCamera | None
) -> tuple[Array, Array]:
    """Return the goal's position as measured in one frame.

    Args:
        layout: layout of the frame. frame: measurements, shape (E, layout.frame).
        valid: validity of the keypoints, shape (E, 8); vision only. camera: vision only.

    Returns:
        Position [m], shape (E, 2), world frame, and its inverse variance [1/m^2], shape (E,).
    """
    if layout.name == "state":
        offset = frame[:, VEHICLE : VEHICLE + 2]
        hanging = frame[:, VEHICLE + 2 : VEHICLE + 4]
        goal_xy = frame[:, :2] + hanging + offset
        return goal_xy, library(frame).full_like(goal_xy[:, 0], POSITION_SIGMA**-2)
    rot_wb = rotation_in(frame)
    goals, weight = goal_by_corner(
        frame, valid, camera, rot_wb, rays_w(camera, rot_wb, _corners(layout, frame))
    )
    total = weight.sum(-1)
    return (weight[..., None] * goals).sum(1) / total.clip(min=1e-9)[:, None], total


def _corners(layout: Layout, frame: Array) -> Array:
    """Return the goal corners of vision frames, normalised [-], shape (E, 4, 2)."""
    return frame[:, VEHICLE : VEHICLE + layout.goal].reshape(-1, GOAL_KEYPOINTS, 2)


def rays_w(camera: KeypointCamera, rot_wb: Array, points: Array) -> Array:
    """Return the rays of image points, unit vectors, shape (E, K, 3), world frame.

    Args:
        camera: the camera. rot_wb: attitude, shape (E, 3, 3).
        points: image points, normalised [-], shape (E, K, 2).
    """
    rays_c, _ = camera.fisheye.unproject(camera.fisheye.denormalize(points))
    return rotate(rot_wb, rotate(camera.rot_cb.T, rays_c))


def goal_by_corner(
    frame: Array, valid: Array, camera: KeypointCamera, rot_wb: Array, rays: Array
) -> tuple[Array, Array]:
    """Return the goal's position according to each corner of a vision frame.

    Args:
        frame, valid, camera: see :func:`measure_goal`.
        rot_wb: attitude in the frame, shape (E, 3, 3).
        rays: rays to the corners, shape (E, 4, 3), world frame.

    Returns:
        Positions [m], shape (E, 4, 2), world frame, and their inverse variances [1/m^2], shape (E,
        4); 0 where a corner is not visible.
    """
    lens_w = frame[:, :3] + rotate(rot_wb, camera.position_b[None])[:, 0]
    height = lens_w[:, None, 2].clip(min=0.1)
    down = -rays[..., 2]
    reach = height / down.clip(min=GRAZING)
    goals = lens_w[:, None, :2] + reach[..., None] * rays[..., :2] - camera.square_w[:, :2]
    followed = valid[:, :GOAL_KEYPOINTS] & (down > GRAZING)
    sharpness = height / (ANGLE_SIGMA * reach * reach)
    return goals, followed * (sharpness * sharpness)


class GoalEstimate(NamedTuple):
    """The result of :func:`update_goal_fit` for a frame."""

    sums: Array  # with this frame, shape (E, 7)
    velocity: Array  # of the goal [m/s], shape (E, 2); None if the layout does not have it
    places: Array  # positions, shape (E, layout.located); None if the layout does not have them
    frame: Array  # with invisible corners at their predicted positions
    valid: Array  # validity after this prediction


def update_goal_fit(
    layout: Layout,
    frame: Array,
    valid: Array | None,
    camera: KeypointCamera | None,
    sums: Array,
    time: Array,
    fresh: Array,
) -> GoalEstimate:
    """Add one frame to the goal's fit; arguments: see :func:`measure_goal` and :func:`fit`."""
    if layout.name == "state" or not layout.located:
        sums, velocity = fit(sums, time, *measure_goal(layout, frame, valid, camera), fresh)
        moves = velocity if layout.motion else None
        if layout.located:
            places = place(sums, time, moves) - frame[:, :2]
        else:
            places = None
        return GoalEstimate(sums, moves, places, frame, valid)
    return _update_located(layout, frame, valid, camera, sums, time, fresh)


def _update_located(
    layout: Layout,
    frame: Array,
    valid: Array,
    camera: KeypointCamera,
    sums: Array,
    time: Array,
    fresh: Array,
) -> GoalEstimate:
    """Do :func:`update_goal_fit` for a located vision layout. Medians over the four points of goal
    and box reject a single wrong one.

    The positions are goal - vehicle, horizontal [m], 2; direction from lens to payload, 3; whether
    the goal is known, 1; world frame. Unknown ones are 0."""
    xp = library(frame)
    box = frame[:, VEHICLE + layout.goal :].reshape(-1, 4, 2)
    box_valid = valid[:, GOAL_KEYPOINTS:]
    rot_wb = rotation_in(frame)
    centre = middle(box, box_valid)
    points = xp.concatenate([_corners(layout, frame), centre[:, None]], 1)
    rays = rays_w(camera, rot_wb, points)
    goals, weight = goal_by_corner(frame, valid, camera, rot_wb, rays[:, :GOAL_KEYPOINTS])
    total = weight[:, 0] + weight[:, 1] + weight[:, 2] + weight[:, 3]
    sums, velocity = fit(sums, time, middle(goals, weight > 0.0), total, fresh)
    moves = velocity if layout.motion else None
    goal_xy = place(sums, time, moves)
    located = sums[:, :1] > 0.0
    hangs = box_valid.any(-1)[:, None]
    goal = (goal_xy - frame[:, :2]) * located
    ball = rays[:, GOAL_KEYPOINTS] * hangs
    places = xp.concatenate([goal, ball, located], -1)
    return GoalEstimate(
        sums,
        moves,
        places,
        *predict_invisible_corners(layout, frame, valid, camera, rot_wb, goal_xy, located),
    )


def predict_invisible_corners(
    layout: Layout,
    frame: Array,
    valid: Array,
    camera: KeypointCamera,
    rot_wb: Array,
    goal_xy: Array,
    is_known: Array,
) -> tuple[Array, Array]:
    """Return the frame and its validity with invisible corners replaced by projections of the
    fitted goal.

    Args:
        layout, frame, valid, camera: see :func:`measure_goal`.
        rot_wb: attitude in the frame, shape (E, 3, 3).
        goal_xy: fitted goal [m], shape (E, 2), world frame.
        is_known: whether the goal was visible in a step so far, bool, shape (E, 1).
    """
    xp = library(frame)
    corners_w = goal_corners_w(goal_xy, camera.square_w)
    corners_c = points_c_from_w(corners_w, frame[:, :3], rot_wb, camera.rot_cb, camera.position_b)
    points, visible = camera.fisheye.project_normalized(corners_c, clip=True)
    measured_valid = valid[:, :GOAL_KEYPOINTS]
    end = VEHICLE + layout.goal
    filled = visible & is_known & ~measured_valid
    corners = xp.where(filled[..., None], points, _corners(layout, frame)).reshape(len(frame), -1)
    frame = xp.concatenate([frame[:, :VEHICLE], corners, frame[:, end:]], -1)
    return frame, xp.concatenate([measured_valid | filled, valid[:, GOAL_KEYPOINTS:]], -1)


def middle(points: Array, valid: Array) -> Array:
    """Return the median of the valid ones, shape (E, 4), among four points, shape (E, 4, 2), which
    rejects a single wrong one; 0 if none is valid.
    """
    xp = library(points)
    count = valid.sum(-1)[:, None]
    known = xp.where(valid[..., None], points, float("inf"))
    one, two = known[:, :2], known[:, 2:]
    # smaller and larger one of two pairs each
    small = xp.minimum(one, two)
    large = xp.maximum(one, two)
    first = xp.minimum(small[:, 0], small[:, 1])
    inner = xp.maximum(small[:, 0], small[:, 1])
    outer = xp.minimum(large[:, 0], large[:, 1])
    second = xp.minimum(inner, outer)
    third = xp.maximum(inner, outer)
    lower = xp.where(count > 2, second, first)
    upper = xp.where(count > 3, third, xp.where(count > 1, second, first))
    return xp.where(count > 0, (lower + upper) * 0.5, 0.0)
