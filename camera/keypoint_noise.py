"""Errors of a keypoint detector: noise, bias of an episode, drop-outs, latency, and the values of
invalid keypoints.

Random numbers are arguments. The functions are pure, so that a CUDA graph can replay them on
refilled buffers and the HIL runner can pass zeros. :class:`DetectorView` draws the random numbers
for a batch of simulated cameras."""

from typing import NamedTuple

import torch
from torch import Tensor

from camera.arrays import interpolate_at_latency, latency_weights, push, redraw
from camera.keypoints import KEYPOINTS, KeypointCamera, correct_keypoints, keypoints
from camera.params import CameraParams, KeypointNoiseParams


class StepDraw(NamedTuple):
    """Random numbers of one step: standard normals, shape (E, K, 2), and uniforms in [0, 1), shape
    (E, K).

    ``wrong``: uniforms that decide whether a keypoint is wrong and where it is, shape (E, K, 3);
    None if no keypoint can be wrong."""

    normals: Tensor
    uniforms: Tensor
    wrong: Tensor | None = None


def apply_noise(
    params: KeypointNoiseParams,
    keypoints: Tensor,
    valid: Tensor,
    bias: Tensor,
    draw: StepDraw,
) -> tuple[Tensor, Tensor]:
    """Add noise and bias, drop keypoints out, and set the values of invalid keypoints.

    Args:
        params: Standard deviations and the rule for invalid keypoints.
        keypoints: Exact keypoints [-], shape (E, K, 2), normalised; with ``invalid_reads = "edge"``
            clipped to the edge.
        valid: Shape (E, K), bool.
        bias: Bias of this episode [-], shape (E, K, 2).
        draw: Random numbers of this step.

    Returns:
        Keypoints as the detector reports them [-], shape (E, K, 2), and validity, shape (E, K).
    """
    noisy = keypoints + bias + draw.normals * params.step_std
    detected = draw.uniforms >= params.drop_probability
    visible = valid & detected
    # clipped points have no noise: they are not measured
    if params.invalid_reads == "edge":
        unseen = keypoints * detected.unsqueeze(-1)
    else:
        unseen = torch.zeros_like(keypoints)
    points = torch.where(visible.unsqueeze(-1), noisy, unseen)
    if draw.wrong is None:
        return points, visible
    mistaken = draw.wrong[..., 0] < params.wrong_probability
    places = 2.0 * draw.wrong[..., 1:] - 1.0
    return torch.where(mistaken.unsqueeze(-1), places, points), visible | mistaken


def apply_latency(history: Tensor, valid_history: Tensor, latency: Tensor) -> tuple[Tensor, Tensor]:
    """Return the keypoints of ``latency`` steps ago.

    Args:
        history: Keypoints [-], shape (E, H, K, 2), newest first (`camera.arrays.push`).
        valid_history: Shape (E, H, K), bool.
        latency: Age [policy steps], shape (E,) or scalar tensor.

    Returns:
        Keypoints [-], shape (E, K, 2), and validity, shape (E, K): whether every entry that the
        interpolation used was valid.
    """
    used = latency_weights(history.shape[1], latency, history) > 0.0
    valid = (valid_history | ~used.unsqueeze(-1)).all(1)
    return interpolate_at_latency(history, latency), valid


class DetectorView:
    """Keypoints as a detector reports them: mount and focal-length errors, latency, noise,
    drop-outs and repeated images.
    """

    def __init__(self, params: CameraParams, like: Tensor):
        """Allocate buffers; ``like``: a tensor of shape (E, ...) on their device."""
        self._params = params
        self.camera = KeypointCamera(params, str(like.device))
        self.correction: tuple[Tensor, Tensor] | None = None
        """Estimates of a calibration: the cameras' rotation errors [rad], shape (E, 3), and
        relative errors of their focal lengths [-], shape (E,)."""
        E = len(like)
        depth = params.noise.history_length
        self._latency = like.new_tensor(params.noise.latency)
        self.buffers = {
            "keypoint_bias": like.new_zeros(E, KEYPOINTS, 2),
            "extrinsic_rotation": like.new_zeros(E, 3),
            "extrinsic_offset": like.new_zeros(E, 3),
            "scale_error": like.new_zeros(E, 1, 1),
            "held_points": like.new_zeros(E, KEYPOINTS, 2),
            "held_valid": like.new_zeros(E, KEYPOINTS, dtype=torch.bool),
            "late_points": like.new_zeros(E, depth, KEYPOINTS, 2),
            "late_valid": like.new_zeros(E, depth, KEYPOINTS, dtype=torch.bool),
        }

    def begin(self, fresh: Tensor) -> None:
        """Draw the errors of the episodes that begin; ``fresh``: their environments, shape (E,)."""
        noise = self._params.noise
        mount = self._params.mount
        spreads = {
            "keypoint_bias": noise.bias_std,
            "extrinsic_rotation": mount.rotation_error_std,
            "extrinsic_offset": mount.position_error_std,
            "scale_error": noise.scale_std,
        }
        redraw(self.buffers, spreads, fresh)

    def _extrinsics(self) -> tuple[Tensor, Tensor] | None:
        """Return the extrinsics of the cameras in these episodes; None if all are nominal."""
        mount = self._params.mount
        if mount.rotation_error_std == 0.0 and mount.position_error_std == 0.0:
            return None
        rotation = self.buffers["extrinsic_rotation"]
        offset = self.buffers["extrinsic_offset"]
        return self.camera.extrinsics(rotation, offset)

    def look(
        self, pos_w: Tensor, rot_wb: Tensor, goal_w: Tensor, payload_w: Tensor, fresh: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return keypoints [-], shape (E, K, 2), and validity, shape (E, K)."""
        buffers = self.buffers
        noise = self._params.noise
        mounts = self._extrinsics()
        points, valid = keypoints(self.camera, pos_w, rot_wb, goal_w, payload_w, mounts)
        if noise.visible_radius < 1.0:
            distance = points.square().sum(-1)
            valid = valid & (distance <= noise.visible_radius**2)
        if noise.scale_std > 0.0:
            points = points * (1.0 + buffers["scale_error"])
        if noise.latency > 0.0:
            late_points = buffers["late_points"]
            late_valid = buffers["late_valid"]
            late_points.copy_(push(late_points, points, fresh))
            late_valid.copy_(push(late_valid, valid, fresh))
            points, valid = apply_latency(late_points, late_valid, self._latency)
        normals = torch.randn_like(points)
        uniforms = torch.rand_like(points[..., 0])
        draw = StepDraw(normals, uniforms)
        if noise.wrong_probability > 0.0:
            wrong = torch.rand(*points.shape[:2], 3, device=points.device)
            draw = draw._replace(wrong=wrong)
        points, valid = apply_noise(noise, points, valid, buffers["keypoint_bias"], draw)
        if noise.held_probability > 0.0:
            share = torch.rand_like(points[:, 0, 0])
            repeated = (share < noise.held_probability) & ~fresh
            points = torch.where(repeated[:, None, None], buffers["held_points"], points)
            valid = torch.where(repeated[:, None], buffers["held_valid"], valid)
            buffers["held_points"].copy_(points)
            buffers["held_valid"].copy_(valid)
        if self.correction is None:
            return points, valid
        return correct_keypoints(self.camera, points, valid, *self.correction)
