"""A vehicle of a few lines for tests of the runner: rates and thrust are followed at once, the
payload hangs straight.
"""

import math
from collections.abc import Callable

import numpy as np
import torch

from hil.control.state_machine import State
from hil.control.tick.runner import OperatorInput, Runner, TickRecord
from hil.links.backends.base import DryRun, Status
from hil.params import HilParams
from hil.poses.pose import Pose
from tests.configs import load_run
from visthrow.common.rotations import multiply, rotate_one
from visthrow.onboard.actions import hover_action
from visthrow.onboard.policy import Policy, find_policy

TICK, SUBSTEPS = 0.02, 2  # poses at 100 Hz
OURS = tuple(
    f"frames.{body}.{key}"
    for body in ("vehicle", "payload")
    for key in ('axes="x,y,z"', 'body_axes="x,y,z"', 'quaternion="xyzw"')
)
"""Overrides that make the source's frames ours."""


def params(*overrides: str) -> HilParams:
    """The shipped dry run, in our frames and without a delay."""
    given = (
        *OURS,
        "policy=state",
        "observe=false",
        "delay.source=0.0",
        "aim.bound=9.0",
        *overrides,
    )  # releases in hover
    return load_run("dry_run", given)


def simple_policy(action=(0.0, 0.0, 0.0, 0.0, 1.0), layout="state") -> Policy:
    """A network with a constant action; hover needs `HOVER` first."""
    shipped = Policy.load(find_policy(layout))
    return Policy(
        (torch.zeros(5, shipped.obs_dim),), (torch.tensor(action),), "relu", shipped.contract
    )


HOVER = hover_action(9.81 * 0.272, 14.0)[0]  # first number of an action that hovers
NEVER, AT_ONCE = (simple_policy((HOVER, 0.0, 0.0, 0.0, latch)) for latch in (-1.0, 1.0))
"""Policies that hover and ask for the release."""


class Vehicle:
    """Vehicle, payload and a perfect motion capture."""

    def __init__(self) -> None:
        self.time, self.pos, self.vel = 0.0, np.array([0.0, 0.0, 1.333]), np.zeros(3)
        self.quat, self.rate = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0)
        self.payload: np.ndarray | None = None
        self.payload_vel = np.zeros(3)
        self.rng = np.random.default_rng(0)

    def step(self, command, released: bool, hang: float, mass: tuple[float, float]) -> None:
        """Half a tick."""
        dt = TICK / SUBSTEPS
        thrust, *rates = command
        if released and self.payload is None:
            self.payload, self.payload_vel = self.pos - [0.0, 0.0, hang], self.vel.copy()
        up = np.array(rotate_one(self.quat, (0.0, 0.0, 1.0)))
        self.vel = self.vel + dt * (thrust / mass[released] * up - [0.0, 0.0, 9.81])
        self.pos = self.pos + dt * self.vel
        turned = multiply(self.quat, (*(0.5 * dt * r for r in rates), 1.0))
        self.quat = tuple(x / math.hypot(*turned) for x in turned)
        self.time += dt
        if self.payload is not None and self.payload[2] > 0.04:
            self.payload = self.payload + dt * self.payload_vel - [0.0, 0.0, 0.5 * 9.81 * dt * dt]
            self.payload_vel = self.payload_vel - [0.0, 0.0, 9.81 * dt]

    def poses(self, hang: float) -> list[Pose]:
        """Return poses of both bodies; a tenth of a millimetre of noise keeps their
        content fresh.
        """
        noise = 1e-4 * self.rng.standard_normal((2, 3))
        ball = self.pos - [0.0, 0.0, hang] if self.payload is None else self.payload
        return [
            Pose(self.time, self.time, name, tuple((pos + noise[i]).tolist()), self.quat)
            for i, (name, pos) in enumerate((("vehicle", self.pos), ("payload", ball)))
        ]


class Spy(DryRun):
    """A back-end that records its calls."""

    def __init__(self) -> None:
        super().__init__()
        self.sent: list[tuple[float, tuple[float, ...]]] = []
        self.release_times: list[float] = []
        self.aborts = 0

    def send(self, command, now) -> bool:
        self.sent.append((now, command))
        return super().send(command, now)

    def release(self, when: float) -> None:
        self.release_times.append(when)
        super().release(when)

    def abort(self, now: float) -> None:
        self.aborts += 1


class Nobody:
    """Never arms: the vehicle hovers."""

    def words(self, state: str) -> OperatorInput:
        return OperatorInput()


class AutoOperator:
    """Arms whenever the run is ready."""

    def words(self, state: str) -> OperatorInput:
        return OperatorInput(arm=state == State.READY)


def fly(
    runner: Runner,
    seconds: float,
    poses: Callable[[float, list[Pose]], list[Pose]] = lambda time, poses: poses,
    status: Callable[[float], Status] = lambda time: Status(True),
    words: Callable[[float, str], OperatorInput] = lambda time, state: OperatorInput(
        arm=state == "ready"
    ),
    late: Callable[[float], float] = lambda time: 0.0,
    watch: Callable[[float, TickRecord], None] | None = None,
    recording: Callable[[float], bool] = lambda time: True,
) -> list[TickRecord]:
    """Fly for a time; ``poses``, ``status``, ``words``, ``late`` and ``recording`` disturb the
    runner's inputs.
    """
    vehicle, decisions, command = Vehicle(), [], None
    waiting: list[Pose] = []
    mass = (runner.mass, runner.vehicle_mass)
    while vehicle.time < seconds and runner.machine.state != "done":
        now = vehicle.time + late(vehicle.time)
        decision = runner.tick(
            now, waiting, status(now), words(now, runner.machine.state), recording(now)
        )
        decisions.append(decision)
        if watch is not None:
            watch(now, decision)
        command = (
            decision.command
            or (command if decision.state == "abort" else None)
            or (mass[0] * 9.81, 0, 0, 0)
        )
        released = bool(runner.backend.release_times) and now >= runner.backend.release_times[0]
        waiting = []
        for _ in range(SUBSTEPS):
            vehicle.step(command, released, runner.hang, mass)
            waiting += poses(vehicle.time, vehicle.poses(runner.hang))
    return decisions


def changes(decisions: list[TickRecord]) -> list[tuple[str, str]]:
    """States passed through, with the reason of each change."""
    out = [(decisions[0].state, decisions[0].reason)]
    for decision in decisions:
        if decision.state != out[-1][0]:
            out.append((decision.state, decision.reason))
    return out
