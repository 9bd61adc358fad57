"""The flight loop: the vehicles of a plant hover, throw and recover, a batch of them or one.

A flight is a sequence of phases. In a hover the hover controller flies all vehicles. In a throw the
pilots fly vehicles with their payload, and the hover controller, which runs along, those that have
released or failed. A recorder gets each period."""

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
"""Longest flight after separation that is waited for [s]."""

LOOK_EVERY = 8
"""Periods of a hover between two looks at pictures."""

VIEWS = ("pos_w", "quat_wb", "vel_w", "rate_b", "payload_pos_w")
"""What a policy is shown of a vehicle."""


class Sight(Protocol):
    """A camera and a detector on each of E vehicles: keypoints from pictures.

    Attributes:
        last_keypoints: keypoints and validity of the last picture, (E, 8, 2) and (E, 8).
    """

    last_keypoints: tuple[ndarray, ndarray] | None

    def look(
        self, snapshot: Snapshot, measured: Snapshot, goal_w: ndarray, carried: ndarray
    ) -> tuple[ndarray, ndarray]:
        """Take a picture on each vehicle and return ``last_keypoints``.

        Args:
            snapshot: true states. measured: states that the detector knows attitude and height of.
            goal_w: goals [m], shape (E, 3), world frame. carried: whether a payload hangs, (E,).
        """

    def lost(self) -> dict[int, str]:
        """Return vehicle -> "ball" or "goal", whichever the hover's pictures did not show."""


@dataclass(frozen=True)
class Decision:
    """The commands of E vehicles for one period."""

    command: ndarray  # collective thrust [N] and body rates [rad/s], shape (E, 4)
    release: ndarray  # whether the latch is to trip, shape (E,), bool
    # the normalised command, and a policy's release output, shape (E, 4 or 5)
    action: ndarray | None = None
    observation: ndarray | None = None  # of a policy, shape (E, D)


class Pilots(ABC):
    """The pilots of E vehicles; the children decide."""

    def __init__(
        self,
        experiment: Experiment,
        goal_w: ndarray,
        first_action: ndarray,
        goal_vel_w: ndarray | None = None,
    ):
        """Begin before the throw, within the experiment's bounds.

        Args:
            experiment: see above.
            goal_w: at its start [m], shape (E, 3). goal_vel_w: [m/s], shape (E, 3); None: still.
            first_action: normalised command of the hover before, shape (E, 4 or 5).
        """
        self.experiment = experiment
        self.goal_w = goal_w
        self.first_action = first_action
        self.goal_vel_w = np.zeros_like(goal_w) if goal_vel_w is None else goal_vel_w

    @abstractmethod
    def decide(self, flight: "Flight", snapshot: Snapshot, latched: ndarray) -> Decision:
        """Decide for all vehicles, of which those of ``flight.flown`` follow; ``latched`` are the
        hover controller's commands.
        """

    def wait(self, flight: "Flight", snapshot: Snapshot) -> dict[int, str]:
        """Vehicles that are not to throw if the hover ended here, and why; called each period of
        the hover before the throw.
        """
        return {}


class Policies(Pilots):
    """Learnt policies that share a batch, each with the same number of vehicles, the first policy's
    first.
    """

    def __init__(
        self,
        loaded: Sequence[Loaded],
        goal_w: ndarray,
        goal_vel_w: ndarray | None = None,
        draws: bool = False,
        eyes: Sight | None = None,
    ):
        """Begin with policies that were trained for one plant; goals as of `Pilots`.

        ``draws``: state policies too have a camera, to be drawn. ``eyes``: whose rendered pictures
        keypoints come from; None: they are what measured poses project to."""
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
        if self.eyes is not None and self._waited % LOOK_EVERY == 0:
            self.eyes.look(flight.plant.exposed, snapshot, self.goal_w, snapshot.attached)
            self._lost = {
                e: f"refused: the {name} is not seen in the hover"
                for e, name in self.eyes.lost().items()
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
    """Keeps nothing of a flight; the children do."""

    def before(self, flight: "Flight", snapshot: Snapshot, sent: Decision) -> None:
        """Take each period's measurement and command, before the plant moves."""

    def after(self, flight: "Flight", snapshot: Snapshot, sent: Decision) -> None:
        """Take the period's end, with the new state in ``flight.now``."""


@dataclass(frozen=True)
class Phase:
    """Part of a flight."""

    # whether the pilots fly, or the hover controller, which begins with empty integrals
    throws: bool
    over: Callable[["Flight"], bool]  # asked after each period


def throw(seconds: float | None = None) -> Phase:
    """Throw until every payload has landed or its throw has failed, at most for a time [s]; default
    what the bounds allow.
    """

    def is_over(flight: "Flight") -> bool:
        if seconds is None:
            longest = flight.pilots.experiment.task.bounds.time_limit + FALL_TIME
        else:
            longest = seconds
        return not np.any(flight.open) or flight.has_lasted(longest)

    return Phase(True, is_over)


def hover(seconds: float) -> Phase:
    """Hover for a time [s]."""
    return Phase(False, lambda flight: flight.has_lasted(seconds))


class Flight:
    """E vehicles of a plant in flight.

    Attributes:
        elapsed: since the phase began [s].
        begin: when the first throw began, on the plant's clock [s]; NaN before it.
        open: whose throw is neither over nor failed, shape (E,). flown: whom the pilots fly in this
            period, shape (E,).
        failed: shape (E,), bool. failures: why, a message or None for each.
        commands: that were sent, each of shape (E, 4).
    """

    def __init__(
        self,
        plant: Plant,
        pilots: Pilots,
        recorder: FlightObserver | None = None,
        home_w: ndarray | None = None,
    ):
        """Take over a plant at its start; the recorder receives each period.

        ``home_w``: place that the hover controller holds [m], shape (3,) or (E, 3); None: where the
        vehicles are."""
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
        """State of the plant, read at most once a period."""
        self._now = self._now or self.plant.state
        return self._now

    @property
    def elapsed(self) -> float:
        return self.plant.time - self._phase_begin

    def has_lasted(self, time: float) -> bool:
        """Whether the phase has lasted for a time [s], to the nearest period."""
        return self.elapsed > time - 0.5 * self.plant.period

    def goal_at(self, time: float | ndarray) -> ndarray:
        """Goals [m], shape (E, 3), at a time or a time each on the plant's clock [s]."""
        return self.pilots.goal_w + np.reshape(time - self.begin, (-1, 1)) * self.pilots.goal_vel_w

    def run(self, phases: Sequence[Phase]) -> None:
        """Fly one phase after the other, each for a period at least."""
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
        """Note that a vehicle's throw has failed, unless it had before."""
        self.failed[vehicle] = True
        self.failures[vehicle] = self.failures[vehicle] or cause

    def _period(self, throws: bool) -> None:
        """Measure, decide, send."""
        plant = self.plant
        measurement = plant.measured()
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
        """Commands of the hover controller."""
        plant = self.plant.params
        mass = plant.vehicle.body.mass + np.where(snapshot.attached, plant.rope.hanging_mass, 0.0)
        return self._hover.step(snapshot.pos_w, snapshot.quat_wb, snapshot.vel_w, self.home_w, mass)

    def judge(self, snapshot: Snapshot) -> None:
        """Note whose throw has failed or is over, by the state after a period."""
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
        """Which throws have ended early, by cause, the first that holds first: the ends of an
        episode of training.
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
        """Begin with the command before the first, shape (E, 4 or more)."""
        self._last = first
        self._sum = np.zeros(len(first))
        self._steps = np.zeros(len(first))

    def add(self, action: ndarray, active: ndarray | bool = True) -> None:
        """Count normalised commands, shape (E, 4 or more), of vehicles that are being flown."""
        self._sum += active * np.mean((action - self._last)[:, :4] ** 2, axis=1)
        self._steps += active
        self._last = action

    @property
    def value(self) -> ndarray:
        """Shape (E,)."""
        return np.sqrt(self._sum / np.maximum(self._steps, 1.0))


class Scores(FlightObserver):
    """Measures what :class:`visthrow.task.measurement.Throws` holds.

    Attributes:
        clearance: least distance of the payload from the vehicle in flight [m], shape (E,);
            infinite before.
        smoothness: of the pilots' commands.
    """

    def __init__(self, pilots: Pilots):
        """Begin before the throw."""
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
        """Return a row a throw, NaN where it failed; ``goal_w`` where goals move."""
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
