"""Each extra of the reference plant does what it says, and nothing when it is off."""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, raises

from sim.params import GRAVITY, change_values
from sim.reference.plant import ReferencePlant
from sim.reference.reference_extras import ReferenceExtras
from tests.plants import paper_plant, plain_plant
from visthrow import config

WEIGHT = 0.272 * GRAVITY
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
STEP = 2e-3  # s, at most; of order 4, and some nanometres off a quarter of it


def short(plant, segments=2):
    """The same rope in few segments: the extras do not depend on their number and the tests take
    less time.
    """
    return change_values(plant, {"rope.segments": segments})


def start(extras, plant=None, count=1, speed=0.0, seed=0):
    reference = ReferencePlant(short(plant or plain_plant(), 2), extras, seed, count, step=STEP)
    velocity = np.tile([speed, 0.0, 0.0], (count, 1))
    reference.reset(
        np.tile([0.0, 0.0, 1.5], (count, 1)),
        np.tile(LEVEL, (count, 1)),
        velocity,
        np.zeros((count, 3)),
    )
    return reference


def hover(reference, periods, release=False):
    for _ in range(periods):
        reference.step(np.array([WEIGHT, 0.0, 0.0, 0.0]), release)
    return reference.state


def test_wind_pushes_vehicle_and_payload():
    extras = ReferenceExtras(payload_drag=2e-3, wind_mean_w=(3.0, 0.0, 0.0))
    state = hover(start(extras, paper_plant()), 5)
    still = hover(start(ReferenceExtras(payload_drag=2e-3), paper_plant()), 5)
    assert state.vel_w[0, 0] > still.vel_w[0, 0] + 0.03
    assert state.payload_vel_w[0, 0] > still.payload_vel_w[0, 0] + 0.02


def test_a_seed_draws_the_same_realistic_flight_again():
    realistic = config.load(ReferenceExtras, config.find("vehicle", "reference_realistic"))
    ends = [
        hover(start(realistic, paper_plant(), 3, seed=seed), 2).payload_pos_w for seed in (1, 1, 2)
    ]
    assert_array_equal(ends[0], ends[1])
    assert np.all(ends[0] != ends[2])


def test_wind_has_its_deviation_and_memory():
    reference = start(
        ReferenceExtras(wind_sigma_w=(0.5, 0.0, 0.0), wind_time_constant=0.1), count=800
    )
    first = reference._wind[:, 0].copy()
    hover(reference, 1)
    later = reference._wind[:, 0]
    assert later.std() == approx(0.5, rel=0.15)
    assert np.mean(first * later) == approx(0.25 * np.exp(-0.2), rel=0.25)
    assert not np.any(reference._wind[:, 1:])


def test_stretch_is_weight_over_stiffness_and_holds():
    state = hover(start(ReferenceExtras(stretch_stiffness=1000.0, stretch_damping=1.0)), 5)
    below = state.pos_w[0, 2] - state.payload_pos_w[0, 2]
    assert below == approx(0.02 + 0.33 + 0.033 + 0.058 * GRAVITY / 1000.0, abs=2e-6)


def test_centre_of_mass_offset_tips_the_vehicle():
    """The reported position stays the frame's; a centre 5 mm ahead pitches it nose down (+y)."""
    reference = start(ReferenceExtras(com_offset=(5e-3, 0.0, 0.0)))
    assert_allclose(reference.state.pos_w, [[0.0, 0.0, 1.5]], atol=1e-15)
    assert hover(reference, 3).rate_b[0, 1] > 0.05


def test_thrust_gain_lifts_by_its_share():
    state = hover(start(ReferenceExtras(thrust_gain_error=0.1)), 1)
    assert state.vel_w[0, 2] == approx(0.1 * GRAVITY * 0.02, rel=1e-3)


def test_motors_differ():
    reference = start(ReferenceExtras(motor_gain_sigma=0.05), count=200)
    assert reference._errors.thrust_gain.std() == approx(0.05, rel=0.1)
    assert np.abs(hover(reference, 1).rate_b).max() > 0.01


def test_jitter_moves_the_switch_and_the_separation():
    """Commands are due 22 +- 3 ms after they were given and never overtake each other; payloads
    leave 110 +- 10 ms after the latch.
    """
    reference = start(ReferenceExtras(delay_jitter=3e-3, release_lag_jitter=1e-2), count=100)
    hover(reference, 1, True)
    due = reference._queue_times[-1]
    hover(reference, 6, True)
    opened = reference.landing.separation_time
    for times, mean, most in ((due, 0.022, 3e-3), (opened, 0.11, 1e-2)):
        assert np.abs(times - mean).max() < most
        assert times.std() == approx(most / np.sqrt(3.0), rel=0.15)


def test_measured_is_the_state_of_before_with_noise():
    reference = start(ReferenceExtras(mocap_latency=0.03), speed=1.0)
    assert reference.measure().pos_w[0, 0] == 0.0
    for _ in range(4):
        hover(reference, 1)
    late = reference.measure()
    assert late.time == approx(0.05, abs=1e-12)
    assert late.pos_w[0, 0] == approx(0.05, abs=1e-6)
    noisy = start(
        ReferenceExtras(mocap_position_sigma=1e-3, mocap_angle_sigma=1e-2, gyro_sigma=0.1),
        count=500,
    )
    measured = noisy.measure()
    assert (measured.pos_w - noisy.state.pos_w).std() == approx(1e-3, rel=0.1)
    assert (2.0 * measured.quat_wb[:, :3]).std() == approx(1e-2, rel=0.1)
    assert measured.rate_b.std() == approx(0.1, rel=0.1)
    assert_array_equal(start(ReferenceExtras()).measure().pos_w, [[0.0, 0.0, 1.5]])


def test_battery_starts_used():
    reference = start(ReferenceExtras(battery_start_used=0.5), paper_plant(), count=100)
    voltage = reference.state.battery_voltage
    assert np.ptp(voltage) > 0.5
    assert voltage.max() < 16.8


def test_payload_and_rope_vary():
    reference = start(ReferenceExtras(payload_mass_sigma=0.02, rope_length_sigma=0.01), count=200)
    below = 1.5 - reference.state.payload_pos_w[:, 2] - 0.053
    assert below.std() == approx(0.0033, rel=0.2)
    assert reference._payload_mass.std() == approx(0.02 * 0.058, rel=0.2)


def test_bad_extras_are_refused():
    with raises(ValueError, match="gyro_sigma is -1"):
        ReferenceExtras(gyro_sigma=-1.0)
