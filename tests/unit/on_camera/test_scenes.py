"""The batched renderer: where things are in its pictures, against projection and motion; seeds."""

from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.testing import assert_allclose
from pytest import fixture, importorskip, raises

from camera.fisheye import Fisheye
from camera.mount import rotation_from_vector
from camera.params import FisheyeParams
from tests.lenses import camera_of
from visthrow.detector_training.scenes.renderer import Renderer
from visthrow.detector_training.scenes.scene import make_plain_scenes, random_scenes, truth_of
from visthrow.detector_training.scenes.textures import photographs, pyramid

importorskip("skimage", reason="photographs of visthrow[detector]")

LENS = FisheyeParams(192, 192, 50.0, 50.0, 95.5, 95.5, k1=-0.01, fov_deg=200.0)
CAMERA = camera_of(LENS)
CENTRE = 0.2
"""Of an evenly lit ball some pixels large, by the middle of its pixels against its projection [px];
the lens bends it a little.
"""


@fixture(scope="module")
def renderer():
    return Renderer(LENS, samples=8)


def make_hovering_scene(ball=(0.05, 0.1, 1.0)):
    """A plain scene, evenly lit, its ball without a seam."""
    scenes = make_plain_scenes(
        CAMERA,
        torch.tensor([[0.0, 0.0, 1.3]]),
        rotation_from_vector(torch.tensor([[0.1, -0.2, 0.05]])),
        torch.tensor([ball]),
        torch.tensor([[0.7, 0.3]]),
        torch.tensor([False]),
    )
    scenes.light[:, 3] = 1.0
    scenes.ball[:, 14:17] = scenes.ball[:, 11:14]
    return scenes


def find_centroid(mask: np.ndarray) -> np.ndarray:
    v, u = np.nonzero(mask)
    return np.array([u.mean(), v.mean()])


def yellow(image) -> np.ndarray:
    r, g, b = image.astype(int).transpose(2, 0, 1)
    return (np.minimum(r, g) - b > 40) & (np.abs(r - g) < 60)


def find_green(image) -> np.ndarray:
    r, g, b = image.astype(int).transpose(2, 0, 1)
    return (g - np.maximum(r, b)) > 25


def test_ball_and_square_are_where_the_lens_puts_them(renderer):
    scenes = make_hovering_scene()
    image = renderer.render(scenes)[0].numpy()
    truth, lens = truth_of(scenes, Fisheye(LENS)), Fisheye(LENS)
    ball, _ = lens.project(truth.ball_c)
    corners, _ = lens.project(truth.corners_c)
    area = cv2.moments(
        corners[0].float().numpy()
    )  # of the quadrangle: its nearer half is the larger one
    assert_allclose(find_centroid(yellow(image)), ball[0].numpy(), atol=CENTRE)
    assert_allclose(
        find_centroid(find_green(image)),
        [area["m10"] / area["m00"], area["m01"] / area["m00"]],
        atol=CENTRE,
    )
    assert truth.ball_visible.all()
    assert truth.goal_visible.all()
    assert not image[0, 0].any(), "black outside the field of view"


def test_motion_and_rolling_shutter_move_things_as_the_truth_says(renderer):
    """A fast ball is smeared about where it is when its rows are exposed, off its place at the
    middle of the frame.
    """
    scenes = make_hovering_scene(ball=(-0.35, 0.1, 1.0))
    scenes.ball[:, 4:7] = torch.tensor([[0.0, 4.0, 0.0]])
    scenes = replace(scenes, shutter=torch.tensor([[0.004, 0.04, 0.0]]))
    lens = Fisheye(LENS)
    rolled, _ = lens.project(truth_of(scenes, lens).ball_c)
    still, _ = lens.project(truth_of(replace(scenes, shutter=torch.zeros(1, 3)), lens).ball_c)
    assert (rolled - still).norm() > 3.0
    assert_allclose(
        find_centroid(yellow(renderer.render(scenes)[0].numpy())),
        rolled[0].numpy(),
        atol=2 * CENTRE,
    )


def test_a_seed_gives_the_same_bits_alone_and_in_a_batch(renderer):
    scenes = random_scenes(CAMERA, renderer.textures, 3, 5)
    again = random_scenes(CAMERA, renderer.textures, 3, 5)
    images = renderer.render(scenes, 7)
    second = replace(scenes, **{name: table[1:2] for name, table in vars(scenes).items()})
    assert torch.equal(images, renderer.render(again, 7))
    assert torch.equal(images[1:2], renderer.render(second, 7))
    assert not torch.equal(images, renderer.render(scenes, 8))
    assert not torch.equal(scenes.pose, random_scenes(CAMERA, renderer.textures, 3, 6).pose)


def test_photographs_that_are_none(tmp_path):
    with raises(ValueError, match="no photograph in"):
        photographs(tmp_path)
    (tmp_path / "a.png").write_bytes(b"no picture")
    with raises(ValueError, match="not a picture that OpenCV can read"):
        pyramid(photographs(tmp_path))
