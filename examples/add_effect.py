"""Describe an effect as a table of configs/effects does, and apply it: how far it moves the ball.

To let the diagnosis select it, add the same fields as a table to a file of configs/effects.

python examples/add_effect.py --size 0.02
"""

import argparse

import numpy as np

from sim.effects.effect import Change, SettingEffect, apply
from sim.effects.setting import Setting
from sim.hybrid import HybridSim
from sim.params import GRAVITY
from visthrow.task import load_experiment, plant_of

EFFECT = SettingEffect(  # as a table of configs/effects
    name="mount_forward",
    cause="The rope is fixed further forward",
    equation="mount_x + theta",
    unit="m",
    block="rope",
    bounds=(-0.05, 0.05),
    prior_sd=0.01,
    floor=0.0005,
    channels=("pos_w", "quat_wb", "payload_pos_w"),
    source="a ruler: 2 mm",
    changes=(Change("plant.rope.mount", index=0),),
)


def hover(setting: Setting) -> np.ndarray:
    """Return the ball after half a second of level thrust [m], shape (3,), world frame."""
    plant = setting.plant
    sim = HybridSim(plant, count=1, device="cpu")
    sim.place(pos_w=np.array([[0.0, 0.0, 1.5]]))
    weight = GRAVITY * (plant.vehicle.body.mass + plant.rope.rope_mass + plant.rope.payload_mass)
    sim.set_command(np.array([[weight, 0.0, 0.0, 0.0]]))
    for _ in range(25):
        sim.step()
    return sim.get("payload_pos_w")[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=float, default=0.02, help="of the effect [m]")
    args = parser.parse_args()
    setting = Setting(plant_of(load_experiment("state")))
    changed = apply({EFFECT.name: EFFECT}, setting, {EFFECT.name: args.size})
    print("the ball moves by", np.round(hover(changed) - hover(setting), 4), "m")


if __name__ == "__main__":
    main()
