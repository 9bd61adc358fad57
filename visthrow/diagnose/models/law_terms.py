"""Laws outside the catalogue: a force or torque as coefficient times up to two scalars times one
vector.

Every factor has a unit, so the coefficient's unit follows; vectors are made of body axes, world
vertical, rope and velocities, so that a law means the same after the world is turned about the
vertical. A term is plain data (:class:`Term`), from which the simulator can build a block.

A torque in the rope's joint acts on both sides: M on the vehicle, -M on the rope. With n the rope's
direction and l its length to the payload's centre, the couple -M on a rope that is straight does
what a pair of forces does,

    F_p = (-M x n) / l on the payload,   -F_p at the mount,

so that the latent forces of three blocks together carry it (:func:`loads`) and momentum is
conserved."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from numpy import ndarray

from sim.law_factors import LAW_FACTORS
from sim.params import LOWEST, SLOWEST, LawParams
from visthrow.common.errors import ConfigError, suggest
from visthrow.common.rotations import cross, normal_part, rotate, rotate_back
from visthrow.diagnose.models.model_interface import LATENT_BLOCKS

Knots = Mapping[str, ndarray]

JOINT = (  # block of the torque between vehicle and rope, which acts in all latent blocks at once
    "rope joint"
)
BLOCKS = (*LATENT_BLOCKS, JOINT)  # what a term can act on
SYMBOLS = dict(zip(BLOCKS, ("F", "M", "F_p", "M_j")))
BASE_UNITS = ("kg", "m", "s")


class KnotValues(dict):
    """Quantities at the knots, and what follows from them, computed when it is first asked for."""

    def __missing__(self, name: str) -> ndarray:
        """Compute a size, a cross product, or one of the quantities of ``DERIVED``."""
        first, crossed, second = name.partition(" x ")
        if name.startswith("|"):
            value = _size(self[name.strip("|")])
        elif crossed:
            value = cross(self[first], self[second])
        else:
            value = DERIVED[name](self)
        self[name] = value
        return value


@dataclass(frozen=True)
class Factor:
    """A scalar or a vector of the state."""

    symbol: str
    unit: str  # of BASE_UNITS with their exponents
    quantity: str  # at the knots, (k,) for a scalar, (k, 3) for a vector, in the block's frame
    needs: frozenset[str]  # keys of Window.knots

    def read(self, values: KnotValues) -> ndarray:
        """Return its values at the knots."""
        return values[self.quantity]

    @property
    def exponents(self) -> ndarray:
        """Return the exponents of kg, m and s."""
        powers = dict(part.partition("^")[::2] for part in self.unit.split())
        return np.array([int(powers[u] or 1) if u in powers else 0 for u in BASE_UNITS])


@dataclass(frozen=True)
class Term:
    """One law without its coefficient."""

    block: str  # of BLOCKS
    factors: tuple[str, ...]  # keys of SCALARS
    vector: str  # key of VECTORS[block]

    @property
    def depth(self) -> int:
        """Number of factors."""
        return len(self.parts)

    @property
    def parts(self) -> list[Factor]:
        """Scalars, then the vector."""
        return [*(SCALARS[name] for name in self.factors), VECTORS[self.block][self.vector]]

    def read(self, values: KnotValues) -> ndarray:
        """Return what it exerts at the knots with a coefficient of 1, shape (k, 3)."""
        vector = VECTORS[self.block][self.vector].read(values)
        return _product(self.factors, values)[:, None] * vector

    def law(self, coefficient: float) -> LawParams:
        """The law that it is with a coefficient."""
        return LawParams(self.block, self.factors, self.vector, coefficient)

    @property
    def needs(self) -> set[str]:
        """Keys of Window.knots that its factors are made of."""
        return set().union(*(factor.needs for factor in self.parts))

    @property
    def unit(self) -> str:
        """Return the coefficient's unit, such that the term is a force [N] or, on the vehicle and
        in the joint, a torque [N m].
        """
        target = (1, 2, -2) if self.block in ("vehicle torque", JOINT) else (1, 1, -2)
        remaining = np.array(target) - sum(factor.exponents for factor in self.parts)
        powers = [u if n == 1 else f"{u}^{n}" for u, n in zip(BASE_UNITS, remaining) if n]
        return " ".join(powers) or "1"

    @property
    def formula(self) -> str:
        """The right-hand side with coefficient c."""
        return f"{SYMBOLS[self.block]} = c {' '.join(factor.symbol for factor in self.parts)}"


def term_of(law: LawParams) -> Term:
    """The term of a law that a file holds.

    Raises ConfigError: a factor or vector that the grammar does not have there.
    """
    for name, present in (
        (law.vector, VECTORS[law.block]),
        *((factor, SCALARS) for factor in law.factors),
    ):
        if name not in present:
            raise ConfigError(f"law on {law.block}: no '{name}'; {suggest(name, present)}")
    if len(law.factors) > MOST_SCALARS:
        raise ConfigError(
            f"law on {law.block}: {len(law.factors)} factors; expected at most {MOST_SCALARS}"
        )
    return Term(law.block, law.factors, law.vector)


def exerted(laws: Sequence[LawParams], values: Knots) -> dict[str, ndarray]:
    """Return the forces and torques of laws in each latent block at states with these quantities,
    shape (k, 3); empty without laws.
    """
    values = KnotValues(values)
    total = {}
    for law in laws:
        value = law.coefficient * Term(law.block, law.factors, law.vector).read(values)
        for block, load in loads(law.block, values, value[:, :, None]).items():
            total[block] = total.get(block, 0.0) + load[:, :, 0]
    return total


def carries(latent_block: ndarray, block: str) -> bool:
    """Whether a window has all latents that terms of a block act through."""
    latent_blocks = LATENT_BLOCKS if block == JOINT else (block,)
    return all(LATENT_BLOCKS.index(name) in latent_block for name in latent_blocks)


def _product(factors: Sequence[str], values: KnotValues) -> ndarray:
    """Return the product of scalars at the knots, shape (k,)."""
    scalars = (SCALARS[name].read(values) for name in factors)
    return math.prod(scalars, start=np.ones(len(values["time"])))


def _dot(a: ndarray, b: ndarray) -> ndarray:
    return np.einsum("ki,ki->k", a, b)


def _in_world(name: str) -> Callable[[KnotValues], ndarray]:
    return lambda k: rotate(k["quat_wb"], k[name])


def _in_body(name: str) -> Callable[[KnotValues], ndarray]:
    return lambda k: rotate_back(k["quat_wb"], k[name])


def _unit(i: int) -> Callable[[KnotValues], ndarray]:
    axis = np.eye(3)[i]
    return lambda k: np.tile(axis, (len(k["time"]), 1))


def _slope(k: KnotValues) -> ndarray:
    thrust = k["thrust"]
    return np.gradient(thrust, k["time"]) if len(thrust) > 1 else np.zeros(len(thrust))


def _reach(k: KnotValues) -> ndarray:
    """Return the vector from the mount to the payload's centre [m], world frame."""
    return k["payload_pos_w"] - k["pos_w"] - rotate(k["quat_wb"], k["mount_b"])


def _joint_rate(k: KnotValues) -> ndarray:
    """Rate of the rope against the vehicle [1/s], body frame; 0 where nothing hangs on it."""
    reach = k["reach_w"]
    mount_vel = k["vel_w"] + rotate(k["quat_wb"], cross(k["rate_b"], k["mount_b"]))
    rope_rate = cross(reach, k["payload_vel_w"] - mount_vel) / _dot(reach, reach)[:, None]
    return (k["tension"] > 0.0)[:, None] * (rotate_back(k["quat_wb"], rope_rate) - k["rate_b"])


def _friction(k: KnotValues) -> ndarray:
    """Direction of that rate, and less than a unit vector where it is slow."""
    return k["joint_rate_b"] / np.hypot(k["|joint_rate_b|"], SLOWEST)[:, None]


def _spring(k: KnotValues) -> ndarray:
    """Return the direction that turns the vehicle's axis against the rope, body frame; 0 where
    nothing hangs on it.
    """
    return (k["tension"] > 0.0)[:, None] * k["unit_z x cable_dir_b"]


def _size(value: ndarray) -> ndarray:
    return np.abs(value) if value.ndim == 1 else np.linalg.norm(value, axis=1)


DERIVED: dict[str, Callable[[KnotValues], ndarray]] = {
    "axis_x": _in_world("unit_x"),
    "axis_y": _in_world("unit_y"),
    "axis_z": _in_world("unit_z"),
    "unit_x": _unit(0),
    "unit_y": _unit(1),
    "unit_z": _unit(2),
    "slope": _slope,
    "swing": lambda k: normal_part(k["payload_vel_w"] - k["vel_w"], k["cable_dir_w"]),
    "along": lambda k: _dot(k["vel_w"], k["axis_z"]),
    "across": lambda k: normal_part(k["vel_w"], k["axis_z"]),
    "under": lambda k: -_dot(k["cable_dir_w"], k["axis_z"]),
    "vel_b": _in_body("vel_w"),
    "cable_dir_b": _in_body("cable_dir_w"),
    "reach_w": _reach,
    "joint_rate_b": _joint_rate,
    "friction": _friction,
    "spring": _spring,
    "speed_across_squared": lambda k: k["|across|"] ** 2,
    "rate_yaw": lambda k: k["rate_b"][:, 2],
    "rate_w": _in_world("rate_b"),
    "swing_b": _in_body("swing"),
    "inverse_height": lambda k: 1.0 / np.maximum(k["pos_w"][:, 2], LOWEST),
    "apart": lambda k: k["pos_w"] - k["neighbour_pos_w"],
    "inverse_distance": lambda k: 1.0 / np.maximum(k["|apart|"], LOWEST),
    "neighbour": lambda k: k["apart"] * k["inverse_distance"][:, None],
    "distance_upright": lambda k: k["neighbour"][:, 2],
    "sideways": lambda k: normal_part(k["cable_dir_w"], k["axis_z"]),
}
"""What :class:`KnotValues` computes of the quantities at the knots."""


def _factors(rows: Mapping[str, Sequence[str]]) -> dict[str, Factor]:
    """Return the factors of a table of the file."""
    factors = {}
    for name, (symbol, unit, quantity, words) in rows.items():
        groups = [LAW_FACTORS["groups"].get(word, [word]) for word in words.split()]
        factors[name] = Factor(symbol, unit, quantity, frozenset().union(*groups))
    return factors


MEASURED = LAW_FACTORS["measured"]  # factors of what a log alone holds: no simulator flies them

SCALARS = _factors(LAW_FACTORS["scalars"] | MEASURED["scalars"])
"""Scalars of a term."""

ONLY_JOINT = ("joint_rate",)  # scalars of terms in the rope's joint alone

VECTORS = {
    block: _factors(rows | MEASURED["vectors"].get(block, {}))
    for block, rows in LAW_FACTORS["vectors"].items()
}
"""Vectors of a term by block, in that block's frame: world for forces, body for torques."""

MOST_SCALARS = 2


def terms_of(block: str, quantities: Sequence[str]) -> list[Term]:
    """All terms of a block whose factors can be made of these knots, simplest first."""
    have = set(quantities)
    scalars = [name for name, factor in SCALARS.items() if factor.needs <= have]
    vectors = [name for name, factor in VECTORS[block].items() if factor.needs <= have]
    if block != JOINT:
        scalars = [name for name in scalars if name not in ONLY_JOINT]
    terms = []
    for count in range(MOST_SCALARS + 1):
        for factors in combinations_with_replacement(scalars, count):
            terms += [Term(block, factors, vector) for vector in vectors]
    return terms


def table(terms: Sequence[Term], values: KnotValues) -> ndarray:
    """Return what all terms of :func:`terms_of` exert at the knots with a coefficient of 1, shape
    (k, 3, T); the scalars of each are multiplied once.
    """
    vectors = VECTORS[terms[0].block]
    names = dict.fromkeys(term.vector for term in terms)
    factors = dict.fromkeys(term.factors for term in terms)
    directions = np.stack([vectors[name].read(values) for name in names], axis=-1)
    products = np.stack([_product(scalars, values) for scalars in factors], axis=-1)
    every = products[:, None, :, None] * directions[:, :, None, :]
    return every.reshape(len(directions), 3, len(terms))


def loads(block: str, knots: KnotValues, values: ndarray) -> dict[str, ndarray]:
    """Return the loads of terms in each latent block: a torque in the joint acts on the vehicle, on
    the rope and, by it, on the payload.

    ``values``: of the terms, shape (k, 3, T), in the block's frame.
    Returns the latent block's forces [N, world] or torques [N m, body], shape (k, 3, T).
    """
    if block != JOINT:
        return {block: values}
    torque_b = np.swapaxes(values, 1, 2)
    reach = knots["reach_w"][:, None, :]
    turn = np.stack([knots[f"axis_{i}"] for i in "xyz"], axis=-1)  # body to world
    torque_w = np.einsum("kij,ktj->kti", turn, torque_b)
    pair = -cross(torque_w, reach) / (reach**2).sum(-1, keepdims=True)
    at_mount = cross(knots["mount_b"][:, None, :], -np.einsum("kij,kti->ktj", turn, pair))
    out = {"vehicle force": -pair, "vehicle torque": torque_b + at_mount, "payload force": pair}
    return {name: np.swapaxes(value, 1, 2) for name, value in out.items()}
