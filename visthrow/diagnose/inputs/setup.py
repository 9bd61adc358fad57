"""A diagnosis setup: how to read logs, and the model to compare them with."""

from collections.abc import Container, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sim.params import LawParams
from visthrow import config
from visthrow.common.errors import ConfigError
from visthrow.diagnose.models.ball import BallModel, BallParams
from visthrow.diagnose.models.numeric import NumericModel
from visthrow.diagnose.models.quadrotor.flyer import FlyerModel
from visthrow.diagnose.models.quadrotor.flyer_params import FlyerParams
from visthrow.diagnose.models.quadrotor.imu import UNREAD, ImuModel, ImuParams
from visthrow.diagnose.models.stand import StandModel, StandParams
from visthrow.logs import read_all, takes_mapping
from visthrow.logs.check.rows import KnownVehicle
from visthrow.logs.flightlog import FlightLog
from visthrow.logs.mapping import TableMap

VELOCITIES = frozenset({"vel_w", "vel_b", "payload_vel_w"})  # not used by any vehicle's model
MODELS: dict[str, Any] = {
    "ball": BallModel,
    "stand": StandModel,
    "flyer": FlyerModel,
    "imu": ImuModel,
}
"""Table of a setup -> model whose parameters it holds."""


@dataclass(frozen=True)
class Setup:
    """A file of ``configs/diagnose``, with at most one of the models.

    Raises ConfigError: more than one model.
    """

    about: str  # origin of the logs
    example: str = ""  # folder of the program that holds the model, if none of the tables does
    table: TableMap | None = None  # mapping of columns; None: logs describe their own contents
    ball: BallParams | None = None
    stand: StandParams | None = None
    flyer: FlyerParams | None = None
    imu: ImuParams | None = None
    # sizes that a diagnosis found, written by apply
    effects: dict[str, float] = field(default_factory=dict)
    laws: tuple[LawParams, ...] = ()  # laws that a diagnosis found, written by apply

    def __post_init__(self) -> None:
        named = [name for name in MODELS if getattr(self, name) is not None]
        if len(named) > 1:
            raise ConfigError(f"{' and '.join(named)}: a setup has only one model")

    @property
    def model(self) -> str:
        """Name of the model that has a table, or "" if none has."""
        return next((name for name in MODELS if getattr(self, name) is not None), "")


def model_of(setup: Setup, logs: Sequence[FlightLog]) -> NumericModel:
    """Build a setup's model of logs.

    Raises ConfigError: the setup has no model; LogError: the logs hold no data for the model, or
    the model does not have an effect or law of the setup."""
    if not setup.model and setup.example:
        raise ConfigError(
            f"the setup '{setup.about}' only reads the columns; its model is a program of the"
            f" repository: {setup.example}"
        )
    if not setup.model:
        raise ConfigError(
            f"the setup '{setup.about}' has no model; expected a table of one of:"
            f" {', '.join(MODELS)}"
        )
    model: NumericModel = MODELS[setup.model](logs, getattr(setup, setup.model))
    model.extend(setup.effects, setup.laws)
    return model


def load(name: str | Path | None) -> Setup:
    """Load a setup by its name in ``configs/diagnose``, or a file; without a name, an empty setup.

    Raises ConfigError: there is no such setup, or it does not match the schema.
    """
    if name is None:
        return Setup("")
    return config.load(Setup, config.find("diagnose", str(name)))


def describe_vehicle(name: str | Path | None, plant: str | None = None) -> KnownVehicle:
    """Return the known properties of a vehicle, from a setup or the plant of an experiment.

    ``name``: of a setup, or None; ``plant``: name in configs/train or a file, used only if the
    setup has no flying model. Raises ConfigError: from :func:`load`.
    """
    setup = load(name)
    if (imu := setup.imu) is not None:
        unread = VELOCITIES | UNREAD
        return KnownVehicle(0.0, imu.mass, imu.input, imu.thrust_map, unread)
    if (flyer := setup.flyer) is not None:
        length = flyer.cable.length - flyer.cable.mount[2] if flyer.cable is not None else 0.0
        return KnownVehicle(length, flyer.total_mass, flyer.input, flyer.thrust_map, VELOCITIES)
    if plant is None:
        return KnownVehicle(unread=VELOCITIES)
    from visthrow.task import load_experiment, plant_of

    trained = plant_of(load_experiment(plant))
    rope = trained.rope
    length = rope.length + rope.payload_offset
    hanging = rope.rope_mass + rope.payload_mass
    return KnownVehicle(length, trained.vehicle.body.mass + hanging)


def read_logs(
    paths: Sequence[str | Path], name: str | Path | None = None, models: Container[str] = MODELS
) -> list[FlightLog]:
    """Read logs; tables by the mapping of the setup ``name``.

    ``models``: models for which a setup is useful although no log is a table. Raises LogError,
    ConfigError: from the readers and :func:`load`; ConfigError: no log is a table, and the setup is
    only for tables."""
    chosen = load(name)
    logs = read_all(paths, chosen.table)
    of_use = chosen.table is None or chosen.model in models
    if not of_use and paths and not any(map(takes_mapping, paths)):
        raise ConfigError(
            f"the setup '{name}' is not used: it states how to read the columns of a table, and"
            f" {', '.join(map(str, paths))} needs no mapping; expected a table, or no"
            " --config"
        )
    return logs
