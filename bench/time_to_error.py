"""Wall time of trainings to a landing error, over seeds, configurations side by side."""

import math
import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

from bench.report import Report, Table, device_name, rate

TARGET = 2.0  # [m]

THROWS = 400  # of an evaluation
IN_A_ROW = 3  # evaluations within an error that hold it for good


def train(
    experiment: Any,
    device: str,
    seed: int,
    errors: Sequence[float],
    minutes: float,
    every: int | None = None,
    whole: bool = False,
) -> dict[str, Any]:
    """Train until throws stay within the smallest error, or the time is over; evaluate every so
    many iterations, or by the clock.

    Args:
        experiment, device, seed: of the training.
        errors: "for good" means that :data:`IN_A_ROW` evaluations in a row are within [m].
        minutes: that a training may take.
        every: iterations between evaluations; None leaves them to the clock.
        whole: whether a training goes on to its last iteration though it reached the errors.

    Returns:
        ``curve``: (wall time without evaluations [s], environment steps, error [m]) of each
        evaluation; ``reached``: error as text -> the evaluation that made it "for good", None where
        there is none; ``final`` and ``final_under_faults``: errors at all targets [m] of a training
        that came to its end, as flown and under its training's faults where these differ.
    """
    from visthrow.training.session import EVALUATION_SHARE, Regularly
    from visthrow.training.trainer import Trainer

    trainer = Trainer(experiment, device, seed)
    evaluations = Regularly(every, EVALUATION_SHARE)
    last = trainer.algorithm.iterations
    curve: list[tuple[float, int, float]] = []
    reached: dict[str, Any] = {f"{error:g}": None for error in errors}
    in_a_row = dict.fromkeys(reached, 0)
    spent = 0.0
    while (
        trainer.iteration < last and spent < 60.0 * minutes and (whole or not all(reached.values()))
    ):
        begin = time.perf_counter()
        trainer.step()
        spent += time.perf_counter() - begin
        if not evaluations.due(trainer.iteration) and trainer.iteration < last:
            continue
        with evaluations.measure_cost():
            throws = trainer.throw(TARGET, THROWS)
        summary = throws.summary()
        error = summary.get("error_mean", math.nan)
        curve.append((spent, trainer.iteration * trainer.algorithm.samples, error))
        print(
            f"seed {seed}: {spent:.1f} s, {error:.4f} m, landed {summary['success']:.3f}",
            file=sys.stderr,
            flush=True,
        )
        for bar in reached:
            in_a_row[bar] = in_a_row[bar] + 1 if throws.land_within(float(bar)) else 0
            if in_a_row[bar] == IN_A_ROW and reached[bar] is None:
                reached[bar] = curve[-1]
    final: dict[str, list] = {}
    if trainer.iteration == last:
        for name, throws in trainer.final_throws().items():
            final[name] = [one.summary().get("error_mean") for one in throws]
    times = ", ".join(
        f"{bar} m {_seconds(hit[0] if hit else math.inf)}" for bar, hit in reached.items()
    )
    print(f"seed {seed}: {times}; {spent:.1f} s in all; {final}", file=sys.stderr, flush=True)
    figures = {"seed": seed, "curve": curve, "reached": reached, "seconds": spent}
    return figures | {
        "final": final.get("flown", []),
        "final_under_faults": final.get("trained", []),
    }


def measure(
    experiments: Mapping[str, Any],
    device: str,
    errors: Sequence[float],
    seeds: Sequence[int],
    minutes: float,
    every: int | None = None,
    whole: bool = False,
) -> Report:
    """Train every configuration under every seed and report."""
    runs = {
        name: [train(experiment, device, seed, errors, minutes, every, whole) for seed in seeds]
        for name, experiment in experiments.items()
    }
    rows = []
    for name, trained in runs.items():
        for error in sorted(errors, reverse=True):
            reached = [run["reached"][f"{error:g}"] for run in trained]
            times = sorted(hit[0] if hit else math.inf for hit in reached)
            steps = sorted(hit[1] if hit else math.inf for hit in reached)
            middle = statistics.median(times)
            least = statistics.median(steps)
            rows.append(
                (
                    name,
                    f"{error:g} m",
                    _seconds(middle),
                    f"{_seconds(times[0])} to {_seconds(times[-1])}",
                    rate(least) if math.isfinite(least) else "-",
                    f"{sum(map(bool, reached))} of {len(seeds)}",
                )
            )
    header = (
        "configuration",
        "error at 2.0 m",
        "median time",
        "range",
        "median steps",
        "seeds that reached it",
    )
    table = Table(
        f"Time to error on {device_name(device)}, seeds {', '.join(map(str, seeds))}",
        header,
        tuple(rows),
    )
    notes = (
        (
            f"Mean landing error of {THROWS} throws from hover with all noise, at least 95 % of"
            f" them landed, for good: in {IN_A_ROW} evaluations in a row, and the time is that of"
            " the last. Wall time of rollouts and learning; evaluations are left out."
        ),
        (
            f"A training that has not reached an error after {minutes:g} minutes or its last"
            " iteration counts as never."
        ),
    )
    return Report(
        "train",
        f"Time to error on {device_name(device)}",
        (table,),
        notes,
        {"device": device, "runs": runs},
    )


def _seconds(value: float) -> str:
    return f"{value:.0f} s" if math.isfinite(value) else "never"
