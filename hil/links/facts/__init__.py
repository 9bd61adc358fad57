"""Facts about firmwares from their public sources: one TOML file for each firmware, one row for
each fact.

A row holds the value, its file and line (``at``), some words of that line (``text``), and its
meaning. ``version`` is the tag of the source and ``repository`` where it is published; a row from
another version states that version. Back-ends, rehearsal vehicles, audits and pages take the values
only from here. ``python -m bench.facts`` compares the rows with a checkout.
"""

import tomllib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from visthrow.common.errors import ConfigError, suggest

FOLDER = Path(__file__).parent
HEAD = ("repository", "version")  # keys of a file that are not facts


@dataclass(frozen=True)
class Fact:
    """A property of a firmware, with the line of its source that shows it."""

    value: Any  # in SI units, if it has a unit
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
