"""Throws through the firmware in lock step: runner, link, firmware and vehicle take turns in one
process, on simulated time.

    python bench/sitl/alone.py python -m bench.sitl.direct --firmware PROGRAM --seeds 0 1 2    # a
    line of JSON a throw

The runner is the one that flies, with its state machine, guard, back-end and recorder; poses come
by MAVLink, commands go by MSP. The same seed gives the same throw on any machine, at full speed."""

import argparse
import json
import math
import select
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from hil.control.loop import Loop
from hil.control.recording.flightlogs import read, throws
from hil.control.recording.record import RunRecorder
from hil.control.recording.run_report import throw_path
from hil.control.state_machine import State
from hil.control.tick.runner import Runner
from hil.links.backends import make_backend, mechanism_lag
from hil.links.device import Device, check_device, open_port
from hil.links.mavlink_link import Link
from hil.params import HilParams
from hil.poses.sources.open_source import open_source
from hil.poses.sources.pose_source import Source
from hil.rehearsal.bridges.betaflight_bridge import BetaflightSitl, MotorPlant
from hil.rehearsal.bridges.betaflight_firmware import Firmware, list_settings
from hil.rehearsal.fake import VEHICLE_ID, Fake, FakeOptions
from hil.rehearsal.fake_command import MOTORS
from hil.rehearsal.fake_mocap import SLACK, FakeMocapParams
from hil.rehearsal.process import load_plant
from tests.hil_flight import AutoOperator
from visthrow import config
from visthrow.onboard.policy import Policy, find_policy

SETTINGS = "settings"  # folder of the firmware's settings beside those of the throws
AFTER = 1.2  # flown on after a landing [s]
MOST = 25.0  # flown at most [s]


class FlightClock:
    """A clock that goes as far as the vehicle behind the firmware has flown; see
    `hil.links.clock.Clock`.
    """

    def __init__(self, fake: Fake) -> None:
        self._fake = fake
        self._now = fake.plant.time

    def now(self) -> float:
        return self._now

    def sleep_until(self, when: float) -> None:
        """See `Clock`: fly until then."""
        self.wait_for((), when)

    def wait_for(self, files: Sequence[Any], when: float) -> None:
        """See `Clock`: fly until there is something to read, or until then."""
        plant = self._fake.plant
        while self._now < when - SLACK:
            if when < plant.time + plant.period - SLACK:  # within a period nothing comes
                self._fake.run_on(when)
                self._now = when
                return
            self._fake.step()
            self._now = plant.time
            if files and select.select(files, [], [], 0.0)[0]:
                return


def set_up(program: str | Path, folder: Path, params: HilParams) -> Path:
    """The firmware's settings for a run, written and read back where the folder has none yet.

    Raises `RunError`: see `Firmware`.
    """
    settings = folder / SETTINGS
    if not (settings / "eeprom.bin").exists():
        Firmware(program, settings).set_up(list_settings(params.betaflight))
    return settings / "eeprom.bin"


@contextmanager
def open_runner(
    program: str | Path,
    folder: Path,
    params: HilParams,
    policy: Policy,
    plant: MotorPlant,
    mocap: FakeMocapParams,
    seed: int,
    bridge: type[BetaflightSitl] = BetaflightSitl,
) -> Iterator[tuple[Runner, Source, FlightClock, BetaflightSitl]]:
    """Runner, its source and clock, and the bridge, connected to a running firmware; all are closed
    afterwards. See `throw`.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    shutil.copy(set_up(program, folder.parent, params), folder)
    firmware = Firmware(program, folder)
    fake = None
    parts = []
    try:
        firmware.start()
        port = check_device(params.source.device or params.link.device).port
        link = Link(open_port(Device("udpout", "127.0.0.1", port)), *VEHICLE_ID)
        fake = bridge(plant, link, mocap, seed, FakeOptions(), params.betaflight, firmware.stands)
        clock = FlightClock(fake)
        source, link, _ = open_source(params, folder / "run", clock)
        backend = make_backend(params, link, folder=folder / "run")
        parts = [source, backend]
        fake.sensors.start()
        yield Runner(params, policy, backend, mechanism_lag(params)), source, clock, fake
    finally:
        for part in [*parts, fake]:
            if part is not None:
                part.close()
        firmware.stop()


def throw(
    program: str | Path,
    folder: Path,
    params: HilParams,
    policy: Policy,
    plant: MotorPlant,
    mocap: FakeMocapParams,
    seed: int,
) -> dict[str, Any]:
    """Fly one throw; returns the bridge's report, with the runner's summary under ``run``; raises
    `RunError` of the firmware.

    Args:
        program: of the firmware. folder: of the throw, made anew: the run's record (``run``) and
            the firmware's blackbox; its settings lie beside it.
        params: of the run. policy: on the CPU. plant: what flies behind the firmware.
        mocap: its faults. seed: of noise and loss.
    """
    with open_runner(program, folder, params, policy, plant, mocap, seed) as (
        runner,
        source,
        clock,
        fake,
    ):
        # Ticks and motion capture are not synchronised: the seed says how old the newest pose is at
        # a tick.
        clock.sleep_until(
            clock.now() + np.random.default_rng([seed, 1]).uniform(0.0, 1.0 / mocap.rate)
        )
        recorder = RunRecorder(folder / "run", params)
        summary = _fly(Loop(runner, source, clock, AutoOperator(), recorder), fake)
        recorder.close(summary)
        for number, log in enumerate(throws(read(folder / "run")), start=1):
            log.save(throw_path(folder / "run", number, ".npz"))
        return {**fake.report(), "run": summary}


def _fly(loop: Loop, fake: BetaflightSitl) -> dict[str, Any]:
    """Take turns until the runner is done and the payload has lain for a while."""
    plant = fake.plant
    done = False
    while plant.time < MOST and not done:
        loop.turn(False)
        landed = plant.landing["landing_time"]
        done = loop.runner.machine.state is State.DONE or (
            landed is not None and plant.time > landed + AFTER
        )
    return {
        **loop.summary(),
        "links": [one.roster.summary() for one in loop.source.links],
        "autopilot": {},
    }


def main() -> None:
    """Throw; a line of JSON a seed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add(
        "--firmware",
        required=True,
        metavar="PROGRAM",
        help="Betaflight's for a PC, to fly the plant's motors",
    )
    add("--config", default="betaflight_sitl", metavar="NAME", help="of configs/hil, or a file")
    add("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    add(
        "--seeds",
        type=int,
        nargs="+",
        default=[0],
        metavar="N",
        help="of starts, noise and loss; a throw each",
    )
    add("--policy", help="whose plant is flown (default: the one that throws)")
    add("--plant", default=MOTORS, metavar="MODULE:FUNCTION", help="that makes the vehicle")
    add(
        "--folder",
        type=Path,
        default=Path("out/firmware"),
        help="of the firmware's settings and blackbox",
    )
    args = parser.parse_args()
    params = config.load(HilParams, config.find("hil", args.config), args.overrides)
    policy = Policy.load(find_policy(params.policy))
    for seed in args.seeds:
        flown = load_plant(args.plant, args.policy or params.policy, seed)
        report = throw(
            args.firmware,
            args.folder / f"{seed:03d}",
            params,
            policy,
            flown,
            FakeMocapParams(),
            seed,
        )
        summary = report.pop("run")
        landed = report["landing_w"]
        error = None if landed is None else math.dist(landed[:2], params.goal_w[:2])
        row = {
            "seed": seed,
            "error": error,
            "state": summary["state"],
            "reason": summary["reason"],
            **report,
        }
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
