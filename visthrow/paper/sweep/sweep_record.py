"""Report the state of a list, one line for each run, and write its two records, of trainings and of
throws.
"""

import csv
import json
from itertools import accumulate, chain
from pathlib import Path
from typing import Any

from visthrow.common.errors import StorageError
from visthrow.paper import results
from visthrow.paper.report.result_set import runs_of
from visthrow.paper.sweep.work import PIECES, is_locked, lock_of
from visthrow.paper.sweep.work_units import (
    PROGRESS,
    SUMMARY,
    ResultSource,
    SweepWork,
    throws_folder,
    variant_of,
)

CURVE_POINTS = 60  # points of a run's learning curve in the record


def status(work: SweepWork, out: Path) -> tuple[list[str], bool]:
    """Return one line for each run and one with the totals, and whether everything is done."""
    lines = []
    seconds = 0.0
    remaining = 0
    width = max(len(source.name) for source in work.sources)
    for source in work.sources:
        units = work.throws.get(source.id, ())
        thrown = sum(unit.is_done(out) for unit in units)
        state, spent = _state(source, out)
        seconds += spent
        remaining += (not source.is_done(out)) + len(units) - thrown
        lines.append(f"{source.name:{width}}  {state:44}  throws {thrown}/{len(units)}")
    lines.append(
        f"{len(work.sources)} runs, {seconds / 60:.1f} minutes of training, {remaining} units left"
    )
    return lines, remaining == 0


def _state(source: ResultSource, out: Path) -> tuple[str, float]:
    """Return a description of a training's state, and its duration so far [s]."""
    if not source.config:
        return "existing policy", 0.0
    rows = _progress(source, out)
    seconds = sum(_sum_seconds(rows)[-1:])
    count = f"{len(rows)} of {source.iterations} iterations"
    if source.is_done(out):
        error = _final(source, out)["error_mean"]
        place = "" if error is None else f", {error:.3f} m at 2.0 m"
        return f"done in {seconds:.0f} s{place}", seconds
    if is_locked(lock_of(out, source.id)):
        return f"running, {count}", seconds
    return f"stopped after {count}" if rows else "not started", seconds


def collect(work: SweepWork, out: Path, records: Path) -> list[Path]:
    """Write ``training/<list>.json`` and ``throws/<list>.json``, merged with existing records;
    return their paths.

    For the same run or throws with other weights or another config, the result in ``out`` replaces
    the recorded one. Raises StorageError: nothing is done, and no record exists."""
    training = records / "training" / f"{work.name}.json"
    throws = records / "throws" / f"{work.name}.json"
    runs = _runs(work, out, training)
    units = chain.from_iterable(work.throws.values())
    thrown = [unit for unit in units if unit.is_done(out)]
    if not runs and not thrown and not throws.exists():
        raise StorageError(
            f"{out}: no unit of the list '{work.name}' is done; expected the results of 'visthrow"
            f" sweep run {work.name}'"
        )
    names = dict.fromkeys(source.name for source in work.sources)
    results.write_line(training, {"runs": [runs[name] for name in names if name in runs]})
    recorded = {_question(result): result for result in results.load_all([throws]).values()}
    for unit in thrown:
        path = throws_folder(out) / f"{results.key_of(unit.unit(out))}.json"
        recorded |= {_question(result): result for result in results.load(path)}
    results.pack(recorded.values(), throws)
    return [training, throws]


def _runs(work: SweepWork, out: Path, record: Path) -> dict[str, dict[str, Any]]:
    """Return the finished trainings of a record and of a folder by name."""
    runs = {run["name"]: run for run in runs_of(record)} if record.exists() else {}
    trained = [source for source in work.sources if source.config and source.is_done(out)]
    return runs | {source.name: _run(source, out) for source in trained}


def _question(result: results.Result) -> str:
    return results.key_of({key: value for key, value in result.unit.items() if key != "weights"})


def _progress(source: ResultSource, out: Path) -> list[dict[str, str]]:
    path = source.folder(out) / PROGRESS
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return [row for row in csv.DictReader(file) if row.get("wall_s")]


def _sum_seconds(rows: list[dict[str, str]]) -> list[float]:
    """Return the duration of work up to the end of each iteration [s]."""
    return list(accumulate(float(row["rollout_s"]) + float(row["learning_s"]) for row in rows))


def _summary(source: ResultSource, out: Path) -> dict[str, Any]:
    return json.loads((source.folder(out) / SUMMARY).read_text(encoding="utf-8"))


def _final(source: ResultSource, out: Path) -> dict[str, float | None]:
    """Return mean error, mean duration and success of a training's final throws at 2.0 m."""
    rows = [row for row in _summary(source, out)["figures"]["throws"] if row["target"] == 2.0]
    return {
        name: rows[0].get(name) if rows else None
        for name in ("error_mean", "duration_mean", "success")
    }


def _run(source: ResultSource, out: Path) -> dict[str, Any]:
    """Return the record of a finished training."""
    rows = _progress(source, out)
    summary = _summary(source, out)
    experiment = source.experiment()
    per_iteration = experiment.samples
    step = max(len(rows) // CURVE_POINTS, 1)
    spent = _sum_seconds(rows)
    curve = []
    for i in range(step - 1, len(rows), step):
        steps = int(rows[i]["iteration"]) * per_iteration
        curve.append([steps, round(spent[i], 2), round(float(rows[i]["landing_error"]), 5)])
    pieces = [
        json.loads(path.read_text())
        for path in sorted((source.folder(out) / PIECES).glob("*.json"))
    ]
    return {
        "name": source.name,
        "run": Path(source.config).stem,
        "variant": variant_of(source.config),
        "layout": experiment.task.observation.layout,
        "train_seed": source.seed,
        "key": source.key,
        "iterations": len(rows),
        "environments": experiment.ppo.environments,
        "steps": len(rows) * per_iteration,
        "seconds": round(spent[-1], 2),
        "wall_s": round(sum(piece["seconds"] for piece in pieces), 2),
        "pieces": len(pieces),
        "device": (summary["processors"].get("gpu") or [summary["processors"]["cpu"]])[0],
        "commit": summary["commit"],
        "command": summary["command"],
        "versions": summary["versions"],
        "final": _final(source, out),
        "curve": curve,
    }
