"""The parts of the fakes: the witness catches breaches, options are checked."""

import math

import numpy as np
from pytest import mark, raises

from hil.errors import RunError
from hil.links.mavlink_link import Link, attitude_target
from hil.links.pymav import mav
from hil.rehearsal.fake import FakeOptions, Witness
from hil.rehearsal.process import load_fake, load_plant
from tests.level import LevelPlant
from tests.loopback.wire import pipe
from visthrow import config
from visthrow.common.errors import ConfigError


def read_options(overrides):
    """Options as `hil fake` reads them."""
    return config.loads(FakeOptions, "", overrides, "options of the fake")


LIMITS = (14.0, 10.0, 10.0, 4.0)
INSIDE = np.array([0.0, 0.0, 1.0])


@mark.parametrize(
    ("command", "text"),
    [
        ((math.nan, 0.0, 0.0, 0.0), "is not finite"),
        ((5.0, 0.0, math.inf, 0.0), "is not finite"),
        ((14.2, 0.0, 0.0, 0.0), "beyond"),
        ((-0.1, 0.0, 0.0, 0.0), "beyond"),
        ((5.0, 10.2, 0.0, 0.0), "beyond"),
        ((5.0, 0.0, 0.0, -4.1), "beyond"),
    ],
)
def test_the_witness_catches_commands(command, text):
    witness = Witness(LIMITS)
    witness.command(1.5, (14.0, 10.0, -10.0, 4.0))
    assert (witness.breaches, witness.worst) == ([], [14.0, 10.0, 10.0, 4.0])
    witness.command(2.5, command)
    assert len(witness.breaches) == 1
    assert witness.breaches[0].startswith("2.500 s: command")
    assert text in witness.breaches[0]


@mark.parametrize(
    ("armed", "payload_w", "text"),
    [(False, INSIDE, "disarmed"), (True, INSIDE + [3.5, 0.0, 0.0], "outside of its fence")],
)
def test_the_witness_catches_releases(armed, payload_w, text):
    witness = Witness(LIMITS)
    for time in (1.0, 1.04):  # a repetition before the answer is one release
        witness.release(time, True, INSIDE)
    assert witness.breaches == []
    witness.release(1.08, armed, payload_w)
    assert [text in breach for breach in witness.breaches] == [True]


def test_a_fake_reports_what_its_witness_saw():
    """Over the wire, a thrust that is none: taken, as by the real ones, and the vehicle falls."""
    here, far_end = pipe()
    fake = load_fake("ardupilot")(LevelPlant(), Link(far_end, 1, 1))
    link = Link(here)
    link.send(attitude_target(0.0, (1, 1), math.nan, (0.0, 0.0, 0.0)))
    gripper = (mav.MAV_CMD_DO_GRIPPER, 0, 1.0, mav.GRIPPER_ACTION_RELEASE, 0.0, 0.0, 0.0, 0.0, 0.0)
    for _ in range(2):
        link.send(mav.MAVLink_command_long_message(1, 1, *gripper))
        for _ in range(4):
            fake.step()
    assert fake.plant.commands[-1][0] == 0.0
    report = fake.report()
    assert len(report["breaches"]) == 2
    assert "is not finite" in report["breaches"][0]
    assert "again after the answer" in report["breaches"][1]


def test_options_of_a_fake():
    options = read_options(["silent_after=12", "parameters.GUID_OPTIONS=0", "answer=silent"])
    assert (options.silent_after, options.parameters, options.answer) == (
        12.0,
        {"GUID_OPTIONS": 0.0},
        "silent",
    )
    with raises(ConfigError, match="did you mean 'silent_after'"):
        read_options(["silent_aftr=12"])
    with raises(ConfigError, match="expected one of 'accepted', 'in-progress'"):
        read_options(["answer=maybe"])
    with raises(ConfigError, match=r"servo_delay is -0.1; expected 0 or more"):
        read_options(["servo_delay=-0.1"])
    with raises(RunError, match="did you mean 'ardupilot'"):
        load_fake("ardupilo")
    with raises(RunError, match="expected module:class"):
        load_fake("my-fakes:Fake")


@mark.parametrize(
    "name",
    [
        "nowhere:make",
        "visthrow.throws.wire_plant:none",
        "visthrow.throws.wire_plant",
        "",
        "os:system",
        "math:pi",
    ],
)
def test_plants_that_are_none(name):
    with raises(RunError, match="expected module:function"):
        load_plant(name, "state", 0)
