"""Units of work and their results: the inputs of throws are named and hashed, and the results are
written to one small file for each unit, or to a packed record.

A unit is a flat description of everything that its throws depend on (for instance
:func:`policy_unit`). Its key is a hash of the description, so that a changed input yields a
different unit, and an unchanged unit is never done twice. Each result is written as a whole when it
is done: a process that is killed loses only the units in progress."""

import hashlib
import json
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from visthrow.common import provenance
from visthrow.common.errors import StorageError
from visthrow.common.storage import atomic_write
from visthrow.common.workers import run_tasks

# increased when the same unit would yield a different result; older results are then not used
PROTOCOL = 1

DIGITS = 4  # decimal places in SI units: 0.1 mm, a hundredth of the throws' scatter

Unit = dict[str, Any]
"""Everything that throws depend on: name -> value (numbers, texts and lists)."""


@dataclass(frozen=True)
class Result:
    """The throws of one unit.

    Columns have one row for each throw: ``success`` (bool), ``landing_w`` [m] (N, 2), ``error``
    [m], ``duration`` [s] and further measurements; NaN where a throw failed."""

    unit: Unit  # everything that the throws depend on
    columns: dict[str, ndarray]
    # commit, command, time [UTC], seconds of work
    provenance: dict[str, Any] = field(default_factory=dict)
    extra: dict[str, Any] = field(default_factory=dict)  # further figures of the whole unit

    @property
    def key(self) -> str:
        """Return the key of the unit."""
        return key_of(self.unit)

    @property
    def good(self) -> ndarray:
        """Return whether each throw landed, shape (N,), bool."""
        return self.columns["success"].astype(bool)

    def of(self, name: str) -> ndarray:
        """Return a column without the failed throws."""
        return self.columns[name][self.good]

    @property
    def miss(self) -> ndarray:
        """Return the landing points of successful throws relative to the target's position at
        impact [m], shape (N, 2): along x, and to the left.
        """
        if "goal_w" in self.columns:
            goal = self.of("goal_w")
        else:
            goal = np.array([self.unit["target"], 0.0])
        return self.of("landing_w") - goal


def key_of(unit: Unit) -> str:
    """Return the hash of a unit, 16 hexadecimal digits, independent of the order of its entries."""
    return _digest(json.dumps(unit, sort_keys=True, allow_nan=False).encode())


def hash_of(path: str | Path) -> str:
    """Return the hash of a file's content, 16 hexadecimal digits."""
    return _digest(Path(path).read_bytes())


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def policy_unit(
    policy: str,
    weights: str,
    layout: str,
    plant: str,
    target: float,
    throws: int,
    seed: int = 0,
    *,
    run: str = "",
    variant: str = "full",
    train_seed: int | None = None,
    departures: dict[str, Any] | None = None,
) -> Unit:
    """Return a unit of throws with a learnt policy at a target [m] along x.

    Args:
        policy: name of the policy. weights: :func:`hash_of` its file.
        layout: "state" or "vision". plant: name in :data:`visthrow.throws.plants.PLANTS`.
        target: distance [m]. throws: number of throws. seed: seed of initial states and noise.
        run, train_seed: config and seed of the policy's training.
        variant: "full", or the name of the difference of the training from the full one.
        departures: config key -> value, for conditions that differ from the policy's own.
    """
    return {
        "kind": "policy",
        "protocol": PROTOCOL,
        "policy": policy,
        "weights": weights,
        "layout": layout,
        "run": run or layout,
        "variant": variant,
        "train_seed": train_seed,
        "plant": plant,
        "target": float(target),
        "throws": int(throws),
        "seed": int(seed),
        "departures": dict(departures or {}),
    }


def columns_of(throws: Any) -> dict[str, ndarray]:
    """Return the arrays with one row for each throw of a dataclass of throws
    (:class:`visthrow.task.measurement.Throws`, :class:`visthrow.paper.baseline.fly_plan.Flown`).
    """
    count = len(throws.success)
    columns = {}
    for name, value in vars(throws).items():
        if isinstance(value, ndarray) and value.ndim and len(value) == count:
            columns[name] = value
    return columns


def save(folder: str | Path, result: Result) -> Path:
    """Write one result as ``<key>.json``."""
    path = Path(folder) / f"{result.key}.json"
    write_line(path, _to_json(result))
    return path


def write_line(path: str | Path, value: Any) -> None:
    """Write JSON in one line, atomically."""
    atomic_write(path, json.dumps(value, allow_nan=False) + "\n")


def load(path: str | Path) -> list[Result]:
    """Read the results in a file, a single one or a packed record.

    Raises StorageError: it is not such a file.
    """
    try:
        value = json.loads(Path(path).read_text(encoding="utf-8"))
        return [_from_json(item) for item in value.get("results", [value])]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise StorageError(
            f"{path}; expected throws as visthrow writes them; got {type(error).__name__}: {error}"
        ) from error


def load_all(places: Iterable[str | Path]) -> dict[str, Result]:
    """Read all results in folders and files, by key; for equal keys the later place counts."""
    results: dict[str, Result] = {}
    for place in map(Path, places):
        files = sorted(place.glob("*.json"))
        if place.is_file():
            files = [place]
        for path in files:
            results.update({result.key: result for result in load(path)})
    return results


def join(results: Iterable[Result]) -> list[Result]:
    """Join the batches of each set of throws, units that differ only in ``batch`` and its size, in
    order.

    Of two results for the same batch the larger counts. Units without a batch are unchanged.
    """
    whole: list[Result] = []
    groups: dict[str, dict[int, Result]] = {}
    for result in results:
        if "batch" not in result.unit:
            whole.append(result)
            continue
        common = dict(result.unit)
        del common["throws"]
        batch = common.pop("batch")
        group = groups.setdefault(key_of(common), {})
        if batch not in group or result.unit["throws"] > group[batch].unit["throws"]:
            group[batch] = result
    return whole + [_join([group[batch] for batch in sorted(group)]) for group in groups.values()]


def _join(group: list[Result]) -> Result:
    if len(group) == 1:
        return group[0]
    unit = dict(group[0].unit)
    del unit["batch"]
    unit["throws"] = sum(result.unit["throws"] for result in group)
    columns = {}
    for name in group[0].columns:
        columns[name] = np.concatenate([result.columns[name] for result in group])
    seconds = sum(result.provenance.get("seconds", 0.0) for result in group)
    return Result(unit, columns, {**group[0].provenance, "seconds": seconds}, group[0].extra)


def pack(results: Iterable[Result], path: str | Path) -> None:
    """Write results into one file, sorted by their units, so that the same results yield the same
    file.
    """
    ordered = sorted(results, key=lambda result: json.dumps(result.unit, sort_keys=True))
    lines = ",\n".join(
        json.dumps(_to_json(result), allow_nan=False, separators=(",", ":")) for result in ordered
    )
    atomic_write(path, f'{{"results": [\n{lines}\n]}}\n')


def work(
    units: Sequence[Unit],
    folder: str | Path,
    function: Callable[[Unit], tuple[dict[str, ndarray], dict[str, Any]]],
    recorded: dict[str, Result] | None = None,
    processes: int = 1,
    say: Callable[[str], None] = lambda text: None,
) -> dict[str, Result]:
    """Do the units whose results are not in the folder, in order; return the results of all units
    by key.

    Args:
        units: the requested units.
        folder: folder for the results, which are written as they finish.
        function: function of a unit that returns columns and extra figures, importable by its name.
        recorded: results from elsewhere, by key; they count as done.
        processes: number of parallel processes; 1 for this one. say: receives progress messages.
    """
    results = {**load_all([folder]), **(recorded or {})}
    todo = list({key_of(unit): unit for unit in units if key_of(unit) not in results}.values())
    begin = time.monotonic()
    one = partial(finish, folder, function, provenance.commit(), provenance.command())
    for count, (_, result) in enumerate(run_tasks(one, todo, processes), 1):
        results[result.key] = result
        remaining = (time.monotonic() - begin) / count * (len(todo) - count)
        say(f"{count} of {len(todo)} sets of throws, about {remaining:.0f} s left")
    return {key_of(unit): results[key_of(unit)] for unit in units}


def finish(folder: str | Path, function: Callable, commit: str, command: str, unit: Unit) -> Result:
    """Do one unit and write its result with commit, command, time and duration."""
    begin = time.perf_counter()
    columns, extra = function(unit)
    origin = {
        "commit": commit,
        "command": command,
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "seconds": round(time.perf_counter() - begin, 2),
    }
    return load(save(folder, Result(unit, columns, origin, extra)))[0]


def _to_json(result: Result) -> dict[str, Any]:
    throws = {name: _plain(value) for name, value in result.columns.items()}
    return {
        "unit": result.unit,
        "throws": throws,
        "provenance": result.provenance,
        "extra": result.extra,
    }


def _plain(value: ndarray) -> list:
    if value.dtype == bool:
        return value.astype(int).tolist()
    rounded = np.round(value.astype(float), DIGITS)
    return np.where(np.isfinite(rounded), rounded, None).tolist()


def _from_json(item: dict[str, Any]) -> Result:
    columns = {name: np.array(value, dtype=float) for name, value in item["throws"].items()}
    columns["success"] = columns["success"] > 0.5
    return Result(item["unit"], columns, item.get("provenance", {}), item.get("extra", {}))
