"""The available results, and queries on them."""

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from visthrow.common import statistics as st
from visthrow.common.errors import StorageError
from visthrow.common.toml_text import tables_beside
from visthrow.paper import RECORDS
from visthrow.paper.report.charts import Line
from visthrow.paper.results import PROTOCOL, Result, join, load_all

SHIPPED = ("state", "vision")  # the paper's two policies, in the package

Points = list[tuple[float, Result]]
"""Values, each with its throws."""

ANY = object()  # any departures

PARTS = ("throws", "training", "findings")  # subfolders of a folder of records

WORDS = tables_beside(__file__, "report.toml")

SHORT: dict[str, str] = WORDS["plants"]
"""Plant -> its name in tables."""


@dataclass(frozen=True)
class ResultSet:
    """Results, training runs and findings."""

    results: tuple[Result, ...]  # sets of throws, with batches joined
    runs: tuple[dict[str, Any], ...] = ()  # training runs, in the form of the records
    # section -> recorded text on its data
    findings: dict[str, str] = field(default_factory=dict)

    def policies(
        self, plant: str, target: float, departures: Any = ANY, **conditions: str
    ) -> list[Result]:
        """Return the throws of learnt policies at a target [m], one result for each policy: the one
        with the most throws.

        Args:
            plant, target: plant and target of the throws.
            departures: departures under which they were flown; :data:`ANY` for all.
            conditions: layout, variant or policy.
        """
        if departures is not ANY:
            conditions |= {"departures": departures}
        matching = self.find_results(kind="policy", plant=plant, target=target, **conditions)
        ascending = sorted(matching[::-1], key=lambda result: result.unit["throws"])
        best = {result.unit["policy"]: result for result in ascending}
        return [best[name] for name in sorted(best)]

    def shipped_throws(self, name: str, plant: str, target: float) -> Result | None:
        """Return the throws of a shipped policy under its own conditions."""
        return next(iter(self.policies(plant, target, {}, policy=name)), None)

    def seeds(
        self, layout: str, variant: str, plant: str, target: float, departures: Any = ANY
    ) -> list[Result]:
        """Return the throws of policies that were trained for the comparison, without shipped ones;
        one result for each training seed.
        """
        return [
            result
            for result in self.policies(plant, target, departures, layout=layout, variant=variant)
            if result.unit["policy"] not in SHIPPED and result.good.any()
        ]

    def find_results(self, **conditions: Any) -> list[Result]:
        """Return the results whose unit has these entries."""
        return [
            r
            for r in self.results
            if all(r.unit.get(name) == value for name, value in conditions.items())
        ]

    def throws_by_value(
        self, policy: str, key: str, plant: str, target: float
    ) -> list[tuple[Any, Result]]:
        """Return a policy's throws with a single value of the config changed, if any landed: the
        value and the throws.
        """
        return [
            (r.unit["departures"][key], r)
            for r in self.find_results(kind="policy", policy=policy, plant=plant, target=target)
            if list(r.unit["departures"]) == [key] and r.good.any()
        ]


def read(records: Iterable[Path] = (RECORDS,), folders: Iterable[Path] = ()) -> ResultSet:
    """Read committed records, folders with ``throws``, ``training`` and ``findings``, and folders
    of single results, ``<key>.json``.

    Later results replace earlier ones; those of an older protocol are omitted. Raises StorageError:
    a file cannot be read."""
    records = [Path(place) for place in records]
    collected = load_all([*(place / PARTS[0] for place in records), *folders]).values()
    runs: dict[str, dict] = {}
    findings: dict[str, str] = {}
    for place in records:
        for path in sorted((place / PARTS[1]).glob("*.json")):
            runs.update(
                {run.get("name", f"{run['run']}-{run['train_seed']}"): run for run in runs_of(path)}
            )
        for path in sorted((place / PARTS[2]).glob("*.md")):
            findings[path.stem] = path.read_text(encoding="utf-8").strip()
    today = [result for result in collected if result.unit.get("protocol") == PROTOCOL]
    return ResultSet(tuple(join(today)), tuple(runs.values()), findings)


def runs_of(path: Path) -> list[dict[str, Any]]:
    """Return the training runs of a record. Raises StorageError: the file is not such a record."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))["runs"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StorageError(
            f"{path}; expected a record of training runs; got {type(error).__name__}: {error}"
        ) from error


def errors(results: Iterable[Result]) -> list[ndarray]:
    """Return the landing errors of each run [m]."""
    return [result.of("error") for result in results if result.good.any()]


def format_landed_share(*results: Result, digits: int = 1) -> str:
    """Return the share of throws that landed, as text."""
    return f"{100 * np.mean(np.concatenate([result.good for result in results])):.{digits}f} %"


def cells(*results: Result) -> dict[str, str]:
    """Return heading -> cell of tables, for throws of the same kind from one or more trainings."""
    unit = results[0].unit
    row = {
        "policy": unit.get("policy", "-"),
        "plant": SHORT[unit["plant"]],
        "target [m]": f"{unit['target']:.1f}",
        "trainings": str(len(results)),
        "throws": str(sum(len(result.good) for result in results)),
        "landed": format_landed_share(*results),
    }
    if landings := errors(results):
        durations = [result.of("duration") for result in results if result.good.any()]
        row["landing error [m]"] = st.mean(landings).text()
        row["duration [s]"] = f"{np.mean([part.mean() for part in durations]):.3f}"
    return row


def line(label: str, points: Points, series: int, nominal: float | None = None) -> Line:
    """Return the curve of mean landing errors over values; ``nominal``: the policy's own value."""
    intervals = [st.mean(result.of("error")) for _, result in points]
    values = [value for value, _ in points]
    return Line(
        label, values, intervals, series, values.index(nominal) if nominal in values else None
    )
