"""The paper's measurement on the reference plant: throws from hover, scored as :mod:`visthrow.training.protocol` scores them.

Each throw hovers first under the hover controller, so that battery, integrals and swing are those of a hover, and sees
the plant's own measurements. Keypoints come from measured poses, as in the paper's hardware-in-the-loop tests. Throws
fly in batches of :data:`BATCH`, each with a seed of its own made of seed, target and number of the batch: results do
not depend on the number of processes, and every policy meets the same vehicles, winds and starts.
"""

import importlib
import math
import multiprocessing as mp
import pickle
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sim.params import RandomizationParams
from visthrow import config
from visthrow.common.errors import ConfigError
from visthrow.onboard.hover import HoverController, HoverParams
from visthrow.onboard.pilot import Pilot
from visthrow.task import Experiment, plant_of
from visthrow.throws.loading import Loaded
from visthrow.throws.plants import Plant, Snapshot, make_plant, random_ropes
from visthrow.training.device import cores

if TYPE_CHECKING:
    from visthrow.training.protocol import Throws

BATCH = 100
"""Throws that share one plant: about 23 s of one core a batch and 1 s a throw."""

HOVER_TIME = 1.6
"""Before the policy takes over [s]; a whole number of control periods."""

FALL_TIME = 1.5
"""Longest flight after separation that is waited for [s]."""

FIELDS = ("success", "landing_w", "error", "duration", "clearance", "smoothness")


@dataclass(frozen=True)
class Job:
    """One batch of throws at one target."""

    policies: tuple[int, ...]  # which of the policies share the batch
    target: float  # [m] along x
    batch: int
    count: int  # throws of each of them
    seed: int


def failures(experiment: Experiment, now: Snapshot, elapsed: float) -> list[str | None]:
    """Say which vehicles ended their throw early and why, by the bounds of :mod:`visthrow.training.terminations`.

    Args:
        experiment: with the bounds.
        now: state before separation.
        elapsed: since the policy started [s].

    Returns:
        One message or None for each vehicle.
    """
    bounds, rope = experiment.task.bounds, experiment.rope
    touching = rope.payload_radius + experiment.vehicle.collision_radius
    found: list[str | None] = []
    for e in range(len(now.pos_w)):
        pos, payload, quat = now.pos_w[e], now.payload_pos_w[e], now.quat_wb[e]
        if not np.all(np.isfinite(pos)) or not np.all(np.isfinite(payload)):
            found.append("the simulation failed")
        elif not bounds.altitude[0] <= pos[2] <= bounds.altitude[1]:
            found.append(f"the vehicle left its altitude bounds at {pos[2]:.2f} m")
        elif math.hypot(pos[0], pos[1]) > bounds.horizontal:
            found.append(f"the vehicle went further than {bounds.horizontal:g} m")
        elif np.linalg.norm(payload - pos) < touching:
            found.append("the payload hit the vehicle")
        elif now.latched[e]:
            found.append(None)
        elif 1.0 - 2.0 * (quat[0] ** 2 + quat[1] ** 2) < math.cos(math.radians(bounds.tilt_deg)):
            found.append("the vehicle tilted too far")
        elif payload[2] > pos[2]:
            found.append("the payload rose above the vehicle")
        elif payload[2] < experiment.release.landing_height:
            found.append("the payload touched the ground before the release")
        elif elapsed > bounds.time_limit - 1e-6:
            found.append(f"no release within {bounds.time_limit:g} s")
        else:
            found.append(None)
    return found


def batch_plant(
    experiment: Experiment, plant_name: str, target: float, batch: int, count: int, seed: int
) -> tuple[Plant, np.random.Generator]:
    """Plant of one batch, and the generator of its starts: the same for whoever throws."""
    seeds = np.random.SeedSequence([seed, round(1000 * target), batch])
    return make_plant(plant_name, experiment, count, int(seeds.generate_state(1)[0])), np.random.default_rng(seeds)


def place_in_hover(
    plant: Plant, experiment: Experiment, start: RandomizationParams, rng: np.random.Generator
) -> np.ndarray:
    """Put the vehicles where a pilot's hover holds them; returns the place they are held at [m], shape (3,)."""
    home = np.array([0.0, 0.0, start.spawn_height])
    spread = np.array(start.position) * rng.uniform(-1.0, 1.0, (plant.count, 3))
    ropes = random_ropes(rng, plant.count, experiment.rope.segments, math.radians(start.cable_angle_deg))
    plant.reset(home + spread, ropes)
    return home


def fly_batch(loaded: Sequence[Loaded], plant_name: str, job: Job, tick: Any = None) -> dict[str, np.ndarray]:
    """Fly one batch.

    Args:
        loaded: the policies; those that share the batch are trained for one plant.
        plant_name: of :data:`visthrow.throws.plants.PLANTS`.
        job: target, count and seed.
        tick: called after each control step with the share of the batch that is done.

    Returns:
        :data:`FIELDS` of :class:`visthrow.training.protocol.Throws`, the first policy's throws first, and ``goal_w`` where goals
        move; NaN where a throw failed.
    """
    flown = [loaded[i] for i in job.policies]
    experiment, count = flown[0].experiment, job.count * len(flown)
    plant, rng = batch_plant(experiment, plant_name, job.target, job.batch, count, job.seed)
    flight = _Batch(flown, plant, job.target, rng)
    steps = round(HOVER_TIME / plant.period)
    expected = steps + round(1.3 / plant.period)
    for k in range(steps):
        flight.hover()
        if tick:
            tick(k / expected)
    flight.start()
    limit = round((experiment.task.bounds.time_limit + FALL_TIME) / plant.period)
    for k in range(limit):
        if not np.any(flight.open):
            break
        flight.throw()
        if tick:
            tick(min((steps + k) / expected, 0.99))
    return flight.results()


class _Batch:
    """State of a batch in flight."""

    def __init__(self, loaded: list[Loaded], plant, target: float, rng: np.random.Generator) -> None:
        experiment = self.experiment = loaded[0].experiment
        start = config.load(RandomizationParams, config.find("start", "hover"))
        self.plant, self.count = plant, plant.count
        self.home = place_in_hover(plant, experiment, start, rng)
        self.goal_w = np.tile([target, 0.0, 0.0], (self.count, 1))
        self.goal_vel_w = _goal_velocities(experiment, self.count, rng)
        share = self.count // len(loaded)
        self.slices = [slice(i * share, (i + 1) * share) for i in range(len(loaded))]
        self.pilots = [Pilot(item.policy, _camera_of(item), share) for item in loaded]
        self.controller = HoverController(HoverParams(), plant.period, self.count)
        self.open = np.ones(self.count, bool)
        self.failed = np.zeros(self.count, bool)
        self.change, self.steps = np.zeros(self.count), np.zeros(self.count)
        self.clearance = np.full(self.count, np.inf)

    def hover(self) -> None:
        """One period of hover with the payload."""
        self.plant.step(self._held(self.plant.measured(), np.ones(self.count, bool)))

    def _held(self, seen: Snapshot, attached: np.ndarray) -> np.ndarray:
        rope = self.experiment.rope
        mass = self.experiment.vehicle.body.mass + np.where(attached, rope.rope_mass + rope.payload_mass, 0.0)
        return self.controller.step(seen.pos_w, seen.quat_wb, seen.vel_w, self.home, mass)

    def start(self) -> None:
        """Hand over to the policy."""
        for pilot in self.pilots:
            pilot.start()
        self.begin = self.plant.time
        self.previous = np.vstack([pilot.previous_action for pilot in self.pilots])

    def _goal_at(self, time: float | np.ndarray) -> np.ndarray:
        """Goals [m], shape (E, 3), at a time or a time each on the plant's clock [s]."""
        return self.goal_w + np.reshape(time - self.begin, (-1, 1)) * self.goal_vel_w

    def _decided(self, seen: Snapshot) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Actions, commands and release requests of all pilots."""
        outs, goal_w = [], self._goal_at(seen.time)
        for pilot, part in zip(self.pilots, self.slices):
            views = (getattr(seen, name)[part] for name in ("pos_w", "quat_wb", "vel_w", "rate_b", "payload_pos_w"))
            outs.append(pilot.act(*views, goal_w[part], seen.attached[part]))
        return tuple(np.concatenate([getattr(out, name) for out in outs]) for name in ("action", "command", "release"))

    def throw(self) -> None:
        """One period: the policy flies what it holds, the hover controller what has let go or failed."""
        plant = self.plant
        seen = plant.measured()
        flown = self.open & seen.attached
        action, command, release = self._decided(seen)
        if np.any(~flown):
            command = np.where(flown[:, None], command, self._held(seen, seen.attached))
        plant.step(command, release & flown)
        self.change += flown * np.mean((action - self.previous)[:, :4] ** 2, axis=1)
        self.steps += flown
        self.previous = action
        now, landing = plant.state, plant.landing
        distance = np.linalg.norm(now.payload_pos_w - now.pos_w, axis=1)
        away = ~now.attached & ~landing.landed
        self.clearance = np.where(away, np.minimum(self.clearance, distance), self.clearance)
        messages = failures(self.experiment, now, plant.time - self.begin)
        broken = np.array([message is not None for message in messages]) & flown & now.attached
        overdue = ~now.attached & ~landing.landed & (plant.time - np.nan_to_num(landing.separation_time) > FALL_TIME)
        self.failed |= broken | overdue
        self.open &= ~(self.failed | landing.landed)

    def results(self) -> dict[str, np.ndarray]:
        """Score the batch."""
        landing = self.plant.landing
        success = landing.landed & ~self.failed
        blank = np.where(success, 1.0, np.nan)
        point = landing.point_w[:, :2] * blank[:, None]
        goal = self._goal_at(landing.time)[:, :2]
        moving = {"goal_w": goal * blank[:, None]} if self.experiment.task.target.moves else {}
        return {
            "success": success,
            "landing_w": point,
            "error": np.linalg.norm(point - goal, axis=1),
            "duration": (landing.time - self.begin) * blank,
            "clearance": np.where(success, self.clearance, np.nan),
            "smoothness": np.sqrt(self.change / np.maximum(self.steps, 1.0)) * blank,
        } | moving


def _goal_velocities(experiment: Experiment, count: int, rng: np.random.Generator) -> np.ndarray:
    """Velocities of the task's goals [m/s], shape (E, 3); nothing is drawn where they stand still."""
    if not experiment.task.target.moves:
        return np.zeros((count, 3))
    speed, heading = rng.uniform(*experiment.task.target.speed, count), rng.uniform(0.0, 2.0 * math.pi, count)
    return np.column_stack((speed * np.cos(heading), speed * np.sin(heading), np.zeros(count)))


def _camera_of(loaded: Loaded):
    return loaded.experiment.camera if loaded.policy.contract["observation"]["layout"] == "vision" else None


def plan(
    policies: int, targets: Sequence[float], throws: int, seed: int, together: bool = False, size: int = BATCH
) -> list[Job]:
    """Cut throws of each policy at each target into batches, with all policies in one batch or each in its own."""
    groups = [tuple(range(policies))] if together else [(i,) for i in range(policies)]
    return [
        Job(group, target, batch, min(size, throws - batch * size), seed)
        for target in targets
        for group in groups
        for batch in range(math.ceil(throws / size))
    ]


class Throwing:
    """Throws on their way in processes of their own; a context manager that stops them when left early.

    >>> with Throwing(policies, (1.5, 2.0), 200, "reference-realistic", seed=0) as throwing:  # doctest: +SKIP
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
    ) -> None:
        """Start.

        Args:
            loaded: the policies.
            targets: [m] along x.
            throws: of each policy at each target.
            plant_name: of :data:`visthrow.throws.plants.PLANTS`.
            seed: of everything random.
            processes: default one a core, and no more than there are batches.
            together: fly all policies in one batch, which is cheaper for a few throws; they must share a plant.
            size: throws of a policy in a batch; fewer are sooner done where there are more cores. Other sizes, other draws.

        Raises:
            ConfigError: policies of different plants that are to fly together.
            ModuleNotFoundError: MuJoCo is not installed.
        """
        importlib.import_module("mujoco")  # said here rather than by every worker
        if together and any(plant_of(item.experiment) != plant_of(loaded[0].experiment) for item in loaded):
            raise ConfigError("policies of different plants cannot fly in one batch")
        self.jobs = plan(len(loaded), targets, throws, seed, together, size)
        context = mp.get_context("spawn")
        self._progress = context.Array("d", len(self.jobs))
        policies = [pickle.dumps((item.name, _plain(item))) for item in loaded]
        self._pool = context.Pool(
            min(processes or cores(), len(self.jobs)), _begin, (policies, plant_name, self._progress)
        )
        self._count = len(loaded)
        self._targets = list(targets)
        self._pending = self._pool.map_async(_work, list(enumerate(self.jobs)), chunksize=1)

    def __enter__(self) -> "Throwing":
        return self

    def __exit__(self, kind: type | None, *_: object) -> None:
        self._pool.terminate()
        self._pool.join()

    def results(self, show: bool = True) -> "list[list[Throws]]":
        """Wait, with a progress line on a terminal.

        Returns:
            For each policy, a :class:`visthrow.training.protocol.Throws` a target.
        """
        from visthrow.training.protocol import Throws

        begin = time.monotonic()
        while not self._pending.ready():
            self._pending.wait(0.5)
            if show and sys.stderr.isatty():
                share = sum(self._progress) / len(self.jobs)
                left = (time.monotonic() - begin) * (1 / share - 1) if share > 0.02 else math.nan
                note = f", about {left:.0f} s left" if math.isfinite(left) else ""
                print(
                    f"\rthrows on the reference plant: {100 * share:3.0f} %{note}   ",
                    end="",
                    file=sys.stderr,
                    flush=True,
                )
        if show and sys.stderr.isatty():
            print(f"\r{' ' * 70}\r", end="", file=sys.stderr, flush=True)
        parts = self._pending.get()
        fields = [*FIELDS, "goal_w"] if "goal_w" in parts[0] else FIELDS
        rows: list[list[Throws]] = []
        for policy in range(self._count):
            row = []
            for target in self._targets:
                of = []
                for job, part in zip(self.jobs, parts):
                    if job.target == target and policy in job.policies:
                        first = job.policies.index(policy) * job.count
                        of.append({name: part[name][first : first + job.count] for name in fields})
                row.append(Throws(target, **{name: np.concatenate([part[name] for part in of]) for name in fields}))
            rows.append(row)
        return rows


def _plain(item: Loaded) -> tuple:
    """A policy without tensors: those would travel as shared memory."""
    policy = item.policy

    def array(tensor):
        return None if tensor is None else tensor.cpu().numpy()

    network = (
        [array(w) for w in policy.weights],
        [array(b) for b in policy.biases],
        policy.activation,
        policy.contract,
    )
    return network, (array(policy.mean), array(policy.std), policy.eps), item.experiment


def _begin(policies: list[bytes], plant_name: str, progress: Any) -> None:
    """Set up a worker process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers
    import torch

    from visthrow.onboard.policy import Policy

    torch.set_num_threads(1)
    global _worker
    loaded = []
    for name, (network, normalizer, experiment) in map(pickle.loads, policies):
        weights, biases, activation, contract = network
        mean, std, eps = normalizer

        def tensor(array):
            return None if array is None else torch.from_numpy(array)

        policy = Policy(
            tuple(map(tensor, weights)),
            tuple(map(tensor, biases)),
            activation,
            contract,
            {},
            tensor(mean),
            tensor(std),
            eps,
        )
        loaded.append(Loaded(name, policy, experiment))
    _worker = (loaded, plant_name, progress)


_worker: tuple = ()


def _work(task: tuple[int, Job]) -> dict[str, np.ndarray]:
    index, job = task
    loaded, plant_name, progress = _worker

    def tick(share: float) -> None:
        progress[index] = share

    result = fly_batch(loaded, plant_name, job, tick)
    progress[index] = 1.0
    return result
