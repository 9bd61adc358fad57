"""Terms of laws outside the catalogue: a force or torque that is a coefficient times up to two
scalars times a vector.

Every factor has a unit, from which the coefficient's unit follows. Vectors are made of body axes,
the world's vertical, the rope and velocities, so a law does not depend on the heading of the world
frame. A term is plain data (:class:`Term`), from which the simulator can build a block.

A torque in the rope's joint acts on both sides: M on the vehicle, -M on the rope. With the rope's
direction n and its length l to the payload's centre, the couple -M on a straight rope is equivalent
to a pair of forces,

    F_p = (-M x n) / l on the payload,   -F_p at the mount,

so it is a combination of the latent forces of three blocks (:func:`loads`), and momentum is
conserved."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations_with_replacement

import numpy as np
from numpy import ndarray

from sim.law_factors import LAW_FACTORS, UNITS, definition
from sim.params import LOWEST, MOST_FACTORS, SLOWEST, LawParams
from visthrow.common.rotations import cross, normal_part, rotate, rotate_back
from visthrow.diagnose.models.model_interface import LATENT_BLOCKS

Knots = Mapping[str, ndarray]

JOINT = "rope joint"  # block of the torque between vehicle and rope; it acts on all latent blocks
BLOCKS = (*LATENT_BLOCKS, JOINT)  # blocks on which a term can act
SYMBOLS = dict(zip(BLOCKS, ("F", "M", "F_p", "M_j")))
BASE_UNITS = ("kg", "m", "s")
OF_PAYLOAD = ("payload_pos_w", "payload_vel_w", "tension")  # quantities at the knots of a replay


class KnotValues(dict):
    """Quantities at the knots, and derived quantities, which are computed at their first use."""

    def __missing__(self, name: str) -> ndarray:
        """Compute a quantity by its definition."""
        if name in UNITS:
            value = np.tile(UNITS[name], (len(self["time"]), 1))
        elif name == "slope":
            value = _slope(self["thrust"], self["time"])
        else:
            operation, *names = definition(name)
            value = OPERATIONS[operation](*[self[part] for part in names])
        self[name] = value
        return value


@dataclass(frozen=True)
class Factor:
    """A scalar or a vector of the state."""

    symbol: str
    unit: str  # product of BASE_UNITS with exponents
    quantity: str  # at the knots, (k,) for a scalar, (k, 3) for a vector, in the block's frame
    needs: frozenset[str]  # keys of Window.knots

    def read(self, values: KnotValues) -> ndarray:
        """Return the factor's values at the knots."""
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
        """Return the number of factors, including the vector."""
        return len(self.parts)

    @property
    def parts(self) -> list[Factor]:
        """Return the scalars, then the vector."""
        return [*(SCALARS[name] for name in self.factors), VECTORS[self.block][self.vector]]

    def read(self, values: KnotValues) -> ndarray:
        """Return the force or torque at the knots with a coefficient of 1, shape (k, 3)."""
        vector = VECTORS[self.block][self.vector].read(values)
        scalars = [SCALARS[name].read(values)[:, None] for name in self.factors]
        return math.prod(scalars, start=vector)

    def law(self, coefficient: float) -> LawParams:
        """Return the law with a coefficient."""
        return LawParams(self.block, self.factors, self.vector, coefficient)

    @property
    def needs(self) -> set[str]:
        """Return the keys of Window.knots on which the factors depend."""
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
        """Return the law's formula with coefficient c."""
        return f"{SYMBOLS[self.block]} = c {' '.join(factor.symbol for factor in self.parts)}"


def describe_knots(
    flown: Knots, time: ndarray, mount: Sequence[float] | None
) -> dict[str, ndarray]:
    """Add times [s], mount and cable direction to the quantities that a replay returned at knots.

    ``mount``: attachment of the cable [m, body frame, from the centre of mass]; None without a
    payload, whose quantities are then dropped."""
    values = {**flown, "time": time}
    if mount is None:
        return {name: value for name, value in values.items() if name not in OF_PAYLOAD}
    values["mount_b"] = np.tile(mount, (len(time), 1))
    reach = KnotValues(values)["reach_w"]
    values["cable_dir_w"] = reach / np.linalg.norm(reach, axis=1, keepdims=True)
    return values


def term_of(law: LawParams) -> Term:
    """Return the term of a law."""
    return Term(law.block, law.factors, law.vector)


def exert(laws: Sequence[LawParams], values: Knots) -> dict[str, ndarray]:
    """Return the forces and torques of laws in each latent block at states with these quantities,
    shape (k, 3); empty without laws.
    """
    values = KnotValues(values)
    total = {}
    for law in laws:
        value = law.coefficient * term_of(law).read(values)
        for block, load in loads(law.block, values, value[:, :, None]).items():
            total[block] = total.get(block, 0.0) + load[:, :, 0]
    return total


def carries(latent_block: ndarray, block: str) -> bool:
    """Return whether a window has all latents on which terms of a block act."""
    latent_blocks = LATENT_BLOCKS if block == JOINT else (block,)
    return all(LATENT_BLOCKS.index(name) in latent_block for name in latent_blocks)


def _dot(a: ndarray, b: ndarray) -> ndarray:
    return np.einsum("ki,ki->k", a, b)


def _slope(thrust: ndarray, time: ndarray) -> ndarray:
    return np.gradient(thrust, time) if len(thrust) > 1 else np.zeros(len(thrust))


def _size(vector: ndarray) -> ndarray:
    return np.linalg.norm(vector, axis=1)


def _scale(factor: ndarray, vector: ndarray) -> ndarray:
    return factor[:, None] * vector


def _inverse(value: ndarray) -> ndarray:
    """Return 1 over values, which are limited to at least :data:`sim.params.LOWEST`."""
    return 1.0 / np.maximum(value, LOWEST)


def _saturate(vector: ndarray) -> ndarray:
    """Return the direction of a velocity; shorter than a unit vector at low speed."""
    return vector / np.hypot(_size(vector), SLOWEST)[:, None]


def _turn_rate(arm: ndarray, arm_vel: ndarray) -> ndarray:
    """Return the angular rate of an arm whose end moves relative to its root [1/s]."""
    return cross(arm, arm_vel) / _dot(arm, arm)[:, None]


OPERATIONS: dict[str, Callable[..., ndarray]] = {
    "to_world": rotate,
    "to_body": rotate_back,
    "cross": cross,
    "inner": _dot,
    "size": _size,
    "absolute": np.abs,
    "sum": np.add,
    "difference": np.subtract,
    "normal_part": normal_part,
    "scaled": _scale,
    "inverse": _inverse,
    "saturated": _saturate,
    "turn_rate": _turn_rate,
}
"""Operations of :data:`sim.law_factors.QUANTITIES` on arrays at the knots."""


def _factors(rows: Mapping[str, Sequence[str]]) -> dict[str, Factor]:
    """Make the factors of a table of ``sim/law_factors.toml``."""
    factors = {}
    for name, (symbol, unit, quantity, words) in rows.items():
        groups = [LAW_FACTORS["groups"].get(word, [word]) for word in words.split()]
        factors[name] = Factor(symbol, unit, quantity, frozenset().union(*groups))
    return factors


MEASURED = LAW_FACTORS["measured"]  # factors that are not simulated, only logged

SCALARS = _factors(LAW_FACTORS["scalars"] | MEASURED["scalars"])
"""Scalars by name."""

ONLY_JOINT = ("joint_rate",)  # scalars that only terms in the rope's joint may have

VECTORS = {
    block: _factors(rows | MEASURED["vectors"].get(block, {}))
    for block, rows in LAW_FACTORS["vectors"].items()
}
"""Vectors by block and name, in that block's frame: world for forces, body for torques."""


@lru_cache(maxsize=32)
def terms_of(block: str, quantities: tuple[str, ...]) -> tuple[Term, ...]:
    """Return all terms of a block that these quantities allow, simplest first."""
    have = set(quantities)
    scalars = [name for name, factor in SCALARS.items() if factor.needs <= have]
    vectors = [name for name, factor in VECTORS[block].items() if factor.needs <= have]
    if block != JOINT:
        scalars = [name for name in scalars if name not in ONLY_JOINT]
    terms = []
    for count in range(MOST_FACTORS + 1):
        for factors in combinations_with_replacement(scalars, count):
            terms += [Term(block, factors, vector) for vector in vectors]
    return tuple(terms)


def table(terms: Sequence[Term], values: KnotValues) -> ndarray:
    """Return the forces or torques of all terms of :func:`terms_of` at the knots with a coefficient
    of 1, shape (k, 3, T). Each product of scalars, and each vector, is computed once.
    """
    vectors = VECTORS[terms[0].block]
    names = dict.fromkeys(term.vector for term in terms)
    directions = np.stack([vectors[name].read(values) for name in names], axis=-1)
    products = {(): np.ones(len(directions))}
    for factors in filter(None, dict.fromkeys(term.factors for term in terms)):
        products[factors] = products[factors[:-1]] * SCALARS[factors[-1]].read(values)
    every = np.stack([*products.values()], axis=-1)[:, None, :, None] * directions[:, :, None]
    return every.reshape(len(directions), 3, len(terms))


def loads(block: str, knots: KnotValues, values: ndarray) -> dict[str, ndarray]:
    """Return the loads of terms on each latent block; a torque in the joint acts on vehicle and
    payload.

    ``values``: of the terms, shape (k, 3, T), in the block's frame.
    Returns the latent block's forces [N, world] or torques [N m, body], shape (k, 3, T).
    """
    if block != JOINT:
        return {block: values}
    hangs = knots["tension"] > 0.0  # a slack rope carries no torque
    torque_b = np.swapaxes(values, 1, 2) * hangs[:, None, None]
    reach = knots["reach_w"][:, None, :]
    turn = np.stack([knots[f"axis_{i}"] for i in "xyz"], axis=-1)  # body to world
    torque_w = np.einsum("kij,ktj->kti", turn, torque_b)
    pair = -cross(torque_w, reach) / (reach**2).sum(-1, keepdims=True)
    at_mount = cross(knots["mount_b"][:, None, :], -np.einsum("kij,kti->ktj", turn, pair))
    out = {"vehicle force": -pair, "vehicle torque": torque_b + at_mount, "payload force": pair}
    return {name: np.swapaxes(value, 1, 2) for name, value in out.items()}
