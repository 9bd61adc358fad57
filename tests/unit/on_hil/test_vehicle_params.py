"""Wrong vehicles, guards and fences in a config, and ports that a back-end must not open."""

from pytest import mark, raises

from hil.errors import LinkError, RunError
from hil.links.backends import make_backend, mechanism_lag
from hil.links.backends.base import DryRun
from hil.links.backends.betaflight import Betaflight
from tests.configs import load_run
from visthrow.common.errors import ConfigError


def load(*overrides, name="dry_run"):
    return load_run(name, overrides)


@mark.parametrize(
    ("override", "message"),
    [
        ("ardupilot.follow_mode=5", r"expected GUIDED \(4\) or GUIDED_NOGPS \(20\)"),
        ("ardupilot.hold_mode=0", r"LOITER \(5\) or BRAKE \(17\)"),
        ("ardupilot.component=0", "component is 0; expected 1 to 255"),
        ("ardupilot.release_timeout=0.0", "release_timeout is 0.0; expected above 0"),
        ("ardupilot.mechanism_lag=-0.01", "mechanism_lag is -0.01; expected 0 or more"),
        ("ardupilot.servo_open_us=190", "servo_open_us is 190; expected 500 to 2500"),
        ('ardupilot.release="magnet"', "one of 'gripper', 'servo'"),
        ("px4.gripper=7", "expected 1 to 6"),
        ("px4.actuator_open=2.0", "expected -1 to 1"),
        ('px4.hold="loiter"', "one of 'hold', 'position'"),
        ("betaflight.release_channel=0", "release_channel is 0; expected 1 to 12"),
        ("betaflight.arm_channel=4", "both AUX 4; expected two"),
        ("betaflight.minimum_us=1500", "expected 900 to 1200"),
        ('betaflight.rates.type="kiss"', "one of 'betaflight', 'actual'"),
        ("betaflight.rates.expo=[0, 0, 101]", r"rates: expo is \(0, 0, 101\); expected 0 to 100"),
        ("betaflight.thrust.hover=1.5", "hover is 1.5; expected above 0 and below 1"),
        ("px4.thurst.hover=0.2", "did you mean 'thrust'"),
        ("gate.hold=0.01", "ascending"),
        ("throws=0", "expected 1 or more"),
        ('source.kind="csv"', "expected the file of the csv source"),
        ('frames.vehicle.axes="x,y,-z"', "mirror the world"),
        ('backend="px5"', "one of 'dry-run', 'ardupilot', 'px4', 'betaflight'"),
        ("gaol_w=[1.0]", "did you mean 'goal_w'"),
        ("guard.slew_thrust=0.0", "above 0"),
        ("fence.vehicle_low=[9.0, 0.0, 0.0]", "ascending corners"),
        ("states.armed=-1.0", "armed is -1.0; expected above 0"),
        ("home_w=[0.0, 0.0, 30.0]", "expected within the vehicle's fence"),
        (
            "goal_w=[9.0, 0.0, 0.0]",
            (
                r"goal_w \(9.0, .* expected within the payload's fence, \(-3.0, -3.0, -0.05\) to"
                r" \(3.0, 3.0, 3.0\)"
            ),
        ),
        ("landing_height=-3.0", "expected within the payload's fence"),
        ("link.system=300", "expected 1 to 255"),
    ],
)
def test_wrong_configs(override, message):
    with raises(ConfigError, match=message):
        load(override)


def test_a_servo_release_needs_its_output():
    with raises(ConfigError, match="expected the output that drives the mechanism"):
        load('ardupilot.release="servo"', "ardupilot.servo_output=0")


@mark.parametrize(
    ("device", "error", "message"),
    [
        ("/bin/sh", LinkError, "is refused"),
        ("betaflight_SITL.elf", LinkError, "is refused"),
        ("tcp:192.168.1.7:5761", LinkError, "is on another machine"),
        ("udp:127.0.0.1:5761", RunError, "MSP is a stream; expected tcp:... or serial:..."),
        ("tcp:127.0.0.1:9", LinkError, "cannot connect"),
    ],
)
def test_ports_of_msp(device, error, message):
    with raises(error, match=message):
        make_backend(load(f'betaflight.device="{device}"', name="fake_betaflight"))


def test_which_back_end():
    assert isinstance(make_backend(load()), DryRun)
    assert mechanism_lag(load()) == 0.0
    assert mechanism_lag(load("px4.mechanism_lag=0.07", name="fake_px4")) == 0.07
    with raises(RunError, match="backend px4 without a MAVLink link"):
        make_backend(load(name="fake_px4"))
    assert Betaflight.holds is False
