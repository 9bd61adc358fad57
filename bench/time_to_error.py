"""Wall time of trainings to a landing error, over seeds, configurations side by side."""

import math
import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

from bench.report import Report, Table, device_name, rate

TARGET = 2.0  # [m]


def train(
    experiment: Any,
    device: str,
    seed: int,
    errors: Sequence[float],
    minutes: float,
    every: int | None = None,
) -> dict[str, Any]:
    """Train until throws land within the smallest error, or the time is up; throw every so many
    iterations, or by the clock.

    Returns:
        ``curve``: (wall time without evaluations [s], environment steps, error [m]) of each
        evaluation; ``reached``: error as text -> first of them within it, None where there is none.
    """
    from visthrow.training.session import EVALUATION_SHARE, Regularly
    from visthrow.training.trainer import Trainer

    trainer, evaluations = Trainer(experiment, device, seed), Regularly(every, EVALUATION_SHARE)
    curve: list[tuple[float, int, float]] = []
    reached: dict[str, Any] = {f"{error:g}": None for error in errors}
    spent = 0.0
    while (
        trainer.iteration < trainer.algorithm.iterations
        and spent < 60.0 * minutes
        and not all(reached.values())
    ):
        start = time.perf_counter()
        trainer.step()
        spent += time.perf_counter() - start
        if (
            not evaluations.due(trainer.iteration)
            and trainer.iteration < trainer.algorithm.iterations
        ):
            continue
        with evaluations.timed():
            throws = trainer.throw(TARGET)
        curve.append(
            (
                spent,
                trainer.iteration * trainer.algorithm.samples,
                throws.summary().get("error_mean", math.nan),
            )
        )
        for error in errors:
            if throws.within(error):
                reached[f"{error:g}"] = reached[f"{error:g}"] or curve[-1]
    told = ", ".join(
        f"{error} m {_seconds(hit[0] if hit else math.inf)}" for error, hit in reached.items()
    )
    print(f"seed {seed}: {told}; {spent:.0f} s in all", file=sys.stderr, flush=True)
    return {"seed": seed, "curve": curve, "reached": reached, "seconds": spent}


def measure(
    experiments: Mapping[str, Any],
    device: str,
    errors: Sequence[float],
    seeds: Sequence[int],
    minutes: float,
    every: int | None = None,
) -> Report:
    """Train every configuration under every seed and report."""
    runs = {
        name: [train(experiment, device, seed, errors, minutes, every) for seed in seeds]
        for name, experiment in experiments.items()
    }
    rows = []
    for name, trained in runs.items():
        for error in sorted(errors, reverse=True):
            found = [run["reached"][f"{error:g}"] for run in trained]
            times = sorted(hit[0] if hit else math.inf for hit in found)
            steps = sorted(hit[1] if hit else math.inf for hit in found)
            middle, least = statistics.median(times), statistics.median(steps)
            rows.append(
                (
                    name,
                    f"{error:g} m",
                    _seconds(middle),
                    f"{_seconds(times[0])} to {_seconds(times[-1])}",
                    rate(least) if math.isfinite(least) else "-",
                    f"{sum(map(bool, found))} of {len(seeds)}",
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
            "Mean landing error of 200 throws from hover with all noise, at least 95 % of them"
            " landed. Wall time of rollouts and learning; evaluations are left out. A time is late"
            " by the way to the next evaluation, whose times are in the file."
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
