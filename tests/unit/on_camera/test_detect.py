"""The detector on rendered frames and on synthetic edges: positions, refusals, and nuisances."""

import math
from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose
from pytest import approx, fixture, mark, raises

from camera.detectors.contours import (
    Detector,
    FrameDetections,
    Prior,
    convert_to_training_keypoints,
    order_corners,
)
from camera.keypoints import KeypointCamera, goal_square, keypoints
from camera.mount import rotation_from_vector
from camera.params import FisheyeParams
from tests.lenses import camera_of, f64
from visthrow.detector_training.eyes import render_hall
from visthrow.detector_training.scenes.renderer import Renderer
from visthrow.detector_training.scenes.scene import make_plain_scenes

LENS = FisheyeParams(400, 400, 104.2, 104.2, 199.5, 199.5)
CAMERA = KeypointCamera(camera_of(LENS), dtype=torch.float64)
DETECTOR = Detector(CAMERA.fisheye, 0.033, 0.25)
POS = f64([[0.1, 0.0, 1.3]])
ROT = rotation_from_vector(f64([[0.05, 0.3, 0.1]]))
BALL = f64([[0.12, 0.05, 0.9]])
GOAL = f64([[0.9, -0.3]])
MATS = torch.tensor(
    [
        # a rectangle of the goal's colour and size, without a rim
        (2.0, 0.4, 0.6, 0.0, 0.12, 0.12, 0.3, 0.16, 0.55, 0.26, 9.0, 0.0),
        # one of the ball's colour, not round
        (2.0, -0.5, 0.3, 0.0, 0.15, 0.05, 0.8, 0.80, 0.88, 0.20, 9.0, 0.0),
    ]
)
"""What lies on the ground: rows of the renderer's things."""
BLUE = torch.tensor([0.2, 0.2, 0.8])
TOLERANCE = 0.8
"""Of any keypoint on a clean frame of 400 pixels [px]; over random frames of 640 the RMS is a third
of that.
"""


@fixture(scope="module")
def scene():
    return render_hall(CAMERA.params, POS[0], ROT[0], BALL[0], GOAL[0], samples=4)


@fixture(scope="module")
def cluttered():
    """Neither goal nor payload in view, only what resembles them: a blue ball, two mats."""
    ball, goal = f64([[0.0, -0.7, 0.1]]), f64([[60.0, 0.0]])
    scenes = make_plain_scenes(CAMERA.params, POS, ROT, ball, goal, torch.tensor([False]))
    scenes.things[:, : len(MATS)] = MATS
    scenes.ball[:, 11:14] = BLUE
    image = Renderer(LENS, files=[], samples=4).render(scenes)[0].numpy()
    return np.ascontiguousarray(image[..., ::-1])


def known() -> Prior:
    eye = POS[0] + ROT[0] @ CAMERA.position_b
    return Prior((CAMERA.rot_cb @ ROT[0].T)[:, 2].numpy(), float(eye[2]), (0.25, 0.6))


def measure_offsets(detected: FrameDetections) -> np.ndarray:
    """How far the keypoints are from the true ones [px], shape (8,)."""
    true, valid = keypoints(CAMERA, POS, ROT, GOAL, BALL)
    assert valid.all()
    detected_points, ok = convert_to_training_keypoints(CAMERA, detected, ROT[0].numpy())
    assert ok.all()
    pixels = [
        CAMERA.fisheye.denormalize(points.double()).numpy() for points in (detected_points, true[0])
    ]
    return norm(pixels[0] - pixels[1], axis=1)


def smear(image):
    """Blur a picture and smear it along its rows."""
    soft = cv2.GaussianBlur(image, (0, 0), 1.5)
    return cv2.blur(soft, (3, 1))


def disturb(image):
    """Add a sensor's noise."""
    return image + 15.0 * default_rng(0).standard_normal(image.shape)


def relight(image):
    """Light a picture from one side, brighter than it was exposed for, with a tint."""
    slope = np.linspace(0.6, 1.4, image.shape[1])
    return 1.3 * slope[:, None] * image * [0.9, 1.0, 1.1]


def cover(image):
    """Draw a bar across the ball, a third as wide as the ball."""
    box = CAMERA.fisheye.denormalize(keypoints(CAMERA, POS, ROT, GOAL, BALL)[0][0, 4:]).numpy()
    middle, radius = box.mean(0), 0.5 * (box[2, 0] - box[0, 0])
    ends = [middle + side * 2.0 * radius * np.array([0.6, 0.8]) for side in (-1.0, 1.0)]
    ends = [tuple(end.round().astype(int).tolist()) for end in ends]
    return cv2.line(image.copy(), *ends, (33, 31, 31), round(radius / 1.5))


@mark.parametrize(
    ("nuisance", "worst"),
    [
        (np.array, TOLERANCE),
        (smear, 1.8),
        (disturb, 1.5),
        (relight, 1.2),
        (cover, 2.5),
    ],
)
def test_ball_and_goal_are_found_under_each_nuisance(scene, nuisance, worst):
    frame = np.round(np.clip(nuisance(scene), 0.0, 255.0)).astype(np.uint8)
    detected = DETECTOR.detect(frame, known())
    assert detected.ball is not None
    assert detected.goal is not None
    assert measure_offsets(detected).max() < worst
    assert DETECTOR.detect(frame).ball is not None, "known things only narrow"


def test_the_ball_is_as_far_away_as_its_size_says(scene):
    detected = DETECTOR.detect(scene)
    eye = POS[0] + ROT[0] @ CAMERA.position_b
    ball_c = (CAMERA.rot_cb @ ROT[0].T @ (BALL[0] - eye)).numpy()
    distance = 0.033 / math.sin(detected.ball.half_angle)
    assert distance == approx(norm(ball_c), rel=0.05)
    assert math.acos(detected.ball.ray_c @ ball_c / norm(ball_c)) < 0.5 / LENS.fx


def test_what_only_resembles_them_is_refused(cluttered):
    detected = DETECTOR.detect(cluttered, known())
    assert detected.goal is None, "no rim"
    assert detected.ball is None, "not round"


def test_known_things_narrow_the_search(scene):
    detected = DETECTOR.detect(scene)
    for wrong in (
        replace(known(), ball_distance=(1.0, 2.0)),
        replace(known(), ball_ray_c=np.array([0.0, 0.8, 0.6])),
    ):
        assert DETECTOR.detect(scene, wrong).ball is None
    high = replace(known(), height=2.6)
    assert DETECTOR.detect(scene, high).goal is None, "a square of twice the size"
    assert DETECTOR.detect(scene, replace(known(), ball_ray_c=detected.ball.ray_c)).ball is not None


def test_a_rounder_ball_scores_higher():
    y, x = np.mgrid[:400, :400] - 199.5
    scores = []
    for stretch in (1.0, 1.03):
        distance = np.hypot(x / stretch, y * stretch)
        level = 200.0 * np.clip(30.5 - distance, 0.0, 1.0).astype(np.float32)
        scores.append(DETECTOR._cone(level, np.array([199.5, 199.5]), 30.0).score)
    # the ellipse is off its circle by 3 % of its radius at most, by 0.03 / sqrt 2 in the mean
    assert scores[0] > 0.98
    assert 0.01 < scores[0] - scores[1] < 0.03


def test_wrong_pictures():
    with raises(ValueError, match=r"expected \(400, 400, 3\) and uint8"):
        DETECTOR.detect(np.zeros((400, 300, 3), np.uint8))
    with raises(ValueError, match="float64"):
        DETECTOR.detect(np.zeros((400, 400, 3)))
    assert DETECTOR.detect(np.zeros((400, 400, 3), np.uint8)) == FrameDetections(None, None)


@mark.parametrize("yaw", np.linspace(-3.1, 3.1, 9))
def test_corners_are_named_by_the_world(yaw):
    """Whatever the heading and however the detector turned about the square."""
    rot_wb = rotation_from_vector(f64([[0.1, 0.2, 0.0]]))[0]
    turn = rotation_from_vector(f64([[0.0, 0.0, yaw]]))[0]
    rot_wc = (turn @ rot_wb @ CAMERA.rot_cb.T).numpy()
    corners_w = goal_square(0.25).numpy() + [0.5, -0.8, -1.3]
    rays = corners_w / norm(corners_w, axis=1, keepdims=True) @ rot_wc
    for order in ([2, 3, 0, 1], [1, 0, 3, 2]):
        assert_allclose(order_corners(rays[order], rot_wc), rays, atol=1e-12)
