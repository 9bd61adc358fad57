"""The bridge to a firmware, without one: packets, its command line, what is read of its
channels.
"""

import os
import shutil
import socket
import subprocess
import threading

import numpy as np
from pytest import approx, fixture, raises, skip

from bench.processes import free_port
from hil.errors import RunError
from hil.links import msp
from hil.links.backends.betaflight import BOX_ARM, HIGH, LOW
from hil.links.device import Device, UdpPort
from hil.links.mavlink_link import Link
from hil.rehearsal.bridges import betaflight_bridge as betaflight
from hil.rehearsal.bridges import betaflight_firmware as firmware
from hil.rehearsal.bridges import packets
from hil.rehearsal.bridges.betaflight_bridge import BetaflightSitl
from hil.rehearsal.bridges.betaflight_firmware import Firmware, needed
from hil.rehearsal.fake import VEHICLE_ID, FakeOptions
from hil.rehearsal.fake_mocap import FakeMocapParams
from tests.configs import load_run
from tests.fakes.ports import ListeningPort
from visthrow.throws.wire_plant import make_motors


@fixture
def params():
    return load_run("betaflight_sitl").betaflight


def test_samples_are_forward_right_down_and_the_force_turned_round():
    """The firmware's own wrapper: rates FRD, acceleration the negative of FLU, attitude w first."""
    values = packets.FDM.unpack(
        packets.sample(1.0, (0.1, 0.2, 0.3), (1.0, 2.0, 9.8), (0.0, 0.1, 0.2, 0.9))
    )
    assert values[1:4] == (0.1, -0.2, -0.3)
    assert values[4:7] == (-1.0, -2.0, -9.8)
    assert values[7:11] == (0.9, 0.0, 0.1, 0.2)
    assert len(values) == 18


STUB = r"""
#include <arpa/inet.h>
#include <pthread.h>
#include <stdio.h>
#include <string.h>
#include <sys/select.h>
#include <time.h>
#include <unistd.h>
static int state, serves;
static double rate;
static void *samples(void *unused) {
    for (;;) {
        double data[18]; fd_set set; struct timeval most = {0, 100000};
        FD_ZERO(&set); FD_SET(state, &set);
        int ready = select(state + 1, &set, NULL, NULL, &most);
        if (ready != 1) continue;
        if (recvfrom(state, data, sizeof data, 0, NULL, NULL) == sizeof data) rate = data[1];
    }
}
static void *ports(void *unused) {
    usleep(50000); serves = 1;
    for (;;) { struct timeval most = {0, 9999}; select(0, NULL, NULL, NULL, &most); }
}
int main(int argc, char **argv) {
    struct sockaddr_in at = {.sin_family = AF_INET};
    pthread_t a, b;
    long turns = 0;
    double before = 0.0;
    int port;
    sscanf(argv[1], "%d", &port);
    at.sin_port = htons(port);
    at.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    pthread_create(&b, NULL, ports, NULL);
    state = socket(AF_INET, SOCK_DGRAM, 0); bind(state, (struct sockaddr *)&at, sizeof at);
    if (!serves) return 1;
    pthread_create(&a, NULL, samples, NULL);
    for (;;) {
        struct timespec now, nap = {0, 50000};
        clock_gettime(CLOCK_MONOTONIC, &now);
        nanosleep(&nap, NULL);
        printf("%ld %ld.%09ld %g\n", ++turns, now.tv_sec, now.tv_nsec, rate); fflush(stdout);
        if (rate != before) {
            float motors[4] = {2.0, 3.0, 4.0, rate}; before = rate; at.sin_port = htons(9002);
            sendto(state, motors, sizeof motors, 0, (struct sockaddr *)&at, sizeof at);
        }
    }
}
"""
"""A program with the firmware's threads: one for samples, one for ports, and a loop that sleeps for
50 us and tells its clock. It opens a port only once the thread of ports serves.
"""


@fixture
def stub(tmp_path, monkeypatch):
    """Run `STUB` in lock step with samples of ours; returns what came of them, and what
    it printed.
    """
    if shutil.which("gcc") is None:
        skip("no C compiler")
    source, program, port = tmp_path / "stub.c", tmp_path / "stub", free_port()
    source.write_text(STUB)
    subprocess.run(["gcc", "-o", program, source, "-lpthread"], check=True)
    monkeypatch.setattr(packets, "SENSORS", port)

    def run(feed):
        stands, said = os.pipe()
        environment = os.environ | {
            "LD_PRELOAD": str(firmware.compiled(tmp_path)),
            "VISTHROW_STANDS": str(said),
        }
        command = [program, str(port)]
        with (
            open(tmp_path / "told.txt", "w") as out,
            subprocess.Popen(command, env=environment, pass_fds=[said], stdout=out) as process,
        ):
            assert packets.stood(stands, 10.0)
            sensors = packets.Sensors(stands)
            came = feed(sensors)
            assert not packets.stood(stands, 0.05), "it stands until the next packet"
            process.kill()
            sensors.close()
        os.close(stands)
        os.close(said)
        return came, [line.split() for line in (tmp_path / "told.txt").read_text().splitlines()]

    return run


def test_a_clock_in_lock_step_goes_as_far_as_the_samples_let_it(stub):
    """Loops of 50.1 us: 2 s after the start it stands still; each packet lets it go on by its
    period, twice the same in two runs.
    """
    told = [
        stub(lambda sensors: [sensors.rest(period) for period in (0.002, 0.002, 0.010)])[1][-1]
        for _ in range(2)
    ]
    turns, now, _ = told[0]
    assert float(now) == approx(1.0 + 2.0 + 0.014, abs=1e-4)
    assert int(turns) == approx(2.014 / 50.1e-6, rel=1e-3)
    assert told[0] == told[1]


def test_samples_of_a_datagram_are_taken_one_after_the_other(stub):
    """Four samples at once are four of 0.5 ms each, as if they had come alone; each is answered, in
    our order: front left, front right, rear left, rear right come as 2, 3, 4, 1.
    """
    rates = np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [3.0, 0.0, 0.0], [4.0, 0.0, 0.0]])
    still = np.array([0.0, 0.0, 9.8]), np.array([0.0, 0.0, 0.0, 1.0])

    def one_by_one(sensors):
        return np.concatenate([sensors.send(rates[i : i + 1], *still, 0.0005) for i in range(4)])

    came, told = stub(lambda sensors: sensors.send(rates, *still, 0.0005))
    alone, as_told = stub(one_by_one)
    assert told == as_told
    assert (
        came.tolist() == alone.tolist() == [[4.0, 2.0, 3.0, rate] for rate in (1.0, 2.0, 3.0, 4.0)]
    )
    for rate in (1.0, 2.0, 3.0, 4.0):
        assert sum(float(words[2]) == rate for words in told) == approx(0.0005 / 50.1e-6, abs=1.0)


class Answers:
    """A command line that keeps what it is told, but for what it is to forget; one connection."""

    def __init__(self, port, forgets=()):
        self._server = socket.create_server(("127.0.0.1", port))
        self.kept, self.forgets = {}, forgets
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self):
        peer, _ = self._server.accept()
        peer.recv(1)
        peer.sendall(b"\r\nEntering CLI Mode, type 'exit' to reboot, or 'help'\r\n\r\n# ")
        for line in peer.makefile("r"):
            peer.sendall(self._said(line.strip()).encode() + b"\r\n# ")

    def _said(self, line):
        words = line.split()
        if words[0] == "set":
            self.kept |= {} if words[1] in self.forgets else {words[1]: words[3]}
            return f"{words[1]} set to {words[3]}"
        if words[0] == "get":
            return f"{words[1]} = {self.kept.get(words[1], '25')}\r\nAllowed range: 0 - 180"
        return "###ERROR IN input: UNKNOWN COMMAND, TRY 'HELP'###"

    def close(self):
        self._server.close()


@fixture
def answers(monkeypatch):
    port = free_port(socket.SOCK_STREAM)
    monkeypatch.setattr(firmware, "PORTS", (port, port + 1))
    server = Answers(port, forgets=("min_check",))
    yield server
    server.close()


def test_command_line_writes_reads_back_and_says_what_is_refused(answers):
    with firmware.CommandLine() as line:
        line.ask(firmware.line_of("small_angle", "180"))
        line.ask(firmware.line_of("min_check", "1050"))
        assert line.read("small_angle") == "180"
        assert line.read("min_check") == "25"
        with raises(RunError, match=r"refuses 'serial UART2 1'.*UNKNOWN COMMAND"):
            line.ask(firmware.line_of("serial UART2", "1"))


def test_a_program_that_is_not_there_is_named(tmp_path):
    with raises(RunError, match=r"no firmware at .*nothing"):
        Firmware(tmp_path / "nothing", tmp_path)


def test_a_program_that_ends_at_once_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(
        firmware, "PORTS", (free_port(socket.SOCK_STREAM), free_port(socket.SOCK_STREAM))
    )
    with raises(RunError, match="does not listen"):
        Firmware("/bin/false", tmp_path).start()


def test_settings_follow_the_runs_configuration(params):
    found = needed(params)
    assert found["roll_srate"] == "60"
    assert found["yaw_srate"] == "30"
    assert found["aux 0"] == "0 0 1700 2100 0 0"
    assert "aux 1" not in found
    override = load_run("betaflight_sitl", ["betaflight.arm_channel=0"]).betaflight
    assert needed(override)["msp_override_channels_mask"] == "143"  # sticks and AUX 4
    assert needed(override)["aux 1"].startswith("50 ")


def test_the_bridge_sees_arming_and_the_release_channel(params, monkeypatch):
    """What the firmware says by MSP becomes events, and the release's channel opens the mechanism
    once.
    """
    mine = free_port(socket.SOCK_STREAM)
    monkeypatch.setattr(betaflight, "PORTS", (0, mine))
    monkeypatch.setattr(
        packets.Sensors, "_run", lambda sensors, data: np.array([[0.4, 0.2, 0.3, 0.1]])
    )
    serial = ListeningPort(mine)
    fake = BetaflightSitl(
        make_motors("vision", 0),
        Link(UdpPort(Device("udpout", "127.0.0.1", 14999)), *VEHICLE_ID),
        FakeMocapParams(),
        0,
        FakeOptions(),
        params,
        -1,
    )
    parser, channels = msp.FrameParser(), [1500, 1500, 1500, 1000, LOW, LOW, LOW, LOW]
    flags = [0]

    def answer(frame):
        payloads = {
            msp.BOXIDS: bytes([1, BOX_ARM]),
            msp.RC: np.array(channels, dtype="<u2").tobytes(),
            msp.STATUS: bytes([125, 0, 0, 0, 0, 0]) + flags[0].to_bytes(4, "little") + bytes(12),
        }
        serial.write(msp.pack(msp.Frame(frame.command, payloads[frame.command], msp.ANSWER)))

    def turn(count):
        for _ in range(count):
            fake.step()
            data = serial.read()
            for frame in parser.parse(data or b""):
                answer(frame)

    turn(120)
    assert fake.motors == approx([0.4, 0.2, 0.3, 0.1])
    assert not fake.armed
    flags[0] = 0b10
    turn(120)
    assert fake.armed
    channels[7] = HIGH
    turn(40)
    report = fake.report()
    assert report["releases"] == 1
    assert report["loop_us"] == 125
    assert report["motor_packets"] > 200
    assert [text for _, text in report["events"]] == ["armed"]
    serial.close()
    fake.close()
