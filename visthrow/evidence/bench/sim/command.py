"""``visthrow bench sim``: on the CPU against MuJoCo C, on a GPU over batches and against MuJoCo Warp."""

import argparse

from visthrow import config
from visthrow.common.errors import VisthrowError
from visthrow.evidence.bench import records


def run(args: argparse.Namespace) -> int:
    """Measure the simulator."""
    if args.seconds <= 0 or args.repeats < 1 or any(n < 1 for n in args.batch or ()):
        raise VisthrowError(
            f"--seconds {args.seconds}, --repeats {args.repeats}, --batch {args.batch}: expected positive numbers"
        )
    from visthrow.task import Experiment

    experiment = config.load(Experiment, config.find("train", args.config), args.overrides)
    if args.device == "cpu":
        from visthrow.evidence.bench.sim import cpu as sim_cpu

        if args.batch and len(args.batch) > 1:
            raise VisthrowError(f"--batch {args.batch}: one core is measured at one batch size")
        report = sim_cpu.measure(
            experiment,
            args.batch[0] if args.batch else sim_cpu.BATCH,
            args.repeats,
            args.seconds,
            args.core,
            not args.without_mujoco,
        )
    else:
        from visthrow.evidence.bench.sim import gpu as sim_gpu
        from visthrow.training import device

        name = device.resolve(args.device)
        if name == "cpu":
            raise VisthrowError(f"--device {args.device}: no GPU here; measure the CPU with --device cpu")
        report = sim_gpu.measure(experiment, name, args.batch or sim_gpu.BATCHES, args.repeats, not args.without_mujoco)
    return records.finish(report, args)
