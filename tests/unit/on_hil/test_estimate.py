"""Velocity and rate from poses: closed forms of lag and noise, uneven stamps, gaps."""

import numpy as np
from numpy.testing import assert_allclose
from pytest import approx, mark
from scipy.spatial.transform import Rotation

from hil.poses.body_track import MOST_PREDICTION, TRUST, Track
from hil.poses.estimate import EstimateParams, SlopeFilter, fit_weights
from hil.poses.frames import FrameParams
from hil.poses.gate import GateParams
from hil.poses.pose import Pose

PERIOD = 0.01
ROUNDING = 1e-9


def run(params, times, position, attitude=None):
    """Estimates at each time of a motion that is given in closed form."""
    slopes = SlopeFilter(params)
    out = []
    for t in times:
        quat = None if attitude is None else tuple(map(float, attitude(t).as_quat()))
        vel = slopes.update(
            Pose(float(t), float(t), "vehicle", tuple(map(float, position(t))), quat)
        )
        out.append((vel, slopes.rate))
    return slopes, out


def window(samples: int) -> float:
    """Window that holds so many samples at an even spacing."""
    return (samples - 0.5) * PERIOD


@mark.parametrize("samples", [2, 3, 5, 8])
def test_a_lines_lag_is_half_its_window(samples):
    acceleration = np.array([3.0, -1.0, 5.0])
    slopes, out = run(
        EstimateParams(window(samples), 1),
        PERIOD * np.arange(30),
        lambda t: 0.5 * acceleration * t * t,
    )
    lag = (samples - 1) * PERIOD / 2
    assert slopes.lag == approx(lag, abs=ROUNDING)
    assert_allclose(out[-1][0], acceleration * (29 * PERIOD - lag), atol=ROUNDING)


@mark.parametrize("window", [0.001, 0.055, 0.1])
def test_a_parabola_is_not_late_on_uneven_stamps_either(window):
    times = np.cumsum(np.random.default_rng(0).uniform(0.003, 0.02, 30))
    slopes, out = run(EstimateParams(window, 2), times, lambda t: np.array([1.0, t, 0.5 * t * t]))
    assert slopes.lag == approx(0.0, abs=ROUNDING)
    assert_allclose(out[-1][0], (0.0, 1.0, times[-1]), atol=1e-6)
    assert_allclose(slopes.acceleration, (0.0, 0.0, 1.0), atol=1e-4)


def test_noise_is_what_the_weights_say():
    """A line over n even samples: sigma sqrt(12 / (n (n^2 - 1))) / T."""
    n = 5
    weights = fit_weights([i * PERIOD for i in range(n)], 1)[0]
    assert np.sqrt(np.sum(np.square(weights))) == approx(np.sqrt(12 / (n * (n * n - 1))) / PERIOD)


def test_body_rate_of_a_steady_turn():
    rate_b = np.array([1.0, -2.0, 0.5])
    start = Rotation.from_euler("xyz", [0.3, -0.2, 1.0])
    for order in (1, 2):
        _, out = run(
            EstimateParams(window(4), order),
            PERIOD * np.arange(10),
            lambda t: np.zeros(3),
            lambda t: start * Rotation.from_rotvec(rate_b * t),
        )
        assert_allclose(out[-1][1], rate_b, atol=1e-6)


def test_what_the_source_gives_is_taken_and_a_gap_empties_the_window():
    slopes = SlopeFilter(EstimateParams(window(3), 1))
    given = Pose(
        0.0, 0.0, "vehicle", (0.0,) * 3, (0.0, 0.0, 0.0, 1.0), (1.0, 2.0, 3.0), (4.0, 5.0, 6.0)
    )
    assert slopes.update(given) == (1.0, 2.0, 3.0)
    assert slopes.rate == (4.0, 5.0, 6.0)
    assert slopes.lag == 0.0
    bare = Pose(0.01, 0.01, "vehicle", (0.01, 0.0, 0.0))
    assert_allclose(slopes.update(bare), (1.0, 0.0, 0.0))
    assert slopes.update(Pose(1.0, 1.0, "vehicle", (5.0, 0.0, 0.0))) == (0.0, 0.0, 0.0)


def test_a_state_is_carried_forward_with_a_share_of_its_accelerations():
    """A body that falls and turns ever faster: place and attitude with its velocities, these with
    half of what they change by.
    """
    frames = FrameParams("x,y,z", "x,y,z", "xyzw", 0.0, (0.0, 0.0, 0.0))
    gate = GateParams(0.02, 10.0, 50.0, 3.0, 50.0, 0.3, 0.04, 0.1, 0.25)
    track, bare = (
        Track(frames, gate, EstimateParams(window(6), 2), turns) for turns in (True, False)
    )
    for i in range(8):
        t = i * PERIOD
        quat = tuple(Rotation.from_rotvec([0.0, 3.0 * t + 10.0 * t * t, 0.0]).as_quat())
        for one in (track, bare):
            assert one.update(Pose(t, t, "vehicle", (0.0, 0.0, 5.0 - 5.0 * t * t), quat)) is None
    now, ahead = 7 * PERIOD, 0.02
    state = track.state(now, ahead)
    assert_allclose(state.vel, (0.0, 0.0, -10.0 * (now + TRUST * ahead)), atol=1e-6)
    assert_allclose(state.rate, (0.0, 3.0 + 20.0 * (now + TRUST * ahead), 0.0), atol=1e-4)
    assert_allclose(state.pos, (0.0, 0.0, 5.0 - 5.0 * now**2 - 10.0 * now * ahead), atol=1e-6)
    assert track.state(now, 0.3) == track.state(now, MOST_PREDICTION), "no pose is carried further"
    assert bare.state(now, ahead).rate == (0.0, 0.0, 0.0)
    assert track.state(now, 0.0).vel == approx((0.0, 0.0, -10.0 * now))
