"""Bytes and messages from anywhere, signals, and the start: nothing of it makes the runner command."""

import os
import resource
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from hil.backends.base import FAILED
from hil.control.loop import AutoOperator
from hil.fakes.level import LevelPlant
from hil.links.pymav import mav
from tests.fuzz import EACH, SEEDS, any_message, mutated, noise
from tests.hil_flight import simple_policy
from tests.loopback.wire import peers, throw
from visthrow.evidence.bench.hil.processes import free_port

READY = 8.0
"""Processor time of a run that waits for poses, from its call to its end [s]; its start takes 1.5 s on a free core, 3 s are
asked for. Wall time says nothing on a busy machine."""


def flood(count: int, kind: str, seed: int) -> None:
    """Messages of every kind with any bits in their fields, spoiled poses, and noise, to a runner that nobody armed."""
    runner, source, clock, fake = peers(LevelPlant(), kind=kind, write=True, loaded=simple_policy((-0.1269, 0, 0, 0, 1.0)))
    rng, inbox, commands = np.random.default_rng(seed), source._link.port.inbox, []
    fake.link.listen(lambda message, arrival: commands.append((message.get_type(), getattr(message, "command", None))))
    good = [any_message(rng) for _ in range(200)]
    makers = (any_message, any_message, any_message, lambda rng: mutated(rng, good), noise)
    said = 0
    while said < count:
        inbox.extend(makers[rng.integers(len(makers))](rng) for _ in range(200))
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
    flood(10_000, kind, 0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_a_million_messages_command_nothing(seed):
    flood(EACH, ("ardupilot", "px4")[seed % 2], seed)


def test_a_flood_in_mid_throw_neither_commands_nor_releases():
    """Noise from the vehicle's own address beside its poses: commands stay finite, and nothing is released twice."""
    plant = LevelPlant()
    rng = np.random.default_rng(1)
    strings = [noise(rng) for _ in range(100)] + [mutated(rng, [any_message(rng)])[:-1] for _ in range(300)]
    step = plant.step

    def noisy(command, release, after=0.0):
        step(command, release, after)
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
        "        if name.split('.')[0] in ('sim', 'warp', 'rsl_rl', 'tensordict', 'mujoco', 'visthrow.training.env'):\n"
        "            raise ImportError('blocked: ' + name)\n"
        "sys.meta_path.insert(0, Blocker())\n"
        "from visthrow.cli import main\n"
        f"sys.exit(main(['hil', 'check', '--seconds', '0.1', '--set', 'link.device=\"udp:127.0.0.1:{free_port()}\"']))\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 1, result.stderr
    assert "FAIL  no good pose of the vehicle" in result.stdout
