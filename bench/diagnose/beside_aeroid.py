"""The diagnosis beside ``aeroid`` (PyPI, MIT), an output-error estimator for parameters that its
user names.

Both get the same throws of a ball under motion capture and the same names: drag and wind. Then only
the diagnosis runs, without the names. Worlds come from scipy's integrator; noise is white, or
correlated over 30 ms as a tracker's filter leaves it.

    pip install -c constraints.txt "visthrow[beside]"
    python -m bench.diagnose.beside_aeroid 10 --out bench/diagnose/ledgers/beside-aeroid.json
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from bench.worlds.world import sensor_noise
from visthrow.diagnose.inputs import fit as fitting
from visthrow.diagnose.models.ball import BallModel, BallParams
from visthrow.diagnose.select import diagnose_flights
from visthrow.logs.flightlog import Channel, FlightLog

NAMES = ("ball_drag", "wind_x", "wind_y")
COLOURS = ("", "coloured")
GRAVITY = 9.81
RATE = 200.0
SECONDS = 0.7
THROWS = 4
SIGMA = 5e-4
REST = 60  # samples after which a log's ball lies still
ASSUMED = BallParams(GRAVITY, 0.0, 0.0, 0.3)


def world(seed: int) -> tuple[dict[str, float], np.ndarray, np.ndarray]:
    """Truth, stamps, and paths of all throws, shape (THROWS, T, 3)."""
    rng = np.random.default_rng(seed)
    truth = {
        "ball_drag": float(rng.uniform(0.03, 0.12)),
        **{name: float(rng.uniform(-0.6, 0.6)) for name in NAMES[1:]},
    }
    stamps = np.arange(0.0, SECONDS, 1.0 / RATE)
    paths = []
    for heading in rng.uniform(0.0, 2.0 * np.pi, THROWS):
        speed = rng.uniform(3.0, 6.0)
        start = [0.0, 0.0, 1.5, speed * np.cos(heading), speed * np.sin(heading), 2.5]
        path = solve_ivp(
            lambda _, x: slope(x, truth),
            (0.0, SECONDS),
            start,
            t_eval=stamps,
            rtol=1e-10,
            atol=1e-12,
        )
        paths.append(path.y[:3].T)
    return truth, stamps, np.array(paths)


def slope(state: np.ndarray, size: dict[str, float]) -> np.ndarray:
    """Derivative of positions and velocities of balls, shape (..., 6)."""
    vel = state[3:]
    air = vel - np.array([size["wind_x"], size["wind_y"], 0.0])
    return np.append(vel, -size["ball_drag"] * np.sqrt(air @ air) * air - [0.0, 0.0, GRAVITY])


def estimate_by_aeroid(stamps: np.ndarray, positions: np.ndarray) -> dict[str, tuple[float, float]]:
    """Estimates and standard errors; initial states of the throws are estimated with the
    parameters.
    """
    import aeroid

    states = [f"{what}{axis}{i}" for i in range(THROWS) for what in ("p", "v") for axis in "xyz"]
    places = [name for name in states if name.startswith("p")]
    starts = []
    for path in positions:
        line = np.polynomial.polynomial.polyfit(stamps, path, 3)
        starts += [*line[0], *line[1]]
    begin = {f"start_{name}": float(value) for name, value in zip(states, starts)}

    def dynamics(_, moved, __, p):
        full = moved + np.array([p[f"start_{name}"] for name in states])
        return np.concatenate([slope(full[6 * i : 6 * i + 6], p) for i in range(THROWS)])

    def measured(_, moved, __, p):
        return [moved[states.index(name)] + p[f"start_{name}"] for name in places]

    guess = {"ball_drag": 0.05, "wind_x": 0.1, "wind_y": 0.1}
    model = aeroid.Model(
        states, [], {**guess, **begin}, dynamics, outputs=places, measurement=measured
    )
    columns = np.moveaxis(positions, 0, 1).reshape(len(stamps), -1)
    data = aeroid.FlightData(stamps, dict(zip(places, columns.T)))
    fitted = aeroid.identify(model, data, [*NAMES, *begin], x0=np.zeros(len(states)))
    return {name: (fitted.parameters[name], fitted.stderr[name]) for name in NAMES}


def model_of(stamps: np.ndarray, positions: np.ndarray) -> BallModel:
    """The diagnosis' model of the same throws, cut where they fall."""
    rest = stamps[-1] + np.arange(1, REST) / RATE
    still = [np.concatenate([path, np.tile(path[-1], (len(rest), 1))]) for path in positions]
    time = np.append(stamps, rest)
    return BallModel(
        [FlightLog({"payload_pos_w": Channel(time, path, "m", "world")}) for path in still], ASSUMED
    )


def estimate_by_fit(stamps: np.ndarray, positions: np.ndarray) -> dict[str, tuple[float, float]]:
    """Estimates of the diagnosis' estimator, with the same parameter names."""
    fitted = fitting.fit(model_of(stamps, positions), NAMES)
    return {
        name: (float(fitted.theta[i]), float(np.sqrt(fitted.covariance[i, i])))
        for i, name in enumerate(NAMES)
    }


def compare_world(seed: int, colour: str) -> dict:
    """One world: errors and standard errors of both, seconds, and the diagnosis without names."""
    truth, stamps, paths = world(seed)
    rng = np.random.default_rng([seed, 1])
    positions = paths + SIGMA * np.array([sensor_noise(rng, colour, path.shape) for path in paths])
    line = {"seed": seed, "noise": colour or "white", "truth": truth}
    for who, ask in (("aeroid", estimate_by_aeroid), ("fit", estimate_by_fit)):
        begin = time.perf_counter()
        estimates = ask(stamps, positions)
        line[who] = {
            name: {"error": value - truth[name], "sd": sd}
            for name, (value, sd) in estimates.items()
        }
        line[f"{who}_s"] = time.perf_counter() - begin
    begin = time.perf_counter()
    verdict = diagnose_flights.explain(model_of(stamps, positions), laws=False)
    line |= {
        "explain_s": time.perf_counter() - begin,
        "overall": verdict.overall,
        "named": sorted(verdict.theta),
    }
    reported = {f.name: f for f in verdict.findings if f.verdict in ("FOUND", "CLASS", "CANDIDATE")}
    line["verdicts"] = {name: f.verdict for name, f in reported.items()}
    line["explain"] = {
        name: {"error": reported[name].estimate - truth[name], "sd": reported[name].sd}
        for name in NAMES
        if name in reported
    }
    return line


def summary(lines: list[dict]) -> dict:
    """By noise and estimator: root mean square error of each name, share of 95 % intervals that
    hold the truth, seconds.
    """
    out: dict = {}
    for noise in sorted({line["noise"] for line in lines}):
        group = [line for line in lines if line["noise"] == noise]
        for who in ("aeroid", "fit"):
            pairs = [line[who][name] for line in group for name in NAMES]
            out[f"{noise}: {who}"] = {
                "worlds": len(group),
                "rms": {
                    name: float(np.sqrt(np.mean([line[who][name]["error"] ** 2 for line in group])))
                    for name in NAMES
                },
                "held": f"{sum(abs(f['error']) < 1.96 * f['sd'] for f in pairs)} of {len(pairs)}",
                "seconds": float(np.median([line[f"{who}_s"] for line in group])),
            }
        sizes = [pairs for line in group for pairs in line["explain"].values()]
        out[f"{noise}: explain"] = {
            "worlds": len(group),
            "known": sum(line["overall"] == "KNOWN" for line in group),
            "wrong names": sum(bool(set(line["named"]) - set(NAMES)) for line in group),
            "named": {name: sum(name in line["explain"] for line in group) for name in NAMES},
            "held": f"{sum(abs(f['error']) < 1.96 * f['sd'] for f in sizes)} of {len(sizes)}",
            "seconds": float(np.median([line["explain_s"] for line in group])),
        }
    return out


def main() -> None:
    """Compare in so many worlds of each noise."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("worlds", type=int)
    parser.add_argument("--seed", type=int, default=240000001)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    lines = [compare_world(args.seed + i, colour) for i in range(args.worlds) for colour in COLOURS]
    args.out.write_text(
        json.dumps({"seed": args.seed, "summary": summary(lines), "worlds": lines}, indent=1) + "\n"
    )
    print(json.dumps(summary(lines), indent=1))


if __name__ == "__main__":
    main()
