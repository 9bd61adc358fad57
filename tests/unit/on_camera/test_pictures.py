"""Overlay and straight views: drawings lie at the keypoints and in the view's directions."""

import math
from dataclasses import replace

import numpy as np
import torch
from pytest import raises

from camera.keypoints import KeypointCamera, keypoints
from camera.mount import rotation_from_vector
from camera.overlay import draw_overlay
from camera.params import FisheyeParams
from camera.rectify import ViewParams, rectify, view_map
from tests.boards import pixel_rays
from tests.lenses import camera_of, f64

LENS = FisheyeParams(320, 320, 83.3, 83.3, 159.5, 159.5)
CAMERA = KeypointCamera(camera_of(LENS), dtype=torch.float64)


def throw_scene():
    """Keypoints of a vehicle before the throw, and which are visible."""
    pos_w = f64([[0.3, 0.05, 1.3]])
    rot_wb = rotation_from_vector(f64([[0.1, 0.0, 0.2]]))
    points, valid = keypoints(CAMERA, pos_w, rot_wb, f64([[1.4, 0.2]]), f64([[0.45, 0.1, 1.02]]))
    return points[0], valid[0]


def test_overlay_colours_the_points_and_leaves_the_input():
    points, valid = throw_scene()
    before = np.full((320, 320, 3), 7, np.uint8)
    image = draw_overlay(CAMERA, points, valid, before)
    assert image.dtype == np.uint8
    assert (before == 7).all()
    pixels = CAMERA.fisheye.denormalize(points).round().long()
    for index, (u, v) in enumerate(pixels.tolist()):
        _, green, red = image[v, u].astype(int)
        assert (green > red + 60) if index < 4 else (red > green + 60)
    assert (image > 200).all(-1).sum() > 60, "body axes"


def test_overlay_marks_invalid_points_even_far_outside():
    points, valid = throw_scene()
    all_visible = draw_overlay(CAMERA, points, valid)
    points[0] = torch.tensor([1e9, -1e9])
    valid = valid.clone()
    valid[0] = False
    image = draw_overlay(CAMERA, points, valid)
    assert not np.array_equal(image, all_visible)
    assert image[:8, -8:].max() > 100, "cut off to the image's corner"
    with raises(ValueError, match="expected \\(320, 320, 3\\)"):
        draw_overlay(CAMERA, points, valid, np.zeros((10, 10, 3), np.uint8))
    lens = replace(LENS, width=480, cx=239.5)
    wide = KeypointCamera(replace(CAMERA.params, fisheye=lens), dtype=torch.float64)
    assert draw_overlay(wide, points, valid)[:8, -8:].max() > 100


def test_rectified_view_has_straight_lines():
    # A frame whose colour is the tangent of the angle to the right of the axis rectifies to a
    # linear ramp.
    lens = CAMERA.fisheye
    rays, _ = pixel_rays(LENS, 1)
    ahead = rays[..., 2] > 0.3
    ramp = torch.where(
        ahead, rays[..., 0] / rays[..., 2].clamp(min=0.3), torch.zeros_like(rays[..., 0])
    )
    view = ViewParams(81, 61, 90.0)
    straight = rectify(ramp[None, None], lens, view)[0, 0]
    expected = (torch.arange(81, dtype=torch.float64) - 40.0) / 40.5
    # Bilinear sampling of tan(theta) at 83 px/rad: second-order, (1/83)^2 / 8 * tan'' = 7e-4 at 45
    # deg off and corners.
    assert (straight[30] - expected).abs().max() < 2e-3
    assert (straight[:, 60] - expected[60]).abs().max() < 2e-3


def test_turned_view_looks_where_it_says():
    pixels, visible = view_map(CAMERA.fisheye, ViewParams(41, 41, 60.0, yaw_deg=50.0))
    # Equidistant: 50 deg to the right is 83.3 * 50 deg from the principal point, along u.
    assert visible.all()
    expected = f64([159.5 + 83.3 * math.radians(50.0), 159.5])
    assert torch.allclose(pixels[20, 20], expected, atol=1e-9)
    up, _ = view_map(CAMERA.fisheye, ViewParams(41, 41, 60.0, pitch_deg=50.0))
    assert torch.allclose(up[20, 20], f64([159.5, 159.5 - 83.3 * math.radians(50.0)]))
    _, past = view_map(CAMERA.fisheye, ViewParams(41, 41, 90.0, yaw_deg=100.0))
    assert not past[20, 40]


def test_image_refusals():
    frames = torch.zeros(1, 3, 10, 10)
    with raises(ValueError, match=r"expected \(B, C, 320, 320\)"):
        rectify(frames, CAMERA.fisheye, ViewParams(10, 10, 90.0))
    with raises(ValueError, match="below 180 deg"):
        rectify(torch.zeros(1, 3, 320, 320), CAMERA.fisheye, ViewParams(10, 10, 190.0))
