"""Thrust to shares and back, its measurement in hover, and the vehicles that are refused."""

from pytest import approx, mark, raises

from hil.errors import RunError
from hil.links.backends import require_reach
from hil.links.backends.thrust_curve import LEAST_SHARES, HoverMeter, HoverThrustParams
from tests.configs import load_run
from tests.hil_flight import simple_policy
from visthrow.common.errors import ConfigError
from visthrow.onboard.hover import GRAVITY

BENT = HoverThrustParams(2.668, 0.37, 0.8, 0.08, 0.0)


def test_the_inverse_restores_the_thrust():
    for thrust in (0.6, 1.0, 2.668, 4.0, 6.0):
        assert BENT.thrust(BENT.share(thrust)) == approx(thrust)
    assert BENT.share(2.668) == approx(0.37)
    assert BENT.share(3.668) - BENT.share(2.668) == approx(0.37 / 2.668 / 0.8), (
        "a flatter vehicle needs more share"
    )
    assert (BENT.share(-5.0), BENT.share(50.0)) == (0.0, 1.0)
    assert BENT.thrust(0.0) == approx(0.2 * 2.668)


def test_a_lower_battery_gets_more_share():
    params = HoverThrustParams(2.668, 0.2, 1.0, 0.08, 12.0)
    assert params.share(2.668, 12.0) == approx(0.2)
    assert params.share(2.668, 10.8) == approx(0.2 / 0.81)
    assert params.thrust(0.2 / 0.81, 10.8) == approx(2.668)
    assert params.share(2.668, None) == approx(0.2), "unknown: not corrected"
    assert params.share(2.668, 0.0) == approx(0.2 * 1.25**2), "a wrong reading does not run away"
    assert BENT.share(2.668, 5.0) == approx(0.37), "not corrected where the config says so"


@mark.parametrize(
    ("off", "good"), [(0.002, True), (0.07, True), (-0.07, True), (0.09, False), (-0.2, False)]
)
def test_the_measured_hover_is_held_against_the_calibration(off, good):
    meter = HoverMeter(BENT)
    for _ in range(LEAST_SHARES):
        meter.add(0.37 * (1.0 + off))
        meter.add(None)
        meter.add(float("nan"))
    passed, text = meter.summary_text(2.668 / GRAVITY)
    assert passed == good
    assert f"measured {0.37 * (1 + off):.3f}, by the config 0.370 ({100.0 * off:+.1f} %" in text
    assert ("calibrate" in text) == (not good)


def test_too_few_values_measure_nothing():
    meter = HoverMeter(BENT)
    meter.add(0.9)
    assert meter.share is None
    assert meter.summary_text(0.272) == (
        True,
        "hover share not measured: 1 of 50 values in steady hover",
    )


@mark.parametrize(
    ("name", "override", "message"),
    [
        (
            "fake",
            "ardupilot.thrust.hover=0.37",
            r"gives 7\.\d+ N at most, the policy was trained with 14 N",
        ),
        ("fake_px4", "px4.thrust.slope=0.7", "gives 12.* N at most"),
        ("fake", "ardupilot.thrust.weight=1.334", "is 0.50 times the weight that the policy was"),
        ("fake_crazyflie", "crazyflie.thrust.weight=5.336", "is 2.00 times the weight"),
        ("fake_betaflight", "betaflight.rates.rc_rates=[40, 60, 30]", None),
        ("fake_betaflight", "betaflight.rates.rates=[60, 60, 20]", None),
    ],
)
def test_a_vehicle_that_cannot_do_it_is_refused(name, override, message):
    contract = simple_policy().contract
    require_reach(load_run(name), contract)
    params = load_run(name, [override])
    if message is None:  # with actual rates the end counts, and is never below the middle's slope
        require_reach(params, contract)
        slow = load_run(
            name, ["betaflight.rates.rc_rates=[30, 60, 30]", "betaflight.rates.rates=[30, 60, 30]"]
        )
        with raises(RunError, match=r"reach 5\.2, 10\.5, 5\.2 rad/s on roll, pitch, yaw"):
            require_reach(slow, contract)
    else:
        with raises(RunError, match=message):
            require_reach(params, contract)


@mark.parametrize("name", ["ardupilot", "px4", "betaflight"])
def test_configs_of_real_vehicles_reach_what_policies_ask_and_are_audited(name):
    params = load_run(name)
    require_reach(params, simple_policy().contract)
    assert getattr(params, params.backend).audit
    with raises(ConfigError, match="a recording flies dry"):
        load_run(name, ['source.kind="tlog"', 'source.file="a.tlog"'])


def test_a_curve_of_the_rotors_is_inverted_exactly():
    """``T = W (z / z_h)^2`` with ``z = idle + (1 - idle) u``: 4 times the weight at twice the
    motors' command.
    """
    params = HoverThrustParams(2.668, 0.36, 1.0, 0.08, 0.0, 2.0, 0.055)
    motors = 0.055 + 0.945 * 0.36
    double = (2 * motors - 0.055) / 0.945
    assert params.thrust(double) == approx(4 * 2.668)
    assert params.share(4 * 2.668) == approx(double)
    assert params.share(2.668) == approx(0.36)
    assert params.share(0.0) == 0.0
    for thrust in (0.5, 2.0, 7.0):
        assert params.thrust(params.share(thrust)) == approx(thrust)
