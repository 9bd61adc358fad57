"""The simulator: on one CPU core against MuJoCo C on the same rope, on a GPU over batches and
against MuJoCo Warp.

On the core: wall time a simulated second of one environment.
"""

import argparse
import contextlib
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from bench import commands, start
from bench.common_options import add_common
from bench.report import Report, Table, finish
from sim.hybrid import HybridSim, tether_lengths
from sim.kernels.state import OUTPUT_FIELDS, STATE_FIELDS
from tests.oracle.converged import run_converged
from tests.simulators import fly
from visthrow.common.errors import VisthrowError
from visthrow.task import Experiment, load_experiment, plant_of

BATCH = 1024
"""Environments of the batch: what they share, the launch and the fetching of code, is spread over
enough of them, and their state (1 kB each) stays in the core's second-level cache.
"""

EPISODE = 50
"""Control steps from one start to the next: one simulated second, about a throw."""

TOLERANCE = 1e-3  # [m], of ball and vehicle at the end of the hard throw
BARS = {"RK4": 20.0, "implicitfast": 4.0}
THREADS_BAR = 1.8  # two threads on two cores over one


@contextlib.contextmanager
def pin_to_one_core(core: int | None = None) -> Iterator[int | None]:
    """Keep the process on one core; yields its number, None where the system cannot do it.

    Raises:
        VisthrowError: a core that this process may not use.
    """
    if not hasattr(os, "sched_setaffinity"):
        yield None
        return
    before = os.sched_getaffinity(0)
    chosen = max(before) if core is None else core
    if chosen not in before:
        raise VisthrowError(f"--core {chosen}: expected one of {sorted(before)}")
    os.sched_setaffinity(0, {chosen})
    try:
        yield chosen
    finally:
        os.sched_setaffinity(0, before)


class Batch:
    """The full model: a batch of plants with all blocks under drawn commands."""

    def __init__(self, experiment: Experiment, count: int, kind: str, threads: int = 1):
        self.plant = plant_of(experiment)
        self.spreads = experiment.task.start
        self.sim = HybridSim(
            self.plant, count, ropes=tether_lengths(experiment.rope, self.spreads), threads=threads
        )
        self.commands = commands.draw(kind, self.plant, experiment.task.action, EPISODE, count)

    def cost(self, seconds: float) -> float:
        """Wall time [s] a simulated second and environment, measured for about ``seconds``, starts
        left out.
        """
        spent = 0.0
        steps = 0
        while spent < seconds:
            self.sim.randomize(self.spreads)
            for command in self.commands:
                self.sim.set_command(command)
                start = time.perf_counter()
                self.sim.step()
                spent += time.perf_counter() - start
            steps += EPISODE
        return spent / (steps * self.sim.count * self.plant.sim.control_period)


def cost_in_c(scene: Any, seconds: float) -> float:
    """Wall time [s] a simulated second of a scene of `bench.mujoco_c`, measured for about
    ``seconds``.
    """
    chunk = round(0.5 / scene.step)
    spent = 0.0
    steps = 0
    while spent < seconds:
        start = time.perf_counter()
        scene.advance(chunk)
        spent += time.perf_counter() - start
        steps += chunk
    return spent / (steps * scene.step)


def measure_interleaved(
    a: Callable[[], float], b: Callable[[], float], repeats: int
) -> list[tuple[float, float]]:
    """Measure A B A B ...; each pair sees about the same machine."""
    return [(a(), b()) for _ in range(repeats)]


def longest_accurate_step(
    error: Callable[[float], float], duration: float, tolerance: float
) -> float:
    """Longest step [s] that divides ``duration`` and whose error, and that of shorter ones, stays
    within ``tolerance``.

    Args:
        error: of a step [m]; NaN counts as too much.
        duration: [s].
        tolerance: [m].

    Raises:
        VisthrowError: even 0.1 ms is too long.
    """
    wrong = round(duration / 2.0e-3)
    right = round(duration / 1.0e-4)
    if not error(duration / right) <= tolerance:
        raise VisthrowError("the step search starts from 0.1 ms, which is too long already")
    while right - wrong > 1:
        middle = (wrong + right) // 2
        if error(duration / middle) <= tolerance:
            right = middle
        else:
            wrong = middle
    return duration / right


def contenders(plant: Any) -> tuple[dict[str, Any], dict[str, tuple[float, float]]]:
    """MuJoCo's two scenes, and how far (ball, vehicle) [m] each contender ends from the converged
    hard throw.
    """
    from bench import mujoco_c

    hard = mujoco_c.HARD_THROW
    numerics = plant.sim
    truth = run_converged(hard)

    def measure_difference(ball_w: np.ndarray, pos_w: np.ndarray) -> tuple[float, float]:
        return float(np.linalg.norm(ball_w - truth.ball_pos_w[-1])), float(
            np.linalg.norm(pos_w - truth.pos_w[-1])
        )

    def run_mujoco(**how: Any) -> tuple[float, float]:
        run = run_converged(hard, **how)
        return measure_difference(run.ball_pos_w[-1], run.pos_w[-1])

    step = longest_accurate_step(lambda h: max(run_mujoco(step=h)), hard.duration, TOLERANCE)
    implicit = {
        "step": mujoco_c.IMPLICIT_STEP,
        "integrator": "implicitfast",
        "armature": mujoco_c.ARMATURE,
    }
    ours = fly(hard, numerics.substep, numerics.precision, numerics.control_period)
    errors = {
        "ours": measure_difference(ours.ball_pos_w, ours.pos_w),
        "RK4": run_mujoco(step=step),
        "implicitfast": run_mujoco(**implicit),
    }
    name = (
        f"MuJoCo C, implicitfast, armature {mujoco_c.ARMATURE:g},"
        f" {mujoco_c.IMPLICIT_STEP * 1e3:g} ms"
    )
    return {
        "RK4": mujoco_c.time_scene(hard, f"MuJoCo C, RK4, {step * 1e3:g} ms", step),
        "implicitfast": mujoco_c.time_scene(hard, name, **implicit),
    }, errors


def measure(
    experiment: Experiment,
    batch: int,
    repeats: int,
    seconds: float,
    core: int | None,
    with_mujoco: bool = True,
) -> Report:
    """Measure on one core and report."""
    plant = plant_of(experiment)
    rivals, errors = contenders(plant) if with_mujoco else ({}, {})
    ours = {kind: Batch(experiment, batch, kind) for kind in commands.KINDS}
    pairs: dict[str, list[tuple[float, float]]] = {}
    with pin_to_one_core(core) as used:
        for warm in ours.values():
            warm.cost(0.1 * seconds)
        for name, scene in rivals.items():
            cost_in_c(scene, 0.1 * seconds)
            pairs[name] = measure_interleaved(
                lambda: ours["hover"].cost(seconds), lambda s=scene: cost_in_c(s, seconds), repeats
            )
        full = [ours["full"].cost(seconds) for _ in range(repeats)]
        alone = [a for rows in pairs.values() for a, _ in rows] or [
            ours["hover"].cost(seconds) for _ in range(repeats)
        ]
    hover = statistics.median(alone)
    period = plant.sim.control_period
    segments = plant.rope.segments
    rows = [
        _row(
            f"visthrow, all blocks, {plant.sim.substep * 1e3:g} ms, hover",
            hover,
            None,
            errors.get("ours"),
            period,
        )
    ]
    rows.append(_row("the same, full-range commands", statistics.median(full), None, None, period))
    figures: dict[str, Any] = {
        "batch": batch,
        "core": used,
        "repeats": repeats,
        "seconds": seconds,
        "errors_m": errors,
        "ours_s_per_s": {"hover": hover, "full": statistics.median(full)},
        "hover_runs": alone,
        "full_runs": full,
        "env_steps_per_s": 1.0 / (hover * period),
        "full_range": commands.shares(ours["full"].sim),
        "rivals": {},
    }
    for name, scene in rivals.items():
        rival = {"scene": scene.name, "step_s": scene.step, "pairs": pairs[name], "bar": BARS[name]}
        rival["s_per_s"] = statistics.median(b for _, b in pairs[name])
        rival["ratio"] = statistics.median(b / a for a, b in pairs[name])
        rows.append(_row(scene.name, rival["s_per_s"], rival["ratio"], errors[name], period))
        figures["rivals"][name] = rival
    header = (
        "plant",
        "wall time a simulated second",
        "env-steps/s",
        "ratio",
        "hard throw: ball, vehicle off by",
    )
    table = Table(
        f"One core, rope of {segments} segments; ours in a batch of {batch}", header, tuple(rows)
    )
    return Report(
        "sim",
        f"Simulator on one CPU core against MuJoCo C ({segments} segments)",
        (table,),
        _notes(figures),
        figures,
    )


def measure_threads(
    experiment: Experiment, batch: int, repeats: int, seconds: float, threads: int
) -> Report:
    """Measure one thread and several in turns, and compare the bits that they leave."""
    one, many = (Batch(experiment, batch, "hover", n) for n in (1, threads))
    for warm in (one, many):
        warm.cost(0.1 * seconds)
    pairs = measure_interleaved(lambda: one.cost(seconds), lambda: many.cost(seconds), repeats)
    ratio = statistics.median(a / b for a, b in pairs)
    for each in (one, many):
        each.sim.episode.zero_()
        each.sim.randomize(each.spreads)
        for command in each.commands:
            each.sim.set_command(command)
            each.sim.step()
    same = all(
        np.array_equal(one.sim.get(name), many.sim.get(name))
        for name in (*STATE_FIELDS, *OUTPUT_FIELDS)
    )
    period = one.plant.sim.control_period
    costs = [statistics.median(column) for column in zip(*pairs)]
    rows = [
        _row(f"{n} thread{'s' * (n > 1)}", cost, costs[0] / cost, None, period)
        for n, cost in zip((1, threads), costs)
    ]
    header = ("plant", "wall time a simulated second", "env-steps/s", "ratio", "")
    table = Table(f"All blocks at hover, a batch of {batch}", header, tuple(rows))
    notes = (
        (
            f"In turns, stretches of {seconds:g} s, {repeats} of each; median of the pairs' ratios"
            f" {ratio:.2f} (bar {THREADS_BAR:g} with two cores)."
        ),
        f"A second of flight from drawn starts leaves {'the same bits' if same else 'OTHER BITS'}.",
    )
    figures = {
        "batch": batch,
        "threads": threads,
        "pairs": pairs,
        "ratio": ratio,
        "same_bits": same,
    }
    return Report(
        "sim", f"Simulator on {threads} CPU threads against one", (table,), notes, figures
    )


def _row(
    name: str, cost: float, ratio: float | None, error: tuple[float, float] | None, period: float
) -> tuple[str, ...]:
    off = "" if error is None else f"{error[0] * 1e3:.3g} mm, {error[1] * 1e3:.3g} mm"
    return (
        name,
        f"{cost * 1e3:.3f} ms",
        f"{1.0 / (cost * period):,.0f}",
        "" if ratio is None else f"{ratio:.1f}",
        off,
    )


def _notes(figures: dict[str, Any]) -> tuple[str, ...]:
    full = figures["full_range"]
    notes = [
        (
            f"Measured on core {figures['core']} in stretches of {figures['seconds']:g} s, median"
            f" of {figures['repeats']}."
        ),
        (
            f"Under full-range commands {100 * full['fallback']:.0f} % of the last control steps"
            f" kept a first stage somewhere and {100 * full['failed']:.2f} % failed."
        ),
    ]
    if figures["rivals"]:
        step = figures["rivals"]["RK4"]["step_s"]
        notes += [
            (
                "Ours and MuJoCo take turns; the ratio is the median over the pairs. Ours flies"
                " queue, controller, motors, battery and aerodynamics, MuJoCo the bare rope and a"
                " constant wrench, in one call of mj_step a throw."
            ),
            (
                f"RK4 at {step * 1e3:.4g} ms is the longest step that ends the hard throw within"
                f" {TOLERANCE * 1e3:g} mm of a converged run (bisection over the steps that divide"
                " it)."
            ),
        ]
        bars = ", ".join(
            f"{n} {r['ratio']:.1f} (at least {r['bar']:g})" for n, r in figures["rivals"].items()
        )
        notes.append(f"Bars: {bars}.")
    return tuple(notes)


def run(args: argparse.Namespace) -> int:
    """Measure the simulator."""
    if (
        args.seconds <= 0
        or args.repeats < 1
        or args.threads < 1
        or any(n < 1 for n in args.batch or ())
    ):
        raise VisthrowError(
            f"--seconds {args.seconds}, --repeats {args.repeats}, --batch {args.batch}, --threads"
            f" {args.threads}: expected positive numbers"
        )
    experiment = load_experiment(args.config, args.overrides)
    if args.device == "cpu":
        if args.batch and len(args.batch) > 1:
            raise VisthrowError(f"--batch {args.batch}: one core is measured at one batch size")
        batch = args.batch[0] if args.batch else BATCH
        if args.threads > 1:
            report = measure_threads(experiment, batch, args.repeats, args.seconds, args.threads)
        else:
            report = measure(
                experiment, batch, args.repeats, args.seconds, args.core, not args.without_mujoco
            )
    else:
        from bench import sim_gpu
        from visthrow.common import compute_device

        name = compute_device.resolve(args.device)
        if name == "cpu":
            raise VisthrowError(
                f"--device {args.device}: no GPU here; measure the CPU with --device cpu"
            )
        report = sim_gpu.measure(
            experiment, name, args.batch or sim_gpu.BATCHES, args.repeats, not args.without_mujoco
        )
    return finish(report, args)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = start.parser_of(__doc__)
    batch = "environments; several on a GPU (default: 1024 on the CPU, 4096 to 524288 on a GPU)"
    parser.add_argument("--batch", type=int, nargs="+", metavar="N", help=batch)
    parser.add_argument(
        "--seconds",
        type=float,
        default=1.0,
        metavar="S",
        help="wall time of one measurement, about (default: 1)",
    )
    threads = "measure N threads of a CPU against one instead of MuJoCo (default: 1)"
    parser.add_argument("--threads", type=int, default=1, metavar="N", help=threads)
    parser.add_argument(
        "--without-mujoco", action="store_true", help="measure this simulator alone"
    )
    parser.add_argument(
        "--repeats",
        type=int,
        default=5,
        metavar="N",
        help="measurements; the median counts (default: 5)",
    )
    parser.add_argument(
        "--core", type=int, metavar="N", help="CPU core to stay on (default: the last one)"
    )
    parser.add_argument(
        "--config",
        default="state",
        metavar="NAME",
        help="training configuration whose plant is measured",
    )
    add_common(parser, json=False)
    parser.set_defaults(device="cpu")
    return start.main(parser, run, argv)


if __name__ == "__main__":
    sys.exit(main())
