"""Throws of the fake autopilot without a wire, one line of JSON per seed: the reference for the
wire's cost.

Plant, start, motion capture, estimator and policy are those of a throw over the wire, with the same
seeds; link, autopilot, state machine, processes and real time are left out; set-points act as late
as the kind of autopilot lets them, which the estimator makes up for. Over the wire the runner's
ticks and the motion capture are not synchronised: at a tick the newest pose is as old as the
latency and up to a period of the motion capture more. Here the seed draws by how many of the
plant's periods ticks follow poses, and whether a pose that arrives at the instant of a tick is in
time."""

import argparse
import json
import math
import sys
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

from bench import start
from hil.control.hovering import Hovering
from hil.params import HilParams
from hil.poses.body_track import BodyState, Track
from hil.poses.frames import FrameParams
from hil.poses.pose import PAYLOAD, VEHICLE, Pose
from hil.rehearsal.fake import SetPoints, WirePlant
from hil.rehearsal.fake_mocap import SLACK, FakeMocapParams, Mocap
from hil.rehearsal.process import load_fake, load_plant
from tests.fakes import KINDS
from visthrow import config
from visthrow.onboard.hover import GRAVITY
from visthrow.onboard.pilot import Pilot
from visthrow.onboard.policy import Policy, find_policy

SETTLED = 0.1
"""Time of checks and arming over the wire beyond the configured times [s]: 5 ticks. A throw that
begins at the same time meets the same noise.
"""

MOST = 8.0  # after which a throw is given up [s]

OURS = FrameParams("x,y,z", "x,y,z", "xyzw", 0.0, (0.0, 0.0, 0.0))


class Direct:
    """One vehicle, from poses to commands in one loop."""

    def __init__(
        self, plant: WirePlant, policy: Policy, params: HilParams, mocap: FakeMocapParams, seed: int
    ) -> None:
        """Begin at the plant's start, with a policy on the CPU and the run's estimator, autopilot
        and goal; ``seed``: of noise and loss.
        """
        self.plant = plant
        self.params = params
        self.pilot = Pilot(policy, params.camera)
        self.mocap = Mocap(mocap, seed)
        self._tracks = {
            body: Track(OURS, params.gate, params.estimate) for body in (VEHICLE, PAYLOAD)
        }
        share = round(1.0 / (mocap.rate * plant.period))
        draw = np.random.default_rng([seed, 1])
        self._phase = int(draw.integers(max(share, 1)))
        self._in_time = bool(draw.integers(2))
        self._aim = 0.5 * sum(policy.contract["observation"]["latency"])
        self._latency = mocap.latency
        states = params.states
        self._taken = states.check_hold
        self._start = states.check_hold + states.armed_least + SETTLED
        place = tuple(plant.state["pos_w"].astype(float).tolist())
        self._hover = Hovering(place, 0.0, plant.max_thrust, self.pilot.period)
        kind = KINDS.get(params.backend)
        self._late = load_fake(kind).usual_delay if kind else 0.0
        self._set_points = SetPoints()
        self._coming: deque[Pose] = deque()

    def _state(self, body: str, now: float) -> BodyState | None:
        track = self._tracks[body]
        age = track.gate.age(now) + self._latency
        ahead = (
            age - self._aim + self._late
            if self.params.delay.compensate and math.isfinite(age)
            else 0.0
        )
        return track.state(now, ahead)

    def _take(self) -> None:
        now = self.plant.time
        if self.mocap.due(now):
            self._coming.extend(self.mocap.measure(now, self.plant.state))
        while self._coming and self._coming[0].arrival <= now + (
            SLACK if self._in_time else -SLACK
        ):
            pose = self._coming.popleft()
            self._tracks[pose.body].update(pose)

    def throw(self) -> dict[str, Any]:
        """Hover in place, then at the hover point, throw, await the landing; returns its report."""
        latch = None
        start = None
        tick = self._phase * self.plant.period
        level = np.array([self.plant.mass[0] * GRAVITY, 0.0, 0.0, 0.0])
        while self.plant.time < MOST:
            self._take()
            now = self.plant.time
            if now >= tick - SLACK:
                tick += self.pilot.period
                if start is None and now >= self._start - SLACK:
                    start = now
                    self.pilot.start()
                command, release = self._decide(now, start is not None, latch)
                if command is not None:
                    self._set_points.add(now + self._late, command)
                if release and latch is None:
                    latch = now
            self._fly(now, level, latch)
            if self.plant.landing["landing_time"] is not None:
                break
        return {**self.plant.landing, "start": start, "latch": latch}

    def _fly(self, now: float, level: np.ndarray, latch: float | None) -> None:
        command = self._set_points.compute_command(now, self.plant.period)
        after = math.inf if latch is None else max(latch + self._late - now, 0.0)
        trips = after < self.plant.period - SLACK
        self.plant.step(level if command is None else command, trips, after if trips else 0.0)

    def _decide(
        self, now: float, throwing: bool, latch: float | None
    ) -> tuple[np.ndarray | None, bool]:
        vehicle = self._state(VEHICLE, now)
        payload = self._state(PAYLOAD, now)
        if vehicle is None or payload is None:
            return None, False
        apart = latch is not None and now - latch >= self.pilot.lag - SLACK
        if not throwing or apart:
            if now >= self._taken:
                self._hover.place_w = self.params.home_w
            return np.array(self._hover.command(vehicle, self.plant.mass[1 if apart else 0])), False
        views = [
            np.array([v])
            for v in (vehicle.pos, vehicle.quat, vehicle.vel, vehicle.rate, payload.pos)
        ]
        out = self.pilot.act(*views, np.array(self.params.goal_w), True)
        return out.command[0].astype(float), bool(out.release[0])


def score_landing(report: dict[str, Any], params: HilParams, start: float | None) -> dict[str, Any]:
    """Return the error [m] and duration [s] of a plant's true landing; both None where there is
    none.
    """
    landed = report["landing_w"]
    when = report["landing_time"]
    if landed is None:
        return {"error": None, "duration": None}
    error = math.hypot(landed[0] - params.goal_w[0], landed[1] - params.goal_w[1])
    return {"error": error, "duration": None if start is None else when - start}


def run(args: argparse.Namespace) -> None:
    """Throw with each seed."""
    params = config.load(HilParams, config.find("hil", args.config), args.overrides)
    policy = Policy.load(find_policy(params.policy))
    for seed in args.seeds:
        flown = load_plant(args.plant, args.policy or params.policy, seed)
        report = Direct(flown, policy, params, FakeMocapParams(), seed).throw()
        print(
            json.dumps({"seed": seed, **score_landing(report, params, report["start"]), **report}),
            flush=True,
        )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = start.parser_of(__doc__, record=False)
    parser.add_argument(
        "--config", metavar="NAME", default="fake", help="of configs/hil, or a file (default: fake)"
    )
    parser.add_argument("--set", metavar="KEY=VALUE", dest="overrides", action="append", default=[])
    parser.add_argument(
        "--seeds",
        metavar="N",
        type=int,
        nargs="+",
        default=[0],
        help="of starts, noise and loss; a throw each",
    )
    parser.add_argument(
        "--policy", metavar="POLICY", help="whose plant is flown (default: the one that throws)"
    )
    parser.add_argument(
        "--plant",
        metavar="MODULE:FUNCTION",
        default="visthrow.throws.wire_plant:make",
        help="that makes the vehicle",
    )
    return start.main(parser, run, argv)


if __name__ == "__main__":
    sys.exit(main())
