"""Where keypoints lie by the camera as it is configured: what the actor may be given beside them. Onboard-safe.

The network need then not learn the lens, but what is wrong with it. The goal is the mean of all steps of the throw, each weighted by
what its distance leaves: noise averages out, and it is known while it is out of view. A corner that is not seen then reads where the
fitted goal would be seen.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from camera.keypoints import GOAL_KEYPOINTS, KeypointCamera, goal_corners_w
from camera.mount import points_c_from_w
from visthrow.onboard import goal_motion
from visthrow.onboard.observations import VEHICLE, Layout, rotation_in


def goal_in_frame(layout: Layout, frame: Tensor, valid: Tensor, camera: KeypointCamera) -> tuple[Tensor, Tensor]:
    """Goal as one vision frame shows it, and its inverse variance; as :func:`goal_motion.measured_goal`, but a wrong corner is outvoted."""
    goals, weight = goal_motion.goal_by_corner(layout, frame, valid, camera)
    return middle(goals, weight > 0.0), weight.sum(-1)


def located(layout: Layout, frame: Tensor, valid: Tensor, camera: KeypointCamera, goal_xy: Tensor, known: Tensor) -> Tensor:
    """Goal and payload in the world.

    Args:
        layout: of the frame.
        frame: shape (E, layout.frame), with its noise.
        valid: validity of the keypoints, shape (E, 8).
        camera: with its nominal mount.
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
    """Take one frame into the goal's fit.

    Args:
        layout, frame, valid, camera: see :func:`goal_motion.measured_goal`.
        sums, time, fresh: see :func:`goal_motion.fit`.
    """
    measured = goal_in_frame if layout.located else goal_motion.measured_goal
    sums, velocity = goal_motion.fit(sums, time, *measured(layout, frame, valid, camera), fresh)
    moves = velocity if layout.motion else None
    if not layout.located:
        return Fitted(sums, moves, None, frame, valid)
    goal_xy, known = goal_motion.place(sums, time, moves), sums[:, 0] > 0.0
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
    """Median of four points' coordinates, shape (E, 4, 2), over those that are valid, shape (E, 4): one wrong point is outvoted.

    Returns:
        Shape (E, 2); 0 where none is valid.
    """
    count = valid.sum(-1, keepdim=True)
    ascending = torch.where(valid.unsqueeze(-1), points, torch.inf).sort(dim=1).values
    low, high = ((count - 1).clamp(min=0) // 2), (count // 2).clamp(max=3)
    rows = [ascending.gather(1, row.unsqueeze(-1).expand(-1, 1, 2))[:, 0] for row in (low, high)]
    return torch.where(count > 0, 0.5 * (rows[0] + rows[1]), 0.0)
