"""The available results, and queries of them."""

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

SHIPPED = ("state", "vision")  # the paper's two policies, as they come with the package

Points = list[tuple[float, Result]]
"""Values, and what was thrown with each."""

ANY = object()  # any departures

PARTS = ("throws", "training", "findings")  # folders of a folder of records

WORDS = tables_beside(__file__, "report.toml")

SHORT: dict[str, str] = WORDS["plants"]
"""Plant -> its name in tables."""


@dataclass(frozen=True)
class ResultSet:
    """Results, training runs and findings."""

    results: tuple[Result, ...]  # sets of throws, batches joined
    runs: tuple[dict[str, Any], ...] = ()  # as the records hold them
    # section -> text written beside the data
    findings: dict[str, str] = field(default_factory=dict)

    def policies(
        self, plant: str, target: float, departures: Any = ANY, **conditions: str
    ) -> list[Result]:
        """Throws of learnt policies at a target [m], one result a policy: of several alike the one
        with most throws.

        Args:
            plant, target: of the throws.
            departures: with which they were flown; :data:`ANY` do not matter.
            conditions: layout, variant or policy.
        """
        if departures is not ANY:
            conditions |= {"departures": departures}
        matching = self.find_results(kind="policy", plant=plant, target=target, **conditions)
        ascending = sorted(matching[::-1], key=lambda result: result.unit["throws"])
        best = {result.unit["policy"]: result for result in ascending}
        return [best[name] for name in sorted(best)]

    def shipped_throws(self, name: str, plant: str, target: float) -> Result | None:
        """Throws of a shipped policy under its own conditions."""
        return next(iter(self.policies(plant, target, {}, policy=name)), None)

    def seeds(
        self, layout: str, variant: str, plant: str, target: float, departures: Any = ANY
    ) -> list[Result]:
        """Throws of runs that were trained for the comparison, shipped policies left out; one
        result a training seed.
        """
        return [
            result
            for result in self.policies(plant, target, departures, layout=layout, variant=variant)
            if result.unit["policy"] not in SHIPPED and result.good.any()
        ]

    def find_results(self, **conditions: Any) -> list[Result]:
        """Results whose unit has these entries."""
        return [
            r
            for r in self.results
            if all(r.unit.get(name) == value for name, value in conditions.items())
        ]

    def throws_by_value(
        self, policy: str, key: str, plant: str, target: float
    ) -> list[tuple[Any, Result]]:
        """Return a policy's throws with one value of the config changed, where any landed: the
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

    A later one counts over an earlier one; what an older protocol flew is left out. StorageError
    for what cannot be read."""
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
    """Training runs of a record; StorageError where it is none."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))["runs"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StorageError(
            f"{path}; expected a record of training runs; got {type(error).__name__}: {error}"
        ) from error


def errors(results: Iterable[Result]) -> list[ndarray]:
    """Landing errors of each run [m]."""
    return [result.of("error") for result in results if result.good.any()]


def format_landed_share(*results: Result, digits: int = 1) -> str:
    """Share of throws that landed."""
    return f"{100 * np.mean(np.concatenate([result.good for result in results])):.{digits}f} %"


def cells(*results: Result) -> dict[str, str]:
    """Return what tables say of throws of one kind, of one training or more, by heading."""
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
    """Return the curve of mean landing errors over values; ``nominal``: the policy's value."""
    intervals = [st.mean(result.of("error")) for _, result in points]
    values = [value for value, _ in points]
    return Line(
        label, values, intervals, series, values.index(nominal) if nominal in values else None
    )
