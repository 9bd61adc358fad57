"""Do lists of training runs and throws, files of ``configs/sweep``, in resumable units, on several
GPUs or a cluster, and none twice.

``work_units`` divides a list into units and checks which are done, ``work`` does them, ``pool``
distributes them, and ``sweep_record`` condenses the results into committed records. The schema of a
list is in this module."""

from dataclasses import dataclass
from typing import Literal

from visthrow.common.errors import ConfigError, suggest
from visthrow.config.bounds import Bounded, Positive
from visthrow.throws.plants import check_plant

Changes = tuple[str, ...]
"""Changes of a config, ``key=value`` each."""


@dataclass(frozen=True)
class ThrowParams(Bounded):
    """A set of throws, which groups of runs refer to by name."""

    plant: str  # name in visthrow.throws.plants.PLANTS
    targets: tuple[Positive, ...]  # distances along x [m]
    count: int  # throws of each policy at each target
    seed: int = 0  # seed of initial states and noise
    fly_in: Literal["own", "full"] = (
        "own"  # the policy's training config, or its layout's full one (state, vision_ideal)
    )
    changes: Changes = ()  # key=value changes of this config
    allow: tuple[
        str, ...
    ] = ()  # parts of the policy's contract that may be violated; recorded as departures

    def __post_init__(self) -> None:
        super().__post_init__()
        check_plant(self.plant)
        if self.count < 1 or not self.targets:
            raise ConfigError(
                f"{self.count} throws at the targets {self.targets}; expected 1 or more of each"
            )


@dataclass(frozen=True)
class RunGroup:
    """Training runs or existing policies, with the throws that each flies."""

    throws: tuple[str, ...]  # names of sets of throws
    configs: tuple[str, ...] = ()  # names in configs/train, or TOML files
    seeds: tuple[int, ...] = (1,)  # each config is trained with each seed, ordered by seed
    changes: Changes = ()  # key=value changes of the configs
    policies: tuple[str, ...] = ()  # shipped names or files of existing policies


@dataclass(frozen=True)
class SweepList:
    """The work of a sweep, in the order of importance."""

    runs: dict[str, RunGroup]
    throws: dict[str, ThrowParams]
    commit: Literal["any", "same"] = "any"  # whether a run by another commit counts as done
    changes: Changes = ()  # key=value changes of every training config
    most_throws: int | None = None  # largest number of throws in a set, for a trial of the list
    checkpoint_every: int = (
        100  # iterations; a killed training loses at most these, about 14 s of one H200
    )

    def __post_init__(self) -> None:
        for name, group in self.runs.items():
            for label in group.throws:
                if label not in self.throws:
                    raise ConfigError(
                        f"runs.{name}: no throws '{label}'; {suggest(label, self.throws)}"
                    )
