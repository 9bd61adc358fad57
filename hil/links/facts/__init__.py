"""What firmwares do, by their public sources: a TOML file a firmware, a row a fact.

A row names the value, the file and line (``at``) that it was read from, some words of that line
(``text``), and what it means. ``version`` is the tag of the source, ``repository`` where it is
published; a row of another version names its own. Back-ends, rehearsal vehicles, audits and pages
read values from here alone. ``python -m bench.facts`` compares the rows with a checkout.
"""

import tomllib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from visthrow.common.errors import ConfigError, suggest

FOLDER = Path(__file__).parent
HEAD = ("repository", "version")  # keys of a file that are no facts


@dataclass(frozen=True)
class Fact:
    """A behaviour of a firmware that a line of its source shows."""

    value: Any  # SI units where it has one
    at: str  # file:line
    text: str  # some words of that line
    means: str
    version: str  # tag of the source
    repository: str  # owner/name


@cache
def facts(firmware: str) -> dict[str, Fact]:
    """Return the facts of a firmware by name; raises `ConfigError` for one without a file."""
    path = FOLDER / f"{firmware}.toml"
    if not path.exists():
        firmwares = [file.stem for file in FOLDER.glob("*.toml")]
        raise ConfigError(f"no facts of firmware '{firmware}'; {suggest(firmware, firmwares)}")
    rows = tomllib.loads(path.read_text(encoding="utf-8"))
    head = {name: rows.pop(name) for name in HEAD}
    return {name: Fact(**{**head, **row}) for name, row in rows.items()}


@cache
def values(firmware: str) -> dict[str, Any]:
    """Return the values of a firmware's facts by name; raises `ConfigError` as :func:`facts`."""
    return {name: fact.value for name, fact in facts(firmware).items()}
