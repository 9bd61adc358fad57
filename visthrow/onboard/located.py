"""Where keypoints lie by the camera as it is configured: what the actor may be given beside them. Onboard-safe.

The estimate that a memory makes (:mod:`visthrow.onboard.estimator`) need then not learn the lens, but what is wrong with it.
"""

import torch
from torch import Tensor

from camera.keypoints import GOAL_KEYPOINTS, KeypointCamera
from visthrow.onboard import goal_motion
from visthrow.onboard.observations import VEHICLE, Layout


def located(layout: Layout, frame: Tensor, valid: Tensor, camera: KeypointCamera) -> Tensor:
    """Goal and payload in the world as one vision frame shows them.

    Args:
        layout: of the frame.
        frame: shape (E, layout.frame), with its noise.
        valid: validity of the keypoints, shape (E, 8).
        camera: with its nominal mount.

    Returns:
        Goal - vehicle, horizontal [m], 2; direction from lens to payload, 3; whether the goal is seen, 1; world frame, shape (E, 6).
        What is not seen is 0.
    """
    goals, weight = goal_motion.goal_by_corner(layout, frame, valid, camera)
    box, bits = frame[:, VEHICLE + layout.goal :].unflatten(1, (-1, 2)), valid[:, GOAL_KEYPOINTS:]
    goal_xy, centre = middle(goals, weight > 0.0), middle(box, bits)
    ray_c, _ = camera.fisheye.unproject(camera.fisheye.denormalize(centre))
    x_axis, y_axis = frame[:, 9:12], frame[:, 12:15]
    rot_wb = torch.stack([x_axis, y_axis, torch.linalg.cross(x_axis, y_axis)], dim=-1)
    ray_w = (ray_c[:, None] @ camera.rot_cb @ rot_wb.transpose(1, 2))[:, 0]
    seen, hangs = (weight > 0.0).any(-1, keepdim=True), bits.any(-1, keepdim=True)
    return torch.cat([(goal_xy - frame[:, :2]) * seen, ray_w * hangs, seen.to(frame.dtype)], dim=-1)


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
