"""Fit of the goal's place, and of its velocity where it moves, from what the actor measures anyway. Onboard-safe.

A history of a few goal measurements cannot serve: with the paper's noise (0.01 m a step) the slope through four of them,
20 ms apart, is known to 0.2 m/s, which is 0.15 m at the landing. So every control step yields one measured goal position in
the world, and the actor is given the slope of the weighted least-squares line through all of them since the throw began,
drawn to zero by a prior that matters for the first few steps. The state layout adds up its measured positions; the vision
layout sends each seen corner's ray to the ground, a corner counting by the accuracy that its distance leaves.

Source: weighted linear regression with a Gaussian prior on the slope (ridge), in sums that are carried from step to step.
"""

import torch
from torch import Tensor

from camera.keypoints import GOAL_KEYPOINTS, KeypointCamera
from visthrow.onboard.observations import VEHICLE, Layout, rotation_in

SUMS = 7  # width of the carried sums: w, w t, w t^2, w x, w y, w t x, w t y
POSITION_SIGMA = 0.017  # deviation of one measured goal position of the state layout [m]: three measurements of 0.01 m each are added up
ANGLE_SIGMA = 0.02  # deviation of a corner's ray, camera and attitude together [rad]: 0.01 of a half field of view of 110 degrees
SPEED_SIGMA = 0.4  # prior of each component of the velocity [m/s]: what speeds uniform up to 1 m/s have
GRAZING = 0.1  # sine of the least angle below the horizon at which a ray is followed to the ground


def empty_sums(count: int, device: str | torch.device = "cpu") -> Tensor:
    """Sums before the first step, shape (E, 7)."""
    return torch.zeros(count, SUMS, device=device)


def fit(sums: Tensor, time: Tensor, goal_xy: Tensor, weight: Tensor, fresh: Tensor) -> tuple[Tensor, Tensor]:
    """Take in one step's goal and give the velocity so far.

    Args:
        sums: of the steps before, shape (E, 7).
        time: since the throw began [s], shape (E,).
        goal_xy: measured goal [m], shape (E, 2), world frame.
        weight: inverse variance of it [1/m^2], shape (E,); 0 where the goal was not seen.
        fresh: throws that begin here, bool, shape (E,).

    Returns:
        The new sums and the velocity [m/s], shape (E, 2), world frame.
    """
    t, w = time[:, None], weight[:, None]
    new = torch.cat([w, w * t, w * t * t, w * goal_xy, w * t * goal_xy], dim=-1)
    sums = torch.where(fresh[:, None], 0.0, sums) + new
    total, first, second, place, moved = sums[:, :1], sums[:, 1:2], sums[:, 2:3], sums[:, 3:5], sums[:, 5:7]
    mean = first / total.clamp(min=1e-9)
    velocity = (moved - mean * place) / ((second - mean * first).clamp(min=0.0) + SPEED_SIGMA**-2)
    return sums, velocity


def place(sums: Tensor, time: Tensor, velocity: Tensor | None = None) -> Tensor:
    """Goal by all steps so far [m], shape (E, 2), world frame; 0 where none has seen it.

    Args:
        sums: of :func:`fit`. time: of this step [s], shape (E,).
        velocity: of a goal that moves [m/s], shape (E, 2).
    """
    total = sums[:, :1].clamp(min=1e-9)
    mean = sums[:, 3:5] / total
    if velocity is None:
        return mean
    return mean + velocity * (time[:, None] - sums[:, 1:2] / total) * (sums[:, :1] > 0.0)


def measured_goal(
    layout: Layout, frame: Tensor, valid: Tensor | None, camera: KeypointCamera | None
) -> tuple[Tensor, Tensor]:
    """Goal in the world as one frame shows it.

    Args:
        layout: of the frame.
        frame: shape (E, layout.frame), with its noise.
        valid: validity of the keypoints, shape (E, 8); vision only.
        camera: vision only.

    Returns:
        Position [m], shape (E, 2), world frame, and its inverse variance [1/m^2], shape (E,).
    """
    if layout.name == "state":
        offset, hanging = frame[:, VEHICLE : VEHICLE + 2], frame[:, VEHICLE + 2 : VEHICLE + 4]
        goal_xy = frame[:, :2] + hanging + offset
        return goal_xy, torch.full_like(goal_xy[:, 0], POSITION_SIGMA**-2)
    goals, weight = goal_by_corner(layout, frame, valid, camera)
    total = weight.sum(-1)
    return (weight[..., None] * goals).sum(1) / total.clamp(min=1e-9)[:, None], total


def goal_by_corner(layout: Layout, frame: Tensor, valid: Tensor, camera: KeypointCamera) -> tuple[Tensor, Tensor]:
    """Goal in the world as each corner of one vision frame shows it.

    Args:
        layout, frame, valid, camera: see :func:`measured_goal`.

    Returns:
        Positions [m], shape (E, 4, 2), world frame, and their inverse variances [1/m^2], shape (E, 4); 0 where a corner is not seen.
    """
    corners = frame[:, VEHICLE : VEHICLE + layout.goal].unflatten(1, (GOAL_KEYPOINTS, 2))
    rays_c, _ = camera.fisheye.unproject(camera.fisheye.denormalize(corners))
    rot_wb = rotation_in(frame)
    rays_w = rays_c @ camera.rot_cb @ rot_wb.transpose(1, 2)  # rows: (R_wb R_bc r)^T
    lens_w = frame[:, :3] + (rot_wb @ camera.position_b)
    height = lens_w[:, None, 2].clamp(min=0.1)
    reach = height / (-rays_w[..., 2]).clamp(min=GRAZING)
    goals = lens_w[:, None, :2] + reach[..., None] * rays_w[..., :2] - camera.square_w[:, :2]
    followed = valid[:, :GOAL_KEYPOINTS] & (rays_w[..., 2] < -GRAZING)
    return goals, followed * (height / (ANGLE_SIGMA * reach * reach)).square()
