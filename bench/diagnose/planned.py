"""What optimised excitation is worth on flights: the optimised manoeuvre beside the best fixed one,
flown as long, effects hidden.

    python -m bench.diagnose.planned [--seed 1] [--steps 6]
        a throw's vehicle, on an independent plant
    python -m bench.diagnose.planned --setup cf_payload
        a setup's, on the training simulator

From hovers without hidden effects the next flight is planned for some effects. Then one after the
other is hidden at 10 floors, both manoeuvres are flown twice beside the hovers, and the search is
asked. A line for each effect: the 95 % interval's width in floors, its nats, and whether it was
named, alone, with the fixed manoeuvre and with the optimised one."""

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from bench.diagnose.sealed import flight_log
from bench.worlds.follow import follow, table_of
from bench.worlds.world import Recipe
from sim.params import PlantParams
from visthrow import config
from visthrow.diagnose.inputs import setup
from visthrow.diagnose.models.flyer import FlyerModel
from visthrow.diagnose.models.model_interface import Model
from visthrow.diagnose.planning.design import Limits, optimise
from visthrow.diagnose.planning.fly_manoeuvres import carried, fly, simulator_of, vehicle_of
from visthrow.diagnose.planning.manoeuvres import Manoeuvre, catalogue
from visthrow.diagnose.planning.plan import PlanningGoal
from visthrow.diagnose.select import search
from visthrow.diagnose.throw.throw_model import ThrowModel
from visthrow.task import Experiment, plant_of

SIZE, TWICE = 10.0, 2
THROW = (
    "yaw_drag_coeff",
    "inertia_z",
    "rotor_gyro",
    "translational_lift",
    "flapping",
    "marker_rot_z",
)
SETUP = ("rotor_drag_xy", "rotor_drag_z", "motor_tau", "parasitic", "translational_lift")
HOVER = next(m for m in catalogue() if m.name == "hover")

Flown = Callable[[Mapping[str, float], Sequence[Manoeuvre], int], Model]
"""Effects' sizes, manoeuvres and a number of the noise -> model of these flights."""


def experiment() -> Experiment:
    """The shipped one, whose plant is diagnosed."""
    return config.load(Experiment, config.find("train", "state"))


def of_throw(seed: int) -> Flown:
    """Flights of worlds of another plant."""
    known = experiment()

    def flown(effects: Mapping[str, float], manoeuvres: Sequence[Manoeuvre], number: int) -> Model:
        tables = [table_of(m.reference().csv(), m.payload) for m in manoeuvres]
        records = follow(Recipe(seed + number, "chain", dict(effects)), tables, number)
        return ThrowModel([flight_log(r) for r in records], plant_of(known), sensing=known.sensing)

    return flown


def of_setup(name: str, seed: int) -> Flown:
    """Flights of a setup's vehicle on the simulator."""
    params = setup.load(name).flyer
    plant = vehicle_of(params, plant_of(experiment()))
    noise = {params.position: 3e-4, "payload_pos_w": 3e-4, "rate_b": 2e-2}

    def flown(effects: Mapping[str, float], manoeuvres: Sequence[Manoeuvre], number: int) -> Model:
        flights = fly(
            altered(plant, effects), [carried(m, params) for m in manoeuvres], seed + number
        )
        return FlyerModel([flight.setup_log(params, noise) for flight in flights], params)

    return flown


def altered(plant: PlantParams, effects: Mapping[str, float]) -> PlantParams:
    """A setup's plant with effects of its model."""
    v = plant.vehicle
    more = {"rotor_drag_xy": ("drag_x", "drag_y"), "rotor_drag_z": ("drag_z",)}
    for name, size in effects.items():
        if name == "motor_tau":
            v = replace(v, motor=replace(v.motor, time_constant=v.motor.time_constant + size))
        else:
            v = replace(
                v,
                aero=replace(
                    v.aero,
                    **{field: getattr(v.aero, field) + size for field in more.get(name, (name,))},
                ),
            )
    return replace(plant, vehicle=v)


def main() -> None:
    """Plan once, then a line for each hidden effect."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--steps", type=int, default=6)
    parser.add_argument("--setup", default="")
    args = parser.parse_args()
    names, flown = (
        (SETUP, of_setup(args.setup, args.seed)) if args.setup else (THROW, of_throw(args.seed))
    )
    model = flown({}, [HOVER] * 2, 0)
    diagnosis = search.explain(model, laws=False)
    aim = PlanningGoal(diagnosis, names)
    made = (lambda logs: FlyerModel(logs, model.params)) if args.setup else None
    simulate, flies = simulator_of(model, diagnosis, made, seed=args.seed)
    able = [m for m in map(flies, catalogue()) if m is not None]
    told = [
        (aim.nats(aim.information(s.model)) / m.seconds, m)
        for m, s in zip(able, simulate(able))
        if s.model is not None
    ]
    found = optimise(
        aim,
        max(told, key=lambda each: each[0])[1],
        simulate,
        Limits(),
        seed=args.seed,
        steps=args.steps,
    )
    print(json.dumps(found.record()), flush=True)
    for i, name in enumerate(names):
        floor = next(e.floor for e in model.effects if e.name == name)
        line = {"effect": name}
        for kind, manoeuvre in (("fixed", found.base), ("optimised", found.manoeuvre)):
            said = search.explain(
                flown({name: SIZE * floor}, [HOVER] * 2 + [manoeuvre] * TWICE, i + 1), laws=False
            )
            own = said[name]
            line[kind] = {
                "width": (own.high - own.low) / floor,
                "nats": own.nats,
                "right": said.named == (name,),
            }
        print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
