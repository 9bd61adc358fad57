"""Reports of measurements: printed as Markdown, written as JSON with their provenance, kept in the package."""

import argparse
import json
import re
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from visthrow.common import provenance
from visthrow.common.errors import StorageError, VisthrowError, suggest
from visthrow.common.storage import write_json
from visthrow.view.parts import aligned

FOLDER = Path(__file__).resolve().parent / "records"
FURTHER_PACKAGES = ("mujoco-warp",)
KEYS = {"bench", "title", "provenance", "tables", "notes", "figures"}
_NAME = re.compile(r"[a-z0-9][a-z0-9_-]*")


@dataclass(frozen=True)
class Table:
    """A table as it is printed: every cell is text."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Report:
    """One measurement."""

    bench: str  # which of ``visthrow bench`` made it
    title: str
    tables: tuple[Table, ...]
    notes: tuple[str, ...]  # sentences below the tables: how it was measured, what a number does not say
    figures: dict[str, Any] = field(default_factory=dict)  # the numbers behind the tables, SI units, for programs

    def record(self) -> dict[str, Any]:
        """The report with its provenance, as JSON holds it."""
        origin = provenance.collect()
        for name in FURTHER_PACKAGES:
            try:
                origin["versions"][name] = metadata.version(name)
            except metadata.PackageNotFoundError:
                continue
        return {**asdict(self), "provenance": origin}


def rate(per_second: float) -> str:
    """A rate as text: in millions from 100,000 on."""
    return f"{per_second / 1e6:,.2f} M" if per_second >= 1e5 else f"{per_second:,.0f}"


def finish(report: Report, args: argparse.Namespace) -> int:
    """Print a report and write it where ``--json`` and ``--record`` say."""
    path = record_path(args.record) if args.record else None
    print(body(asdict(report)))
    for target in (args.json, path):
        if target is not None:
            write_json(target, report.record())
            print(f"\nwritten: {target}")
    return 0


def record_path(name: str) -> Path:
    """File of a record; StorageError for a name that is no plain word."""
    if not _NAME.fullmatch(name):
        raise StorageError(f"record name '{name}'; expected lower-case letters, digits, '-' and '_'")
    return FOLDER / f"{name}.json"


def body(record: dict[str, Any]) -> str:
    """Title, tables and notes of a record as Markdown."""
    tables = [f"**{table['title']}**\n\n{aligned(table['header'], table['rows'])}" for table in record["tables"]]
    return "\n\n".join([f"### {record['title']}", *tables, "\n".join(f"- {note}" for note in record["notes"])]).rstrip()


def origin(record: dict[str, Any]) -> str:
    """Provenance of a record in a few lines of Markdown."""
    came = record["provenance"]
    processors = came["processors"]
    machine = f"{processors['cpu']}, {processors['cores']} cores"
    if processors.get("gpu"):
        machine += f"; {', '.join(processors['gpu'])}"
    versions = ", ".join(f"{name} {version}" for name, version in came["versions"].items())
    return f"`{came['command']}`, {came['time']}, commit {came['commit'][:12]}\n\n{machine}\n\n{versions}"


def load(path: Path) -> dict[str, Any]:
    """Read a record; StorageError where it is no JSON, or keys are missing."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise StorageError(f"{path.name}: not a readable record ({error})") from error
    missing = KEYS - (record.keys() if isinstance(record, dict) else set())
    if missing:
        raise StorageError(f"{path.name}: not a record; missing {sorted(missing)}")
    return record


def add_arguments_of_measurements(parser: argparse.ArgumentParser, repeats: int) -> None:
    """Add ``--repeats`` and ``--record``; what :func:`finish` asks for besides, ``--json``, is among the common ones."""
    text = f"measurements; the median counts (default: {repeats})"
    parser.add_argument("--repeats", type=int, default=repeats, metavar="N", help=text)
    parser.add_argument("--record", metavar="NAME", help="keep the result in the package's records under this name")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the action."""
    parser.add_argument("names", metavar="NAME", nargs="*", help="records to print (default: all)")


def run(args: argparse.Namespace) -> int:
    """Print records."""
    kept = {path.stem: path for path in sorted(FOLDER.glob("*.json"))}
    unknown = [name for name in args.names if name not in kept]
    if unknown:
        raise VisthrowError(f"no record '{unknown[0]}'; {suggest(unknown[0], kept)}")
    for name in args.names or kept:
        record = load(kept[name])
        print(f"## {name}\n\n{origin(record)}\n\n{body(record)}\n")
    if not kept:
        print("nothing is recorded yet; measure with: visthrow bench train --record NAME")
    return 0
