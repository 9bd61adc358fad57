"""Betaflight's own firmware flies the simulated vehicle: take-over, steps, a whole throw with
release and recovery, silence.

``make test-sitl`` builds the firmware (the package `betaflight` holds its sources; GPL-3, a tool of
these tests alone) and runs this file in a network of its own. Its clock goes in lock step with the
vehicle; where two processes fly, both are paced to ``VISTHROW_SITL_SPEED`` of real time, 0.5 where
it is not set."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import numpy as np
import pytest
from pytest import approx, fixture, mark

from bench.sitl import override
from bench.sitl.direct import open_runner, throw
from hil.links.backends.base import FOLLOW
from hil.links.backends.betaflight import EXPIRES, FACTS, Betaflight
from hil.links.device import Device, UdpPort, check_device, open_port
from hil.links.mavlink_link import Link
from hil.rehearsal.bridges.betaflight_bridge import BetaflightSitl
from hil.rehearsal.bridges.betaflight_firmware import Firmware, list_settings
from hil.rehearsal.fake import VEHICLE_ID, FakeOptions
from hil.rehearsal.fake_mocap import FakeMocapParams
from tests.commands import set_words, start
from tests.configs import load_run
from tests.loopback import test_endings as endings
from visthrow.onboard.policy import Policy, find_policy
from visthrow.throws.wire_plant import make_motors

pytestmark = mark.sitl

SPEED = float(os.environ.get("VISTHROW_SITL_SPEED", "0.5"))
"""Of both clocks."""

TICK = 0.02
"""Between two commands [s]."""

STEP = np.array([1.5, 1.5, 1.0])
"""Commanded rates about x, y, z [rad/s]."""

HALF_STEP = 0.15
"""Time to half of a step [s]: 55 to 90 ms were measured; a period of the commands and a late
machine besides.
"""

STIFF = {"p": "11", "i": "20", "d": "8", "d_max": "8"}
"""Gains of roll and pitch that hold a rate against the swinging ball."""

FASTER, SETTLED, RAMP = 20.0, 0.03, 0.15
"""Angular acceleration [rad/s^2], and the interval in which its response is measured [s]."""

LEAD = 5 * 0.000529 / (5 * 0.032029) - 1.0 / (2.0 * np.pi * 250.0) - 1.0 / (2.0 * np.pi * 500.0)
"""Of the output before the rate while it grows, 15.6 ms:

D over P of roll (pid.h), less what the gyro's two filters cost [s].
"""

OTHERS = 0.25
"""Rate of the other axes beside a step, as a share of it: 0.03 of 1.5 rad/s were measured on a
quiet machine.
"""

LIFT = 0.25
"""Share by which a step of thrust may differ from the command: the battery's voltage has changed
since the calibration.
"""

IDLE, DISARM = (0.2, 0.6), (1.0, 2.5)
"""Silence after which the motors idle and after which it disarms [s]: 0.36 and 1.6 s were measured.
"""

MISS = 0.35
"""Of a landing [m]; a payload that just hangs is 2 m off.

Throws on a quiet machine land 0.02 to 0.15 m off.
"""

ON = 10.0
"""Time flown on after a landing [s]: the runner hovers again 3 s and has landed 6 s after it."""

LONG = 200.0
"""A run on a busy machine [s]."""


def program() -> Path:
    """The firmware that the package built, or the one that the environment names."""
    named = os.environ.get("VISTHROW_FIRMWARE")
    where = Path(sysconfig.get_paths()["purelib"]) / "betaflight" / "firmware" / "obj"
    programs = [Path(named)] if named else sorted(where.glob("betaflight_*_SITL"))
    if not programs:
        pytest.fail(f"no firmware in {where}; `make test-sitl` builds it")
    return programs[0]


@fixture(scope="session")
def settings(tmp_path_factory):
    """A folder with the firmware's settings, written and read back once, and what was read."""
    folder = tmp_path_factory.mktemp("firmware")
    params = load_run("betaflight_sitl").betaflight
    return folder, Firmware(program(), folder).set_up(list_settings(params))


class Bench:
    """Firmware, bridge and the runner's back-end in one process, in lock step."""

    def __init__(self, folder: Path, settings: Path):
        shutil.copy(settings / "eeprom.bin", folder)
        self.params = load_run("betaflight_sitl").betaflight
        self.firmware = Firmware(program(), folder)
        self.firmware.start()
        self.plant = make_motors("vision", 0)
        nobody = Link(UdpPort(Device("udpout", "127.0.0.1", 14999)), *VEHICLE_ID)
        self.fake = BetaflightSitl(
            self.plant,
            nobody,
            FakeMocapParams(),
            0,
            FakeOptions(),
            self.params,
            self.firmware.stands,
        )
        self.backend = Betaflight(open_port(check_device(self.params.device)), self.params)
        self.fake.sensors.start()
        self._next = 0.0
        self.rows: list[tuple] = []

    def turn(self, seconds, command=None, ask=None, until=None):
        """Fly for a time, or until something holds; a command is sent each tick."""
        end = self.plant.time + seconds
        while self.plant.time < end:
            self.fake.step()
            now = self.plant.time
            self.rows.append(
                (now, *self.plant.rate_b, self.plant.force_b[2], self.fake.motors.sum())
            )
            if now >= self._next:
                self._next = now + TICK
                if command is not None:
                    self.backend.send(command, now)
                if ask is not None:
                    self.backend.ask(ask, now)
                if command is not None or ask is not None:
                    self.backend.service(now)
            if until is not None and until():
                return True
        return until is None

    def take(self):
        """Read the settings, arm, lift out of the stand and hang there for a moment."""
        idle, hover = (0.0, 0.0, 0.0, 0.0), (self.plant.mass[0] * 9.81 * 1.02, 0.0, 0.0, 0.0)
        known = lambda: self.backend.audit.done and self.fake._boxes  # noqa: E731
        assert self.turn(10.0, idle, until=known), "the firmware answers on both ports"
        following = lambda: self.backend.status(self.plant.time).mode == FOLLOW  # noqa: E731
        assert self.turn(10.0, idle, FOLLOW, until=following), self.backend.status(self.plant.time)
        assert self.turn(3.0, hover, until=lambda: not self.plant.held), (
            f"motors {self.fake.motors}"
        )
        self.turn(0.4, hover)
        return hover

    def close(self):
        self.backend.close()
        self.fake.close()
        self.firmware.stop()


@fixture
def bench(tmp_path, settings):
    desk = Bench(tmp_path, settings[0])
    yield desk
    desk.close()


@fixture
def stiff(tmp_path):
    """With `STIFF` gains: those of the throws hold no rate against the ball, as the training's do
    not.
    """
    params = load_run("betaflight_sitl").betaflight
    gains = {f"{gain}_{axis}": value for axis in ("roll", "pitch") for gain, value in STIFF.items()}
    folder = tmp_path / "stiff"
    Firmware(program(), folder).set_up({**list_settings(params), **gains})
    desk = Bench(tmp_path, folder)
    yield desk
    desk.close()


def test_settings_are_written_and_read_back(settings):
    params = load_run("betaflight_sitl").betaflight
    assert settings[1] == list_settings(params)
    assert settings[1]["small_angle"] == "180"
    assert settings[1]["blackbox_device"] == "VIRTUAL"


def test_it_is_taken_armed_and_follows_steps(stiff):
    """Sign, axis, scale and time of each rate and of thrust, by the vehicle's own motion."""
    bench = stiff
    hover = bench.take()
    assert bench.fake.armed
    assert not bench.backend.audit.problems
    print()
    for axis, name in enumerate(("roll", "pitch", "yaw")):
        for sign in (1.0, -1.0):
            command = np.zeros(3)
            command[axis] = sign * STEP[axis]
            begun, first = bench.plant.time, len(bench.rows)
            bench.turn(0.3, (hover[0], *command))
            rows = np.array(bench.rows[first:])
            rate = sign * rows[:, 1 + axis] / STEP[axis]
            half = rows[np.argmax(rate > 0.5), 0] - begun
            reached, others = rate[-25:].mean(), np.delete(rows[-25:, 1:4], axis, 1)
            print(
                f"{name} {sign * STEP[axis]:+.1f} rad/s: reached {reached:.2f}, half after"
                f" {1e3 * half:.0f} ms"
            )
            assert (rate > 0.5).any()
            assert half < HALF_STEP
            assert 0.8 < reached < 1.3
            assert np.abs(others).mean() < OTHERS * STEP[axis] + 0.05
        bench.turn(0.2, hover)
    for share in (1.2, 0.8):
        first = len(bench.rows)
        bench.turn(0.3, (share * hover[0], 0.0, 0.0, 0.0))
        force = np.array(bench.rows[first:])[-25:, 4].mean()
        expected = share * hover[0] / bench.plant.mass[0]
        print(f"thrust x {share}: {force:.2f} of {expected:.2f} m/s^2")
        assert force == approx(expected, rel=LIFT)


def test_its_d_and_its_gyro_are_those_of_its_settings(bench):
    """The vehicle turns faster and faster: motors lead its rate by D and lag it by the gyro's
    filters. A sample a period: 11.1 ms.
    """
    hover, plant, rows = bench.take(), bench.plant, []

    def turned(motors, *_):
        rows.append((motors[[0, 2]] - motors[[1, 3]]).mean())
        plant.rate_b = plant.rate_b + [FASTER * plant.period, 0.0, 0.0]
        plant._plant.time += plant.period

    plant.rate_b, plant.step = np.zeros(3), turned
    bench.turn(RAMP, hover)
    time = plant.period * (np.arange(len(rows)) + 0.5)
    settled = time > SETTLED
    _, slope, offset = np.polyfit(time[settled], np.array(rows)[settled], 2)
    print(f"\nlead {1e3 * offset / slope:.2f} ms, {1e3 * LEAD:.2f} by the settings")
    assert offset / slope == approx(LEAD, rel=0.05)


def test_silence_idles_the_motors_and_disarms(bench):
    bench.take()
    begun, first = bench.plant.time, len(bench.rows)
    assert bench.turn(6.0, until=lambda: not bench.fake.armed), "it disarms"
    rows = np.array(bench.rows[first:])
    least = 4 * 0.06  # of four motors at idle, 5.5 %
    quiet = rows[:, 5] < least
    assert quiet.any(), rows[:, 5].min()
    idle, gone = rows[np.argmax(quiet), 0] - begun, bench.plant.time - begun
    print(f"\nmotors idle {idle:.2f} s, disarmed {gone:.2f} s after the last frame")
    assert IDLE[0] < idle < IDLE[1]
    assert DISARM[0] < gone < DISARM[1]


def test_throws_in_lock_step_are_the_same_to_the_bit(tmp_path, settings, monkeypatch):
    """The runner with its link, the firmware and the vehicle on one clock, down to the ground,
    independent of the machine's load.
    """
    monkeypatch.setattr(sys.modules[throw.__module__], "AFTER", ON)
    shutil.copytree(settings[0], tmp_path / "settings")
    params = load_run("betaflight_sitl")
    policy, reports = Policy.load(find_policy(params.policy)), []
    for name in ("first", "again"):
        plant = make_motors(params.policy, 1)
        reports.append(
            throw(program(), tmp_path / name, params, policy, plant, FakeMocapParams(), 1)
        )
    one, again = reports
    error = float(np.hypot(one["landing_w"][0] - 2.0, one["landing_w"][1]))
    print(f"\nlanding error {error:.3f} m, loop {one['loop_us']:.0f} us")
    assert (one["landing_w"], one["end_w"]) == (again["landing_w"], again["end_w"])
    assert one["separation_time"] == again["separation_time"]
    assert one["releases"] == 1
    assert error < MISS
    ticks = (
        json.loads(line)
        for line in (tmp_path / "first" / "run" / "ticks.jsonl").read_text().splitlines()
    )
    ends = dict.fromkeys((tick["state"], tick["reason"]) for tick in ticks)
    assert list(ends)[-3:] == [
        ("recover", "separated"),
        ("land", "hovering again"),
        ("done", "landed"),
    ]
    assert (tmp_path / "first" / "run" / "throw-01.npz").exists()
    assert list((tmp_path / "first").glob("LOG*")), "the firmware wrote its blackbox"


def test_a_pilot_hands_over_by_msp_override_and_a_throw_lands(tmp_path):
    """A transmitter beside the runner, whose switch gives the sticks to the runner."""
    report = override.fly(program(), tmp_path / "throw")
    error = float(np.hypot(report["landing_w"][0] - 2.0, report["landing_w"][1]))
    print(f"\nlanding error {error:.3f} m")
    assert (report["releases"], report["release"]) == (1, "accepted")
    assert error < MISS


@mark.parametrize("state", endings.STATES)
def test_under_msp_override_the_audit_knows_what_silence_does(tmp_path, state):
    """The runner killed in hover and in a throw: the last sticks expire, or count until the pilot
    switches off, as the version's row of the table of facts says.
    """
    report = override.fly_until_killed(program(), tmp_path, state)
    sticks, expires = report["killed"], report["version"] >= EXPIRES - 1e-6
    print(f"\n{report['version']:g}, {state}: {sticks}")
    assert (sticks["expired"] is not None) == expires
    if expires:
        assert sticks["expired"] == approx(FACTS["override_window"], abs=0.1)
    assert sticks["back"] < 0.2, "the pilot's switch gives the sticks back"


WAYS = [("SIGINT", "armed"), ("SIGINT twice", "armed")]
WAYS += [(way, "throw") for way in ("SIGINT", "SIGINT twice", "source raises", "output raises")]
"""Signals and the end of the time are one to the autopilot: `tests/loopback/test_endings.py`."""


@mark.parametrize(("way", "state"), WAYS)
def test_every_way_to_end_brings_it_down(tmp_path, settings, way, state, monkeypatch):
    """In hover and in a throw: the runner descends, except where it is gone at once, and the
    firmware disarms when it falls silent.
    """
    shutil.copytree(settings[0], tmp_path / "settings")
    abort = (
        1.2 if way == "source raises" else 1.5
    )  # [s]; without poses nothing is sent, and after 1.5 s the firmware would disarm
    overrides = (*endings.QUICK, f"states.abort={abort}", *endings.STATES[state])
    params = load_run("betaflight_sitl", overrides)
    if way == "SIGINT twice":
        endings.twice(monkeypatch)
    reason = {
        "output raises": "BrokenPipeError: nobody reads",
        "SIGINT twice": endings.REASONS["SIGINT"],
    } | endings.REASONS
    plant = make_motors("vision", 0)
    with open_runner(
        program(), tmp_path / way, params, endings.NEVER, plant, FakeMocapParams(), 0
    ) as parts:
        run = endings.Ending(way.split(" twice")[0], state, parts, monkeypatch)
        fake, clock = run.fake, run.clock
        assert fake.armed, "up to the end of the run"
        low = plant.state["pos_w"][2]
        clock.sleep_until(clock.now() + DISARM[1])
    print(
        f"\n{way}, {state}: {run.summary['reason']}, {low - run.heights.get('abort', low):+.2f} m,"
        f" {fake.events}"
    )
    assert run.summary["aborted"]
    assert reason[way] in run.summary["reason"]
    assert fake.report()["releases"] == 0
    assert not fake.armed
    if way not in ("source raises", "SIGINT twice"):
        assert low < run.heights["abort"] - 0.3, "a descent of 0.4 m/s, for 1.5 s"


def wait_for(process, words):
    """Read a process's output up to a line with these words."""
    lines = []
    for line in process.stderr:
        lines.append(line)
        if words in line:
            return
    pytest.fail("".join(lines[-30:]))


def bridged(folder, report, *more):
    """Start the firmware with the bridge to it."""
    words = f"hil fake --kind betaflight-sitl --speed {SPEED}"
    places = "--firmware", program(), "--folder", folder, "--out", report
    return start(words, *places, *more, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL)


def running(folder, *overrides):
    """Start the runner."""
    words = f"hil run --config betaflight_sitl --auto-arm --bare --speed {SPEED} --out"
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return start(words, folder, *set_words(overrides), **pipes)


def test_a_whole_throw(tmp_path):
    """Take-over, throw, release, recovery and landing with the page's two commands; the error is
    printed.
    """
    report, folder = tmp_path / "report.json", tmp_path / "firmware"
    bridge = bridged(folder, report, "--policy", "vision", "--after", "9")
    runner = None
    try:
        wait_for(bridge, "it flies")
        runner = running(tmp_path / "run", "realtime.priority=10")
        output, states = runner.communicate(timeout=LONG)
        bridge.communicate(timeout=LONG)
    finally:
        bridge.kill()
    flight = json.loads(report.read_text())
    assert flight["landing_w"] is not None, states
    error = float(np.hypot(flight["landing_w"][0] - 2.0, flight["landing_w"][1]))
    lag = flight["separation_time"] - flight["release_time"]
    late = flight["late_periods"] / (flight["time"] / 0.002)
    print(
        f"\nlanding error {error:.3f} m, {100 * late:.1f} % of the periods late, loop"
        f" {flight['loop_us']:.0f} us, {lag:.3f} s"
    )
    print(output.splitlines()[0])
    assert flight["releases"] == 1
    assert error < MISS, states
    assert "recover" in states
    # Late commands may let the fence foresee a braking point below the ground: the runner then
    # lands at once. On time it hovers again, as the throws in lock step say.
    assert "hovering again" in states or "after the throw, fence" in states
    assert list(folder.glob("LOG*")), "the firmware wrote its blackbox"
