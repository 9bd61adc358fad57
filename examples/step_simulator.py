"""Step a batch of vehicles with rope and ball, and read where the balls hang.

python examples/step_simulator.py --count 64 --seconds 1
"""

import argparse

import numpy as np

from sim.hybrid import HybridSim
from visthrow.task import load_experiment, plant_of


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=64, help="vehicles")
    parser.add_argument("--seconds", type=float, default=1.0)
    parser.add_argument("--device", default="cpu", help="cpu or cuda:0")
    args = parser.parse_args()
    experiment = load_experiment("state")
    sim = HybridSim(plant_of(experiment), count=args.count, device=args.device)
    sim.place(pos_w=np.tile([0.0, 0.0, 1.5], (args.count, 1)))
    pitch = np.linspace(0.0, 1.0, args.count)  # body rate [rad/s]
    level = np.full(args.count, 2.67)  # collective thrust [N]
    still = np.zeros(args.count)
    sim.set_command(np.stack([level, still, pitch, still], axis=1))
    for _ in range(round(args.seconds / 0.02)):  # the period of a command [s]
        sim.step()
    balls = sim.get("payload_pos_w")
    print("the first ball at", balls[0], "m, the last at", balls[-1], "m")


if __name__ == "__main__":
    main()
