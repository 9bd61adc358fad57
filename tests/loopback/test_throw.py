"""Complete throws with the shipped policies: mocap in, thrust, rates and release out, payload
lands.
"""

import json
import socket
import subprocess
import sys

import numpy as np
from numpy.linalg import norm
from pytest import mark

from hil.control.loop import Loop
from hil.control.recording.playback import replay
from hil.control.recording.record import RunRecorder
from hil.control.runner import Runner
from hil.links.backends import make_backend, mechanism_lag
from hil.links.clock import MonotonicClock
from hil.links.device import check_device, open_port
from hil.links.mavlink_link import Link
from hil.links.writer import TlogWriter
from hil.poses.sources.mavlink import MavlinkSource
from hil.poses.sources.player import read_tlog
from tests.configs import load_run
from tests.hil_flight import AutoOperator
from tests.loopback.wire import throw
from visthrow.onboard.policy import Policy, find_policy
from visthrow.throws.wire_plant import make

LANDING = 0.05
"""Mean landing error over the wire of two throws at 2 m [m], with 1 mm, 0.2 deg, 10 ms and 2 % of
loss; 0.10 m is asked for.
"""

ONE_THROW = 0.10
"""A single throw [m]: three deviations of what is measured in simulated time."""

READ_BACK = 0.01
"""Landing by the payload's noisy poses against the truth [m]."""

FEW_LATE = 20
"""Periods of the fake that came late in a throw whose times are right: 0.1 s in all.

With more, or with a tick that was missed, the machine is too busy for real time, and how well a
throw lands is not the runner's doing.
"""


@mark.parametrize("policy", ["state", "vision"])
def test_throws_in_lock_step(policy):
    loaded, errors = Policy.load(find_policy(policy)), []
    for seed in range(2):
        summary, fake, _ = throw(
            make(policy, seed), seed=seed, policy=policy, loaded=loaded, seconds=5.5
        )
        true = fake.plant.landing["landing_w"]
        assert true is not None, summary["reason"]
        errors.append(np.hypot(true[0] - 2.0, true[1]))
        (landing,) = summary["landings"]
        assert norm(np.subtract(landing["landing_w"], true)) < READ_BACK
        assert (summary["cancelled"], fake.witness.releases, summary["guard"]["refused"]) == (
            0,
            1,
            0,
        )
        assert summary["held_back"] == 0, "a right throw is not delayed"
    assert np.mean(errors) < LANDING


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_a_throw_over_udp_against_a_process_of_its_own(tmp_path):
    """In real time; recorded, replayed to the bit, and the .tlog holds the poses that the run was
    flown on.
    """
    device = f"127.0.0.1:{free_port()}"
    params = load_run("fake", [f'link.device="udp:{device}"', "states.abort=0.5"])
    clock = MonotonicClock()
    recorder = RunRecorder(tmp_path / "run", params)
    link = Link(
        open_port(check_device(params.link.device)), tlog=TlogWriter(tmp_path / "run" / "link.tlog")
    )
    source = MavlinkSource(link, params.source.senders, clock.now)
    backend = make_backend(params, link)
    runner = Runner(params, Policy.load(find_policy(params.policy)), backend, mechanism_lag(params))
    runner.commander.warm_up()
    # The fake goes away in mid flight, which ends the run: half a second later it is done.
    command = [sys.executable, "-m", "visthrow.cli", "hil", "fake", "--device", f"udpout:{device}"]
    fake = subprocess.Popen(
        [*command, "--seconds", "20", "--after", "0.2", "--out", str(tmp_path / "fake.json")],
        stdout=subprocess.DEVNULL,
    )
    try:
        summary = Loop(runner, source, clock, AutoOperator(), recorder).fly()
        assert fake.wait(30) == 0
    finally:
        fake.kill()
        source.close()
    recorder.close(summary)
    report = json.loads((tmp_path / "fake.json").read_text())
    assert report["breaches"] == []
    assert report["releases"] == summary["latches"] <= 1
    if report["late_periods"] < FEW_LATE and summary["missed"] == 0:
        true, (landing,) = report["landing_w"], summary["landings"]
        assert np.hypot(true[0] - 2.0, true[1]) < ONE_THROW
        assert norm(np.subtract(landing["landing_w"], true)) < READ_BACK
    found = replay(tmp_path / "run")
    assert found["differences"] == []
    assert found["actions"] > 20 * summary["latches"]
    taken = sum(track.accepted for track in runner.tracks.values())
    assert len(read_tlog(tmp_path / "run" / "link.tlog", params.source.senders)) >= taken
