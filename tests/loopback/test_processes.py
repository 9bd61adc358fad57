"""Runner and fake as two processes in real time: whole throws with each kind, SIGTERM, SIGKILL, a
full disk.
"""

import fcntl
import json
import os
import pty
import re
import resource
import signal
import socket
import subprocess
import termios
import time

import numpy as np
from pytest import fixture, mark

from bench.processes import free_port
from hil.control.recording.playback import replay
from tests.commands import set_words, start
from tests.fakes import KINDS
from tests.hil_flight import simple_policy
from tests.loopback.wire import CONFIGS
from tests.waiting import eventually
from visthrow.onboard.actions import hover_action

HOVER = hover_action(9.81 * 0.272, 14.0)[0]
QUICK = ("states.check_hold=0.2", "states.armed_least=0.1", "states.quiet=0.1", "states.throw=30.0")
PATIENCE = 120.0
"""For anything to happen on a busy machine [s]."""

ONE_THROW, MOST_LATE = 0.25, 100
"""Landing error of a single throw [m], and periods of the fake that may be late: late commands, all
of them.
"""


START = 5.0
"""After which a run whose output is not read has begun to listen [s]."""


class Pair:
    """A fake and a runner, each in a process of its own."""

    def __init__(
        self,
        folder,
        kind,
        policy,
        plant=("--plant", "tests.level:make"),
        overrides=(),
        both=(),
        terminal=None,
    ):
        self.both, self.terminal = (
            both,
            terminal,
        )  # further arguments of runner and fake; what the runner's controls it
        self.folder, poses, msp = folder, free_port(), free_port(socket.SOCK_STREAM)
        self.device, self.msp = f"127.0.0.1:{poses}", msp
        self.fake = self.runner = None
        if kind == "betaflight":  # listens itself, so that it must be there first
            self._start_fake(kind, plant)
            self._start_runner(kind, policy, overrides)
        else:
            self._start_runner(kind, policy, overrides)
            self._start_fake(kind, plant)

    def _start_fake(self, kind, plant):
        words = f"hil fake --kind {KINDS[kind]} --device udpout:{self.device} --msp-port {self.msp}"
        words += " --seconds 300 --after 1.5 --out"
        self.fake = start(
            words,
            self.folder / "fake.json",
            *plant,
            *self.both,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )
        assert "flies" in self.fake.stderr.readline()

    def _start_runner(self, kind, policy, overrides):
        sets = [
            f'link.device="udp:{self.device}"',
            f'betaflight.device="tcp:127.0.0.1:{self.msp}"',
            f'policy="{policy}"',
        ]
        words = f"hil run --config {CONFIGS[kind]} --auto-arm --out"
        more = (*self.both, *set_words((*sets, *overrides)))
        self.runner = start(words, self.folder / "run", *more, **self._streams())
        if self.terminal is None:
            assert self.runner.stderr.readline().startswith("ready after")
        else:
            time.sleep(START)

    def _streams(self) -> dict:
        """A terminal of its own, or pipes."""
        if self.terminal is None:
            return {
                "stdout": subprocess.PIPE,
                "stderr": subprocess.PIPE,
                "stdin": subprocess.DEVNULL,
            }

        def control():
            os.setsid()
            fcntl.ioctl(self.terminal, termios.TIOCSCTTY, 0)

        return {
            "stdout": self.terminal,
            "stderr": self.terminal,
            "stdin": self.terminal,
            "preexec_fn": control,
        }

    def wait_for(self, state: str) -> None:
        """Until the runner says that it is in a state."""
        end, said = time.monotonic() + PATIENCE, ""
        while time.monotonic() < end:
            line = self.runner.stderr.readline()
            said += line
            assert line, f"the runner has ended: {said}"
            if re.match(rf" *[0-9.]+ s  {state} ", line):
                return
        raise AssertionError(f"no {state} within {PATIENCE} s")

    def wait_for_actions(self, count: int) -> None:
        """Until so many actions of the policy are recorded: on a busy machine most ticks are
        missed.
        """
        path = self.folder / "run" / "ticks.jsonl"
        eventually(lambda: path.read_text().count('"action": [') >= count, PATIENCE)

    def report(self, end=True) -> dict:
        """The fake's, when it has ended, by Ctrl-C or by itself."""
        if end:
            self.fake.send_signal(signal.SIGINT)
        assert self.fake.wait(PATIENCE) == 0
        return json.loads((self.folder / "fake.json").read_text())

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for process in (self.fake, self.runner):
            if process is not None:
                process.kill()
                process.communicate()


@fixture
def never(tmp_path):
    """A policy that hovers and never releases, as a file."""
    path = tmp_path / "never.npz"
    simple_policy((HOVER, 0.0, 0.0, 0.0, -1.0)).save(path)
    return path


def test_sigterm_in_mid_throw(tmp_path, never):
    """What systemd, `timeout` and a shutdown send; `bench.runner --faults` flies the others,
    in hover and with each kind. Signed.
    """
    key = tmp_path / "key"
    key.write_text("a phrase that both know\n")
    key.chmod(0o600)
    with Pair(
        tmp_path,
        "ardupilot",
        never,
        overrides=(*QUICK, "states.abort=1.0"),
        both=("--sign", str(key)),
    ) as pair:
        pair.wait_for("throw")
        pair.wait_for_actions(10)
        os.kill(pair.runner.pid, signal.SIGTERM)
        out, err = pair.runner.communicate(timeout=PATIENCE)
        time.sleep(1.0)
        report = pair.report()
    assert "ABORTED: the process was told to end (SIGTERM)" in out
    assert "Traceback" not in err
    assert (report["breaches"], report["releases"]) == ([], 0)
    assert "mode 9" in [text for _, text in report["events"]]
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["aborted"]


@mark.slow
def test_the_terminal_is_closed_in_mid_throw(tmp_path, never):
    """As by a dropped ssh: the run's terminal is gone, and says so by SIGHUP; it lands, and its
    folder is complete.
    """
    master, slave = pty.openpty()
    with Pair(
        tmp_path, "ardupilot", never, overrides=(*QUICK, "states.abort=1.0"), terminal=slave
    ) as pair:
        os.close(slave)
        pair.wait_for_actions(10)
        os.close(master)
        assert pair.runner.wait(PATIENCE) == 1
        time.sleep(1.0)
        report = pair.report()
    assert "mode 9" in [text for _, text in report["events"]]
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["reason"] == "the process was told to end (SIGHUP)"
    assert (tmp_path / "run" / "throw-01.npz").is_file()


FEW_MISSED = 3
"""Ticks of a run that may be missed where its throw is to land in its place."""


SPEEDS = (1.0, 0.5, 0.25)
"""Of both processes' clocks: the next one is flown where the machine was too busy for the one
before; the last one counts as it is.
"""


FULL_DISK = 20_000
"""Bytes that a file may still grow by: some forty ticks."""


def kept_up(folder, fly):
    """What ``fly(folder, speed)`` gives, with whether the machine was late, at the first of
    `SPEEDS` at which it was not.
    """
    for speed in SPEEDS:
        place = folder / f"at-{speed:g}"
        place.mkdir()
        *found, late = fly(place, speed)
        if not late:
            break
    return *found, place


OWN = {
    "ardupilot": "levelled: no set-points",
    "px4": "left OFFBOARD: no set-points",
    "betaflight": "override: the pilot's sticks count again",
}
"""What the vehicle does by itself when nobody speaks any more."""


@mark.slow
@mark.parametrize("kind", ["ardupilot", "px4", "betaflight"])
def test_the_runner_is_killed_in_mid_throw(tmp_path, kind, never):
    def fly(folder, speed):
        with Pair(folder, kind, never, overrides=QUICK, both=("--speed", str(speed))) as pair:
            pair.wait_for("throw")
            pair.wait_for_actions(10)
            os.kill(pair.runner.pid, signal.SIGKILL)
            pair.runner.wait(PATIENCE)
            time.sleep(2.5 / speed)
            report = pair.report()
        return report, report["late_periods"] > MOST_LATE

    report, folder = kept_up(tmp_path, fly)
    assert OWN[kind] in [text for _, text in report["events"]]
    happened = next(
        at for at, text in report["events"] if text == OWN[kind] and at > report["last_command"]
    )
    assert 0.29 < happened - report["last_command"] < 0.6
    assert (report["breaches"], report["releases"]) == ([], 0)
    found = replay(folder / "run")
    assert found["differences"] == [], "what was written until then runs again to the bit"
    assert found["actions"] > 5


@mark.slow
def test_the_disk_fills_up_in_mid_throw(tmp_path, never):
    """The throw is flown to its end, the next one is not armed, the end of the run says so."""
    overrides = (*QUICK[:3], "states.throw=4.0", "states.ready=2.0", "states.land=1.0", "throws=2")
    with Pair(tmp_path, "ardupilot", never, overrides=overrides) as pair:
        pair.wait_for("throw")
        room = (tmp_path / "run" / "ticks.jsonl").stat().st_size + FULL_DISK
        resource.prlimit(pair.runner.pid, resource.RLIMIT_FSIZE, (room, room))
        out, err = pair.runner.communicate(timeout=PATIENCE)
        report = pair.report()
    assert "the policy did not release in time" in err
    assert "nobody armed a throw" in err, "the next one is not armed"
    assert "File too large" in out + err + (tmp_path / "run" / "summary.json").read_text()
    assert (report["breaches"], report["releases"]) == ([], 0)


@mark.slow
@mark.parametrize("policy", ["state", "vision"])
@mark.parametrize("kind", ["ardupilot", "px4", "betaflight"])
def test_a_throw_with_each_kind(tmp_path, kind, policy):
    """In real time where the machine keeps up, with the simulator's vehicle and the shipped
    policies.
    """

    def fly(folder, speed):
        both = ("--speed", str(speed))
        with Pair(
            folder,
            kind,
            policy,
            plant=("--policy", policy),
            overrides=("states.abort=0.5",),
            both=both,
        ) as pair:
            out, _ = pair.runner.communicate(timeout=PATIENCE)
            report = pair.report(end=False)
        summary = json.loads((folder / "run" / "summary.json").read_text())
        return (
            out,
            report,
            summary,
            report["late_periods"] > MOST_LATE or summary["missed"] > FEW_MISSED,
        )

    out, report, summary, folder = kept_up(tmp_path, fly)
    assert report["landing_w"] is not None, out
    assert (report["breaches"], report["releases"]) == ([], 1)
    assert (summary["latches"], summary["errors"]) == (1, [])
    autopilot = summary["autopilot"]
    assert (autopilot["backend"], autopilot["parameters"]["problems"]) == (kind, [])
    assert autopilot["release"]["state"] == "accepted"
    assert replay(folder / "run")["differences"] == []
    # A fake that is late has a clock that stands still and then hurries.
    assert autopilot["clocks"]["foreign_stamps"] == 0 or kind == "betaflight"
    assert np.hypot(report["landing_w"][0] - 2.0, report["landing_w"][1]) < ONE_THROW
