"""The results that are there, and questions to them."""

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from visthrow.common.errors import StorageError
from visthrow.paper import RECORDS
from visthrow.throws.results import PROTOCOL, Result, join, load_all

SHIPPED = ("state", "vision")  # the paper's two policies, as they come with the package

ANY = object()  # any departures

PARTS = ("throws", "training", "findings")  # folders of a folder of records


@dataclass(frozen=True)
class ResultSet:
    """Results, training runs and findings."""

    results: tuple[Result, ...]  # sets of throws, batches joined
    runs: tuple[dict[str, Any], ...] = ()  # as the records hold them
    # section -> text that somebody wrote beside the data
    findings: dict[str, str] = field(default_factory=dict)

    def policies(
        self,
        plant: str,
        target: float,
        *,
        layout: str | None = None,
        variant: str | None = None,
        policy: str | None = None,
        departures: Any = ANY,
    ) -> list[Result]:
        """Throws of learnt policies at a target [m], one result a policy: of several alike the one
        with most throws.

        What is None does not matter, nor do departures, with which the throws were flown, that are
        :data:`ANY`."""
        conditions = {
            "layout": layout,
            "variant": variant,
            "policy": policy,
            "departures": None if departures is ANY else departures,
        }
        conditions = {name: value for name, value in conditions.items() if value is not None}
        best: dict[str, Result] = {}
        for result in self.matching(kind="policy", plant=plant, target=target, **conditions):
            name = result.unit["policy"]
            if name not in best or result.unit["throws"] > best[name].unit["throws"]:
                best[name] = result
        return [best[name] for name in sorted(best)]

    def shipped(self, name: str, plant: str, target: float) -> Result | None:
        """Throws of a shipped policy under its own conditions."""
        collected = self.policies(plant, target, policy=name, departures={})
        return collected[0] if collected else None

    def seeds(
        self, layout: str, variant: str, plant: str, target: float, departures: Any = ANY
    ) -> list[Result]:
        """Throws of runs that were trained for the comparison, shipped policies left out; one
        result a training seed.
        """
        collected = self.policies(
            plant, target, layout=layout, variant=variant, departures=departures
        )
        return [
            result
            for result in collected
            if result.unit["policy"] not in SHIPPED and result.good.any()
        ]

    def matching(self, **conditions: Any) -> list[Result]:
        """Results whose unit has these entries."""
        return [
            r
            for r in self.results
            if all(r.unit.get(name) == value for name, value in conditions.items())
        ]

    def by_departure(
        self, policy: str, key: str, plant: str = "hybrid", target: float = 2.0
    ) -> list[tuple[Any, Result]]:
        """Return a shipped policy's throws with one value of the config changed: the value and the
        throws, ascending.
        """
        collected = [
            r
            for r in self.matching(kind="policy", policy=policy, plant=plant, target=target)
            if list(r.unit["departures"]) == [key]
        ]
        return sorted(
            ((r.unit["departures"][key], r) for r in collected),
            key=lambda pair: float(np.ravel(pair[0])[0]),
        )


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


def errors(results: Iterable[Result]) -> list[np.ndarray]:
    """Landing errors of each run [m]."""
    return [result.of("error") for result in results if result.good.any()]


def landed(*results: Result, digits: int = 1) -> str:
    """Share of throws that landed."""
    return f"{100 * np.mean(np.concatenate([result.good for result in results])):.{digits}f} %"
