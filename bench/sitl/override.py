"""MSP OVERRIDE on Betaflight in software: a pilot hovers, hands over, and the runner is killed;
prints the sticks' values, a line of JSON per case.

    python bench/sitl/alone.py python -m bench.sitl.override --firmware PROGRAM
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from bench.sitl.direct import open_runner
from bench.sitl.piloted import Piloted
from hil.control.loop import Loop
from hil.control.state_machine import State
from hil.links.backends.betaflight import STICKS
from hil.params import HilParams
from hil.rehearsal.fake_mocap import FakeMocapParams
from tests.hil_flight import AutoOperator
from tests.loopback import test_endings as endings
from visthrow import config
from visthrow.onboard.policy import Policy, find_policy
from visthrow.throws.wire_plant import make_motors

OVERRIDDEN = ("betaflight.arm_channel=0",)
LONGEST = 25.0  # of a flight [s]
GONE_AFTER = 0.2  # in the state in which the runner is killed [s]
WATCHED = 1.0  # after the runner has gone [s]
AFTER = 1.0  # flown on after a landing [s]


def fly(
    program: str | Path,
    folder: Path,
    overrides: tuple[str, ...] = (),
    policy: Policy | None = None,
    until: str = "",
    seed: int = 0,
) -> dict[str, Any]:
    """Fly with a pilot beside the runner, who switches the override on once it is ready.

    Args:
        program: the firmware. folder: of the flight, made anew.
        overrides: of the configuration. policy: None for the configuration's.
        until: state in which the runner is killed; then the firmware's sticks are recorded, and the
            pilot switches off. Empty: a throw is flown to its landing.
        seed: of start, noise and loss.
    """
    params = config.load(
        HilParams, config.find("hil", "betaflight_sitl"), [*OVERRIDDEN, *overrides]
    )
    policy = policy or Policy.load(find_policy(params.policy))
    plant = make_motors(params.policy, seed)
    with open_runner(
        program, folder, params, policy, plant, FakeMocapParams(), seed, Piloted
    ) as parts:
        runner, source, clock, fake = parts
        loop = Loop(runner, source, clock, AutoOperator())
        killed = None
        while plant.time < LONGEST and runner.machine.state is not State.DONE:
            state = runner.machine.state.value
            fake.override |= state == State.READY
            if state == until and clock.now() - runner.machine.since >= GONE_AFTER:
                killed = _watch(runner, clock, fake)
                break
            loop.turn(False)
            landed = plant.landing["landing_time"]
            if landed is not None and plant.time > landed + AFTER:
                break
        version = runner.backend.audit.found.get("fc_version")
        return {
            "version": version,
            "reason": runner.machine.reason,
            **fake.report(),
            "killed": killed,
            "release": runner.backend.release_record.state,
        }


def _watch(runner: Any, clock: Any, fake: Piloted) -> dict[str, Any]:
    """Close the runner's port, and report sticks and vehicle; then the pilot switches off."""
    last = fake.firmware[:STICKS]
    begun = clock.now()
    start_w = fake.plant.state["pos_w"].copy()
    runner.backend.close()
    expired = None
    way = []
    while clock.now() < begun + WATCHED:
        clock.sleep_until(clock.now() + 0.02)
        way.append(fake.plant.state["pos_w"] - start_w)
        if expired is None and np.abs(np.subtract(fake.firmware[:STICKS], last)).max() > 3:
            expired = clock.now() - begun
    fake.override = False
    off = clock.now()
    while np.abs(np.subtract(fake.firmware[:3], fake.radio[:2] + fake.radio[3:4])).max() > 60:
        clock.sleep_until(clock.now() + 0.02)
        if clock.now() > off + WATCHED:
            break
    return {
        "sticks": last,
        "expired": expired,
        "sunk": float(-min(step[2] for step in way)),
        "moved": float(np.linalg.norm(way[-1][:2])),
        "back": clock.now() - off,
    }


def never(folder: Path) -> Policy:
    """Return a policy that hovers and never releases."""
    endings.NEVER.save(folder / "never.npz")
    return Policy.load(folder / "never.npz")


def fly_until_killed(program: str | Path, folder: Path, state: str) -> dict[str, Any]:
    """Fly until the runner is killed, in hover, or in a throw by the shipped policy."""
    hovers = state != State.THROW
    policy = never(folder) if hovers else None
    overrides = (*endings.QUICK, *endings.STATES[state])
    return fly(program, folder / state, overrides, policy, until=state)


def main() -> None:
    """Fly a throw, and the runner killed in hover and in a throw."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--firmware", required=True, metavar="PROGRAM")
    parser.add_argument("--folder", type=Path, default=Path("out/override"))
    args = parser.parse_args()
    print(json.dumps(fly(args.firmware, args.folder / "throw")), flush=True)
    for state in endings.STATES:
        print(json.dumps(fly_until_killed(args.firmware, args.folder, state)), flush=True)


if __name__ == "__main__":
    main()
