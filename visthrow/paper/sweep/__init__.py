"""Lists of training runs and throws, files of ``configs/sweep``: worked in resumable pieces, on
several GPUs or a cluster, never twice.

``units`` cuts a list into units and knows which are done, ``work`` does them, ``pool`` hands them
out, ``record`` condenses the results into what is committed. The schema of a list is here."""

from dataclasses import dataclass
from typing import Literal

from visthrow.common.errors import ConfigError, suggest
from visthrow.config.bounds import Bounded, Positive
from visthrow.throws.plants import check_plant

Changes = tuple[str, ...]
"""Changes of a config, ``key=value`` each."""


@dataclass(frozen=True)
class ThrowParams(Bounded):
    """Throws of every policy that names them."""

    plant: str  # of visthrow.throws.plants.PLANTS
    targets: tuple[Positive, ...]  # along x [m]
    count: int  # of each policy at each target
    seed: int = 0  # of starts and noise
    fly_in: Literal["own", "full"] = (
        "own"  # the policy's training config, or its layout's full one (state, vision_ideal)
    )
    changes: Changes = ()  # key=value of that config
    allow: tuple[
        str, ...
    ] = ()  # parts of the policy's contract that may be broken so; recorded as departures

    def __post_init__(self) -> None:
        super().__post_init__()
        check_plant(self.plant)
        if self.count < 1 or not self.targets:
            raise ConfigError(
                f"{self.count} throws at the targets {self.targets}; expected 1 or more of each"
            )


@dataclass(frozen=True)
class RunGroup:
    """Training runs, or policies that are there already, with the throws that each is to fly."""

    throws: tuple[str, ...]  # names of tables of throws
    configs: tuple[str, ...] = ()  # of configs/train, or TOML files
    seeds: tuple[int, ...] = (1,)  # every config with every one of them, seed after seed
    changes: Changes = ()  # key=value of the configs
    policies: tuple[str, ...] = ()  # shipped names, or files, that need no training


@dataclass(frozen=True)
class SweepList:
    """The work of a sweep, the most important first."""

    runs: dict[str, RunGroup]
    throws: dict[str, ThrowParams]
    commit: Literal["any", "same"] = "any"  # whether a run by another commit counts as done
    changes: Changes = ()  # key=value of every training config
    most_throws: int | None = None  # in any set; for a trial of the list
    checkpoint_every: int = (
        100  # iterations: what a killed training loses at most, about 14 s of one H200
    )

    def __post_init__(self) -> None:
        for name, group in self.runs.items():
            for label in group.throws:
                if label not in self.throws:
                    raise ConfigError(
                        f"runs.{name}: no throws '{label}'; {suggest(label, self.throws)}"
                    )
