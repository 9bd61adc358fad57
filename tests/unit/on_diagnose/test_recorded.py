"""A replay's inputs from a log."""

import numpy as np
from numpy.random import default_rng
from numpy.testing import assert_allclose
from pytest import approx, raises

from tests.flightlogs import level_log, log_at, with_channels
from visthrow.common.errors import DiagnoseError
from visthrow.diagnose.throw.recorded_flight import record_of
from visthrow.logs.flightlog import Channel, FlightLog

SWING = [0.1, 0.2, 0.3]
"""Of the body rates [rad/s]."""


def flight(rate: float, noise: float, gap: tuple[float, float] = (9.0, 9.0)) -> FlightLog:
    """Ten seconds whose body rates swing at 10 Hz, sampled at ``rate`` [Hz], not in the gap."""
    at, stamps = np.arange(0.0, 10.0, 0.005), np.arange(0.0, 10.0, 1.0 / rate)
    stamps = stamps[(stamps <= gap[0]) | (stamps >= gap[1])]
    values = np.sin(2.0 * np.pi * 10.0 * stamps)[:, None] * SWING
    values += noise * default_rng(0).standard_normal(values.shape)
    still = np.zeros((len(at), 3)) + 1e-4 * default_rng(1).standard_normal((len(at), 3))
    quat = np.column_stack((1e-4 * default_rng(2).standard_normal((len(at), 3)), np.ones(len(at))))
    commands = log_at(at[::4], command=np.tile([4.0, 0.0, 0.0, 0.0], (len(at[::4]), 1)))
    gyro = log_at(stamps, rate_b=values)
    return with_channels(
        log_at(at, pos_w=still, quat_wb=quat), **commands.channels, **gyro.channels
    )


def test_a_gyro_of_1_kHz_is_as_good_in_a_quarter_of_its_samples():
    """Its noise is halved and white, and the measured motion is kept."""
    log = flight(1000.0, 0.02)
    gyro = record_of(log).gyro
    assert len(gyro.time) == approx(2500, abs=5)
    assert_allclose(np.diff(gyro.time), 0.004, atol=1e-9)
    assert gyro.sigma == approx(0.01, rel=0.1)
    wave = np.sin(2.0 * np.pi * 10.0 * gyro.time)
    left = gyro.values - np.outer(wave, SWING)
    assert np.std(left) == approx(0.0101, rel=0.05)
    assert abs(np.corrcoef(left[:-1].ravel(), left[1:].ravel())[0, 1]) < 0.08
    assert_allclose(wave @ gyro.values / (wave @ wave), SWING, rtol=5e-3)


def test_no_sample_of_a_gyro_is_made_up_in_a_gap():
    time = record_of(flight(1000.0, 0.02, (4.0, 5.0))).gyro.time
    assert not np.any((time > 4.0) & (time < 5.0))
    assert np.sum(time <= 4.0) == approx(1000, abs=3)


def test_a_log_without_commands_is_answered_with_what_makes_them():
    """As PX4's, which holds motor outputs, poses and rates."""
    log = level_log(np.arange(20.0), np.zeros((20, 3)))
    with raises(DiagnoseError, match=r"no command; .*throttle and rate_setpoint_b.*--config"):
        record_of(log)


def test_rounding_counts_as_noise_of_a_twelfth_of_its_steps_square():
    """A gyro that writes whole hundredths of a rad/s, and one that is exact."""
    log = flight(200.0, 0.0)
    step = 0.01
    at = log["rate_b"].time
    ramp = np.round(0.2 * at[:, None] * [1.0, 1.1, 1.2] / step) * step
    log.channels["rate_b"] = Channel(at, ramp, "rad/s", "body")
    sigma = record_of(log).gyro.sigma
    assert sigma == approx(step * 12**-0.5, rel=0.5)


def test_rounding_counts_of_axes_that_hardly_move():
    """Positions in whole millimetres of a vehicle that flies along one axis."""
    log = flight(200.0, 0.0)
    at = log["pos_w"].time
    path = np.column_stack([np.sin(at), 1e-3 * np.sin(at), np.ones(len(at))])
    log.channels["pos_w"] = Channel(at, np.round(path, 3), "m", "world")
    assert record_of(log).vehicle.sigma == approx(1e-3 * 12**-0.5, rel=0.2)


def test_samples_that_rounding_repeats_are_kept_and_those_that_are_held_are_not():
    log = flight(200.0, 0.0)
    at = log["pos_w"].time
    axis = np.array([1.0, 0.0, 0.0])
    slow = 0.05 * at[:, None] * axis
    log.channels["pos_w"] = Channel(at, np.round(slow, 3), "m", "world")
    assert len(record_of(log).vehicle.time) == len(at)
    fast = np.sin(at)[:, None] * axis
    held = fast[::2].repeat(2, axis=0)[: len(at)]
    log.channels["pos_w"] = Channel(at, held, "m", "world")
    assert len(record_of(log).vehicle.time) == approx(len(at) / 2, abs=1)
