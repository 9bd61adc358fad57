"""Fisheye model: round trip, derivatives and validity on the whole sphere."""

import math
from dataclasses import replace

import numpy as np
import torch
from pytest import mark, raises

from camera.fisheye import Fisheye
from camera.params import FisheyeParams
from tests.lenses import BENT, EQUIDISTANT, LENSES, f64

ANGLE_TOLERANCE = 1e-9  # rad; the bar of the model, 1e6 times the rounding of float64
EDGE_TOLERANCE = 1e-12  # rounding of a dozen float64 operations on values near 1


def sphere(half_fov: float) -> torch.Tensor:
    """Unit rays on a polar grid that holds the axis and the edge itself, float64, shape (N, 3)."""
    theta = torch.linspace(0.0, half_fov, 60, dtype=torch.float64).repeat_interleave(24)
    phi = torch.linspace(-math.pi, math.pi, 24, dtype=torch.float64).repeat(60)
    return torch.stack([theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()], -1)


def angle_between(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Angle between unit vectors, accurate for small angles."""
    return 2.0 * torch.asin((0.5 * (a - b).norm(dim=-1)).clamp(max=1.0))


@LENSES
def test_round_trip_up_to_the_field_of_view(params):
    lens = Fisheye(params)
    rays = sphere(lens.half_fov - 1e-12)
    pixels, valid = lens.project(3.7 * rays)
    back, visible = lens.unproject(pixels)
    assert valid.all()
    assert visible.all()
    assert angle_between(back, rays).max() < ANGLE_TOLERANCE
    assert torch.allclose(
        back.norm(dim=-1), torch.ones(len(rays), dtype=torch.float64), atol=EDGE_TOLERANCE
    )


@LENSES
def test_normalized_radius_is_one_at_the_edge(params):
    lens = Fisheye(params)
    edge = sphere(lens.half_fov)[-24:]
    normalized, _ = lens.project_normalized(edge)
    assert torch.allclose(
        normalized.norm(dim=-1), torch.ones(24, dtype=torch.float64), atol=EDGE_TOLERANCE
    )
    pixels, _ = lens.project(edge)
    assert torch.allclose(lens.normalize(pixels), normalized, atol=EDGE_TOLERANCE)
    assert torch.allclose(lens.denormalize(normalized), pixels, atol=1e-9)


def test_closed_form_at_90_and_110_degrees():
    # Equidistant, so u = fx theta + cx: 90 deg to the right is 319.5 + 166.6786 pi/2; the same past
    # 90 deg.
    lens = Fisheye(EQUIDISTANT)
    t = math.radians(105.0)
    points = f64([[2.0, 0.0, 0.0], [0.0, 3.0 * math.sin(t), 3.0 * math.cos(t)]])
    pixels, valid = lens.project(points)
    expected = f64([[319.5 + 166.6786 * math.pi / 2, 319.5], [319.5, 319.5 + 166.6786 * t]])
    assert torch.allclose(pixels, expected, atol=1e-10)
    assert valid.all()


@LENSES
@mark.parametrize("degrees", [5.0, 60.0, 89.999, 90.0, 90.001, 95.0, 99.0, 109.0, 140.0])
def test_gradcheck_past_90_degrees(params, degrees):
    lens = Fisheye(params)
    t = math.radians(degrees)
    point = f64([[0.6 * math.sin(t), 0.8 * math.sin(t), math.cos(t)]]) * 1.3
    point.requires_grad_()
    assert torch.autograd.gradcheck(lambda p: lens.project(p)[0], (point,))
    assert torch.autograd.gradcheck(lambda p: lens.project_normalized(p)[0], (point,))


@LENSES
def test_unprojection_gradient(params):
    lens = Fisheye(params)
    normalized = f64([[0.1, 0.2], [-0.6, 0.3], [0.0, -0.97]])
    pixels = lens.denormalize(normalized).requires_grad_()
    assert torch.autograd.gradcheck(lambda p: lens.unproject(p)[0], (pixels,))


@LENSES
@mark.parametrize("dtype", [torch.float32, torch.float64])
def test_value_and_gradient_are_finite_everywhere(params, dtype):
    lens = Fisheye(params)
    special = [
        [0, 0, 1],
        [0, 0, -1],
        [0, 0, 0],
        [0, 0, 1e-6],
        [1e-9, 0, -1],
        [1, 0, 0],
        [0, -1, 0],
        [-1e-7, 1e-7, -5],
        [1e3, -1e3, -1e3],
    ]
    points = torch.cat(
        [torch.tensor(special, dtype=dtype), sphere(math.pi).to(dtype)]
    ).requires_grad_()
    for function in (
        lens.project,
        lens.project_normalized,
        lambda p: lens.project_normalized(p, clip=True),
    ):
        value, valid = function(points)
        (gradient,) = torch.autograd.grad(value.sum(), points)
        assert value.isfinite().all()
        assert gradient.isfinite().all()
        assert valid.dtype == torch.bool
        assert value.dtype == dtype


@LENSES
def test_a_point_behind_the_field_of_view_is_never_valid(params):
    lens = Fisheye(params)
    rng = np.random.default_rng(3)
    points = torch.from_numpy(rng.normal(size=(200_000, 3)))
    theta = torch.atan2(points[:, :2].norm(dim=-1), points[:, 2])
    outside = theta > lens.half_fov + 1e-9
    _, valid = lens.project(points)
    normalized, visible = lens.project_normalized(points)
    assert not valid[outside].any()
    assert not visible[outside].any()
    assert (valid[~outside]).all()
    assert (normalized[outside].norm(dim=-1) > 1.0).all(), (
        "the map must stay one-to-one past the field of view"
    )
    clipped, _ = lens.project_normalized(points, clip=True)
    assert torch.allclose(
        clipped[outside].norm(dim=-1), torch.ones(int(outside.sum()), dtype=torch.float64)
    )
    assert torch.equal(clipped[~outside], normalized[~outside])


def test_points_beside_the_sensor_are_not_valid_keypoints():
    lens = Fisheye(BENT)  # its circle is higher than the sensor
    assert not lens.circle_inside_image
    assert Fisheye(EQUIDISTANT).circle_inside_image
    t = math.radians(99.0)
    points = f64([[0.0, math.sin(t), math.cos(t)], [math.sin(t), 0.0, math.cos(t)]])
    pixels, valid = lens.project(points)
    assert valid.all()
    assert lens.is_on_sensor(pixels).tolist() == [False, True]
    assert lens.project_normalized(points)[1].tolist() == [False, True]


def test_pixels_beyond_the_field_of_view_do_not_unproject():
    lens = Fisheye(BENT)
    pixels = lens.denormalize(f64([[1.01, 0.0], [0.99, 0.0]]))
    rays, valid = lens.unproject(pixels)
    assert valid.tolist() == [False, True]
    assert rays.isfinite().all()
    assert math.isclose(
        math.atan2(float(rays[0, :2].norm()), float(rays[0, 2])), lens.half_fov, abs_tol=1e-9
    )


@mark.parametrize("change", [{"k1": -0.3}, {"k1": 1.0, "k4": -0.5}])
def test_a_radius_that_stops_growing_is_refused(change):
    with raises(ValueError, match="stops growing"):
        Fisheye(replace(EQUIDISTANT, **change))


def test_monotonic_limit_closed_form():
    # theta_d' = 1 + 3 k1 theta^2 is zero at theta = sqrt(-1 / (3 k1)): k1 = -1/12 gives 2 rad =
    # 114.6 deg.
    fits = FisheyeParams(640, 640, 100.0, 100.0, 320.0, 320.0, k1=-1 / 12, fov_deg=2 * 114.0)
    Fisheye(fits)
    with raises(ValueError, match=r"114\.59"):
        Fisheye(FisheyeParams(640, 640, 100.0, 100.0, 320.0, 320.0, k1=-1 / 12, fov_deg=2 * 115.0))
