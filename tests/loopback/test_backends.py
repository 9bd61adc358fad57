"""Each back-end against its fake, in lock step: commands, modes, hand-over, parameters, release,
and who controls the vehicle.
"""

import numpy as np
from numpy.testing import assert_allclose
from pytest import approx, mark

from hil.check import AutopilotCheck
from hil.control.loop import Loop
from hil.control.state_machine import OperatorInput
from hil.links.backends.ardupilot import BRAKE
from hil.links.backends.base import FOLLOW, HOLD, LAND, WAIT
from hil.links.backends.betaflight import OPEN_TIME, STICKS
from hil.links.backends.mavlink_autopilot import MOST_TEXTS
from hil.links.pymav import mav
from tests.fakes.fake_px4 import LAND as PX4_LAND
from tests.fakes.fake_px4 import OFFBOARD, POSCTL, custom
from tests.hil_flight import AT_ONCE, AutoOperator
from tests.level import LevelPlant
from tests.loopback.wire import AUTOPILOTS, QUICK, peers, throw

HOVER = (2.668, 0.0, 0.0, 0.0)
STEPS = round(0.02 / LevelPlant.period)
"""Of the plant in a tick."""

SEPARATION = 5e-4
"""Latch to separation against the trained lag [s]: 5 ms are required; the clock is simulated, so
that nothing else is late.
"""


class Desk:
    """A back-end without a runner, which the test queries and commands."""

    def __init__(self, kind, *overrides, **options):
        parts = peers(LevelPlant(), kind=kind, loaded=AT_ONCE, overrides=overrides, **options)
        self.runner, self.source, self.clock, self.fake = parts
        self.backend = self.runner.backend

    @property
    def now(self):
        return self.fake.plant.time

    @property
    def status(self):
        return self.backend.status(self.now)

    def turn(self, seconds, command=None, ask=None):
        end = self.now + seconds
        while self.now < end - 1e-9:
            for _ in range(STEPS):
                self.fake.step()
            self.source.poll(self.now)
            if command is not None:
                self.backend.send(command, self.now)
            if ask is not None:
                self.backend.ask(ask, self.now)
            self.backend.service(self.now)

    def follow(self):
        """Until commands are followed."""
        self.turn(0.5)
        for _ in range(100):
            if self.status.mode == FOLLOW:
                return self
            self.turn(0.02, HOVER, FOLLOW)
        raise AssertionError(self.status)

    @property
    def state(self):
        return self.status.connected, self.status.mode

    def take_over(self, mode, *words):
        """Let the pilot choose a mode, which a heartbeat reports at once."""
        self.fake.mode, self.fake._next_beat = mode, 0.0
        self.turn(0.1, HOVER, *words)

    def release(self):
        self.backend.release(self.now)

    def abort(self):
        """Request the end of the flight at each tick for a while."""
        for _ in range(20):
            self.turn(0.02)
            self.backend.abort(self.now)


def test_of_an_autopilot_that_says_much_the_newest_words_are_kept():
    """The last message gives the reason why it is not armed."""
    desk = Desk("ardupilot")
    desk.turn(0.5)
    for n in range(MOST_TEXTS + 1):
        text = f"word {n}".encode()
        desk.fake.link.send(mav.MAVLink_statustext_message(mav.MAV_SEVERITY_INFO, text))
    desk.turn(0.5)
    assert len(desk.backend.texts) == MOST_TEXTS
    assert desk.backend.texts[-1] == f"word {MOST_TEXTS}"


@mark.parametrize("kind", AUTOPILOTS)
def test_units_and_axes_of_commands(kind):
    """A quarter of a turn a second about each axis alone, and a thrust, arrive with the right sign
    and size.
    """
    desk = Desk(kind).follow()
    for command in (
        (7.0, 1.0, 0.0, 0.0),
        (1.0, 0.0, 2.0, 0.0),
        (2.668, 0.0, 0.0, -3.0),
        (13.0, -9.0, 8.0, 2.0),
    ):
        desk.turn(0.06, command)
        assert_allclose(desk.fake.plant.commands[-1], command, atol=0.012, rtol=2e-3)
    assert desk.fake.witness.breaches == []


def test_what_the_fakes_make_of_a_positive_rate_stands_in_their_axes():
    """Nose down is stick forward for Betaflight: the raw channels, in the order aileron, elevator,
    throttle, rudder.
    """
    desk = Desk("betaflight").follow()
    desk.turn(0.06, (2.668, 1.0, 2.0, 1.0))
    roll, pitch, throttle, yaw = desk.fake.channels[:4]
    assert (roll - 1500, pitch - 1500, yaw - 1500) == (
        round(500 * 57.2958 / 600),
        round(500 * 114.5916 / 600),
        -95,
    )
    assert throttle == round(1050 + 0.1906 * 950)


def test_a_vehicle_that_the_runner_is_to_arm_is_not_taken_before_its_checks_pass():
    desk = Desk("ardupilot", "ardupilot.arm=true", "ardupilot.take=true")
    desk.fake.armed, desk.fake.mode = False, BRAKE
    desk.turn(0.5)
    assert desk.status.connected
    check = mav.MAV_SYS_STATUS_PREARM_CHECK
    for health, connected in ((0, False), (check, True)):
        desk.fake.link.send(mav.MAVLink_sys_status_message(check, check, health, *[0] * 10))
        desk.turn(0.1)
        assert desk.status.connected == connected, desk.status.note


@mark.parametrize("kind", AUTOPILOTS)
def test_hands(kind):
    """Pilot, runner, the autopilot's own hold and landing; then the pilot again, who is
    not fought.
    """
    desk = Desk(kind).follow()
    assert desk.status.connected
    if not desk.backend.holds:
        desk.fake.armed = False
        desk.turn(0.3, HOVER, FOLLOW)
        assert desk.state == (False, WAIT)
        assert desk.status.note == "disarmed"
        return
    desk.turn(0.3, HOVER, HOLD)
    assert desk.state == (True, HOLD)
    desk.turn(1.6, HOVER, FOLLOW)
    assert desk.state == (True, FOLLOW)
    desk.take_over(2 if kind == "ardupilot" else POSCTL, FOLLOW)
    assert desk.state == (False, WAIT)
    assert "did not ask for: pilot or failsafe has it" in desk.status.note
    mode = desk.fake.mode
    desk.abort()
    assert desk.fake.mode == mode, "an abort does not take it out of the pilot's hands"


@mark.parametrize("kind", ["ardupilot", "px4"])
def test_an_abort_lands(kind):
    desk = Desk(kind).follow()
    sent = desk.source.links[0].sent
    desk.abort()
    assert desk.source.links[0].sent - sent <= 20, "it does not ask at every tick"
    assert desk.status.mode == LAND
    assert desk.fake.mode == (9 if kind == "ardupilot" else PX4_LAND)


@mark.parametrize("kind", ["ardupilot", "px4"])
def test_an_abort_right_after_a_request_for_hold_still_lands(kind):
    """The heartbeat shows the hold when landing is wanted already: that is no pilot."""
    desk = Desk(kind).follow()
    desk.backend.ask(HOLD, desk.now)
    desk.turn(0.02)
    desk.backend.ask(HOLD, desk.now)
    desk.backend.abort(desk.now)
    hold = 17 if kind == "ardupilot" else custom(4, 3)
    desk.fake.enter(hold)
    desk.fake._next_beat = 0.0
    desk.abort()
    assert desk.status.mode == LAND


def test_offboard_is_requested_of_px4_only_after_a_second_of_set_points():
    desk = Desk("px4")
    desk.turn(0.5)
    assert desk.state == (
        True,
        HOLD,
    ), "in Position mode it may be taken"
    start = desk.now
    while desk.status.mode != FOLLOW:
        desk.turn(0.02, HOVER, FOLLOW)
        assert desk.now - start < 2.0
    assert 1.0 < desk.now - start < 1.5
    assert desk.fake.mode == OFFBOARD


def test_px4_gives_the_vehicle_back_in_position_mode_where_the_config_says_so():
    desk = Desk("px4", 'px4.hold="position"').follow()
    desk.turn(0.3, HOVER, HOLD)
    assert (desk.status.connected, desk.status.mode, desk.fake.mode) == (True, HOLD, POSCTL)
    desk.turn(1.6, HOVER, FOLLOW)
    desk.take_over(POSCTL, FOLLOW)
    assert not desk.status.connected, "unasked it is the pilot's"


def test_px4_in_position_mode_is_the_pilots_where_its_hold_was_requested():
    desk = Desk("px4").follow()
    desk.turn(0.5, HOVER, HOLD)
    assert desk.status.mode == HOLD
    desk.take_over(POSCTL)
    assert desk.status.mode != HOLD


def test_px4_without_a_stream_gets_no_request():
    desk = Desk("px4")
    desk.turn(2.0, None, FOLLOW)
    assert desk.fake.mode == POSCTL


def test_betaflight_waits_for_the_pilots_switch_and_refuses_one_that_is_on_too_early():
    desk = Desk("betaflight")
    desk.turn(0.5)
    assert desk.state == (True, WAIT)
    desk.fake.override = True
    desk.turn(0.2)
    assert desk.status.note.startswith("MSP OVERRIDE is on before the runner is ready")
    assert not desk.status.connected


def test_what_silence_does_under_the_override_follows_betaflights_version():
    """Since 2026.6 the pilot's sticks count again; before, the last frame counts for ever, and the
    audit reports this before anything flies.
    """
    tables = []
    for version, word in (((2026, 6, 1), "ok"), ((4, 6, 0), "WARN")):
        desk = Desk("betaflight", tell=tables.append)
        desk.fake.version = version
        desk.follow()
        (row,) = [line for line in tables[-1].splitlines() if "fc_version" in line]
        assert row.startswith(word)
        assert "its last sticks count until the pilot switches MSP OVERRIDE off" in row
        assert desk.status.fault is None


def test_betaflight_that_is_handed_back_is_level_with_the_pilots_throttle():
    """Where the last sticks count for ever; where they expire the runner falls silent."""
    for version, frames in (((4, 5, 2), True), ((2026, 6, 1), False)):
        desk = Desk("betaflight")
        desk.fake.version = version
        desk.follow()
        desk.turn(0.3, (5.0, 1.0, 0.0, 0.0))
        came = desk.fake.witness.commands
        for _ in range(50):
            desk.turn(0.02)
            desk.backend.surrender(desk.now)
        assert (desk.fake.witness.commands > came + 5) == frames
        assert_allclose(desk.fake.plant.commands[-1], HOVER, rtol=0.01, atol=0.05)


def test_betaflight_with_all_channels_arms_with_the_throttle_low_and_disarms_in_the_end():
    desk = Desk("betaflight", "betaflight.arm_channel=1", all_channels=True)
    desk.turn(0.5)
    assert not desk.fake.armed
    assert desk.fake.witness.commands > 10, (
        "it is spoken to before it is taken: a silent receiver cannot be armed"
    )
    desk.follow()
    assert desk.fake.armed
    desk.turn(0.1, HOVER)
    assert_allclose(desk.fake.plant.commands[-1][0], HOVER[0], rtol=2e-3)
    desk.backend.finish(desk.now)
    desk.turn(0.05)
    assert not desk.fake.armed


TRAPS = {
    "ardupilot": {
        "GUID_OPTIONS": 0.0,
        "ATC_ANGLE_BOOST": 1.0,
        "GUID_TIMEOUT": 3.0,
        "EK3_SRC1_POSXY": 3.0,
        "GRIP_ENABLE": 0.0,
        "GRIP_TYPE": 0.0,
        "GRIP_RELEASE": 1900.0,
        "SERVO9_FUNCTION": 33.0,
    },
    "px4": {
        "COM_OF_LOSS_T": 5.0,
        "COM_OBL_RC_ACT": 0.0,
        "EKF2_EV_CTRL": 0.0,
        "PD_GRIPPER_EN": 0.0,
        "PD_GRIPPER_TO": 6.0,
        "PWM_AUX_FUNC1": 301.0,
        "PWM_AUX_MIN1": 900.0,
    },
    "betaflight": {
        "rates_type": 0,
        "roll_rc_rate": 7,
        "pitch_rate": 67,
        "yaw_expo": 50,
        "deadband": 5,
        "min_check": 1000,
        "mid_rc": 1510,
        "failsafe_delay": 2.0,
    },
}


@mark.parametrize(("kind", "name"), [(kind, name) for kind in AUTOPILOTS for name in TRAPS[kind]])
def test_a_wrong_parameter_is_found_over_the_wire(kind, name):
    tables = []
    desk = Desk(kind, parameters={name: TRAPS[kind][name]}, tell=tables.append)
    desk.turn(0.5)
    (table,) = tables
    wrong = [line for line in table.splitlines() if line.startswith("WRONG")]
    assert len(wrong) == 1
    assert name in wrong[0]
    assert "--write-parameters" in table
    assert not desk.status.connected
    assert f"parameter audit: {name} wrong" in desk.status.fault
    assert any(text.startswith(f"{name} is ") for text in desk.backend.audit.problems)
    assert desk.fake.parameters[name] == TRAPS[kind][name], "nothing is written unasked"


@mark.parametrize(
    ("kind", "names"),
    [
        ("ardupilot", set(TRAPS["ardupilot"]) - {"GRIP_TYPE", "GRIP_RELEASE"}),
        ("px4", set(TRAPS["px4"]) - {"PD_GRIPPER_TO", "PWM_AUX_MIN1"}),
        ("betaflight", {"rates_type", "roll_rc_rate", "pitch_rate", "yaw_expo"}),
    ],
)
def test_write_parameters_mends_them(kind, names):
    desk = Desk(kind, parameters={name: TRAPS[kind][name] for name in names}, write=True)
    if kind == "betaflight":
        desk.fake.armed = False
    desk.turn(3.0)
    assert desk.status.fault is None
    assert set(desk.backend.audit.written) == names


AUDITED = [
    # software knows its place by its own simulated GPS
    ("ardupilot", "poses=false", {"EK3_SRC1_POSXY": 0.0}, []),
    ("px4", "poses=false", {"EKF2_EV_CTRL": 0.0}, []),
    # a second of the last rates is too long
    ("ardupilot", "", {"GUID_TIMEOUT": 1.0}, ["GUID_TIMEOUT is 1; expected above 0, at most 0.5"]),
    ("px4", "", {"COM_OF_LOSS_T": 1.0}, ["COM_OF_LOSS_T is 1; expected above 0, at most 0.5"]),
    (
        "ardupilot",
        "",
        {"GUID_OPTIONS": 5.0},
        ["GUID_OPTIONS is 5; expected with the bits of 8 set"],
    ),
    # older firmware answers no DO_GRIPPER without it
    ("px4", "", {"PD_GRIPPER_EN": 0.0}, ["PD_GRIPPER_EN is 0; expected 1, or none since 1.17"]),
    # the closed end taken for the open one
    ("px4", "servo_open_us=2000", {}, ["PWM_AUX_MIN1 is 1000; expected 2000 (servo_open_us)"]),
]


@mark.parametrize(("kind", "override", "parameters", "problems"), AUDITED)
def test_what_the_audit_says(kind, override, parameters, problems):
    desk = Desk(kind, *([f"{kind}.{override}"] if override else []), parameters=parameters)
    desk.turn(1.5)
    assert (desk.backend.audit.done, desk.backend.audit.problems) == (True, problems)


def test_px4_in_software_has_no_minimum_of_an_output():
    """Nor a switch of the gripper, which is gone since 1.17."""
    desk = Desk("px4", 'px4.output_parameter="PWM_MAIN_FUNC9"', parameters={"PWM_MAIN_FUNC9": 430})
    desk.turn(1.5)
    assert desk.status.fault is None
    assert desk.backend.audit.refused == {"PWM_MAIN_MIN9": "no such parameter"} | {
        "PD_GRIPPER_EN": "no such parameter"
    }


def test_parameters_of_the_config_are_audited_and_written():
    """They make a vehicle in software the policy's."""
    overrides, values = ("px4.parameters.SIH_MASS=0.272",), {"SIH_MASS": 1.0}
    desk = Desk("px4", *overrides, parameters=values)
    desk.turn(0.5)
    assert desk.backend.audit.problems == ["SIH_MASS is 1; expected 0.272"]
    desk = Desk("px4", *overrides, parameters=values, write=True)
    desk.turn(3.0)
    assert desk.status.fault is None
    assert desk.fake.parameters["SIH_MASS"] == approx(0.272)


def test_betaflight_is_not_written_while_it_is_armed():
    desk = Desk("betaflight", parameters={"roll_rc_rate": 7}, write=True)
    desk.turn(6.0)
    assert desk.fake.parameters["roll_rc_rate"] == 7
    assert "roll_rc_rate" in desk.status.fault


def test_a_run_ends_at_once_on_a_wrong_parameter():
    summary, fake, decisions = throw(
        LevelPlant(), loaded=AT_ONCE, seconds=5.0, parameters={"GUID_OPTIONS": 0.0}
    )
    assert (summary["aborted"], fake.witness.commands) == (True, 0)
    assert summary["reason"] == "parameter audit: GUID_OPTIONS wrong, see the table"
    assert decisions[-1].time < 1.0


def test_without_the_audit_the_traps_are_what_they_are():
    """What the audit is for: thrust as a climb rate, thrust that grows with tilt, a servo that is
    acknowledged and stays.
    """
    desk = Desk("ardupilot", "ardupilot.audit=false", parameters={"GUID_OPTIONS": 0.0}).follow()
    desk.turn(0.1, (7.0, 0.0, 0.0, 0.0))
    assert desk.fake.plant.commands[-1][0] == approx(2.668, rel=1e-3), "half thrust: no climb"
    desk = Desk("ardupilot", "ardupilot.audit=false", 'ardupilot.release="servo"').follow()
    desk.release()
    desk.turn(0.7, HOVER)
    assert (desk.status.release, desk.fake.release_time) == ("failed", None)
    assert desk.backend.release_record.note == "accepted, but nothing moved within 0.5 s"


ACTUATOR = (
    'px4.release="actuator"',
    'px4.output_parameter="PWM_AUX_FUNC1"',
    "px4.servo_open_us=2000",
)


@mark.parametrize(
    ("kind", "overrides", "parameters"),
    [
        ("ardupilot", (), {}),
        ("ardupilot", ('ardupilot.release="servo"',), {"SERVO9_FUNCTION": 0.0}),
        ("px4", (), {}),
        ("px4", ACTUATOR, {"PWM_AUX_FUNC1": 301.0}),
        ("betaflight", (), {}),
        ("betaflight", ("betaflight.servo_output=0",), {}),
    ],
)
def test_every_way_to_release(kind, overrides, parameters):
    desk = Desk(kind, *overrides, parameters=parameters).follow()
    assert desk.backend.audit.fault() is None
    when = desk.now + 0.05
    desk.backend.release(when)
    while desk.status.release == "idle" or desk.fake.release_time is None:
        desk.turn(0.02, HOVER)
        assert desk.now < when + 0.2
    assert desk.fake.release_time == approx(when, abs=0.025)
    desk.turn(1.5, HOVER)
    assert desk.status.release == "accepted"
    assert (desk.fake.witness.releases, desk.fake.witness.breaches) == (1, [])


@mark.parametrize(("answer", "after"), [("accepted", OPEN_TIME), ("silent", 0.1)])
def test_betaflights_mechanism_closes_again(answer, after):
    """A while after it has opened, and where an unanswered release is stopped."""
    desk = Desk("betaflight", answer=answer).follow()
    channel = STICKS + desk.backend.params.release_channel - 1
    desk.release()
    desk.turn(0.3, HOVER)
    assert desk.fake.channels[channel] > 1900
    if answer == "silent":
        desk.backend.stop_release()
    desk.turn(after, HOVER)
    assert desk.fake.channels[channel] < 1100


@mark.parametrize("kind", AUTOPILOTS)
def test_a_release_that_is_stopped_before_its_hour_is_not_sent(kind):
    desk = Desk(kind).follow()
    desk.backend.release(desk.now + 0.1)
    desk.turn(0.04, HOVER)
    desk.backend.stop_release()
    desk.turn(1.0, HOVER)
    assert (desk.fake.witness.releases, desk.status.release) == (0, "idle")


def test_px4_says_in_progress_first_and_that_is_pending():
    desk = Desk("px4").follow()
    desk.release()
    desk.turn(0.5, HOVER)
    assert (desk.status.release, desk.fake.witness.releases) == ("pending", 1)
    desk.turn(0.8, HOVER)
    assert desk.status.release == "accepted"


@mark.parametrize(
    ("kind", "mechanism"),
    [*((kind, 0.06) for kind in AUTOPILOTS), ("ardupilot", 0.002), ("betaflight", 0.11)],
)
def test_latch_to_separation_is_the_trained_lag(kind, mechanism):
    """The fake measures the true separation; the runner delays a faster mechanism by the
    difference.

    A latch counts from when the policy's commands of its tick act: the state that it decided on was
    carried forward to then."""
    plant, overrides = LevelPlant(lag=mechanism), (*QUICK, f"{kind}.mechanism_lag={mechanism}")
    runner, source, clock, fake = peers(plant, kind=kind, loaded=AT_ONCE, overrides=overrides)
    summary = Loop(runner, source, clock, AutoOperator()).fly(3.5)
    latch = summary["latch_times"][0] + runner.params.delay.command
    assert abs(fake.report()["separation_time"] - latch - 0.11) <= SEPARATION
    assert (summary["latches"], fake.witness.breaches) == (1, [])


@mark.parametrize(("kind", "prompt"), [*((kind, True) for kind in AUTOPILOTS), ("px4", False)])
def test_a_complete_throw(kind, prompt):
    """Also where a change of mode is seen in a heartbeat up to a second later."""
    plant = LevelPlant()
    quick = QUICK if prompt else (*QUICK[:-1], "states.land=2.0", "states.quiet=1.2")
    summary, fake, decisions = throw(
        plant, kind=kind, loaded=AT_ONCE, seconds=9.5, overrides=quick, prompt=prompt
    )
    assert (summary["latches"], len(summary["landings"]), summary["stuck"], summary["errors"]) == (
        1,
        1,
        0,
        [],
    )
    assert (fake.witness.releases, fake.witness.breaches) == (1, [])
    assert [d.state for d in decisions][:7] == [
        "idle",
        "check",
        "ready",
        "armed",
        "throw",
        "recover",
        "land",
    ]
    if kind == "betaflight":
        assert fake.override, "it is flown by the runner to the end"
    else:
        modes = [text for _, text in fake.events if text.startswith("mode")]
        assert modes == (
            ["mode 17", "mode 9"] if kind == "ardupilot" else ["mode 6.0", "mode 4.3", "mode 4.6"]
        )


def test_two_throws_with_the_autopilots_hold_between_them():
    """From the hold the runner takes the vehicle back for the next throw, and the
    release is new.
    """
    plant = LevelPlant()

    class HangOn:
        """Arms, and hangs the payload on again once the vehicle is held."""

        def words(self, state):
            if state == "ready" and plant.released is not None:
                plant.released, fake._trip, fake.release_time = None, None, None
                fake.witness._answered = False
            return OperatorInput(arm=state == "ready")

    runner, source, clock, fake = peers(
        plant, kind="ardupilot", loaded=AT_ONCE, overrides=(*QUICK, "throws=2")
    )
    summary = Loop(runner, source, clock, HangOn()).fly(9.0)
    assert (summary["latches"], fake.witness.releases, fake.witness.breaches) == (2, 2, [])
    assert [text for _, text in fake.events] == ["mode 17", "mode 4", "mode 17", "mode 9"]


@mark.parametrize(
    ("kind", "factor", "good"), [*((kind, 1.0, True) for kind in AUTOPILOTS), ("px4", 1.15, False)]
)
def test_the_hover_share_is_measured_before_a_flight(kind, factor, good):
    """The vehicle hovers under another controller; its share of thrust is compared with the
    config's.
    """
    hover = {"ardupilot": 0.1906, "px4": 0.1585, "betaflight": 0.1906}[kind]
    desk = Desk(kind, f"{kind}.thrust.hover={hover * factor}")
    check = AutopilotCheck(desk.runner.params, desk.backend)
    desk.fake.compute_command = lambda: np.array([2.668, 0.0, 0.0, 0.0])
    for _ in range(400):
        for _ in range(STEPS):
            desk.fake.step()
        for pose in desk.source.poll(desk.now):
            desk.runner.tracks[pose.body].update(pose)
        check.tick(desk.now, desk.runner)
    passed, text = check.results(desk.now, desk.runner.mass)[-1]
    assert passed == good, text
    assert check.meter.share == approx(hover, rel=0.01)
    desk.turn(1.0)
    if good:
        assert desk.status.thrust == approx(2.668, rel=0.02)


def test_betaflight_is_read_back_from_its_channel_where_outputs_are_forwarded():
    """MSP_SERVO does not show them; a release that moves nothing must not count as good."""
    desk = Desk("betaflight", parameters={"channel_forwarding": 1}).follow()
    assert desk.backend.voltage == approx(11.1), "sent in hundredths of a volt"
    desk.release()
    desk.turn(1.0, HOVER)
    assert (desk.status.release, desk.fake.witness.releases) == ("accepted", 1)
    desk = Desk("betaflight", parameters={"channel_forwarding": 1}, answer="silent").follow()
    desk.release()
    desk.turn(1.0, HOVER)
    assert desk.status.release == "failed", "a channel that does not arrive is none"


def test_betaflight_arms_though_the_receiver_was_lost_as_arm_went_up():
    """ARM that is high when the receiver comes back has to go low first."""
    desk = Desk("betaflight", "betaflight.arm_channel=1", all_channels=True)
    came, lost = desk.fake._sticks_came, []

    def deaf(channels):
        if channels[4] > 1700 and not lost:
            lost.append(desk.now)
        if not (lost and desk.now < lost[0] + 0.5):
            came(channels)

    desk.fake._sticks_came = deaf
    desk.turn(1.0)
    desk.turn(3.0, HOVER, FOLLOW)
    assert lost
    assert (desk.fake.armed, desk.status.mode) == (True, FOLLOW)


@mark.parametrize(("kind", "closed"), [("ardupilot", 1900), ("px4", 2000)])
def test_a_mechanism_that_is_open_is_not_taken(kind, closed):
    """One that was left open after the last throw, or whose ends are exchanged: nothing hangs."""
    desk = Desk(kind, f"{kind}.servo_open_us={closed}", f"{kind}.audit=false")
    desk.turn(0.5)
    assert not desk.status.connected
    assert desk.status.note.startswith("the mechanism's output is at its open end: close it")


@mark.parametrize("kind", ["ardupilot", "px4"])
def test_a_mode_is_noticed_soon_though_the_heartbeat_is_slow(kind):
    """PX4's comes once a second and does not report a change; the runner requests it more often."""
    desk = Desk(kind, prompt=False).follow()
    begin = desk.now
    while desk.status.mode != HOLD:
        desk.turn(0.02, HOVER, HOLD)
        assert desk.now - begin < 0.2


def test_idle_says_at_once_why_it_waits():
    runner, source, clock, _ = peers(
        LevelPlant(), loaded=AT_ONCE, overrides=("states.idle=1.0",), armed=False
    )
    decisions = []
    Loop(runner, source, clock, AutoOperator(), None, decisions.append).fly(5.0)
    waits = {d.waits: d.time for d in decisions if d.state == "idle"}
    assert waits["autopilot not ready (disarmed)"] < 0.2
    assert len(decisions) <= 8, "and not at every tick"
