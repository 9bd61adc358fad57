"""Throws of a policy on the reference plant, all at once, as a hall records them: what is diagnosed where flights are wanted soon.

One vehicle costs nearly as much as thirty: the plant's arrays hold one row a vehicle. All hover for the same time first, so that
these are not the flights of :func:`visthrow.throws.flight.fly`, which waits for each swing to become quiet.
"""

from dataclasses import dataclass, field

import numpy as np

from sim.params import RandomizationParams
from visthrow import config
from visthrow.common.errors import DiagnoseError
from visthrow.logs.flightlog import Channel, FlightLog
from visthrow.onboard.hover import HoverController, HoverParams
from visthrow.onboard.pilot import Pilot
from visthrow.throws.loading import Loaded
from visthrow.throws.plants import Plant, make_plant
from visthrow.throws.reference_protocol import FALL_TIME, place_in_hover

SETTLED = 2.4
"""Hover before the policy takes over [s], of which a log keeps the last part."""

AFTERWARDS = 0.7
"""Flown on after the last landing [s]."""


@dataclass
class _Track:
    """What is read off all vehicles at one time, before a command is sent."""

    time: list[float] = field(default_factory=list)
    rows: dict[str, list[np.ndarray]] = field(default_factory=dict)

    def add(self, time: float, **values: np.ndarray) -> None:
        self.time.append(time)
        for name, value in values.items():
            self.rows.setdefault(name, []).append(np.array(value, dtype=float))

    def of(self, name: str, e: int) -> np.ndarray:
        return np.array([row[e] for row in self.rows[name]])


def throws(loaded: Loaded, plant_name: str, goals_w: np.ndarray, seed: int) -> list[FlightLog]:
    """Throw at goals, one vehicle each, side by side.

    Args:
        loaded: policy and experiment, whose plant it is.
        plant_name: of :data:`visthrow.throws.plants.PLANTS`.
        goals_w: on the ground [m], shape (E, 3).
        seed: of plant and starts.

    Returns:
        A log each with poses, commands, the release's command and the landing; ``meta["times"]`` as of :func:`visthrow.throws.flight.fly`.

    Raises:
        DiagnoseError: A throw failed.
    """
    count = len(goals_w)
    plant, rng = make_plant(plant_name, loaded.experiment, count, seed), np.random.default_rng(seed)
    start = config.load(RandomizationParams, config.find("start", "hover"))
    home, track = place_in_hover(plant, loaded.experiment, start, rng), _Track()
    controller = HoverController(HoverParams(), plant.period, count)
    for _ in range(round(SETTLED / plant.period)):
        _send(plant, track, _held(plant, loaded, controller, home), np.zeros(count, dtype=bool))
    pilot, begin = Pilot(loaded.policy, loaded.experiment.camera, count), plant.time
    limit = begin + loaded.experiment.task.bounds.time_limit + FALL_TIME
    while not plant.landing.landed.all():
        if plant.time > limit:
            raise DiagnoseError(f"throws {np.flatnonzero(~plant.landing.landed)} did not come down; can the policy fly this plant?")
        seen = plant.measured()
        views = (getattr(seen, name) for name in ("pos_w", "quat_wb", "vel_w", "rate_b", "payload_pos_w"))
        out = pilot.act(*views, goals_w, seen.attached)
        held = _held(plant, loaded, controller, home)
        _send(plant, track, np.where(seen.attached[:, None], out.command, held), out.release & seen.attached)
    for _ in range(round(AFTERWARDS / plant.period)):
        _send(plant, track, _held(plant, loaded, controller, home), np.zeros(count, dtype=bool))
    return [_log(track, plant, begin, loaded.name, e) for e in range(count)]


def _held(plant: Plant, loaded: Loaded, controller: HoverController, home: np.ndarray) -> np.ndarray:
    """Commands of the hover controller."""
    seen, rope = plant.measured(), loaded.experiment.rope
    mass = loaded.experiment.vehicle.body.mass + np.where(seen.attached, rope.rope_mass + rope.payload_mass, 0.0)
    return controller.step(seen.pos_w, seen.quat_wb, seen.vel_w, home, mass)


def _send(plant: Plant, track: _Track, command: np.ndarray, release: np.ndarray) -> None:
    now = plant.state
    track.add(
        plant.time, pos_w=now.pos_w, quat_wb=now.quat_wb, payload_pos_w=now.payload_pos_w, command=command, release_command=release
    )
    plant.step(command, release)


def _log(track: _Track, plant: Plant, begin: float, policy: str, e: int) -> FlightLog:
    """Flight of one vehicle."""
    time = np.array(track.time)
    units = {"pos_w": "m", "payload_pos_w": "m", "quat_wb": "1"}
    channels = {name: Channel(time, track.of(name, e), unit, "world") for name, unit in units.items()}
    channels["command"] = Channel(time, track.of("command", e), "N, rad/s", "body")
    channels["release_command"] = Channel(time, track.of("release_command", e), "1")
    landing = plant.landing
    channels["landing"] = Channel(landing.time[e : e + 1], landing.point_w[e : e + 1], "m", "world")
    times = {"policy_start": begin, "landing": float(landing.time[e]), "end": float(time[-1])}
    return FlightLog(channels, {"policy": policy, "plant": plant.name, "times": times})
