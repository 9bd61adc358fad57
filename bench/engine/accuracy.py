"""Solvers on bare scenes, without blocks: how far they end from a converged run, by their step.

The hard throw and the whip of ``tests/data/scenes``, a pendulum, and a vehicle that pulls straight
up on a rope that hangs askew."""

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np

from bench import start
from bench.report import Report, Table, finish
from sim.hybrid import HybridSim
from sim.params import GRAVITY
from tests.oracle.converged import converged
from tests.plants import SCENES
from tests.scenes import Scene, Wrench, load_scene, wrench_at
from tests.simulators import scene_plant

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


def simulator(scene: Scene, solver: str, substep: float) -> HybridSim:
    """The scene's vehicle, without blocks, at its start."""
    plant = scene_plant(scene, substep, "float32", PERIOD)
    plant = dataclasses.replace(plant, sim=dataclasses.replace(plant.sim, solver=solver))
    sim = HybridSim(plant, 1, direct=True)
    states = (scene.pos_w, scene.quat_wb, scene.vel_w, scene.rate_b)
    rope = scene.cable_dir_w()[None], scene.cable_vel_w()[None]
    sim.place(*(np.array([value]) for value in states), *rope)
    return sim


def fly(scene: Scene, solver: str, substep: float) -> dict[str, np.ndarray]:
    """Ball and vehicle [m] after each control period, shape (T, 3); the rope's rates at the end."""
    sim, rows = simulator(scene, solver, substep), []
    for k in range(round(scene.duration / PERIOD)):
        wrench = wrench_at(scene, PERIOD * k)
        sim.set_command(np.array([[wrench.force_b[2], *wrench.torque_b]]))
        sim.step()
        rows.append([sim.get(name)[0].astype(float) for name in ("payload_pos_w", "pos_w")])
    ball, vehicle = (np.array(column) for column in zip(*rows))
    failed = bool(sim.get("status")[0] & 1)
    rates = np.linalg.norm(sim.get("cable_vel_w")[0], axis=1)
    return {"ball": ball, "vehicle": vehicle, "rates": rates, "failed": failed}


def pendulum() -> Scene:
    """The hard throw's rope at 57 degrees below a vehicle of 100 kg that is held up."""
    scene = load_scene(SCENES / "hard_throw.toml")
    mass, angle = 100.0, np.radians(57.0)
    lift = GRAVITY * (mass - scene.mass + scene.total_mass)
    still = {"vel_w": (0.0, 0.0, 0.0), "cable_rate_w": (0.0, 0.0, 0.0), "duration": 3.0}
    direction = (float(np.sin(angle)), 0.0, float(-np.cos(angle)))
    schedule = (Wrench(0.0, (0.0, 0.0, lift), (0.0, 0.0, 0.0)),)
    body = {"mass": mass, "inertia": (10.0, 10.0, 10.0)}
    return dataclasses.replace(scene, **body, **still, direction=direction, schedule=schedule)


def pulled(weights: float) -> Scene:
    """The hard throw's vehicle, still, that pulls straight up with its rope 15 degrees askew."""
    scene = load_scene(SCENES / "hard_throw.toml")
    lift = weights * GRAVITY * scene.total_mass
    still = {"vel_w": (0.0, 0.0, 0.0), "duration": PULLED}
    direction = (float(np.sin(np.radians(15.0))), 0.0, float(-np.cos(np.radians(15.0))))
    schedule = (Wrench(0.0, (0.0, 0.0, lift), (0.0, 0.0, 0.0)),)
    return dataclasses.replace(scene, **still, direction=direction, schedule=schedule)


def reference(scene: Scene) -> dict[str, np.ndarray]:
    """MuJoCo's converged run at the same times."""
    times = PERIOD * np.arange(1, round(scene.duration / PERIOD) + 1)
    run = converged(scene, times=times)
    return {"ball": run.ball_pos_w, "vehicle": run.pos_w}


def run(args) -> int:
    names = {name: load_scene(SCENES / f"{name}.toml") for name in ("hard_throw", "whip")}
    scenes = names | {"pendulum": pendulum()}
    truths = {name: reference(scene) for name, scene in scenes.items()}
    rows = []
    for solver, substep in itertools.chain(*([(s, h) for h in STEPS[s]] for s in args.solvers)):
        row: dict = {"solver": solver, "substep": substep}
        for name, scene in scenes.items():
            found = fly(scene, solver, substep)
            for part in ("ball", "vehicle"):
                off = np.linalg.norm(found[part] - truths[name][part], axis=1)
                row[f"{name}_{part}"] = None if found["failed"] else float(off[-1])
                row[f"{name}_{part}_most"] = None if found["failed"] else float(off.max())
        calm = [k for k in PULLS if not_wild(fly(pulled(k), solver, substep))]
        row["pull"] = max(calm, default=0)
        rows.append(row)
        print(row, flush=True)
    columns = ("hard_throw_ball", "hard_throw_vehicle", "pendulum_ball_most", "whip_ball")
    header = ("solver, step", *(name.replace("_", " ") + " [mm]" for name in columns), "pull")
    cells = []
    for row in rows:
        parts = ["NaN" if row[name] is None else f"{1e3 * row[name]:.2f}" for name in columns]
        cells.append((f"{row['solver']}, {1e3 * row['substep']:g} ms", *parts, f"{row['pull']}"))
    title = "Solvers on bare scenes, off MuJoCo at 20 us"
    notes = (
        f"pull: the most weights of {PULLS} under which no segment turns faster than {CALM:g} rad/s"
        f" after {PULLED} s. Most: the largest distance of the run; else at its end.",
    )
    report = Report("engine", title, (Table(title, header, tuple(cells)),), notes, {"rows": rows})
    return finish(report, args)


def not_wild(found: dict) -> bool:
    """Whether a pulled rope has come to rest along its pull, or nearly."""
    return not found["failed"] and float(found["rates"].max()) < CALM


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = start.parser_of(__doc__)
    parser.add_argument("--solvers", nargs="+", default=list(STEPS), choices=list(STEPS))
    return start.main(parser, run, argv)


if __name__ == "__main__":
    raise SystemExit(main())
