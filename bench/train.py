"""Wall time of a training: by parts of an iteration, or to an error over seeds.

python -m bench.train state --device cuda
    simulation, environment, inference and learning
python -m bench.train laptop --until 0.06 0.04  seconds of whole trainings to these errors
"""

import argparse
import secrets
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

from bench import start
from bench.common_options import add_common
from bench.report import (
    Report,
    Table,
    add_arguments_of_measurements,
    device_name,
    finish,
    rate,
)
from visthrow import config
from visthrow.common.compute_device import allow_rounded_products
from visthrow.common.errors import VisthrowError

# iterations before measuring: the first runs eagerly, the second captures the CUDA graph
WARM_UP = 3

PARTS = {
    "simulation": "the fused kernel",
    "environment": "noise, rewards, ends, resets, observations, camera",
    "inference": "actor and critic, sampling",
    "storage": "rollout buffer, normalisation, returns",
    "learning": "PPO's update",
}


def seconds(
    function: Callable[[], Any], device: str, repeats: int, before: Callable[[], Any] = lambda: None
) -> float:
    """Median wall time of device operations [s]: replayed from a CUDA graph, as training does, or
    on the CPU run as they are.

    ``before`` is run before each of the repeats and not timed.
    """
    import torch

    settle = torch.cuda.synchronize if device.startswith("cuda") else (lambda: None)
    times = []
    function()
    if device.startswith("cuda"):
        from sim.torch_bridge import capture_graph

        function = capture_graph(function).replay
    for _ in range(repeats):
        before()
        settle()
        start = time.perf_counter()
        function()
        settle()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def time_iterations(trainer: Any, iterations: int) -> dict[str, list[float]]:
    """Wall time [s] of rollouts and updates as training makes them."""
    for _ in range(WARM_UP):
        trainer.step()
    rows = [trainer.step() for _ in range(iterations)]
    return {"rollout": [r["rollout_s"] for r in rows], "learning": [r["learning_s"] for r in rows]}


@allow_rounded_products(True)
def time_parts_alone(trainer: Any, repeats: int) -> dict[str, float]:
    """Median wall time [s] of an iteration's simulator steps, environment steps and policy calls,
    each alone.

    The trainer's environment is spent afterwards: its steps do not belong to an iteration.
    """
    import torch

    from sim.torch_bridge import on_torch_stream

    env = trainer.algorithm.env
    alg = trainer.algorithm.alg
    steps = trainer.experiment.ppo.steps
    device = trainer.device
    observations = env.get_observations()
    with torch.inference_mode():
        actions = alg.act(observations).clone()
        actions[:, -1] = -1.0  # nothing is released: the rope is simulated throughout

    @torch.inference_mode()
    def reset() -> None:
        env.reset()

    def simulate() -> None:
        with on_torch_stream(device):
            for _ in range(steps):
                env.sim.step()

    @torch.inference_mode()
    def steps_of_env() -> None:
        for _ in range(steps):
            env.step(actions)

    @torch.inference_mode()
    def infer() -> None:
        for _ in range(steps):
            alg.act(observations)

    durations = {}
    for name, function in (("simulation", simulate), ("step", steps_of_env), ("inference", infer)):
        reset()
        durations[name] = seconds(
            function, device, repeats, reset if name == "simulation" else lambda: None
        )
    return durations


def split(total: dict[str, float], parts: dict[str, float]) -> dict[str, float]:
    """Seconds of each of :data:`PARTS` from the whole iteration and the parts measured alone; none
    below zero.
    """
    environment = max(parts["step"] - parts["simulation"], 0.0)
    storage = max(total["rollout"] - parts["step"] - parts["inference"], 0.0)
    return dict(
        zip(
            PARTS,
            (parts["simulation"], environment, parts["inference"], storage, total["learning"]),
        )
    )


def run(args: argparse.Namespace) -> int:
    """Measure a training iteration."""
    numbers = (
        args.iterations,
        args.repeats,
        args.minutes,
        args.evaluate_every or 1,
        args.fresh,
        *(args.until or ()),
    )
    if min(numbers) <= 0:
        raise VisthrowError(
            f"--iterations {args.iterations}, --repeats {args.repeats}, --minutes {args.minutes},"
            f" --until {args.until}, --evaluate-every {args.evaluate_every}, --fresh {args.fresh}:"
            " expected positive numbers"
        )
    from visthrow.common import compute_device
    from visthrow.task import Experiment

    paths = [config.find("train", name) for name in args.configs]
    experiments = {path.stem: config.load(Experiment, path, args.overrides) for path in paths}
    name = compute_device.resolve(args.device)
    if args.until:
        from bench import time_to_error

        return finish(
            time_to_error.measure(
                experiments,
                name,
                args.until,
                args.seeds or [secrets.randbelow(10**6) for _ in range(args.fresh)],
                args.minutes,
                args.evaluate_every,
                args.whole,
            ),
            args,
        )
    if len(experiments) > 1:
        raise VisthrowError(
            f"{' '.join(experiments)}: an iteration is measured of one configuration; several with"
            " --until"
        )
    (stem, experiment), *_ = experiments.items()
    if experiment.algorithm != "ppo":
        raise VisthrowError(
            f'{stem}: algorithm "{experiment.algorithm}"; parts of an iteration are measured of'
            ' "ppo"; use --until'
        )
    return finish(measure(experiment, stem, name, args.iterations, args.repeats), args)


def measure(experiment: Any, name: str, device: str, iterations: int, repeats: int) -> Report:
    """Measure and report."""
    from visthrow.training.trainer import Trainer

    trainer = Trainer(experiment, device, seed=1)
    runs = time_iterations(trainer, iterations)
    total = {key: statistics.median(values) for key, values in runs.items()}
    parts = split(total, time_parts_alone(trainer, repeats))
    samples = trainer.algorithm.samples
    wall = sum(total.values())
    rows = [
        (
            f"{part}: {PARTS[part]}",
            f"{t * 1e3:.2f} ms",
            f"{100 * t / wall:.0f} %",
            rate(samples / t) if t else "",
        )
        for part, t in parts.items()
    ]
    rows.append(("iteration", f"{wall * 1e3:.2f} ms", "100 %", rate(samples / wall)))
    p = experiment.ppo
    title = f"{name}: {p.environments:,} environments x {p.steps} steps on {device_name(device)}"
    notes = (
        (
            f"Rollout and learning are medians of {iterations} iterations of training itself, after"
            f" {WARM_UP} that warm up. Simulation, environment step and policy were then run alone,"
            " from CUDA graphs on a GPU; environment is the step less the simulation, storage what"
            " is left of the rollout."
        ),
        f"The paper's 2e8 environment steps at this speed: {2e8 / samples * wall:.0f} s.",
    )
    figures = {
        "config": name,
        "device": device,
        "samples": samples,
        "seconds": parts,
        "iteration_s": wall,
        "rollout_s": total["rollout"],
        "steps_per_s": samples / wall,
        "runs": runs,
    }
    table = Table(title, ("part", "time", "share", "env-steps/s"), tuple(rows))
    return Report(
        "train", f"A training iteration on {device_name(device)}", (table,), notes, figures
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = start.parser_of(__doc__, record=False)
    add = parser.add_argument
    add(
        "configs",
        metavar="CONFIG",
        nargs="*",
        default=["state"],
        help="training configurations (default: state)",
    )
    add("--iterations", type=int, default=5, metavar="N", help="iterations measured (default: 5)")
    add(
        "--until",
        type=float,
        nargs="+",
        metavar="ERROR",
        help="train until throws at 2.0 m land so near on average [m], and time that",
    )
    add(
        "--seeds",
        type=int,
        nargs="+",
        metavar="N",
        help="of the trainings (default: as many as --fresh says, drawn anew and printed)",
    )
    add("--fresh", type=int, default=10, metavar="N", help="seeds to draw (default: 10)")
    add(
        "--whole",
        action="store_true",
        help="go on to the last iteration though an error is reached, and throw at all targets",
    )
    add(
        "--minutes",
        type=float,
        default=30.0,
        metavar="T",
        help="that a training may take (default: 30)",
    )
    add(
        "--evaluate-every",
        type=int,
        metavar="N",
        help="iterations between throws (default: a twentieth of the time)",
    )
    add_arguments_of_measurements(parser, 5)
    add_common(parser)
    return start.main(parser, run, argv)


if __name__ == "__main__":
    sys.exit(main())
