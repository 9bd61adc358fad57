"""Read recorded measurements of speed, each with command, commit and machine, and convert them to
Markdown.
"""

import json
from pathlib import Path
from typing import Any

from visthrow.common.errors import StorageError
from visthrow.view.parts import align

FOLDER = Path(__file__).with_name("records") / "bench"
PAGES = Path(__file__).with_name("records") / "pages"
"""Figures from pages of an earlier commit, in addition to those on the present pages."""
PAGE_KEYS = {"title", "source", "tables", "notes"}
KEYS = {"bench", "title", "provenance", "tables", "notes", "figures"}
"""Keys of every record.

A record of another version also has ``today``, the present command.
"""


def body(record: dict[str, Any]) -> str:
    """Return title, tables and notes of a record as Markdown."""
    tables = [
        f"**{table['title']}**\n\n{align(table['header'], table['rows'])}"
        for table in record["tables"]
    ]
    return "\n\n".join(
        [f"### {record['title']}", *tables, "\n".join(f"- {note}" for note in record["notes"])]
    ).rstrip()


def record_paths() -> list[Path]:
    """Return the files of all shipped records: those of programs, then those of pages."""
    return [*sorted(FOLDER.glob("*.json")), *sorted(PAGES.glob("*.json"))]


def origin(record: dict[str, Any]) -> str:
    """Return the provenance of a record in a few lines of Markdown."""
    if "source" in record:
        return f"From {record['source']}."
    provenance = record["provenance"]
    processors = provenance["processors"]
    machine = f"{processors['cpu']}, {processors['cores']} cores"
    if processors.get("gpu"):
        machine += f"; {', '.join(processors['gpu'])}"
    versions = ", ".join(f"{name} {version}" for name, version in provenance["versions"].items())
    return f"{provenance_of(record)}\n\n{machine}\n\n{versions}"


def provenance_of(record: dict[str, Any]) -> str:
    """Return command, time and commit of a record, and the present command if it differs."""
    provenance = record["provenance"]
    text = f"`{provenance['command']}`, {provenance['time']}, commit {provenance['commit'][:12]}"
    return f"{text}; today, from a clone: `{record['today']}`" if record.get("today") else text


def load(path: Path) -> dict[str, Any]:
    """Read a record. Raises StorageError: it is not JSON, or keys are missing."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise StorageError(f"{path.name}: not a readable record ({error})") from error
    keys = PAGE_KEYS if path.parent == PAGES else KEYS
    missing = keys - (record.keys() if isinstance(record, dict) else set())
    if missing:
        raise StorageError(f"{path.name}: not a record; missing {sorted(missing)}")
    return record
