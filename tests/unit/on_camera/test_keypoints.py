"""Mount, goal corners, payload box, and the one function of environment and HIL."""

import math
from dataclasses import replace

import torch
from pytest import approx, mark
from scipy.spatial.transform import Rotation

from camera.fisheye import Fisheye
from camera.keypoints import (
    KeypointCamera,
    apply_invalid_rule,
    ball_extremes_c,
    keypoints,
    payload_keypoints,
)
from camera.mount import nominal_rot_cb, rotation_from_vector
from camera.params import CameraParams, FisheyeParams, KeypointNoiseParams, MountParams
from tests.lenses import f64

LENS = FisheyeParams(640, 640, 166.6786, 166.6786, 319.5, 319.5)
PARAMS = CameraParams(
    LENS, MountParams(position_b=(0.03, 0.0, -0.02)), KeypointNoiseParams(), 0.25, 0.033
)
CENTRED = KeypointCamera(replace(PARAMS, mount=MountParams()), dtype=torch.float64)
EDGE = math.radians(110.0)


def hover(height: float, environments: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
    """Level vehicle above the origin, float64."""
    pos_w = torch.zeros(environments, 3, dtype=torch.float64)
    pos_w[:, 2] = height
    return pos_w, torch.eye(3, dtype=torch.float64).expand(environments, 3, 3)


def scene(environments: int):
    """Random poses, goals and balls."""
    generator = torch.Generator().manual_seed(5)
    normal = lambda *shape: torch.randn(*shape, generator=generator)  # noqa: E731
    pos_w = 0.5 * normal(environments, 3) + torch.tensor([0.0, 0.0, 1.5])
    return (
        pos_w,
        rotation_from_vector(0.6 * normal(environments, 3)),
        2.0 * normal(environments, 2),
        pos_w + 0.3 * normal(environments, 3),
    )


def test_mount_rotation_is_about_body_axes():
    # Pitch -90 deg about body y (left) turns the downward camera to the front: z_c = +x_b; image
    # top is then body up.
    rot_cb = nominal_rot_cb(MountParams(rpy_deg=(0.0, -90.0, 0.0)))
    assert torch.allclose(rot_cb[2], f64([1.0, 0.0, 0.0]), atol=1e-9)
    assert torch.allclose(rot_cb[1], f64([0.0, 0.0, -1.0]), atol=1e-9)
    assert torch.allclose(rot_cb @ rot_cb.T, torch.eye(3, dtype=torch.float64), atol=1e-9)


def test_rotation_vector_against_scipy():
    vector = torch.tensor(
        [[0.3, -1.2, 0.4], [0.0, 0.0, 0.0], [1e-4, 0.0, 3.0]],
        dtype=torch.float64,
        requires_grad=True,
    )
    rotation = rotation_from_vector(vector)
    expected = Rotation.from_rotvec(vector.detach()).as_matrix()
    assert torch.allclose(rotation, f64(expected), atol=1e-9)
    (gradient,) = torch.autograd.grad(rotation.sum(), vector)
    assert gradient.isfinite().all()


def test_extrinsic_error_moves_and_turns_the_camera():
    angle = 0.05
    rotation_error = f64([[0.0, -angle, 0.0], [0.0, 0.0, 0.0]])
    position_error = f64([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
    pos_w, rot_wb = hover(2.0, 2)
    payload_w = f64([[0.0, 0.0, 1.0]]).expand(2, 3)
    goal_w = torch.zeros(2, 2, dtype=torch.float64)
    points, _ = keypoints(
        CENTRED,
        pos_w,
        rot_wb,
        goal_w,
        payload_w,
        CENTRED.extrinsics(rotation_error, position_error),
    )
    middle = points[:, 4:].mean(1)
    # Camera pitched to the front by 0.05 rad: the ball below lies 0.05 rad towards the image's
    # bottom. Camera 0.1 m forward: atan(0.1) in the same direction.
    assert torch.allclose(middle[0], f64([0.0, angle / EDGE]), atol=1e-6)
    assert torch.allclose(middle[1], f64([0.0, math.atan(0.1) / EDGE]), atol=1e-4)


def test_goal_below_a_level_vehicle_closed_form():
    pos_w, rot_wb = hover(1.0)
    points, valid = keypoints(
        CENTRED,
        pos_w,
        rot_wb,
        torch.zeros(1, 2, dtype=torch.float64),
        f64([[0.0, 0.0, 0.5]]),
    )
    # Corner 0 (front left) 0.125 m each way, 1 m below: angle atan(0.125 sqrt 2), up and left in
    # the image, 45 deg.
    c = math.atan(0.125 * math.sqrt(2.0)) / EDGE / math.sqrt(2.0)
    expected = f64([[-c, -c], [c, -c], [c, c], [-c, c]])
    assert valid.all()
    assert torch.allclose(points[0, :4], expected, atol=1e-12)
    # Ball of 33 mm at 0.5 m on the axis: a circle of radius asin(0.066).
    a = math.asin(0.066) / EDGE
    box = f64([[-a, 0.0], [0.0, -a], [a, 0.0], [0.0, a]])
    assert torch.allclose(points[0, 4:], box, atol=1e-9)


@mark.parametrize(("distance", "tolerance"), [(0.2, 2e-3), (0.38, 3e-4), (0.6, 1e-4)])
def test_payload_box_against_the_dense_outline(distance, tolerance):
    # Tolerances: the box's second-order error up to 105 deg off the axis; at 0.38 m, the rope's
    # length, a thirtieth of the noise.
    lens = Fisheye(LENS)
    generator = torch.Generator().manual_seed(1)
    centre = torch.randn(2000, 3, generator=generator, dtype=torch.float64)
    centre = centre / centre.norm(dim=1, keepdim=True)
    centre = centre[lens.angle(centre)[0] < math.radians(105.0)]
    other = torch.randn(centre.shape, generator=generator, dtype=torch.float64)
    e1 = torch.nn.functional.normalize(torch.linalg.cross(centre, other), dim=-1)
    e2 = torch.linalg.cross(centre, e1)
    phi = torch.linspace(0.0, 2.0 * math.pi, 361, dtype=torch.float64)[None, :, None]
    a = math.asin(0.033 / distance)
    outline = math.cos(a) * centre[:, None] + math.sin(a) * (
        phi.cos() * e1[:, None] + phi.sin() * e2[:, None]
    )
    image, _ = lens.project_normalized(outline)
    points, _ = lens.project_normalized(ball_extremes_c(lens, centre * distance, 0.033))
    ours = torch.stack([points[:, 0, 0], points[:, 1, 1], points[:, 2, 0], points[:, 3, 1]], -1)
    theirs = torch.cat([image.amin(1), image.amax(1)], -1)
    assert (ours - theirs).abs().max() < tolerance


def test_the_payloads_box_is_smooth():
    ball_c = f64([[0.1, 0.2, 0.3], [0.3, -0.1, -0.05]]).requires_grad_()
    assert torch.autograd.gradcheck(lambda p: payload_keypoints(CENTRED, p)[0], (ball_c,))


def test_target_past_90_degrees_is_visible_and_the_sky_is_not():
    # Nose down by 40 deg (a positive pitch about body y), target 62 deg off the vertical in front:
    # 102 deg off the axis.
    pos_w, _ = hover(1.0)
    rot_wb = rotation_from_vector(f64([[0.0, math.radians(40.0), 0.0]]))
    goal_w = f64([[math.tan(math.radians(62.0)), 0.0]])
    above_w = f64([[0.0, 0.0, 2.0]])
    points, valid = keypoints(CENTRED, pos_w, rot_wb, goal_w, above_w)
    assert valid[0, :4].all()
    assert not valid[0, 4:].any()
    # 102 deg of 110 towards the image's top; the square's corners lie about it.
    assert points[0, :4, 1].mean() == approx(-102.0 / 110.0, abs=5e-3)


def test_out_of_view_tells_nothing_but_that():
    """The policy's input does not depend on where a hidden object is; hidden sides of a ball cut by
    the edge do not leak.
    """
    honest = replace(PARAMS, noise=KeypointNoiseParams(invalid_reads="zero"))
    camera = KeypointCamera(honest, dtype=torch.float64)
    pos_w, rot_wb = hover(1.0, 3)
    goal_w = torch.zeros(3, 2, dtype=torch.float64)
    above_w = f64([[0.0, 0.0, 2.0], [0.5, 0.3, 2.2], [-0.4, 0.0, 1.8]])
    points, valid = keypoints(camera, pos_w, rot_wb, goal_w, above_w)
    assert not valid[:, 4:].any()
    assert torch.equal(points[:1], points[1:2])
    assert torch.equal(points[:1], points[2:])
    off_axis = torch.deg2rad(torch.linspace(100.0, 120.0, 81, dtype=torch.float64))
    rays = torch.stack([off_axis.sin(), torch.full_like(off_axis, 0.05), off_axis.cos()], -1)
    _, sides = payload_keypoints(camera, 0.2 * rays)
    partly = sides.any(-1) & ~sides.all(-1)
    assert partly.sum() > 3
    shown, shown_valid = apply_invalid_rule(
        camera, torch.ones(81, 8, 2, dtype=torch.float64), torch.cat([sides, sides], -1)
    )
    cut = shown_valid[partly, 4:]
    assert not cut.all(-1).any()
    for k, (one, other) in enumerate([(1, 3), (0, 2), (1, 3), (0, 2)]):
        assert torch.equal(shown_valid[:, 4 + k], sides[:, k] & sides[:, one] & sides[:, other])
    assert (shown[~shown_valid] == 0.0).all()


def test_batch_of_many_equals_batch_of_one_bit_for_bit():
    camera = KeypointCamera(PARAMS)
    arguments = scene(1003)
    extrinsics = camera.extrinsics(0.02 * torch.ones(1003, 3), 0.001 * torch.ones(1003, 3))
    points, valid = keypoints(camera, *arguments, extrinsics)
    for i in range(0, 1003, 13):
        row = slice(i, i + 1)
        turned = tuple(part[row] for part in extrinsics)
        one, visible = keypoints(camera, *(part[row] for part in arguments), turned)
        assert torch.equal(one, points[row])
        assert torch.equal(visible, valid[row])
