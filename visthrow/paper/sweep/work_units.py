"""Units of work of a list, training runs and sets of throws, with the files of their results.

A training run is identified by a hash of its resolved config, its seed and, if the list requires
it, the commit; a changed config yields another run with another folder. Throws are identified as in
:mod:`visthrow.paper.results`, by everything that they depend on, including the policy file's
content."""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from visthrow import config
from visthrow.common import provenance
from visthrow.common.errors import ConfigError, suggest
from visthrow.onboard.policy import find_policy
from visthrow.paper import results
from visthrow.paper.sweep import Changes, SweepList, ThrowParams
from visthrow.task import Experiment, load_experiment
from visthrow.throws.reference_protocol import batches

FULL = {"state": "state", "vision": "vision_ideal"}
"""Layout -> the full training config, with which variants are compared."""

POLICY = "policy.npz"
SUMMARY = "summary.json"
PROGRESS = "progress.csv"

_experiment = cache(load_experiment)


@dataclass(frozen=True)
class ResultSource:
    """A policy to train, or an existing one."""

    # <config>-<seed> for a training, <config>-<group>-<seed> with changes of its group
    name: str
    config: str = ""  # name in configs/train; empty for an existing policy
    changes: Changes = ()
    seed: int = 0
    key: str = ""  # hash of the training; empty for an existing policy

    @property
    def id(self) -> str:
        """Return the name on the command line and of the training's folder."""
        return f"{self.name}-{self.key[:8]}" if self.key else self.name

    @property
    def iterations(self) -> int:
        """Return the number of iterations of the training."""
        return self.experiment().iterations

    def folder(self, out: Path) -> Path:
        """Return the folder of the training run."""
        return out / "train" / self.id

    def policy(self, out: Path) -> Path:
        """Return the policy's path, whether the file exists or not."""
        return self.folder(out) / POLICY if self.config else find_policy(self.name)

    def is_done(self, out: Path) -> bool:
        """Return whether the policy exists and, for a training, its summary."""
        return not self.config or (self.folder(out) / SUMMARY).is_file()

    def experiment(self) -> Experiment:
        """Return the experiment of the training."""
        return _experiment(self.config, self.changes)

    @property
    def flown(self) -> Changes:
        """Return the changes of the config under which the policy is flown."""
        return self.changes + self.experiment().flown if self.config else ()


@dataclass(frozen=True)
class ThrowUnit:
    """Throws of one policy at one target: all of them in the training simulator, or one batch on a
    reference plant.
    """

    source: ResultSource
    set: str  # name of the set of throws
    params: ThrowParams
    target: float  # [m]
    count: int
    batch: int | None = None

    @property
    def id(self) -> str:
        """Return the name on the command line."""
        place = "" if self.batch is None else f":{self.batch}"
        return f"{self.source.id}:{self.set}:{self.target:g}{place}"

    def unit(self, out: Path) -> results.Unit:
        """Return the unit of :mod:`visthrow.paper.results`; the policy must exist."""
        source = self.source
        params = self.params
        path = source.policy(out)
        nominal, flown = self.experiments(out)
        layout = nominal["task"]["observation"]["layout"]
        run, seed = (source.config, source.seed) if source.config else (layout, None)
        unit = results.policy_unit(
            source.name,
            _hash(path, path.stat().st_mtime_ns),
            layout,
            params.plant,
            self.target,
            self.count,
            params.seed,
            run=Path(run).stem,
            variant=variant_of(run),
            train_seed=seed,
            departures=differences(nominal, flown),
        )
        return unit if self.batch is None else {**unit, "batch": self.batch}

    def experiments(self, out: Path) -> tuple[dict, dict]:
        """Return the policy's config and the config in which it is flown, without learning
        parameters.
        """
        source = self.source

        def state_config(name: str, changes: Changes) -> dict[str, Any]:
            if name:
                values = config.to_dict(_experiment(name, changes))
            else:
                values = _shipped_config(source.policy(out), changes)
            return {key: value for key, value in values.items() if key != "ppo"}

        nominal = state_config(source.config, source.flown)
        return nominal, state_config(*self.flight_config(nominal["task"]["observation"]["layout"]))

    def flight_config(self, layout: str) -> tuple[str, Changes]:
        """Return the config of ``configs/train`` to fly in, empty for that in the policy's file,
        and its changes.
        """
        if self.params.fly_in == "full":
            return FULL[layout], self.params.changes
        return self.source.config, self.source.flown + self.params.changes

    def is_done(self, out: Path) -> bool:
        """Return whether the result exists."""
        return (
            self.source.is_done(out)
            and (throws_folder(out) / f"{results.key_of(self.unit(out))}.json").is_file()
        )


@dataclass(frozen=True)
class SweepWork:
    """All units of a list, in the order of importance."""

    name: str
    sources: tuple[ResultSource, ...]
    throws: dict[str, tuple[ThrowUnit, ...]]  # by the policy's id
    checkpoint_every: int  # iterations

    def source(self, name: str) -> ResultSource:
        """Return the training with this id. Raises ConfigError: the list does not contain it."""
        sources = {source.id: source for source in self.sources}
        if name not in sources:
            raise ConfigError(f"no run '{name}' in the list; {suggest(name, sources)}")
        return sources[name]


def throws_folder(out: Path) -> Path:
    """Return the folder of results of throws."""
    return out / "throws"


def variant_of(run: str) -> str:
    """Return the name of a training config's difference from its layout's full config, such as
    ``no_delay`` for ``state_no_delay``.
    """
    stem = Path(run).stem
    layout, _, variant = stem.partition("_")
    return "full" if stem in FULL.values() else variant if layout in FULL and variant else stem


def load_list(name: str, overrides: Changes = ()) -> SweepWork:
    """Load a list, a name in ``configs/sweep`` or a file, and divide it into units.

    Raises ConfigError: the list is invalid.
    """
    path = config.find("sweep", name)
    return expand(path.stem, config.load(SweepList, path, overrides))


def expand(name: str, params: SweepList) -> SweepWork:
    """Divide a list into units. Raises ConfigError: a config, change or policy does not exist."""
    sources: dict[str, ResultSource] = {}
    throws: dict[str, list[ThrowUnit]] = {}
    commit = provenance.commit() if params.commit == "same" else ""
    for called, group in params.runs.items():
        changes = params.changes + group.changes
        mark = f"{called}-" if group.changes else ""
        trained = [
            _make_training(item, mark, changes, seed, commit)
            for seed in group.seeds
            for item in group.configs
        ]
        for source in [*(ResultSource(str(policy)) for policy in group.policies), *trained]:
            sources.setdefault(source.id, source)
            listed = throws.setdefault(source.id, [])
            for label in group.throws:
                throw = params.throws[label]
                count = min(throw.count, params.most_throws or throw.count)
                fresh = _throws(source, label, replace(throw, count=count))
                listed.extend(unit for unit in fresh if unit not in listed)
    return SweepWork(
        name,
        tuple(sources.values()),
        {key: tuple(units) for key, units in throws.items()},
        params.checkpoint_every,
    )


def differences(base: dict, flown: dict, path: str = "") -> dict[str, Any]:
    """Return dotted key -> value in ``flown``, for all differences of two configs."""
    changed: dict[str, Any] = {}
    for key in sorted(base.keys() | flown.keys()):
        before = base.get(key)
        value = flown.get(key)
        if isinstance(before, dict) and isinstance(value, dict):
            changed |= differences(before, value, f"{path}{key}.")
        elif before != value:
            changed[f"{path}{key}"] = value
    return changed


def _make_training(name: str, mark: str, changes: Changes, seed: int, commit: str) -> ResultSource:
    # without defaults, so that a new field with a default does not change keys
    stated = config.to_dict(_experiment(name, changes), defaults=False)
    key = results.key_of({"config": stated, "seed": seed, **({"commit": commit} if commit else {})})
    return ResultSource(f"{Path(name).stem}-{mark}{seed}", name, changes, seed, key)


def _throws(source: ResultSource, name: str, params: ThrowParams) -> list[ThrowUnit]:
    if params.plant == "hybrid":
        return [ThrowUnit(source, name, params, target, params.count) for target in params.targets]
    cut = batches(params.count)
    return [
        ThrowUnit(source, name, params, target, size, batch)
        for target in params.targets
        for batch, size in cut
    ]


@cache
def _hash(path: Path, changed: int) -> str:
    return results.hash_of(path)


@cache
def _shipped_config(path: Path, changes: Changes) -> dict[str, Any]:
    from visthrow.throws.loading import load_policy

    return config.to_dict(load_policy(path, None, changes, allow=_ANYTHING).experiment)


_ANYTHING = (
    *("observation", "action", "control_period", "release"),
    *("vehicle", "rope", "air", "laws", "camera"),
)
"""All sections of a contract, which may differ here because the config is only read."""
