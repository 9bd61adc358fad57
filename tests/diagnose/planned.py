"""What optimised excitation is worth on flights: the optimised manoeuvre and the best fixed one, flown as long on an independent plant.

    python -m tests.diagnose.planned --seed 1 [--steps 6] [--about NAMES]
    python -m tests.diagnose.planned --setup nanobench_cf21

Two hovers of a world without hidden effects ask ``visthrow diagnose plan`` for the next flight. Then one effect after the other is hidden
at 5 floors; each of both manoeuvres is flown twice beside the hovers, and ``explain`` is asked. A line for each effect: the 95 % interval's
width in floors with the fixed manoeuvre and with the optimised one, its nats, and whether it was named, alone.

With ``--setup`` the vehicle is that of a setup, and flies on the training simulator, whose equations are others than the model's.
"""

import argparse
import json
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from sim.params import PlantParams
from tests.diagnose.cases import explained
from tests.diagnose.sealed import flight_log, named_by
from tests.worlds.follow import follow, table_of
from tests.worlds.world import FLOORS, ONE_SIDED, Recipe
from visthrow import config
from visthrow.diagnose.inputs import setup
from visthrow.diagnose.models.flyer import FlyerModel
from visthrow.diagnose.planning.design import Limits, optimise
from visthrow.diagnose.planning.fly_manoeuvres import carried, fly, simulator_of, vehicle_of
from visthrow.diagnose.planning.manoeuvres import Manoeuvre, catalogue
from visthrow.diagnose.planning.plan import Aim
from visthrow.diagnose.select import search
from visthrow.task import Experiment, plant_of

HIDDEN = ("rotor_drag", "wind_x", "com_x", "rate_gain", "rope_length", "motor_tau", "thrust_gain", "marker_rot_y", "payload_drag")
SIZE, TWICE = 5.0, 2


def planned(recipe: Recipe, folder: Path, more: tuple[str, ...]) -> tuple[dict, str, str]:
    """What the tool plans from two hovers, and the references' text: of the best fixed manoeuvre, and of that one optimised."""
    hover = next(m for m in catalogue() if m.name == "hover")
    logs = [flight_log(r) for r in follow(recipe, [table_of(hover.reference().csv(), True)] * 2, 0)]
    said = explained(folder, logs, recipe, action="plan", more=more)
    found = said["optimised"]
    by_name = {p["name"]: said["tables"][p["reference"]] for p in said["proposals"] if p["reference"]}
    return found, by_name[found["base"]], by_name[found["manoeuvre"]]


def asked(recipe: Recipe, text: str, folder: Path, number: int) -> dict:
    """What ``explain`` says of two hovers and a manoeuvre flown twice in a world: of its effect, and the names."""
    hover = next(m for m in catalogue() if m.name == "hover").reference().csv()
    tables = [table_of(hover, True)] * 2 + [table_of(text, True)] * TWICE
    said = explained(folder, [flight_log(r) for r in follow(recipe, tables, number)], recipe)
    (name,) = recipe.effects
    finding = next(f for f in said["findings"] if f["name"] == name)
    return {"width": (finding["high"] - finding["low"]) / finding["floor"], "sd": finding["sd"], "nats": finding["nats"],
            "verdict": finding["verdict"], "right": named_by(said) == [{name}]}  # fmt: skip


def altered(plant: PlantParams, name: str, size: float) -> PlantParams:
    """A setup's plant with an effect of its model."""
    v = plant.vehicle
    change = {
        "rotor_drag_xy": {"aero": replace(v.aero, drag_x=v.aero.drag_x + size, drag_y=v.aero.drag_y + size)},
        "rotor_drag_z": {"aero": replace(v.aero, drag_z=v.aero.drag_z + size)},
        "motor_tau": {"motor": replace(v.motor, time_constant=v.motor.time_constant + size)},
        "parasitic": {"aero": replace(v.aero, parasitic=v.aero.parasitic + size)},
        "translational_lift": {"aero": replace(v.aero, translational_lift=v.aero.translational_lift + size)},
    }  # fmt: skip
    return replace(plant, vehicle=replace(v, **change[name]))


def of_setup(name: str, seed: int, steps: int) -> Iterator[dict]:
    """Plan for a setup's vehicle after a hover; then what was planned, and each effect hidden at 10 floors."""
    params = setup.load(name).flyer
    plant = vehicle_of(params, plant_of(config.load(Experiment, config.find("train", "state"))))
    known, noise = {m.name: m for m in catalogue()}, {params.position: 3e-4, "payload_pos_w": 3e-4, "rate_b": 2e-2}

    def explain(plant: PlantParams, flown: list[Manoeuvre], number: int):
        flights = fly(plant, [carried(known["hover"], params), *flown], seed + number)
        model = FlyerModel([flight.setup_log(params, noise) for flight in flights], params)
        return model, search.explain(model, laws=False)

    model, diagnosis = explain(plant, [], 0)
    names = ("rotor_drag_xy", "rotor_drag_z", "motor_tau", "parasitic", "translational_lift")
    aim, (simulate, flies) = Aim(diagnosis, names), simulator_of(model, diagnosis, lambda logs: FlyerModel(logs, params), seed=seed)
    able = [m for m in map(flies, known.values()) if m is not None]
    told = [(aim.nats(aim.information(s.model)) / m.seconds, m) for m, s in zip(able, simulate(able)) if s.model is not None]
    found = optimise(aim, max(told, key=lambda each: each[0])[1], simulate, Limits(), seed=seed, steps=steps)
    yield found.said()
    for i, effect in enumerate(names):
        size = 2.0 * SIZE * next(e.floor for e in model.effects if e.name == effect)
        line = {"effect": effect}
        for kind, manoeuvre in (("fixed", found.base), ("optimised", found.manoeuvre)):
            said = explain(altered(plant, effect, size), [manoeuvre] * TWICE, i + 1)[1]
            own = said[effect]
            line[kind] = {"width": (own.high - own.low) / own.floor, "nats": own.nats, "right": said.named == (effect,)}
        yield line


def main() -> None:
    """Plan once, then a line for each hidden effect."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--steps", type=int, default=6)
    parser.add_argument("--about", default="")
    parser.add_argument("--effects", default=",".join(HIDDEN))
    parser.add_argument("--setup", default="")
    args = parser.parse_args()
    if args.setup:
        for line in of_setup(args.setup, args.seed, args.steps):
            print(json.dumps(line), flush=True)
        return
    recipe = Recipe(args.seed, "chain")
    with tempfile.TemporaryDirectory() as folder:
        about = ("--about", args.about) if args.about else ()
        found, fixed, optimised = planned(recipe, Path(folder), ("--steps", str(args.steps), *about))
        print(json.dumps(found), flush=True)
        for i, name in enumerate(args.effects.split(",")):
            sign = 1.0 if name in ONE_SIDED or i % 2 else -1.0
            world = replace(recipe, seed=recipe.seed + 100 + i, effects={name: sign * SIZE * FLOORS[name]})
            line = {kind: asked(world, text, Path(folder), i) for kind, text in (("fixed", fixed), ("optimised", optimised))}
            print(json.dumps({"effect": name, **line}), flush=True)


if __name__ == "__main__":
    main()
