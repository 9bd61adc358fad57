"""Pendulums, and vehicles in slow flight, by another author's generator: nothing is hidden, or a
force outside the catalogue.

    python -m bench.diagnose.small --seeds 8 --ledger small.jsonl

Written from the equations alone. A pendulum is a mass in the plane on a rod, the rod a constraint
(Udwadia and Kalaba 1992), integrated by scipy; its encoder has lines, and scatters. A vehicle in
slow flight is a balance of four thrusts with noise; near the ground they are larger (Cheeseman and
Bennett 1955)."""

import argparse
import json
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from examples.pendulum.swing_model import PendulumModel, PendulumParams
from examples.trim.trim_model import TrimModel, TrimParams
from visthrow.common.errors import VisthrowError
from visthrow.diagnose.models.numeric import NumericModel
from visthrow.diagnose.select import diagnose_flights
from visthrow.logs.flightlog import Channel, FlightLog

G = 9.80665  # [m/s^2]
ROD = 0.25  # [m]
GREASE = 0.03  # [1/s]
LINES = 2.0 * np.pi / 8192
SWING = PendulumParams(G, ROD, 0.0, GREASE, 0.0, 0.0, 1.0, 0.02, 4)
CRAFT = dict(
    mass=1.2, arm=0.17, disc=0.4, map=(0.0, 2.0, 6.0), kappa=0.016
)  # [kg, m, m, N, m]; disc: of all rotors, as one
HOVER = TrimParams(
    "motor_command",
    "pos_w",
    "vel_w",
    1.2,
    G,
    CRAFT["map"],
    15.0,
    0.0,
    (1.0, 1.0, 1.0, 1.0),
    0.17,
    0.016,
    (1.0, -1.0, -1.0, 1.0),
    0.15,
    1.0,
    0.6,
    0.01,
    0.015,
    0.002,
)
PULLS = {
    "brake": ("F_p = c (-n·e_z) (-n·e_z) v_p", lambda v, down, pull: -0.04 * down**2 * v),
    "load": ("F_p = c S v_p", lambda v, down, pull: -0.003 * pull * v),
    "cubic": ("F_p = c |v_p| |v_p| v_p", lambda v, down, pull: -0.012 * (v @ v) * v),
}
"""Forces on a bob of 1 kg by its velocity, the cosine of the rod's angle and the rod's pull: an
eddy current brake below the pivot, a bearing that the load presses, a drag that grows faster than
it should.
"""
GROUND = "F = c 1/z 1/z z"


def record_swing(law: str, rng: np.random.Generator, seconds: float = 20.0) -> FlightLog:
    """One free swing, as its encoder sees it."""
    force = PULLS[law][1] if law else lambda v, down, pull: 0.0 * v

    def slope(t: float, y: np.ndarray) -> np.ndarray:
        r = y[:2]
        v = y[2:]
        n = r / ROD
        free = np.array([0.0, -G]) - GREASE * v
        tie = (
            -(n @ free) - v @ v / ROD
        )  # acceleration along the rod; back to its length where rounding left it
        push = force(v, -n[1], -tie)
        return np.concatenate(
            [
                v,
                free
                + push
                - n * (n @ (free + push) + v @ v / ROD + 2.0 * n @ v + 40.0 * (r @ n - ROD)),
            ]
        )

    begin = rng.uniform(1.2, 2.2) * rng.choice([-1.0, 1.0])
    stamps = np.arange(0.0, seconds, 0.005)
    start = [ROD * np.sin(begin), -ROD * np.cos(begin), 0.0, 0.0]
    path = solve_ivp(slope, (0.0, seconds), start, "DOP853", stamps, rtol=1e-10, atol=1e-12).y
    angle = np.arctan2(path[0], -path[1]) + rng.laplace(0.0, 1e-4, len(stamps))
    return FlightLog({"angle": Channel(stamps, np.round(angle / LINES) * LINES, "rad")})


def record_hover(law: str, rng: np.random.Generator, seconds: float = 25.0) -> FlightLog:
    """Logs of one slow flight up and down, by its motors and a capture."""
    stamps = np.arange(0.0, seconds, 0.02)
    low = rng.uniform(0.2, 0.35)
    high = rng.uniform(1.0, 1.6)
    turn = rng.uniform(0.0, 2.0 * np.pi, 2)
    height = low + 0.5 * (high - low) * (1.0 + np.cos(0.25 * stamps + turn[0]))
    place = np.column_stack(
        [0.3 * np.sin(0.4 * stamps + turn[1]), 0.2 * np.cos(0.3 * stamps), height]
    )
    speed = np.gradient(place, 0.02, axis=0)
    carried = 0.25 * CRAFT["mass"] * (G + np.gradient(np.gradient(height, 0.02), 0.02))
    helped = 1.0 / (1.0 - (CRAFT["disc"] / (4.0 * height)) ** 2) if law else 1.0
    a = CRAFT["map"][2]
    b = CRAFT["map"][1]
    thrust = np.tile((carried / helped)[:, None], (1, 4)) * (
        1.0 + rng.normal(0.0, 0.1, (len(stamps), 4))
    )
    return FlightLog(
        {
            "motor_command": Channel(
                stamps, (-b + np.sqrt(b * b + 4.0 * a * thrust)) / (2.0 * a), "1"
            ),
            "pos_w": Channel(stamps, place + rng.laplace(0.0, 5e-4, place.shape), "m", "world"),
            "vel_w": Channel(stamps, speed, "m/s", "world"),
        }
    )


WORLDS = {
    "pendulum": (record_swing, PendulumModel, SWING, ("", *PULLS)),
    "trim": (record_hover, TrimModel, HOVER, ("", "ground")),
}
"""Generator, model of the diagnosis, numbers that its owner knows, and laws that may be hidden."""


def logs_of(kind: str, law: str, seed: int, count: int = 4) -> list[FlightLog]:
    """Flights of one world."""
    return [WORLDS[kind][0](law, np.random.default_rng([20261126, seed, i])) for i in range(count)]


def model_of(kind: str, logs: list[FlightLog]) -> NumericModel:
    """The model, with the numbers that its owner knows."""
    return WORLDS[kind][1](logs, WORLDS[kind][2])


def formula(kind: str, law: str) -> str:
    """Of a hidden law."""
    return PULLS[law][0] if kind == "pendulum" else GROUND


def diagnose_world(kind: str, law: str, seed: int) -> dict:
    """Fly a world and diagnose it; returns a line of the ledger."""
    line = {"kind": kind, "law": law, "seed": seed}
    try:
        diagnosis = diagnose_flights.explain(model_of(kind, logs_of(kind, law, seed)), seed=seed)
    except (VisthrowError, ValueError, FloatingPointError) as error:
        return line | {"verdict": "failed", "why": str(error)[:200]}
    return line | {
        "verdict": diagnosis.overall,
        "named": list(diagnosis.theta),
        "laws": [x.formula for x in diagnosis.laws[:3]],
        "seconds": diagnosis.seconds,
    }


def main() -> None:
    """Diagnose worlds of every kind."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, required=True, help="of each kind")
    parser.add_argument("--ledger", type=Path, required=True)
    args = parser.parse_args()
    with args.ledger.open("a") as ledger:
        for kind, (*_, laws) in WORLDS.items():
            for law in laws:
                for seed in range(args.seeds):
                    ledger.write(json.dumps(diagnose_world(kind, law, seed)) + "\n")
                    ledger.flush()


if __name__ == "__main__":
    main()
