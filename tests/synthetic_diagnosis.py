"""Flights of two point masses with effects whose truth is known: a model to be diagnosed without
any simulator.

Vehicle and payload are moved by smooth random forces; positions of both are measured. Effects are
force shapes on either mass or shifts of a measured position, so the linearisation is exact unless
``curvature`` says otherwise. A hidden law acts at all times, not at the knots alone."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.random import default_rng

from visthrow.diagnose.models.model_interface import Effect, Linearised, Model, Window
from visthrow.diagnose.select import diagnose_flights
from visthrow.diagnose.select.point import Point, Problem, linearise
from visthrow.diagnose.select.selection import Selector

MASS = (0.21, 0.058)  # [kg]
SIGMA = (5e-4, 8e-4)  # [m]
LENGTH, KNOTS = 1.0, 11
FINE = 50  # steps between two knots
CHANNELS = ("pos_w", "payload_pos_w")
GUST = (0.015, 6e-4)  # deviation of the gusts on either mass [N]
GUST_TIME = 0.6  # [s]


def _fine() -> np.ndarray:
    return np.linspace(0.0, LENGTH, FINE * (KNOTS - 1) + 1)


def _integrate(time: np.ndarray, forces: np.ndarray) -> np.ndarray:
    """Positions of a unit mass under forces at fine times, shape (T, n) from (F, n)."""
    fine = _fine()
    speed = np.cumsum(forces, axis=0) * fine[1]
    place = np.cumsum(speed, axis=0) * fine[1]
    return np.array([np.interp(time, fine, column) for column in place.T]).T


def _response(time: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """Position after a unit force on a unit mass at each knot (triangles), shape (T, knots)."""
    return _integrate(
        time, np.array([np.interp(_fine(), knots, row) for row in np.eye(len(knots))]).T
    )


def explain_without_laws(model: Model) -> diagnose_flights.Diagnosis:
    """Explain flights by the effects of the catalogue alone."""
    return diagnose_flights.explain(model, laws=False)


def linearise_flights(model: Model) -> Point:
    """Return a model's flights linearised where no effect acts."""
    windows = model.windows({})
    problem = Problem.of(model, windows, range(len(windows)))
    return linearise(problem, np.zeros(len(model.effects)), windows=windows)


def selector_of(model: Model) -> Selector:
    """Return a search that has begun with a model's flights and looks for no laws."""
    return Selector(linearise_flights(model), 5.0, laws=False)


def catalogue(count: int) -> tuple[Effect, ...]:
    """Effects: two thirds are forces, one third are shifts of a measured position."""
    blocks = ("thrust map", "rope", "aero", "payload aero", "release")
    effects = []
    for i in range(count):
        sensing = i % 3 == 2
        effects.append(
            Effect(
                name=f"effect_{i:02d}",
                cause=f"cause {i}",
                equation=f"F += theta phi_{i}",
                unit="m" if sensing else "N",
                block="sensing" if sensing else blocks[i % len(blocks)],
                bounds=(-2e-2, 2e-2) if sensing else (-1.0, 1.0),
                prior_sd=5e-3 if sensing else 0.2 if i % 2 else 0.05,
                floor=1e-4 if sensing else 4e-3 if i % 2 else 1e-3,
                channels=("payload_pos_w",) if i % 2 == 0 else ("pos_w",),
                source="made up",
                manoeuvres=("swing",),
            )
        )
    return tuple(effects)


EFFECTS = catalogue(12)


@dataclass
class SyntheticModel(Model):
    """A synthetic :class:`visthrow.diagnose.models.model_interface.Model`; ``truth`` in floors."""

    effects: tuple[Effect, ...] = EFFECTS
    truth: dict[str, float] = field(default_factory=dict)
    seed: int = 0
    throws: int = 5
    free: int = 1
    noise: float = 1.0
    gust: float = 1.0
    curvature: float = 0.0  # of the response, a 30 floors' size bends it by this share
    same: dict[str, tuple[str, float]] = field(
        default_factory=dict
    )  # effect -> (of which it is a multiple, factor)
    law: str = ""  # a hidden force outside the catalogue: "speed" or "swirl"
    law_size: float = 0.0
    channels: tuple[str, ...] = CHANNELS
    rate: int = 40  # of the measurements [Hz]
    fresh: int = 0  # seed of noise and gusts alone

    def __post_init__(self) -> None:
        self._rng = default_rng(self.seed)
        self._draw = default_rng([self.seed, self.fresh])
        self._at = {e.name: j for j, e in enumerate(self.effects)}
        self._time = np.arange(0.0, LENGTH, 1.0 / self.rate)
        self._knots = np.linspace(0.0, LENGTH, KNOTS)
        self._placed = _response(self._time, self._knots)
        # of each window, what the law adds to the measured positions
        self.by_law: list[np.ndarray] = []
        self._windows = [
            w for flight in range(self.free + self.throws) for w in self._flight(flight)
        ]

    def _flight(self, flight: int) -> list[Window]:
        if flight < self.free:
            return [self._window(flight, "flight", k * LENGTH, 1.0) for k in range(4)]
        return [self._window(flight, "hover", 0.0, 0.3), self._window(flight, "throw", LENGTH, 2.0)]

    def _smooth(self, size: int, scale: float, at: np.ndarray | None = None) -> np.ndarray:
        at = self._knots if at is None else at
        phase = self._rng.uniform(0, 2 * np.pi, (3, size, 1))
        speed = self._rng.uniform(2.0, 9.0, (3, size, 1))
        waves = np.sin(speed * at + phase) * self._rng.normal(size=(3, size, 1))
        return scale * waves.sum(0).T / 1.7  # (times, size)

    def _motion(self, vigour: float) -> dict[str, np.ndarray]:
        """At fine times; every ``FINE``-th is a knot."""
        at = _fine()
        velocity = self._smooth(3, 1.5 * vigour, at)
        return {
            "time": at,
            "pos_w": self._smooth(3, 0.5, at) + [0, 0, 1.5],
            "vel_w": velocity,
            "quat_wb": np.tile([0.0, 0.0, 0.0, 1.0], (len(at), 1)),
            "rate_b": self._smooth(3, vigour, at),
            "thrust": 2.63 + self._smooth(1, 0.8 * vigour, at)[:, 0],
            "payload_pos_w": self._smooth(3, 0.5, at) + [0, 0, 1.2],
            "payload_vel_w": velocity + self._smooth(3, 0.7 * vigour, at),
            "cable_dir_w": np.tile([0.0, 0.0, -1.0], (len(at), 1)),
            "tension": 0.57 + self._smooth(1, 0.1, at)[:, 0],
        }

    def _window(self, flight: int, phase: str, start: float, vigour: float) -> Window:
        n = len(self._time)
        moves = self._motion(vigour)
        motion = {name: value[::FINE] for name, value in moves.items()}
        effects = np.zeros((6 * n, len(self.effects)))
        for j, e in enumerate(self.effects):
            on_payload = e.channels == ("payload_pos_w",)
            rows = slice(3 * n, 6 * n) if on_payload else slice(0, 3 * n)
            if e.unit == "m":
                moved = self._smooth(3, vigour).T
                shape = np.array([np.interp(self._time, self._knots, c) for c in moved]).T
            else:
                shape = self._placed @ self._smooth(3, vigour) / MASS[on_payload]
            effects[rows, j] = shape.ravel()
        for name, (of, factor) in self.same.items():
            effects[:, self._at[name]] = factor * effects[:, self._at[of]]
        nuisance, latent = np.zeros((6 * n, 12)), np.zeros((6 * n, 6 * KNOTS))
        for m in range(2):
            for axis in range(3):
                rows = m * 3 * n + 3 * np.arange(n) + axis
                nuisance[rows, m * 6 + axis], nuisance[rows, m * 6 + 3 + axis] = 1.0, self._time
                at = (m * 3 + axis) * KNOTS
                latent[rows, at : at + KNOTS] = self._placed / MASS[m]
        sigma = np.repeat(SIGMA, 3 * n)
        self.by_law.append(self._moved(moves) if self.law else np.zeros(6 * n))
        measured = latent @ self._gusts() + self.by_law[-1] + self._answer(effects, self.truth)
        measured += sigma * self.noise * self._draw.normal(size=6 * n)
        measured += nuisance @ self._draw.normal(0.0, 0.02, 12)
        return Window(
            flight,
            phase,
            start + np.tile(np.repeat(self._time, 3), 2),
            np.repeat([0, 1], 3 * n),
            measured,
            sigma,
            effects,
            nuisance,
            np.full(12, 0.1),
            latent,
            np.repeat([0, 2], 3 * KNOTS),
            np.tile(np.repeat([0, 1, 2], KNOTS), 2),
            np.tile(start + self._knots, 6),
            {**motion, "time": start + self._knots},
        )

    def _gusts(self) -> np.ndarray:
        root = np.linalg.cholesky(np.exp(-np.abs(self._knots[:, None] - self._knots) / GUST_TIME))
        white = self._draw.normal(size=(2, 3, KNOTS)) * self.gust * np.array(GUST)[:, None, None]
        return (white @ root.T).ravel()

    def _moved(self, moves: dict[str, np.ndarray]) -> np.ndarray:
        """What the law adds to the measured positions, shape (6 n,)."""
        forces = self._law(moves).reshape(2, 3, -1)
        return np.concatenate(
            [(_integrate(self._time, forces[m].T) / MASS[m]).ravel() for m in range(2)]
        )

    def _law(self, motion: dict[str, np.ndarray]) -> np.ndarray:
        force = np.zeros((2, 3, len(motion["time"])))
        if self.law == "speed":  # drag of the vehicle that grows with the square of its speed
            speed = np.linalg.norm(motion["vel_w"], axis=1)
            force[0] = -self.law_size * speed * motion["vel_w"].T
        else:  # a force across the payload's velocity
            force[1] = self.law_size * np.cross([0.0, 0.0, 1.0], motion["payload_vel_w"]).T
        return force.ravel()

    def _floors(self, sizes: dict[str, float]) -> np.ndarray:
        theta = np.zeros(len(self.effects))
        for name, size in sizes.items():
            theta[self._at[name]] = size
        return theta

    def _answer(self, effects: np.ndarray, sizes: dict[str, float]) -> np.ndarray:
        theta, floor = self._floors(sizes), np.array([e.floor for e in self.effects])
        return effects @ (floor * (theta + self.curvature * theta * np.abs(theta) / 30.0))

    def _sizes(self, theta: dict[str, float]) -> dict[str, float]:
        return {name: value / self.effects[self._at[name]].floor for name, value in theta.items()}

    def windows(self, theta: dict[str, float]) -> list[Window]:
        slope = 1.0 + 2.0 * self.curvature * np.abs(self._floors(self._sizes(theta))) / 30.0
        left = self.residuals(theta)
        return [
            replace(w, residual=r, effects=w.effects * slope) for w, r in zip(self._windows, left)
        ]

    def residuals(
        self, theta: dict[str, float], about: Linearised | None = None
    ) -> list[np.ndarray]:
        sizes = self._sizes(theta)
        return [w.residual - self._answer(w.effects, sizes) for w in self._windows]


def alter_windows(change: Callable[[SyntheticModel, Window], Window], **options) -> SyntheticModel:
    """Return flights with a change applied to each of their windows."""
    model = SyntheticModel(**options)
    model._windows = [change(model, w) for w in model._windows]
    return model


def push_window(model: SyntheticModel, window: Window, **sizes: float) -> Window:
    """Return a window in which effects of some sizes, in floors, act besides."""
    return replace(window, residual=window.residual + model._answer(window.effects, sizes))
