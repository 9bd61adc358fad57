"""The results that are there, and questions to them."""

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from visthrow.common.errors import StorageError
from visthrow.throws.results import PROTOCOL, RECORDS, Result, join, load_all

SHIPPED = ("state", "vision")
"""The paper's two policies, as they come with the package."""

ANY = object()
"""Any departures."""


@dataclass(frozen=True)
class ResultSet:
    """Results, training runs and findings.

    Attributes:
        results: sets of throws, batches joined.
        runs: training runs as the records hold them.
        findings: section -> text that somebody wrote beside the data.
        note: on the number of throws, where these are few.
    """

    results: tuple[Result, ...]
    runs: tuple[dict[str, Any], ...] = ()
    findings: dict[str, str] = field(default_factory=dict)
    note: str = ""

    def policies(
        self, plant: str, target: float, *, layout: str | None = None, variant: str | None = None, policy: str | None = None,
        departures: Any = ANY,
    ) -> list[Result]:  # fmt: skip
        """Throws of learnt policies, one result a policy: of several alike the one with most throws.

        Args:
            plant: of :data:`visthrow.throws.plants.PLANTS`.
            target: [m].
            layout: "state" or "vision"; None for either.
            variant: of the training; None for any.
            policy: by its name alone; None for all.
            departures: that the throws were flown with; a dictionary, or :data:`ANY`.
        """
        wanted = {"kind": "policy", "plant": plant, "target": target}
        wanted |= {} if variant is None else {"variant": variant}
        wanted |= {} if layout is None else {"layout": layout}
        wanted |= {} if policy is None else {"policy": policy}
        wanted |= {} if departures is ANY else {"departures": departures}
        best: dict[str, Result] = {}
        for result in self.matching(**wanted):
            name = result.unit["policy"]
            if name not in best or result.unit["throws"] > best[name].unit["throws"]:
                best[name] = result
        return [best[name] for name in sorted(best)]

    def shipped(self, name: str, plant: str, target: float, departures: Any = None) -> Result | None:
        """Throws of a shipped policy under its own conditions, or with departures."""
        found = self.policies(plant, target, policy=name, departures=departures or {})
        return found[0] if found else None

    def seeds(self, layout: str, variant: str, plant: str, target: float, departures: Any = ANY) -> list[Result]:
        """Throws of runs that were trained for the comparison, shipped policies left out; one result a training seed."""
        found = self.policies(plant, target, layout=layout, variant=variant, departures=departures)
        return [result for result in found if result.unit["policy"] not in SHIPPED and result.good.any()]

    def matching(self, **wanted: Any) -> list[Result]:
        """Results whose unit has these entries."""
        return [r for r in self.results if all(r.unit.get(name) == value for name, value in wanted.items())]

    def baseline(self, plant: str, compensation: str | None = None, **wanted: Any) -> list[Result]:
        """Throws of the baseline."""
        wanted |= {} if compensation is None else {"compensation": compensation}
        return self.matching(kind="baseline", plant=plant, **wanted)

    def by_departure(self, policy: str, key: str, plant: str = "hybrid", target: float = 2.0) -> list[tuple[Any, Result]]:
        """A shipped policy's throws with one value of the config changed: the value and the throws, ascending."""
        found = [r for r in self.matching(kind="policy", policy=policy, plant=plant, target=target)
                 if list(r.unit["departures"]) == [key]]  # fmt: skip
        return sorted(((r.unit["departures"][key], r) for r in found), key=lambda pair: _first(pair[0]))


def _first(value: Any) -> float:
    return float(value[0] if isinstance(value, list) else value)


def read(records: Iterable[Path] = (RECORDS,), folders: Iterable[Path] = (), note: str = "") -> ResultSet:
    """Read committed records, and folders of single results; what an older protocol flew is left out.

    Args:
        records: folders with ``throws``, ``training`` and ``findings``; a later one counts over an earlier one.
        folders: of ``<key>.json``.
        note: on the number of throws.

    Raises:
        StorageError: a record that cannot be read.
    """
    records = [Path(place) for place in records]
    found = load_all([*(place / "throws" for place in records), *folders]).values()
    runs: dict[str, dict] = {}
    findings: dict[str, str] = {}
    for place in records:
        for path in sorted((place / "training").glob("*.json")):
            runs.update({run.get("name", f"{run['run']}-{run['train_seed']}"): run for run in _runs(path)})
        for path in sorted((place / "findings").glob("*.md")):
            findings[path.stem] = path.read_text(encoding="utf-8").strip()
    today = [result for result in found if result.unit.get("protocol") == PROTOCOL]
    return ResultSet(tuple(join(today)), tuple(runs.values()), findings, note)


def _runs(path: Path) -> list[dict[str, Any]]:
    try:
        return json.loads(path.read_text(encoding="utf-8"))["runs"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StorageError(f"{path}; expected a record of training runs; got {type(error).__name__}: {error}") from error


def errors(results: Iterable[Result]) -> list[np.ndarray]:
    """Landing errors of each run [m]."""
    return [result.of("error") for result in results if result.good.any()]


def durations(results: Iterable[Result]) -> list[np.ndarray]:
    """Times from start to landing of each run [s]."""
    return [result.of("duration") for result in results if result.good.any()]


def misses(results: Iterable[Result]) -> list[np.ndarray]:
    """Misses of each run, along the throw and to the left [m]."""
    return [result.miss for result in results if result.good.any()]


def landed(results: Iterable[Result]) -> float:
    """Share of throws that landed."""
    results = list(results)
    return float(np.mean(np.concatenate([result.good for result in results]))) if results else 0.0
