"""The flight loop: the vehicles of a plant, one or a batch, hover, throw and recover.

A flight is a sequence of phases. In a hover the hover controller flies all vehicles. In a throw the
pilots fly the vehicles that carry their payload, and the hover controller, which always runs, flies
those that have released or failed. A recorder receives each period."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy import ndarray
from numpy.linalg import norm

from visthrow.onboard.hover import HoverController, HoverParams
from visthrow.onboard.pilot import Pilot
from visthrow.task import Experiment, terminations
from visthrow.task.measurement import blank_failed
from visthrow.throws.loading import Loaded
from visthrow.throws.plants import Plant, Snapshot

FALL_TIME = 1.5
"""Longest flight of a payload before its throw counts as failed [s]."""

PICTURE_PERIOD = 8
"""Control periods between pictures in a hover."""

VIEWS = ("pos_w", "quat_wb", "vel_w", "rate_b", "payload_pos_w")
"""Measured quantities of a vehicle that a policy receives."""


class Sight(Protocol):
    """A camera and a detector on each of E vehicles, which find keypoints in pictures.

    Attributes:
        last_keypoints: keypoints and validity of the last picture, (E, 8, 2) and (E, 8).
    """

    last_keypoints: tuple[ndarray, ndarray] | None

    def look(
        self, snapshot: Snapshot, measured: Snapshot, goal_w: ndarray, carried: ndarray
    ) -> tuple[ndarray, ndarray]:
        """Take a picture on each vehicle and return ``last_keypoints``.

        Args:
            snapshot: true states. measured: states from which the detector knows attitude and
                height.
            goal_w: goals [m], shape (E, 3), world frame. carried: whether a payload is attached,
                shape (E,).
        """

    def find_lost(self) -> dict[int, str]:
        """Return vehicle -> the object, "ball" or "goal", that the hover's pictures did not
        show.
        """


@dataclass(frozen=True)
class Decision:
    """The commands of E vehicles for one period."""

    command: ndarray  # collective thrust [N] and body rates [rad/s], shape (E, 4)
    release: ndarray  # whether to trip the latch, shape (E,), bool
    # the normalised command and a policy's release output, shape (E, 4 or 5)
    action: ndarray | None = None
    observation: ndarray | None = None  # of a policy, shape (E, D)


class Pilots(ABC):
    """The pilots of E vehicles; subclasses decide their commands."""

    def __init__(
        self,
        experiment: Experiment,
        goal_w: ndarray,
        first_action: ndarray,
        goal_vel_w: ndarray | None = None,
    ):
        """Prepare for a throw.

        Args:
            experiment: experiment whose bounds apply.
            goal_w: goals at the start of the throw [m], shape (E, 3). goal_vel_w: their velocities
                [m/s], shape (E, 3); None for goals that do not move.
            first_action: normalised command of the hover before, shape (E, 4 or 5).
        """
        self.experiment = experiment
        self.goal_w = goal_w
        self.first_action = first_action
        self.goal_vel_w = np.zeros_like(goal_w) if goal_vel_w is None else goal_vel_w

    @abstractmethod
    def decide(self, flight: "Flight", snapshot: Snapshot, latched: ndarray) -> Decision:
        """Return the commands for all vehicles, of which those in ``flight.flown`` follow them;
        ``latched``: the hover controller's commands, shape (E, 4).
        """

    def wait(self, flight: "Flight", snapshot: Snapshot) -> dict[int, str]:
        """Return vehicle -> the reason why it must not throw if the hover ended now; called in each
        period of the hover before the throw.
        """
        return {}


class Policies(Pilots):
    """Learnt policies that share a batch; each flies the same number of consecutive vehicles."""

    def __init__(
        self,
        loaded: Sequence[Loaded],
        goal_w: ndarray,
        goal_vel_w: ndarray | None = None,
        draws: bool = False,
        eyes: Sight | None = None,
    ):
        """Prepare policies that were trained for the same plant; goals: see `Pilots`.

        ``draws``: state policies have a camera too, for drawing. ``eyes``: source of keypoints from
        rendered pictures; None to project measured poses."""
        self.eyes = eyes
        self._waited = 0
        self._lost = {}
        share = len(goal_w) // len(loaded)
        self.slices = [slice(i * share, (i + 1) * share) for i in range(len(loaded))]
        looks = [
            draws or item.policy.contract["observation"]["layout"] == "vision" for item in loaded
        ]
        self.pilots = []
        for item, look in zip(loaded, looks):
            camera = item.experiment.camera if look else None
            self.pilots.append(Pilot(item.policy, camera, share, item.departures))
        first_action = np.vstack([pilot.previous_action for pilot in self.pilots])
        super().__init__(loaded[0].experiment, goal_w, first_action, goal_vel_w)

    def wait(self, flight: "Flight", snapshot: Snapshot) -> dict[int, str]:
        self._waited += 1
        if self.eyes is not None and self._waited % PICTURE_PERIOD == 0:
            self.eyes.look(flight.plant.exposed, snapshot, self.goal_w, snapshot.attached)
            self._lost = {
                e: f"refused: the {name} is not seen in the hover"
                for e, name in self.eyes.find_lost().items()
            }
        return self._lost

    def decide(self, flight: "Flight", snapshot: Snapshot, latched: ndarray) -> Decision:
        outs = []
        goal_w = flight.goal_at(snapshot.time)
        sighted = None
        if self.eyes is not None:  # not needed once all have released
            if np.any(flight.flown):
                sighted = self.eyes.look(flight.plant.exposed, snapshot, goal_w, snapshot.attached)
            else:
                sighted = self.eyes.last_keypoints
        for pilot, part in zip(self.pilots, self.slices):
            keypoints = None if sighted is None else (sighted[0][part], sighted[1][part])
            views = [getattr(snapshot, name)[part] for name in VIEWS]
            outs.append(pilot.act(*views, goal_w[part], snapshot.attached[part], keypoints))
        names = ("command", "release", "action", *(["observation"] if len(outs) == 1 else []))
        return Decision(*(np.concatenate([getattr(out, name) for out in outs]) for name in names))


class FlightObserver:
    """An observer of a flight that records nothing; subclasses record."""

    def before(self, flight: "Flight", snapshot: Snapshot, sent: Decision) -> None:
        """Receive a period's measurement and command before the plant advances."""

    def after(self, flight: "Flight", snapshot: Snapshot, sent: Decision) -> None:
        """Receive the end of a period, with the new state in ``flight.now``."""


@dataclass(frozen=True)
class Phase:
    """A part of a flight."""

    # whether the pilots fly; otherwise the hover controller does, with its integrals reset
    throws: bool
    over: Callable[["Flight"], bool]  # whether the phase is over, called after each period


def throw(seconds: float | None = None) -> Phase:
    """Return the phase of a throw, which lasts until every payload has landed or its throw has
    failed, at most for a time [s]; default the longest time within the bounds.
    """

    def is_over(flight: "Flight") -> bool:
        if seconds is None:
            longest = flight.pilots.experiment.task.bounds.time_limit + FALL_TIME
        else:
            longest = seconds
        return not np.any(flight.open) or flight.has_lasted(longest)

    return Phase(True, is_over)


def hover(seconds: float) -> Phase:
    """Return the phase of a hover for a time [s]."""
    return Phase(False, lambda flight: flight.has_lasted(seconds))


class Flight:
    """E vehicles of a plant in flight.

    Attributes:
        elapsed: time since the phase began [s].
        begin: start of the first throw on the plant's clock [s]; NaN before it.
        open: whether a throw is neither over nor failed, shape (E,). flown: whether the pilots fly
            the vehicle in this period, shape (E,).
        failed: whether the throw has failed, shape (E,). failures: a message or None for each.
        commands: the commands sent in each period, shape (E, 4).
    """

    def __init__(
        self,
        plant: Plant,
        pilots: Pilots,
        recorder: FlightObserver | None = None,
        home_w: ndarray | None = None,
    ):
        """Prepare the flight of a plant from its present state; the recorder receives each period.

        ``home_w``: set-point of the hover controller [m], shape (3,) or (E, 3); default the
        vehicles' positions."""
        count = plant.count
        self.plant = plant
        self.pilots = pilots
        self.recorder = recorder or FlightObserver()
        self._now: Snapshot | None = None
        self.home_w = self.now.pos_w if home_w is None else home_w
        self.begin = math.nan
        self.open = np.ones(count, bool)
        self.flown = np.zeros(count, bool)
        self.failed = np.zeros(count, bool)
        self.failures: list[str | None] = [None] * count
        self.commands: list[ndarray] = []
        self._refused: dict[int, str] = {}  # by the pilots, in the hover
        max_thrust = pilots.experiment.task.action.max_thrust
        limits = HoverParams(
            min_thrust=min(HoverParams.min_thrust, max_thrust / 70.0), max_thrust=max_thrust
        )
        self._hover = HoverController(limits, plant.period, count)

    @property
    def now(self) -> Snapshot:
        """Return the state of the plant, read at most once a period."""
        self._now = self._now or self.plant.state
        return self._now

    @property
    def elapsed(self) -> float:
        return self.plant.time - self._phase_begin

    def has_lasted(self, time: float) -> bool:
        """Return whether the phase has lasted for a time [s], to the nearest period."""
        return self.elapsed > time - 0.5 * self.plant.period

    def goal_at(self, time: float | ndarray) -> ndarray:
        """Return the goals' positions [m], shape (E, 3), at a time on the plant's clock [s], one
        for all or shape (E,).
        """
        return self.pilots.goal_w + np.reshape(time - self.begin, (-1, 1)) * self.pilots.goal_vel_w

    def run(self, phases: Sequence[Phase]) -> None:
        """Fly the phases in sequence, each for at least one period."""
        for phase in phases:
            self._phase_begin = self.plant.time
            if not phase.throws:
                self._hover.reset()
            elif math.isnan(self.begin):
                self.begin = self.plant.time
                for vehicle, cause in self._refused.items():
                    self.fail(vehicle, cause)
                self.open &= ~self.failed
            self._period(phase.throws)
            while not phase.over(self):
                self._period(phase.throws)

    def fail(self, vehicle: int, cause: str) -> None:
        """Mark a vehicle's throw as failed; its first cause is kept."""
        self.failed[vehicle] = True
        self.failures[vehicle] = self.failures[vehicle] or cause

    def _period(self, throws: bool) -> None:
        """Fly one control period: measure, decide and send."""
        plant = self.plant
        measurement = plant.measure()
        hold_command = self._command_hover(measurement)
        self.flown = self.open & measurement.attached & throws
        sent = Decision(hold_command, np.zeros(plant.count, bool))
        if math.isnan(self.begin):
            self._refused = self.pilots.wait(self, measurement)
        if throws:
            decision = self.pilots.decide(self, measurement, hold_command)
            command = np.where(self.flown[:, None], decision.command, hold_command)
            release = decision.release & self.flown
            sent = replace(decision, command=command, release=release)
        self.recorder.before(self, measurement, sent)
        self.commands.append(sent.command)
        plant.step(sent.command, sent.release)
        self._now = None
        if throws:
            self.judge(self.now)
        self.recorder.after(self, measurement, sent)

    def _command_hover(self, snapshot: Snapshot) -> ndarray:
        """Return the hover controller's commands, shape (E, 4)."""
        plant = self.plant.params
        mass = plant.vehicle.body.mass + np.where(snapshot.attached, plant.rope.hanging_mass, 0.0)
        return self._hover.step(snapshot.pos_w, snapshot.quat_wb, snapshot.vel_w, self.home_w, mass)

    def judge(self, snapshot: Snapshot) -> None:
        """Mark throws that have failed or are over, from the state after a period."""
        plant = self.plant
        landing = self.plant.landing
        carrying = self.flown & snapshot.attached
        for cause, mask in self._causes(snapshot).items():
            for e in np.flatnonzero(mask & carrying):
                self.fail(e, cause)
        fallen = plant.time - np.nan_to_num(landing.separation_time)
        for e in np.flatnonzero(~snapshot.attached & ~landing.landed & (fallen > FALL_TIME)):
            self.fail(e, f"the payload did not land within {FALL_TIME:g} s of its separation")
        self.open &= ~(self.failed | landing.landed)

    def _causes(self, snapshot: Snapshot) -> dict[str, ndarray]:
        """Return cause -> whether it ended a throw early, shape (E,). The causes are those that end
        an episode of training; the first that applies counts.
        """
        experiment = self.pilots.experiment
        pos_w = snapshot.pos_w
        payload_w = snapshot.payload_pos_w
        bounds = experiment.task.bounds
        rope = experiment.rope
        touching = rope.payload_radius + experiment.vehicle.collision_radius
        upright = 1.0 - 2.0 * (snapshot.quat_wb[:, 0] ** 2 + snapshot.quat_wb[:, 1] ** 2)
        height = experiment.release.landing_height
        carrying = terminations.ends_while_carrying(
            bounds, pos_w, upright, payload_w, self.plant.time - self.begin, height
        )
        return {
            "the simulation failed": ~(np.isfinite(pos_w) & np.isfinite(payload_w)).all(1),
            **terminations.out_of_bounds(bounds, pos_w),
            "the payload hit the vehicle": norm(payload_w - pos_w, axis=1) < touching,
            **{cause: mask & ~snapshot.latched for cause, mask in carrying.items()},
        }


class Smoothness:
    """Root mean square change of normalised commands from step to step."""

    def __init__(self, first: ndarray):
        """Start with the command before the first one, shape (E, 4 or more)."""
        self._last = first
        self._sum = np.zeros(len(first))
        self._steps = np.zeros(len(first))

    def add(self, action: ndarray, active: ndarray | bool = True) -> None:
        """Add normalised commands, shape (E, 4 or more), of the vehicles in ``active``."""
        self._sum += active * np.mean((action - self._last)[:, :4] ** 2, axis=1)
        self._steps += active
        self._last = action

    @property
    def value(self) -> ndarray:
        """Return the root mean square change so far, shape (E,)."""
        return np.sqrt(self._sum / np.maximum(self._steps, 1.0))


class Scores(FlightObserver):
    """An observer that measures the results of :class:`visthrow.task.measurement.Throws`.

    Attributes:
        clearance: smallest distance between the flying payload and the vehicle [m], shape (E,);
            infinite before.
        smoothness: smoothness of the pilots' commands.
    """

    def __init__(self, pilots: Pilots):
        """Prepare for a throw."""
        self.clearance = np.full(len(pilots.goal_w), np.inf)
        self.smoothness = Smoothness(pilots.first_action)

    def after(self, flight: Flight, snapshot: Snapshot, sent: Decision) -> None:
        if sent.action is None:
            return
        state = flight.now
        self.smoothness.add(sent.action, flight.flown)
        distance = norm(state.payload_pos_w - state.pos_w, axis=1)
        flying = ~state.attached & ~flight.plant.landing.landed
        self.clearance = np.where(flying, np.minimum(self.clearance, distance), self.clearance)

    def columns(self, flight: Flight) -> dict[str, ndarray]:
        """Return columns with one row for each throw, NaN if it failed; with ``goal_w`` if goals
        move.
        """
        landing = flight.plant.landing
        success = landing.landed & ~flight.failed
        point = landing.point_w[:, :2]
        goal = flight.goal_at(landing.time)[:, :2]
        columns = {
            "landing_w": point,
            "error": norm(point - goal, axis=1),
            "duration": landing.time - flight.begin,
            "clearance": self.clearance,
            "smoothness": self.smoothness.value,
        }
        if np.any(flight.pilots.goal_vel_w):
            columns["goal_w"] = goal
        return {"success": success} | blank_failed(success, columns)
