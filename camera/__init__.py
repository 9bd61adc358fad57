"""Fisheye camera of the vision policy: lens, mount, keypoints, history, noise (torch); files, images, drawing (cv2,
kornia).

Frames: ``_w`` world (z up), ``_b`` body (x forward, y left, z up), ``_c`` camera (x image right, y image down, z along
the optical axis).
What the policy needs is exported here. Calibration files and boards live in `camera.calibrate`, pictures in `camera.imaging`, the
detector of ball and goal square in `camera.detectors`.
Knows neither the simulator nor the rest of the project; cv2, kornia, scipy and yaml are imported by the functions that use them.
"""

from camera.fisheye import Fisheye, FisheyeParams, transfer_pixels
from camera.history import at_latency, filled, push, push_
from camera.keypoints import KEYPOINTS, KeypointCamera, goal_corners_w, keypoints, payload_keypoints
from camera.mount import MountParams, points_c_from_w
from camera.noise import KeypointNoiseParams, StepDraw, apply_latency, apply_noise, draw_episode, draw_step
from camera.params import CameraParams

__all__ = [
    "KEYPOINTS",
    "CameraParams",
    "Fisheye",
    "FisheyeParams",
    "KeypointCamera",
    "KeypointNoiseParams",
    "MountParams",
    "StepDraw",
    "apply_latency",
    "apply_noise",
    "at_latency",
    "draw_episode",
    "draw_step",
    "filled",
    "goal_corners_w",
    "keypoints",
    "payload_keypoints",
    "points_c_from_w",
    "push",
    "push_",
    "transfer_pixels",
]
