"""A diagnosis setup: how logs are read, which simulation they are held against, and its parameters."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from visthrow.diagnose.ingest.mapping import TableMap
from visthrow.flightlog import FlightLog


@dataclass(frozen=True)
class Setup:
    """File of ``configs/diagnose``."""

    about: str  # whose logs these are
    table: TableMap | None = None  # of tables' columns; None: the logs say themselves what they hold


def load(name: str | Path) -> Setup:
    """Load a setup by its name in ``configs/diagnose``, or a file.

    Raises:
        ConfigError: There is none, or it does not fill the schema.
    """
    from visthrow import config

    return config.load(Setup, config.find("diagnose", str(name)))


def read_logs(paths: Sequence[str | Path], name: str | Path | None = None) -> list[FlightLog]:
    """Read logs, tables by the setup's mapping.

    Args:
        paths: Files or folders.
        name: Of a setup, or None.

    Raises:
        LogError, ConfigError: As the readers and :func:`load`.
    """
    from visthrow.diagnose.ingest import read_all

    return read_all(paths, load(name).table if name is not None else None)
