"""Latency from the newest pose on the wire to the command on the wire, through the firmware's link,
and the runner's share of it.

    python bench/sitl/alone.py python -m bench.sitl.latency --seconds 25

Bridge and runner are processes of their own, in real time. The kernel stamps each packet on the
loopback interface (a packet socket, which a network namespace of one's own grants): poses of the
vehicle go to the runner by MAVLink, sticks to the firmware by MSP. Commands are not held back here.
The runner's share is its stage ``total``: from reading messages to writing the command's bytes."""

import argparse
import json
import signal
import socket
import struct
import subprocess
import tempfile
import threading
from pathlib import Path

import numpy as np

from hil.links import msp
from hil.links.pymav import mav
from tests.commands import set_words, start
from tests.sitl.test_betaflight import program, wait_for

POSES = 14560
COMMANDS = 5761
"""Ports of the runner's poses (UDP) and of the firmware's first serial port (TCP)."""

STAMP = struct.Struct("qq")
SO_TIMESTAMPNS = 35
ETH_P_IP = 0x0800
IP = 20
ETHER = 14
UDP = 8


class Wire(threading.Thread):
    """Packets on the loopback interface: kernel's stamps [s] of the vehicle's poses and of set
    sticks.
    """

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self._socket = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETH_P_IP))
        self._socket.bind(("lo", 0))
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 24)
        self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self.poses = []
        self.commands = []
        self._mavlink = mav.MAVLink(None)
        self._msp = msp.FrameParser()
        self._mavlink.robust_parsing = True

    def run(self) -> None:
        """Listen until the process ends."""
        while True:
            data, more, _, where = self._socket.recvmsg(65536, 256)
            # each packet appears twice, outgoing and incoming
            if where[2] == socket.PACKET_OUTGOING:
                continue
            seconds, nanoseconds = STAMP.unpack(more[0][2])
            self._take(data[ETHER:], seconds + 1e-9 * nanoseconds)

    def _take(self, packet: bytes, stamp: float) -> None:
        head = 4 * (packet[0] & 15)
        packet = packet[: struct.unpack("!H", packet[2:4])[0]]
        port = struct.unpack("!H", packet[head + 2 : head + 4])[0]
        if packet[9] == socket.IPPROTO_UDP and port == POSES:
            for message in self._mavlink.parse_buffer(packet[head + UDP :]) or ():
                if message.get_type() == "ATT_POS_MOCAP" and message.get_srcComponent() == 1:
                    self.poses.append(stamp)
        elif packet[9] == socket.IPPROTO_TCP and port == COMMANDS:
            body = packet[head + 4 * (packet[head + 12] >> 4) :]
            self.commands += [
                stamp for frame in self._msp.parse(body) if frame.command == msp.SET_RAW_RC
            ]

    def times(self) -> np.ndarray:
        """Of each command, since the newest pose before it [s]."""
        poses = np.array(self.poses)
        commands = np.array(self.commands)
        newest = np.searchsorted(poses, commands) - 1
        return (commands - poses[newest])[newest >= 0]


def fly_hover(folder: Path, seconds: float, speed: float) -> dict:
    """Hover through the firmware for a time; the report."""
    wire = Wire()
    pipes = {"stderr": subprocess.PIPE, "stdout": subprocess.DEVNULL}
    places = ("--firmware", program(), "--folder", folder / "firmware")
    words = f"hil fake --kind betaflight-sitl --speed {speed} --out"
    bridge = start(words, folder / "bridge.json", *places, **pipes)
    try:
        wait_for(bridge, "it flies")
        sets = (f"states.armed_least={seconds}", f"states.armed={seconds + 20.0}", "delay.hold=0.0")
        words = f"hil run --config betaflight_sitl --auto-arm --bare --speed {speed} --out"
        runner = start(words, folder / "run", *set_words(sets), **pipes)
        wait_for(runner, " s  armed ")
        wire.start()
        with_time = threading.Timer(seconds / speed, runner.send_signal, (signal.SIGINT,))
        with_time.start()
        runner.communicate()
        bridge.send_signal(signal.SIGINT)
        bridge.communicate()
    finally:
        bridge.kill()
    summary, report = (
        json.loads((folder / name).read_text()) for name in ("run/summary.json", "bridge.json")
    )
    p50, p99 = (1e3 * float(np.quantile(wire.times(), share)) for share in (0.5, 0.99))
    total = summary["latency"]["total"]
    return {
        "commands": len(wire.commands),
        "poses": len(wire.poses),
        "pose_to_command_ms": {"p50": p50, "p99": p99},
        "own_ms": {"p50": total["p50_ms"], "p99": total["p99_ms"]},
        "late_periods": report["late_periods"],
        "periods": round(report["time"] / 0.002),
        "missed_ticks": summary["missed"],
        "speed": speed,
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=25.0)
    parser.add_argument("--speed", type=float, default=1.0, help="of both clocks")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        print(json.dumps(fly_hover(Path(folder), args.seconds, args.speed), indent=1))


if __name__ == "__main__":
    main()
