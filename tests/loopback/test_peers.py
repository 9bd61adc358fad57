"""Peers of a link, over UDP between sockets: strays, two senders, a bridge that restarts, another
autopilot, cut recordings.
"""

import contextlib
import socket

from pytest import fixture, raises

from bench.processes import free_port
from hil.links.backends import make_backend
from hil.links.clock import MonotonicClock
from hil.links.device import check_device, open_port
from hil.links.mavlink_link import Link
from hil.links.pymav import mav
from hil.links.roster import SILENT
from hil.poses.sources.mavlink import MavlinkSource
from hil.poses.sources.open_source import open_source
from tests.commands import run_command
from tests.configs import load_run

ATTITUDE = "SET_ATTITUDE_TARGET"


class Wire:
    """The runner's end of a link on a UDP port, and senders of any ids at others."""

    def __init__(self, folder, base="fake", *overrides):
        self.now, self.messages = 0.0, []
        self.number, self.other = free_port(), free_port()
        given = (
            f'link.device="udp:127.0.0.1:{self.number}"',
            *(o.format(other=self.other) for o in overrides),
        )
        self.params = load_run(base, given)
        self.source, self.link, _ = open_source(
            self.params, folder, MonotonicClock(), None, self.messages.append
        )
        self.backend = make_backend(self.params, self.link)

    def peer(self, number=None):
        """A peer with a separate socket, and the messages that it receives."""
        port, heard = open_port(check_device(f"udpout:127.0.0.1:{number or self.number}")), []
        link = Link(port, 1, 1)
        link.listen(lambda message, arrival: heard.append(message.get_type()))
        return link, heard

    def poll(self, seconds=0.0):
        self.now += seconds
        self.source._clock = lambda: self.now
        poses = self.source.poll(self.now)
        self.backend.service(self.now)
        return poses


@fixture
def wire(tmp_path):
    with contextlib.ExitStack() as stack:

        def make(*args):
            made = Wire(tmp_path / "run", *args)
            stack.callback(made.source.close)
            return made

        yield make


def beat(autopilot=mav.MAV_AUTOPILOT_ARDUPILOTMEGA):
    return mav.MAVLink_heartbeat_message(2, autopilot, 128, 4, 4, 3)


def pose(x=1.0):
    return mav.MAVLink_att_pos_mocap_message(5, [1.0, 0.0, 0.0, 0.0], x, 2.0, 3.0)


def test_a_stray_byte_does_not_make_its_sender_the_vehicle(wire):
    """It came first; the vehicle is still accepted, and the stranger gets no command."""
    run = wire()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(b"\0", ("127.0.0.1", run.number))
        run.poll()
        vehicle, heard = run.peer()
        vehicle.send(beat())
        run.poll()
        assert run.backend._heartbeat is not None
        assert run.backend.send((2.7, 0.0, 0.0, 0.0), run.now)
        vehicle.pump(lambda: 0.0)
        assert ATTITUDE in heard
        stranger.setblocking(False)
        with raises(BlockingIOError):
            stranger.recv(1000)


def test_poses_come_on_a_separate_port(wire):
    """As `ardupilot.toml` has it: the autopilot on its own device, the poses by UDP."""
    run = wire("fake", 'source.device="udp:127.0.0.1:{other}"')
    vehicle, heard = run.peer()
    bridge, requests = run.peer(number=run.other)
    stray = run.peer(number=run.other)[0]
    vehicle.send(beat())
    bridge.send(pose())
    run.poll()
    vehicle.send(pose(9.0))  # on the autopilot's port no poses are expected
    stray.send(beat())
    bridge.send(pose(2.0))
    assert [p.pos[0] for p in run.poll(0.2)] == [2.0]
    run.backend.send((2.7, 0.0, 0.0, 0.0), run.now)
    vehicle.pump(lambda: 0.0)
    bridge.pump(lambda: 0.0)
    assert ATTITUDE in heard
    assert set(requests) <= {"TIMESYNC", "HEARTBEAT"}
    assert len(run.source.links) == 2


def test_a_bridge_that_restarts_is_heard_again_on_the_ground_and_audited_anew(wire):
    run = wire()
    first = run.peer()[0]
    first.send(beat())
    run.poll()
    audit = run.backend.audit
    second, heard = run.peer()
    run.source.hold(True)
    run.now += 10.0
    second.send(beat())
    run.poll()
    assert run.backend.audit is audit, "not in flight"
    run.source.hold(False)
    run.now += SILENT
    second.send(beat())
    run.poll(0.1)
    assert run.backend.audit is not audit
    second.pump(lambda: 0.0)
    assert "PARAM_REQUEST_READ" in heard
    assert any("the autopilot speaks from" in text for text in run.messages)


def test_check_says_who_is_heard_with_which_ids(tmp_path, capsys, monkeypatch, printed):
    number = free_port()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        poll, packer = MavlinkSource.poll, mav.MAVLink(None, 42, 7)
        message = mav.MAVLink_vision_position_estimate_message(5, 1.0, 2.0, 3.0, 0.1, 0.2, 0.3)

        def sending(source, now):
            sender.sendto(message.pack(packer), ("127.0.0.1", number))
            return poll(source, now)

        monkeypatch.setattr(MavlinkSource, "poll", sending)
        assert (
            run_command(f'hil check --seconds 0.5 --set link.device="udp:127.0.0.1:{number}"') == 1
        )
        port = sender.getsockname()[1]
    out = capsys.readouterr().out
    assert "vehicle: no pose" in out
    assert (
        "vehicle and payload not heard; expected: vehicle as 1/1 (ATT_POS_MOCAP), payload as 1/25"
        " (ATT_POS_MOCAP)" in out
    )
    assert (
        f"VISION_POSITION_ESTIMATE of system 42, component 7 from 127.0.0.1:{port}: nobody of"
        " this run" in out
    )
    monkeypatch.setattr(MavlinkSource, "poll", poll)
    assert f"nobody speaks on udp:127.0.0.1:{number}" in printed(
        f'hil check --seconds 0.1 --set link.device="udp:127.0.0.1:{number}"', status=1
    )
