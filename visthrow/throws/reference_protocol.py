"""Make the paper's measurement on the reference plant: throws from hover, scored by
:mod:`visthrow.task.measurement`.

Before each throw the hover controller flies, so that battery, integrals and swing are those of a
hover. The policy receives the plant's measurements. Keypoints are computed from measured poses, as
in the paper's hardware-in-the-loop tests. Throws are flown in batches of :data:`BATCH`. The seed of
a batch follows from seed, target and number of the batch, so results do not depend on the number of
processes, and every policy flies the same vehicles, winds and initial states."""

import importlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy import ndarray

from sim.cores import cores
from visthrow.common.errors import ConfigError
from visthrow.common.workers import Workers, progress
from visthrow.task import Experiment, plant_of
from visthrow.task.measurement import Throws, pilots_hover
from visthrow.throws.flight_loop import Decision, Flight, Policies, Scores, Sight, hover, throw
from visthrow.throws.loading import Loaded
from visthrow.throws.plants import Plant, Snapshot, make_plant, random_ropes

BATCH = 100  # throws that share one plant; about 12 s of one core for a batch and 1 s for a throw

HOVER_TIME = 1.6  # hover before the policy takes over [s]; a whole number of control periods

THROW_TIME = 1.3  # typical time of a throw until the landing, for the progress line [s]

FIELDS = ("success", "landing_w", "error", "duration", "clearance", "smoothness")


@dataclass(frozen=True)
class Job:
    """One batch of throws at one target."""

    policies: tuple[int, ...]  # indices of the policies that share the batch
    target: float  # [m] along x
    batch: int
    count: int  # throws of each of these policies
    seed: int


def batch_plant(
    experiment: Experiment, plant_name: str, target: float, batch: int, count: int, seed: int
) -> tuple[Plant, np.random.Generator]:
    """Return the plant of one batch and the random generator of its initial states; they are the
    same for all policies.
    """
    seeds = np.random.SeedSequence([seed, round(1000 * target), batch])
    plant_seed = int(seeds.generate_state(1)[0])
    plant = make_plant(plant_name, experiment, count, plant_seed)
    return plant, np.random.default_rng(seeds)


def place_in_hover(plant: Plant, experiment: Experiment, rng: np.random.Generator) -> ndarray:
    """Place the vehicles near the hover point and return that point [m], shape (3,)."""
    start = pilots_hover()
    home = np.array([0.0, 0.0, start.spawn_height])
    spread = np.array(start.position) * rng.uniform(-1.0, 1.0, (plant.count, 3))
    angle = math.radians(start.cable_angle_deg)
    ropes = random_ropes(rng, plant.count, experiment.rope.segments, angle)
    plant.reset(home + spread, ropes)
    return home


def fly_batch(
    loaded: Sequence[Loaded], plant_name: str, job: Job, eyes: Sight | None = None
) -> dict[str, ndarray]:
    """Fly one batch of policies that were trained for the same plant; ``eyes``: source of keypoints
    from rendered pictures.

    Returns :data:`FIELDS` of :class:`visthrow.task.measurement.Throws`, the first policy's throws
    first, and ``goal_w`` if goals move; NaN where a throw failed."""
    flown = [loaded[i] for i in job.policies]
    experiment = flown[0].experiment
    count = job.count * len(flown)
    plant, rng = batch_plant(experiment, plant_name, job.target, job.batch, count, job.seed)
    home = place_in_hover(plant, experiment, rng)
    goal_w = np.tile([job.target, 0.0, 0.0], (count, 1))
    pilots = Policies(flown, goal_w, _goal_velocities(experiment, count, rng), eyes=eyes)
    flight = Flight(plant, pilots, scores := _Scores(pilots), home)
    flight.run([hover(HOVER_TIME), throw()])
    return scores.columns(flight)


class _Scores(Scores):
    """Scores that also report progress."""

    def before(self, flight: Flight, snapshot: Snapshot, sent: Decision) -> None:
        progress(min(flight.plant.time / (HOVER_TIME + THROW_TIME), 0.99))


def _goal_velocities(experiment: Experiment, count: int, rng: np.random.Generator) -> ndarray:
    """Return velocities of the task's goals [m/s], shape (E, 3); zero, without random draws, if
    goals do not move.
    """
    if not experiment.task.target.moves:
        return np.zeros((count, 3))
    speed = rng.uniform(*experiment.task.target.speed, count)
    heading = rng.uniform(0.0, 2.0 * math.pi, count)
    return np.column_stack((speed * np.cos(heading), speed * np.sin(heading), np.zeros(count)))


def batches(throws: int, size: int = BATCH) -> list[tuple[int, int]]:
    """Divide throws into batches; return the index and the size of each."""
    return [(first // size, min(size, throws - first)) for first in range(0, throws, size)]


def plan(
    policies: int,
    targets: Sequence[float],
    throws: int,
    seed: int,
    together: bool = False,
    size: int = BATCH,
) -> list[Job]:
    """Divide the throws of each policy at each target into batches; ``together``: all policies
    share the batches.
    """
    groups = [tuple(range(policies))] if together else [(i,) for i in range(policies)]
    cut = batches(throws, size)
    return [
        Job(group, target, *part, seed) for target in targets for group in groups for part in cut
    ]


class Throwing(Workers):
    """Throws in separate processes; a context manager that stops these if it is left early.

    >>> plant = "reference-realistic"
    >>> with Throwing(policies, (1.5, 2.0), 200, plant, seed=0) as throwing:  # doctest: +SKIP
    ...     results = throwing.results()
    """

    def __init__(
        self,
        loaded: Sequence[Loaded],
        targets: Sequence[float],
        throws: int,
        plant_name: str,
        seed: int,
        processes: int | None = None,
        together: bool = False,
        size: int = BATCH,
    ):
        """Start ``throws`` throws of each policy at each target [m] along x.

        Raises ConfigError: ``together`` is set, but the policies have different plants;
        ModuleNotFoundError: MuJoCo is not installed.

        Args:
            loaded: policies. targets: distances [m]. plant_name: name of the plant.
            throws: number of throws of each policy at each target.
            seed: seed of all random draws.
            processes: number of processes; default one for each core, at most one for each batch.
            together: fly all policies in the same batches, which is cheaper for a few throws; they
                must have the same plant.
            size: throws of a policy in a batch; smaller batches finish earlier on many cores. The
                random draws depend on the size.
        """
        importlib.import_module("mujoco")  # a missing package is reported once, not by every worker
        plant = plant_of(loaded[0].experiment)
        if together and any(plant_of(item.experiment) != plant for item in loaded):
            raise ConfigError("policies of different plants cannot fly in one batch")
        self.jobs = plan(len(loaded), targets, throws, seed, together, size)
        self._count = len(loaded)
        self._targets = list(targets)
        flown = partial(fly_batch, list(loaded), plant_name)
        super().__init__(flown, self.jobs, processes or cores(), "throws on the reference plant")

    def results(self, show: bool = True) -> list[list[Throws]]:
        """Wait, with a progress line on a terminal; return for each policy one
        :class:`visthrow.task.measurement.Throws` for each target.
        """
        self.label *= show
        results = dict(self)
        parts = [results[index] for index in range(len(self.jobs))]
        rows = []
        for policy in range(self._count):
            rows.append([self._throws(parts, policy, target) for target in self._targets])
        return rows

    def _throws(self, parts: Sequence[dict[str, ndarray]], policy: int, target: float) -> Throws:
        """Return all throws of one policy at one target."""
        units = []
        for job, part in zip(self.jobs, parts):
            if job.target == target and policy in job.policies:
                first = job.policies.index(policy) * job.count
                rows = slice(first, first + job.count)
                units.append({name: values[rows] for name, values in part.items()})
        columns = {name: np.concatenate([part[name] for part in units]) for name in units[0]}
        return Throws(target, **columns)
