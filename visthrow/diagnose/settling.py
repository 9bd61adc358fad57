"""Initial states of replay windows fitted to their samples by Levenberg and Marquardt, all windows at once."""

import dataclasses

import numpy as np

from sim.replay.kernel import ATTACHED
from sim.replay.lanes import Replay
from visthrow.diagnose.catalogue import Setting
from visthrow.diagnose.replay import Flights, Lane
from visthrow.diagnose.states import Direction, States, concerns, moved, stacked

DAMPING, DAMPING_MOST = 1e-3, 1e5
"""Of the Levenberg-Marquardt steps: at first, and where a window counts as settled."""
ROUNDS = 25
HUBER = 30.0  # deviations, beyond which a sample counts less
SETTLED = 0.003  # relative fall of the cost below which an initial state is settled
MOVED = 0.2  # relative fall of the cost above which derivatives by the initial state are taken anew
ROUGHER = 3.0
"""Added to the square of the step, in the nominal one, for derivatives that only point the way to an initial state: twice as
long steps. Columns keep the nominal step: twice as long ones changed those of rope and release in throws by up to their size.
"""
EARLIER = 0.05  # by which a payload may leave before it is expected to [s]
SEEN = 0.25  # before that, without which an initial state is fitted to the whole window [s]
TRUSTED = ("motor_speed",)
"""Fields that are linearised about where the commands left them. Fitted without gusts they would take the gusts' place: rotors
far from their commands at the start of a window, and with them a law of the thrust's slope that is none."""


class Settling:
    """Fits the states of the windows that count in one setting."""

    def __init__(
        self,
        flights: Flights,
        told: np.ndarray,
        directions: tuple[Direction, ...],
        setting: Setting,
        *,
        lag: float,
        substep: float,
        device: str,
    ):
        """Make ready.

        Args:
            flights: cut into windows.
            told: windows that count.
            directions: in which states may be wrong.
            setting: what is simulated.
            lag: of the release, as far as known [s].
            substep: largest integration step [s].
            device: of the replay.
        """
        self.flights, self.told, self.directions, self.setting = flights, told, directions, setting
        self.lag, self.substep = lag, substep
        self.replay = Replay([setting.plant], [setting.sensing], device)

    def better(self, settled: States, fresh: States) -> States:
        """For each window, the better of two initial states."""
        which = np.arange(len(self.flights.cuts))
        old, new = (np.array([_huber(r) for r in self._residuals(states, which)]) for states in (settled, fresh))
        return {name: np.where(_like(new < old, value), fresh[name], value) for name, value in settled.items()}

    def fit(self, states: States) -> States:
        """Fit each window's initial state to its samples; no step that does not help is taken."""
        count = len(self.flights.cuts)
        moves, damping = np.zeros((count, len(self.directions))), np.full(count, DAMPING)
        left, cost = self.told, np.full(count, np.inf)
        stale, aged = np.ones(count, dtype=bool), np.zeros(count, dtype=bool)
        residuals = dict(zip(left, self._residuals(states, left)))
        cost[left] = [_huber(residuals[w]) for w in left]
        slopes: dict[int, np.ndarray] = {}
        for _ in range(ROUNDS):
            slopes |= self._slopes(states, left[stale[left]])
            aged &= ~stale
            trial = np.zeros_like(moves)
            for w in left:
                trial[w] = self._increment(w, slopes[w], residuals[w], moves[w], damping[w])
            there = self._moved(states, trial)
            tried, seen = np.full(count, np.inf), dict(zip(left, self._residuals(there, left)))
            tried[left] = [_huber(seen[w]) for w in left]
            better = tried < cost
            residuals |= {w: seen[w] for w in left if better[w]}
            states = {name: np.where(_like(better, v), there[name], v) for name, v in states.items()}
            moves[better] += trial[better]
            little = better & (tried > (1.0 - SETTLED) * cost)
            settled = little & ~aged  # by derivatives from elsewhere a step may be short though the goal is far
            stale = np.where(better, (tried < (1.0 - MOVED) * cost) | little, aged)
            damping = np.where(better, damping / 10.0, np.where(aged, damping, damping * 10.0))
            aged, cost = aged | better, np.where(better, tried, cost)
            left = left[~settled[left] & (damping[left] < DAMPING_MOST)]
            if not len(left):
                break
        return states

    def _moved(self, states: States, sizes: np.ndarray) -> States:
        """States moved along all directions by ``sizes``, shape (windows, directions)."""
        for d, direction in enumerate(self.directions):
            states = moved(states, direction, sizes[:, d])
        return states

    def _residuals(self, states: States, which: np.ndarray) -> list[np.ndarray]:
        """Residuals of windows in the noise, of what tells of their initial states."""
        f = self.flights
        seen = f.fly(self.replay, [self.setting], states, [Lane(w, 0, w) for w in which], self.substep).seen
        return [self._tells_of_start(w) * f.residual(seen, w, lane) / f.sigma(w) for lane, w in enumerate(which)]

    def _tells_of_start(self, w: int) -> np.ndarray:
        """1 for samples before the payload may have left, 0 for later ones, which tell of the release; all 1 where few are left."""
        c, time = self.flights.cuts[w], self.flights.time(w)
        left = self.flights.flights[c.flight].latch + self.lag - EARLIER
        if c.payload != ATTACHED or not c.start + SEEN < left < c.end:
            return np.ones(len(time))
        return (time < left).astype(float)

    def _fitted(self, w: int) -> list[int]:
        """Directions in which a window's initial state is fitted."""
        cut = self.flights.cuts[w]
        return [d for d, x in enumerate(self.directions) if concerns(x, cut) and x.field not in TRUSTED]

    def _slopes(self, states: States, which: np.ndarray) -> dict[int, np.ndarray]:
        """Derivatives of windows' samples by their initial states, in the noise."""
        if not len(which):
            return {}
        count, lanes, first = len(self.flights.cuts), [], []
        for w in which:
            first.append(len(lanes))
            lanes += [Lane(w, 0, w), *[Lane(w, 0, (1 + d) * count + w) for d in self._fitted(w)]]
        there = perturbed(states, self.directions)
        seen = self.flights.fly(self.replay, [_rougher(self.setting)], there, lanes, self.substep).seen
        slopes = {}
        for at, w in zip(first, which):
            ds, rows = self._fitted(w), int(self.flights.rows[w])
            flat = np.swapaxes(seen[:rows, at : at + 1 + len(ds)], 1, 2).reshape(3 * rows, -1)
            steps = np.array([self.directions[d].step for d in ds])
            slopes[w] = (flat[:, 1:] - flat[:, :1]) / steps * (self._tells_of_start(w) / self.flights.sigma(w))[:, None]
        return slopes

    def _increment(self, w: int, slopes: np.ndarray, residual: np.ndarray, done: np.ndarray, damping: float) -> np.ndarray:
        """Levenberg-Marquardt step of a window's state, with its vague prior; shape (directions,)."""
        ds = self._fitted(w)
        sd = np.array([self.directions[d].sd for d in ds])
        weight = np.minimum(1.0, HUBER / np.maximum(np.abs(residual), 1e-12))
        scaled = slopes * sd
        normal = scaled.T @ (scaled * weight[:, None]) + np.eye(len(ds))
        normal += damping * np.diag(np.diag(normal))
        wanted = scaled.T @ (residual * weight) - done[ds] / sd
        out = np.zeros(len(done))
        out[ds] = np.linalg.solve(normal, wanted) * sd
        return out


def perturbed(states: States, directions: tuple[Direction, ...]) -> States:
    """The states, and after them each direction's perturbed ones: row ``(1 + d) W + w``."""
    return stacked([states, *[moved(states, d, d.step) for d in directions]])


def _like(mask: np.ndarray, value: np.ndarray) -> np.ndarray:
    """The mask with as many axes as a value."""
    return mask.reshape(-1, *[1] * (value.ndim - 1))


def _rougher(setting: Setting) -> Setting:
    """The setting with longer steps, for lanes that only point the way."""
    return dataclasses.replace(setting, step_square=setting.step_square + ROUGHER)


def _huber(residual: np.ndarray) -> float:
    """Huber's cost of residuals in the noise; infinite where one is not finite."""
    off = np.abs(residual)
    cost = float(np.sum(np.where(off < HUBER, 0.5 * off**2, HUBER * (off - 0.5 * HUBER))))
    return cost if np.isfinite(cost) else np.inf
