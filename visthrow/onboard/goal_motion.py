"""Fit of the goal's place, and of its velocity where it moves, from what the actor measures anyway. Onboard-safe.

A history of a few goal measurements cannot serve: with the paper's noise (0.01 m a step) the slope through four of them,
20 ms apart, is known to 0.2 m/s, which is 0.15 m at the landing. So every control step yields one measured goal position in
the world, and the actor is given the slope of the weighted least-squares line through all of them since the throw began,
drawn to zero by a prior that matters for the first few steps. The state layout adds up its measured positions; the vision
layout sends each seen corner's ray to the ground, a corner counting by the accuracy that its distance leaves.

Where a layout is ``located`` the actor is given too where keypoints lie by the camera as it is configured: the network need then not
learn the lens, but what is wrong with it. The goal is the mean of all steps of the throw, each weighted by what its distance leaves:
noise averages out, and it is known while it is out of view. A corner that is not seen then reads where the fitted goal would be seen.

Source: weighted linear regression with a Gaussian prior on the slope (ridge), in sums that are carried from step to step.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from camera.keypoints import GOAL_KEYPOINTS, KeypointCamera, goal_corners_w
from camera.mount import points_c_from_w
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
    """Goal by all steps so far [m], shape (E, 2), world frame, by its velocity where it moves [m/s]; 0 where none has seen it."""
    total = sums[:, :1].clamp(min=1e-9)
    mean = sums[:, 3:5] / total
    if velocity is None:
        return mean
    return mean + velocity * (time[:, None] - sums[:, 1:2] / total) * (sums[:, :1] > 0.0)


def measured_goal(layout: Layout, frame: Tensor, valid: Tensor | None, camera: KeypointCamera | None) -> tuple[Tensor, Tensor]:
    """Goal in the world as one frame shows it.

    Args:
        layout: of the frame. frame: shape (E, layout.frame), with its noise.
        valid: validity of the keypoints, shape (E, 8); vision only. camera: vision only.

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
    """Goal in the world as each corner of one vision frame shows it; arguments as of :func:`measured_goal`.

    Returns positions [m], shape (E, 4, 2), world frame, and their inverse variances [1/m^2], shape (E, 4); 0 where a corner is not seen.
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


def goal_in_frame(layout: Layout, frame: Tensor, valid: Tensor, camera: KeypointCamera) -> tuple[Tensor, Tensor]:
    """Goal as one vision frame shows it, and its inverse variance; as :func:`measured_goal`, but a wrong corner is outvoted."""
    goals, weight = goal_by_corner(layout, frame, valid, camera)
    return middle(goals, weight > 0.0), weight.sum(-1)


def located(layout: Layout, frame: Tensor, valid: Tensor, camera: KeypointCamera, goal_xy: Tensor, known: Tensor) -> Tensor:
    """Goal and payload in the world; arguments as of :func:`measured_goal`, and of the goal so far.

    Args:
        layout, frame, valid, camera: see there.
        goal_xy: goal by the steps so far [m], shape (E, 2), world frame. known: whether one has seen it, bool, shape (E,).

    Returns:
        Goal - vehicle, horizontal [m], 2; direction from lens to payload, 3; whether the goal is known, 1; world frame, shape (E, 6).
        What is not known is 0.
    """
    box, bits = frame[:, VEHICLE + layout.goal :].unflatten(1, (-1, 2)), valid[:, GOAL_KEYPOINTS:]
    centre = middle(box, bits)
    ray_c, _ = camera.fisheye.unproject(camera.fisheye.denormalize(centre))
    rot_wb = rotation_in(frame)
    ray_w = (ray_c[:, None] @ camera.rot_cb @ rot_wb.transpose(1, 2))[:, 0]
    hangs = bits.any(-1, keepdim=True)
    return torch.cat([(goal_xy - frame[:, :2]) * known[:, None], ray_w * hangs, known[:, None].to(frame.dtype)], dim=-1)


class Fitted(NamedTuple):
    """What :func:`fitted_goal` makes of a frame."""

    sums: Tensor
    velocity: Tensor | None  # of the goal [m/s], shape (E, 2), where the layout has it
    places: Tensor | None  # where the keypoints lie, shape (E, 6), where the layout has it
    frame: Tensor  # with corners that were not seen where they would be
    valid: Tensor | None


def fitted_goal(
    layout: Layout, frame: Tensor, valid: Tensor | None, camera: KeypointCamera | None, sums: Tensor, time: Tensor, fresh: Tensor
) -> Fitted:
    """Take one frame into the goal's fit; arguments as of :func:`measured_goal` and :func:`fit`."""
    measured = goal_in_frame if layout.located else measured_goal
    sums, velocity = fit(sums, time, *measured(layout, frame, valid, camera), fresh)
    moves = velocity if layout.motion else None
    if not layout.located:
        return Fitted(sums, moves, None, frame, valid)
    goal_xy, known = place(sums, time, moves), sums[:, 0] > 0.0
    places = located(layout, frame, valid, camera, goal_xy, known)
    return Fitted(sums, moves, places, *predicted(layout, frame, valid, camera, goal_xy, known))


def predicted(
    layout: Layout, frame: Tensor, valid: Tensor, camera: KeypointCamera, goal_xy: Tensor, known: Tensor
) -> tuple[Tensor, Tensor]:
    """The frame, and its validity, with corners that are not seen where the goal so far would be seen; arguments as of :func:`located`."""
    rot_wb = rotation_in(frame)
    corners_w = goal_corners_w(goal_xy, square_w=camera.square_w)
    corners_c = points_c_from_w(corners_w, frame[:, :3], rot_wb, camera.rot_cb, camera.position_b)
    points, inside = camera.fisheye.project_normalized(corners_c, clip=True)
    seen, end = valid[:, :GOAL_KEYPOINTS], VEHICLE + layout.goal
    filled = ~seen & inside & known[:, None]
    corners = torch.where(filled[..., None], points, frame[:, VEHICLE:end].unflatten(1, (GOAL_KEYPOINTS, 2)))
    frame = torch.cat([frame[:, :VEHICLE], corners.flatten(1), frame[:, end:]], dim=-1)
    return frame, torch.cat([seen | filled, valid[:, GOAL_KEYPOINTS:]], dim=-1)


def middle(points: Tensor, valid: Tensor) -> Tensor:
    """Median of four points, shape (E, 4, 2), over those that are valid, shape (E, 4): a wrong one is outvoted; 0 where none is."""
    count = valid.sum(-1, keepdim=True)
    ascending = torch.where(valid.unsqueeze(-1), points, torch.inf).sort(dim=1).values
    low, high = ((count - 1).clamp(min=0) // 2), (count // 2).clamp(max=3)
    rows = [ascending.gather(1, row.unsqueeze(-1).expand(-1, 1, 2))[:, 0] for row in (low, high)]
    return torch.where(count > 0, 0.5 * (rows[0] + rows[1]), 0.0)
