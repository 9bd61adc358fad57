"""Laws outside the catalogue: a force or torque as coefficient times up to two scalars times one vector.

Every factor has a unit, so the coefficient's unit follows; vectors are made of body axes, world vertical, rope and velocities, so
that a law means the same after the world is turned about the vertical. A term is plain data (:class:`Term`), from which the
simulator can build a block.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np

from visthrow.diagnose.model import LATENT_BLOCKS

Unit = tuple[int, int, int]
"""Exponents of kg, m and s."""

Knots = Mapping[str, np.ndarray]

LOWEST = 0.05
"""Height [m] below which 1/z is held, so that a pose at the ground stays finite."""


@dataclass(frozen=True)
class Factor:
    """A scalar or a vector of the state."""

    symbol: str
    unit: Unit
    needs: tuple[str, ...]  # keys of Window.knots
    values: Callable[[Knots], np.ndarray]  # (k,) for a scalar, (k, 3) for a vector, in the block's frame


@dataclass(frozen=True)
class Term:
    """One law without its coefficient."""

    block: str  # of visthrow.diagnose.model.LATENT_BLOCKS
    factors: tuple[str, ...]  # keys of SCALARS
    vector: str  # key of VECTORS[block]

    @property
    def depth(self) -> int:
        """Number of factors."""
        return len(self.factors) + 1

    @property
    def unit(self) -> str:
        """Of the coefficient, such that the term is a force [N] or, on the vehicle's torque, a torque [N m]."""
        target = (1, 2, -2) if self.block == "vehicle torque" else (1, 1, -2)
        parts = [SCALARS[f].unit for f in self.factors] + [VECTORS[self.block][self.vector].unit]
        return unit_text(tuple(t - sum(p[i] for p in parts) for i, t in enumerate(target)))

    @property
    def formula(self) -> str:
        """The right-hand side with coefficient c."""
        symbols = [SCALARS[f].symbol for f in self.factors] + [VECTORS[self.block][self.vector].symbol]
        left = {"vehicle force": "F", "vehicle torque": "M", "payload force": "F_p"}[self.block]
        return f"{left} = c {' '.join(symbols)}"

    def values(self, knots: Knots) -> np.ndarray:
        """The term without its coefficient at the knots, shape (k, 3), in the frame of its block."""
        vector = VECTORS[self.block][self.vector].values(knots)
        for factor in self.factors:
            vector = vector * SCALARS[factor].values(knots)[:, None]
        return vector


def rotate(knots: Knots, vector_b: np.ndarray) -> np.ndarray:
    """Body to world at the knots, shape (k, 3)."""
    q = np.asarray(knots["quat_wb"], dtype=float)
    axis, w = q[:, :3], q[:, 3:]
    cross = 2.0 * np.cross(axis, vector_b)
    return vector_b + w * cross + np.cross(axis, cross)


def rotate_back(knots: Knots, vector_w: np.ndarray) -> np.ndarray:
    """World to body at the knots, shape (k, 3)."""
    return rotate({"quat_wb": np.asarray(knots["quat_wb"]) * [-1.0, -1.0, -1.0, 1.0]}, vector_w)


def _axis(i: int) -> Callable[[Knots], np.ndarray]:
    return lambda k: rotate(k, np.tile(np.eye(3)[i], (len(k["quat_wb"]), 1)))


def _fixed(i: int, like: str = "time") -> Callable[[Knots], np.ndarray]:
    return lambda k: np.tile(np.eye(3)[i], (len(k[like]), 1))


def _along(k: Knots) -> np.ndarray:
    return np.einsum("ki,ki->k", k["vel_w"], _axis(2)(k))


def _across(k: Knots) -> np.ndarray:
    return k["vel_w"] - _along(k)[:, None] * _axis(2)(k)


def _slope(k: Knots) -> np.ndarray:
    return np.gradient(k["thrust"], k["time"]) if len(k["time"]) > 1 else np.zeros(len(k["time"]))


def _swing(k: Knots) -> np.ndarray:
    """Velocity of the payload against the vehicle, across the rope."""
    relative, n = k["payload_vel_w"] - k["vel_w"], k["cable_dir_w"]
    return relative - np.einsum("ki,ki->k", relative, n)[:, None] * n


def _under(k: Knots) -> np.ndarray:
    return -np.einsum("ki,ki->k", k["cable_dir_w"], _axis(2)(k))


def _aside(k: Knots) -> np.ndarray:
    """The rope's direction across the rotors' axis."""
    return k["cable_dir_w"] + _under(k)[:, None] * _axis(2)(k)


def _size(vector: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vector, axis=1)


_POSE, _MOVES = ("quat_wb",), ("vel_w", "quat_wb")
_PAIR = ("payload_vel_w", "vel_w", "cable_dir_w")

SCALARS: dict[str, Factor] = {
    "thrust": Factor("T", (1, 1, -2), ("thrust",), lambda k: k["thrust"]),
    "thrust_rate": Factor("dT/dt", (1, 1, -3), ("thrust", "time"), _slope),
    "abs_thrust_rate": Factor("|dT/dt|", (1, 1, -3), ("thrust", "time"), lambda k: np.abs(_slope(k))),
    "speed": Factor("|v|", (0, 1, -1), ("vel_w",), lambda k: _size(k["vel_w"])),
    "speed_across": Factor("v_xy", (0, 1, -1), _MOVES, lambda k: _size(_across(k))),
    "speed_across_squared": Factor("v_xy²", (0, 2, -2), _MOVES, lambda k: _size(_across(k)) ** 2),
    "speed_along": Factor("v_z", (0, 1, -1), _MOVES, _along),
    "rate": Factor("|ω|", (0, 0, -1), ("rate_b",), lambda k: _size(k["rate_b"])),
    "rate_yaw": Factor("ω_z", (0, 0, -1), ("rate_b",), lambda k: k["rate_b"][:, 2]),
    "inverse_height": Factor("1/z", (0, -1, 0), ("pos_w",), lambda k: 1.0 / np.maximum(k["pos_w"][:, 2], LOWEST)),
    "tension": Factor("S", (1, 1, -2), ("tension",), lambda k: k["tension"]),
    "payload_speed": Factor("|v_p|", (0, 1, -1), ("payload_vel_w",), lambda k: _size(k["payload_vel_w"])),
    "swing_speed": Factor("|v_s|", (0, 1, -1), _PAIR, lambda k: _size(_swing(k))),
    "cable_under_rotors": Factor("(-n·e_z)", (0, 0, 0), ("cable_dir_w", "quat_wb"), _under),
}  # fmt: skip
"""Scalars of a term."""

VECTORS: dict[str, dict[str, Factor]] = {
    "vehicle force": {
        "body_z": Factor("e_z", (0, 0, 0), _POSE, _axis(2)), "body_x": Factor("e_x", (0, 0, 0), _POSE, _axis(0)),
        "body_y": Factor("e_y", (0, 0, 0), _POSE, _axis(1)), "world_z": Factor("z", (0, 0, 0), ("time",), _fixed(2)),
        "vel": Factor("v", (0, 1, -1), ("vel_w",), lambda k: k["vel_w"]),
        "vel_across": Factor("v_⊥", (0, 1, -1), _MOVES, _across),
        "axis_cross_vel": Factor("(e_z x v)", (0, 1, -1), _MOVES, lambda k: np.cross(_axis(2)(k), k["vel_w"])),
        "rate_cross_vel": Factor("(ω x v)", (0, 1, -2), (*_MOVES, "rate_b"),
                                 lambda k: np.cross(rotate(k, k["rate_b"]), k["vel_w"])),
        "cable": Factor("n", (0, 0, 0), ("cable_dir_w",), lambda k: k["cable_dir_w"]),
        "swing_vel": Factor("v_s", (0, 1, -1), _PAIR, _swing),
    },
    "vehicle torque": {
        "body_x": Factor("e_x", (0, 0, 0), ("time",), _fixed(0)), "body_y": Factor("e_y", (0, 0, 0), ("time",), _fixed(1)),
        "body_z": Factor("e_z", (0, 0, 0), ("time",), _fixed(2)),
        "rate": Factor("ω", (0, 0, -1), ("rate_b",), lambda k: k["rate_b"]),
        "axis_cross_rate": Factor("(e_z x ω)", (0, 0, -1), ("rate_b",), lambda k: np.cross([0.0, 0.0, 1.0], k["rate_b"])),
        "vel": Factor("v", (0, 1, -1), _MOVES, lambda k: rotate_back(k, k["vel_w"])),
        "axis_cross_vel": Factor("(e_z x v)", (0, 1, -1), _MOVES,
                                 lambda k: np.cross([0.0, 0.0, 1.0], rotate_back(k, k["vel_w"]))),
        "axis_cross_cable": Factor("(e_z x n)", (0, 0, 0), ("cable_dir_w", "quat_wb"),
                                   lambda k: np.cross([0.0, 0.0, 1.0], rotate_back(k, k["cable_dir_w"]))),
        "axis_cross_swing": Factor("(e_z x v_s)", (0, 1, -1), (*_PAIR, "quat_wb"),
                                   lambda k: np.cross([0.0, 0.0, 1.0], rotate_back(k, _swing(k)))),
    },
    "payload force": {
        "payload_vel": Factor("v_p", (0, 1, -1), ("payload_vel_w",), lambda k: k["payload_vel_w"]),
        "vertical_cross_vel": Factor("(z x v_p)", (0, 1, -1), ("payload_vel_w",),
                                     lambda k: np.cross([0.0, 0.0, 1.0], k["payload_vel_w"])),
        "world_z": Factor("z", (0, 0, 0), ("time",), _fixed(2)), "body_z": Factor("e_z", (0, 0, 0), _POSE, _axis(2)),
        "cable": Factor("n", (0, 0, 0), ("cable_dir_w",), lambda k: k["cable_dir_w"]),
        "swing_vel": Factor("v_s", (0, 1, -1), _PAIR, _swing),
        "cable_cross_swing": Factor("(n x v_s)", (0, 1, -1), _PAIR, lambda k: np.cross(k["cable_dir_w"], _swing(k))),
        "vel": Factor("v", (0, 1, -1), ("vel_w",), lambda k: k["vel_w"]),
        "sideways": Factor("(n - (n·e_z) e_z)", (0, 0, 0), ("cable_dir_w", "quat_wb"), _aside),
    },
}  # fmt: skip
"""Vectors of a term by latent block, in that block's frame: world for forces, body for torques."""

MOST_SCALARS = 2


def unit_text(unit: Unit) -> str:
    """Write a unit, such as ``kg m^-1``."""
    parts = [name if n == 1 else f"{name}^{n}" for name, n in zip(("kg", "m", "s"), unit) if n]
    return " ".join(parts) or "1"


def terms(block: str, known: Sequence[str]) -> list[Term]:
    """All terms of a block whose factors can be made of these knots, simplest first."""
    have = set(known)
    scalars = [name for name, factor in SCALARS.items() if set(factor.needs) <= have]
    vectors = [name for name, factor in VECTORS[block].items() if set(factor.needs) <= have]
    return [
        Term(block, factors, vector)
        for count in range(MOST_SCALARS + 1)
        for factors in combinations_with_replacement(scalars, count)
        for vector in vectors
    ]


def table_of(terms_: Sequence[Term], knots: Knots) -> np.ndarray:
    """Values of many terms of one block, shape (k, 3, terms); each factor is computed once."""
    scalars = {f: SCALARS[f].values(knots) for f in {f for t in terms_ for f in t.factors}}
    vectors = {v: VECTORS[terms_[0].block][v].values(knots) for v in {t.vector for t in terms_}}
    values = np.empty((len(knots["time"]), 3, len(terms_)))
    for i, term in enumerate(terms_):
        column = vectors[term.vector]
        for factor in term.factors:
            column = column * scalars[factor][:, None]
        values[:, :, i] = column
    return values


def coefficients(latent_block: np.ndarray, latent_axis: np.ndarray, latent_time: np.ndarray, time: np.ndarray, block: str,
                 values: np.ndarray) -> np.ndarray:  # fmt: skip
    """Latent-force coefficients that a term stands for.

    Args:
        latent_block: of each coefficient, shape (L,).
        latent_axis: shape (L,).
        latent_time: of each coefficient's knot [s], shape (L,).
        time: of the knots that ``values`` belong to [s], shape (k,).
        block: of the terms.
        values: shape (k, 3, T).

    Returns:
        Shape (L, T); 0 for other blocks.
    """
    out = np.zeros((len(latent_block), values.shape[2]))
    of_block = np.flatnonzero(np.asarray(latent_block) == LATENT_BLOCKS.index(block))
    at = np.abs(latent_time[of_block, None] - time).argmin(axis=1)
    out[of_block] = values[at, np.asarray(latent_axis, dtype=int)[of_block]]
    return out
