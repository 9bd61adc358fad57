"""Bytes and messages from anywhere, signals, and the start: nothing of it makes the runner command."""

import os
import resource
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
from pymavlink.generator.mavcrc import x25crc

from hil.backends.base import FAILED
from hil.fakes.level import LevelPlant
from hil.flight import AutoOperator
from hil.mavlink import mav
from tests.hil_flight import simple_policy
from tests.loopback.wire import peers, throw

READY = 8.0
"""Processor time of a run that waits for poses, from its call to its end [s]; its start takes 1.5 s on a free core, 3 s are
asked for. Wall time says nothing on a busy machine."""


def random_messages(rng, count: int) -> list[bytes]:
    """Messages of every kind with any bits in their fields, and plain noise."""
    kinds = sorted(mav.mavlink_map)
    out: list[bytes] = []
    while len(out) < count:
        if rng.random() < 0.2:
            out.append(rng.bytes(int(rng.integers(0, 300))))
            continue
        kind = mav.mavlink_map[kinds[rng.integers(len(kinds))]]
        out.append(framed(kind, rng.bytes(kind.unpacker.size)))
    return out


def framed(kind, body: bytes) -> bytes:
    """A message of the vehicle with a right checksum, so that its fields reach whoever listens."""
    number = kind.id
    head = bytes([len(body), 0, 0, 0, 1, 1])
    head += bytes([number & 255, number >> 8 & 255, number >> 16 & 255])
    crc = x25crc(head + body + bytes([kind.crc_extra]))
    return bytes([mav.PROTOCOL_MARKER_V2]) + head + body + crc.crc.to_bytes(2, "little")


def flood(count: int, kind: str = "ardupilot") -> None:
    runner, source, clock, fake = peers(LevelPlant(), kind=kind, write=True, loaded=simple_policy((-0.1269, 0, 0, 0, 1.0)))
    rng, inbox, commands = np.random.default_rng(0), source._link.port.inbox, []
    fake.link.listen(lambda message, arrival: commands.append((message.get_type(), getattr(message, "command", None))))
    strings = random_messages(rng, min(count, 5000))
    said = 0
    while said < count:
        inbox.extend(strings[i] for i in rng.integers(len(strings), size=200))
        said += 200
        now = clock.now() + said * 1e-4
        # Nobody arms: whatever comes, nothing is thrown and nothing released.
        runner.tick(now, source.poll(now), runner.backend.status(now), AutoOperator().words("idle"))
        runner.backend.service(now)
        fake.link.pump(clock.now)
    assert source._link.received > count // 2, "most must reach the listeners"
    assert not runner.errors
    harmless = ("COMMAND_LONG", mav.MAV_CMD_SET_MESSAGE_INTERVAL)
    told = {kind for kind, number in commands if (kind, number) != harmless}
    assert {"SET_ATTITUDE_TARGET", "COMMAND_LONG", "PARAM_SET"}.isdisjoint(told)
    assert runner.backend.status(now).release != FAILED


@pytest.mark.parametrize("kind", ["ardupilot", "px4"])
def test_messages_of_every_kind_command_nothing(kind):
    flood(10_000, kind)


@pytest.mark.slow
def test_a_million_messages_command_nothing():
    flood(1_000_000)


def test_a_flood_in_mid_throw_neither_commands_nor_releases():
    """Noise from the vehicle's own address beside its poses: commands stay finite, and nothing is released twice."""
    plant = LevelPlant()
    rng = np.random.default_rng(1)
    strings = [s for s in random_messages(rng, 300) if len(s) < 10 or s[0] != mav.PROTOCOL_MARKER_V2]
    strings += [bytes(rng.integers(0, 256, 40, dtype=np.uint8)) for _ in range(100)]
    step = plant.step

    def noisy(command, release):
        step(command, release)
        noisy.port.inbox.extend(strings[i] for i in rng.integers(len(strings), size=3))

    plant.step = noisy
    from tests.loopback import wire

    made = wire.peers

    def keep(*args, **kwargs):
        found = made(*args, **kwargs)
        noisy.port = found[1]._link.port
        return found

    wire.peers = keep
    try:
        summary, fake, _ = throw(plant, loaded=simple_policy((-0.1269, 0, 0, 0, 1.0)), seconds=6.0)
    finally:
        wire.peers = made
    assert (summary["latches"], fake.witness.releases, fake.witness.breaches) == (1, 1, [])
    assert np.all(np.isfinite(plant.commands))


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_the_start_is_quick_and_ctrl_c_ends_a_waiting_run(tmp_path):
    device = f'link.device="udp:127.0.0.1:{free_port()}"'
    command = [sys.executable, "-m", "visthrow.cli", "hil", "run", "--set", device, "--out", str(tmp_path / "run")]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True
    )
    try:
        assert process.stderr.readline().startswith("ready after")
        time.sleep(0.3)
        os.kill(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < READY
    assert "ABORTED: the operator said abort" in out
    assert "Traceback" not in err
    assert process.returncode == 1
    assert (tmp_path / "run" / "summary.json").is_file()


def test_what_the_runner_imports_is_enough_on_board():
    """The whole command starts where neither simulator nor trainer can be imported."""
    code = (
        "import sys\n"
        "class Blocker:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] in ('sim', 'warp', 'rsl_rl', 'tensordict', 'mujoco', 'visthrow.env'):\n"
        "            raise ImportError('blocked: ' + name)\n"
        "sys.meta_path.insert(0, Blocker())\n"
        "from visthrow.cli import main\n"
        f"sys.exit(main(['hil', 'check', '--seconds', '0.1', '--set', 'link.device=\"udp:127.0.0.1:{free_port()}\"']))\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 1, result.stderr
    assert "FAIL  no good pose of the vehicle" in result.stdout
