"""Solvers on bare scenes, without blocks: how far they end from a converged run, by their step.

The hard throw and the whip of ``tests/data/scenes``, a pendulum, and a vehicle that pulls straight
up on a rope that hangs askew."""

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np

from bench import start
from bench.report import Report, Table, finish
from sim.params import GRAVITY
from tests.oracle.converged import OracleRun, run_converged
from tests.plants import SCENES
from tests.scenes import Scene, Wrench, load_scene, wrench_at
from tests.simulators import scene_sim

STEPS = {
    "chain": (0.002, 0.0005),
    "exchanged_chain": (0.002,),
    "mujoco_warp": (0.001, 0.0005),
    "physx": (0.002, 0.001, 0.0005, 0.000125),
}
"""Solver -> substeps [s]."""

PERIOD = 0.01
PULLS = (1, 2, 3, 4, 5, 6)  # weights of vehicle, rope and ball
CALM = 20.0  # [rad/s]: a rope that is pulled straight turns slower than that after PULLED
PULLED = 0.3  # [s]
COLUMNS = ("hard_throw_ball", "hard_throw_vehicle", "pendulum_ball_most", "whip_ball")


def fly(scene: Scene, solver: str, substep: float) -> dict[str, np.ndarray]:
    """Ball and vehicle [m] after each control period, shape (T, 3), NaN where the solver failed;
    the rope's rates at the end."""
    sim = scene_sim(scene, substep, "float32", PERIOD, solver)
    rows = []
    for k in range(round(scene.duration / PERIOD)):
        wrench = wrench_at(scene, PERIOD * k)
        sim.set_command(np.array([[wrench.force_b[2], *wrench.torque_b]]))
        sim.step()
        rows.append([sim.get(name)[0].astype(float) for name in ("payload_pos_w", "pos_w")])
    scale = np.nan if sim.get("status")[0] & 1 else 1.0
    ball, vehicle = np.moveaxis(scale * np.array(rows), 1, 0)
    rates = scale * np.linalg.norm(sim.get("cable_vel_w")[0], axis=1)
    return {"ball": ball, "vehicle": vehicle, "rates": rates}


def pendulum() -> Scene:
    """The hard throw's rope at 57 degrees below a vehicle of 100 kg that is held up."""
    scene = load_scene(SCENES / "hard_throw.toml")
    mass = 100.0
    angle = np.radians(57.0)
    lift = GRAVITY * (mass - scene.mass + scene.total_mass)
    still = {"vel_w": (0.0, 0.0, 0.0), "cable_rate_w": (0.0, 0.0, 0.0), "duration": 3.0}
    direction = (float(np.sin(angle)), 0.0, float(-np.cos(angle)))
    schedule = (Wrench(0.0, (0.0, 0.0, lift), (0.0, 0.0, 0.0)),)
    body = {"mass": mass, "inertia": (10.0, 10.0, 10.0)}
    return dataclasses.replace(scene, **body, **still, direction=direction, schedule=schedule)


def pull_up(weights: float) -> Scene:
    """The hard throw's vehicle, still, that pulls straight up with its rope 15 degrees askew."""
    scene = load_scene(SCENES / "hard_throw.toml")
    lift = weights * GRAVITY * scene.total_mass
    still = {"vel_w": (0.0, 0.0, 0.0), "duration": PULLED}
    direction = (float(np.sin(np.radians(15.0))), 0.0, float(-np.cos(np.radians(15.0))))
    schedule = (Wrench(0.0, (0.0, 0.0, lift), (0.0, 0.0, 0.0)),)
    return dataclasses.replace(scene, **still, direction=direction, schedule=schedule)


@functools.cache
def reference(scene: Scene) -> OracleRun:
    """MuJoCo's converged run."""
    return run_converged(scene, times=PERIOD * np.arange(1, round(scene.duration / PERIOD) + 1))


def distances(scene: Scene, name: str, solver: str, substep: float) -> dict[str, float]:
    """How far ball and vehicle end from MuJoCo's converged run, and the most on the way [m]."""
    truth = reference(scene)
    flown = fly(scene, solver, substep)
    row = {}
    for part, true in (("ball", truth.ball_pos_w), ("vehicle", truth.pos_w)):
        off = np.linalg.norm(flown[part] - true, axis=1)
        row |= {f"{name}_{part}": float(off[-1]), f"{name}_{part}_most": float(off.max())}
    return row


def run(args) -> int:
    scenes = {name: load_scene(SCENES / f"{name}.toml") for name in ("hard_throw", "whip")}
    scenes["pendulum"] = pendulum()
    rows = []
    cells = []
    for solver in args.solvers:
        for substep in STEPS[solver]:
            row = {"solver": solver, "substep": substep}
            for name, scene in scenes.items():
                row |= distances(scene, name, solver, substep)
            calm = [k for k in PULLS if fly(pull_up(k), solver, substep)["rates"].max() < CALM]
            row["pull"] = max(calm, default=0)
            rows.append(row)
            print(row, flush=True)
            parts = [f"{1e3 * row[name]:.2f}" for name in COLUMNS]
            cells.append((f"{solver}, {1e3 * substep:g} ms", *parts, f"{row['pull']}"))
    header = ("solver, step", *(name.replace("_", " ") + " [mm]" for name in COLUMNS), "pull")
    title = "Solvers on bare scenes, off MuJoCo at 20 us"
    notes = (
        f"pull: the most weights of {PULLS} under which no segment turns faster than {CALM:g} rad/s"
        f" after {PULLED} s. Most: the largest distance of the run; else at its end.",
    )
    report = Report("engine", title, (Table(title, header, tuple(cells)),), notes, {"rows": rows})
    return finish(report, args)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = start.parser_of(__doc__)
    parser.add_argument("--solvers", nargs="+", default=list(STEPS), choices=list(STEPS))
    return start.main(parser, run, argv)


if __name__ == "__main__":
    raise SystemExit(main())
