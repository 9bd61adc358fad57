"""Fisheye against OpenCV, which is right for z > 0 only."""

import math

import cv2
import numpy as np
import torch

from camera.fisheye import Fisheye
from tests.lenses import LENSES

PIXEL_TOLERANCE = 1e-9  # px; the bar: 1e4 times the rounding of float64 at 1,000 px


def points_before_the_lens() -> np.ndarray:
    """Points up to 89.5 deg off the axis, some close to it, shape (N, 3)."""
    rng, number = np.random.default_rng(0), 5000
    theta, phi = (
        rng.uniform(0.0, math.radians(89.5), number),
        rng.uniform(-math.pi, math.pi, number),
    )
    theta[:50] *= 1e-6
    rays = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    return rays * rng.uniform(0.1, 10.0, (number, 1))


@LENSES
def test_equal_to_opencv_before_the_lens(params):
    points = points_before_the_lens()
    camera_matrix = np.array([[params.fx, 0, params.cx], [0, params.fy, params.cy], [0, 0, 1]])
    theirs, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), camera_matrix, np.array(params.coefficients)
    )
    ours, valid = Fisheye(params).project(torch.from_numpy(points))
    assert valid.all()
    assert np.abs(ours.numpy() - theirs[:, 0]).max() < PIXEL_TOLERANCE
