"""Fit of the goal's place, and of its velocity where it moves, from what the actor measures anyway.

Onboard-safe.

A history of a few goal measurements cannot serve: with the paper's noise (0.01 m a step) the slope
through four of them, 20 ms apart, is known to 0.2 m/s, which is 0.15 m at the landing. So every
control step yields one measured goal position in the world, and the actor is given the slope of the
weighted least-squares line through all of them since the throw began, drawn to zero by a prior that
matters for the first few steps. The state layout adds up its measured positions; the vision layout
sends each seen corner's ray to the ground, a corner counting by the accuracy that its distance
leaves.

Where a layout is ``located`` the actor is given the mean goal of all steps. A vision layout is
given where keypoints lie by the camera as it is configured: the network need then not learn the
lens, but what is wrong with it. The goal is the mean of all steps of the throw, each weighted by
what its distance leaves: noise averages out, and it is known while it is out of view. An invisible
corner then reads as the fitted goal's projection.

Source: weighted linear regression with a Gaussian prior on the slope (ridge), in sums that are
carried from step to step."""

from typing import NamedTuple

import torch
from torch import Tensor

from camera.arrays import Array, library
from camera.keypoints import GOAL_KEYPOINTS, KeypointCamera, goal_corners_w
from camera.mount import points_c_from_w, rotate
from visthrow.onboard.observations import VEHICLE, Layout, rotation_in

SUMS = 7  # width of the carried sums: w, w t, w t^2, w x, w y, w t x, w t y
# deviation of one measured goal position of the state layout [m]: three measurements of 0.01 m each
# are added up
POSITION_SIGMA = 0.017
# deviation of a corner's ray, camera and attitude together [rad]: 0.01 of a half field of view of
# 110 degrees
ANGLE_SIGMA = 0.02
# prior of each component of the velocity [m/s]: what speeds uniform up to 1 m/s have
SPEED_SIGMA = 0.4
GRAZING = 0.1  # sine of the least angle below the horizon at which a ray is followed to the ground


def empty_sums(count: int, device: str | torch.device = "cpu") -> Tensor:
    """Return the sums before the first step, shape (E, 7)."""
    return torch.zeros(count, SUMS, device=device)


def fit(
    sums: Array, time: Array, goal_xy: Array, weight: Array, fresh: Array
) -> tuple[Array, Array]:
    """Take in one step's goal and give the velocity so far.

    Args:
        sums: of the steps before, shape (E, 7).
        time: since the throw began [s], shape (E,).
        goal_xy: measured goal [m], shape (E, 2), world frame.
        weight: inverse variance of it [1/m^2], shape (E,); 0 where the goal was not visible.
        fresh: throws that begin here, bool, shape (E,).

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
    """Goal by all steps so far [m], shape (E, 2), world frame, by its velocity where it moves
    [m/s]; 0 where none has seen it.
    """
    total = sums[:, :1].clip(min=1e-9)
    mean = sums[:, 3:5] / total
    if velocity is None:
        return mean
    return mean + velocity * (time[:, None] - sums[:, 1:2] / total) * (sums[:, :1] > 0.0)


def measure_goal(
    layout: Layout, frame: Array, valid: Array | None, camera: KeypointCamera | None
) -> tuple[Array, Array]:
    """Goal in the world as one frame shows it.

    Args:
        layout: of the frame. frame: shape (E, layout.frame), with its noise.
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
    """Goal corners of vision frames, normalised [-], shape (E, 4, 2)."""
    return frame[:, VEHICLE : VEHICLE + layout.goal].reshape(-1, GOAL_KEYPOINTS, 2)


def rays_w(camera: KeypointCamera, rot_wb: Array, points: Array) -> Array:
    """Directions in which points of the image lie, shape (E, K, 3), world frame.

    Args:
        camera: of the image. rot_wb: attitude, shape (E, 3, 3). points: normalised [-], shape (E,
            K, 2).
    """
    rays_c, _ = camera.fisheye.unproject(camera.fisheye.denormalize(points))
    return rotate(rot_wb, rotate(camera.rot_cb.T, rays_c))


def goal_by_corner(
    frame: Array, valid: Array, camera: KeypointCamera, rot_wb: Array, rays: Array
) -> tuple[Array, Array]:
    """Goal in the world as each corner of one vision frame shows it.

    Args:
        frame, valid, camera: as of :func:`measure_goal`. rot_wb: attitude in the frame, shape (E,
            3, 3).
        rays: to the corners, shape (E, 4, 3), world frame.

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
    """The sums that :func:`update_goal_fit` adds for a frame."""

    sums: Array
    velocity: Array  # of the goal [m/s], shape (E, 2), where the layout has it
    places: Array  # where they lie, shape (E, layout.located), where the layout has it
    frame: Array  # with invisible corners at their predicted places
    valid: Array


def update_goal_fit(
    layout: Layout,
    frame: Array,
    valid: Array | None,
    camera: KeypointCamera | None,
    sums: Array,
    time: Array,
    fresh: Array,
) -> GoalEstimate:
    """Take one frame into the goal's fit; arguments as of :func:`measure_goal` and :func:`fit`."""
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
    """:func:`update_goal_fit` where the layout says where keypoints lie: of four points of goal
    or box a wrong one is outvoted.

    The places are goal - vehicle, horizontal [m], 2; direction from lens to payload, 3; whether the
    goal is known, 1; world frame. What is not known is 0."""
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
    """Return the frame, and its validity, with invisible corners projected from the goal so far.

    Args:
        layout, frame, valid, camera: as of :func:`measure_goal`. rot_wb: attitude in the frame,
            shape (E, 3, 3).
        goal_xy: goal by the steps so far [m], shape (E, 2), world frame. is_known: whether one has
            seen it, bool, shape (E, 1).
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
    """Median of four points, shape (E, 4, 2), over those that are valid, shape (E, 4): a wrong one
    is outvoted; 0 where none is.
    """
    xp = library(points)
    count = valid.sum(-1)[:, None]
    known = xp.where(valid[..., None], points, float("inf"))
    one, two = known[:, :2], known[:, 2:]
    # of two pairs, each
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
