"""Reports of measurements: printed as Markdown, written as JSON with their provenance, kept in the
package.
"""

import argparse
import re
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from visthrow.common import provenance
from visthrow.common.errors import StorageError
from visthrow.common.storage import write_json
from visthrow.paper import measurements

FURTHER_PACKAGES = ("mujoco-warp", "ovphysx")
_NAME = re.compile(r"[a-z0-9][a-z0-9_-]*")


def device_name(device: str) -> str:
    """Return the model of the processor that a device is."""
    if not device.startswith("cuda"):
        return "CPU"
    import torch

    return torch.cuda.get_device_name(device)


@dataclass(frozen=True)
class Table:
    """A table as it is printed: every cell is text."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Report:
    """One measurement."""

    bench: str  # which module of this folder made it
    title: str
    tables: tuple[Table, ...]
    # sentences below the tables: how it was measured, limits of the numbers
    notes: tuple[str, ...]
    # the numbers behind the tables, SI units, for programs
    figures: dict[str, Any] = field(default_factory=dict)

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
    """Print a report and write it to ``--json`` and ``--record``."""
    path = record_path(args.record) if args.record else None
    print(measurements.body(asdict(report)))
    for target in (args.json, path):
        if target is not None:
            write_json(target, report.record())
            print(f"\nwritten: {target}")
    return 0


def record_path(name: str) -> Path:
    """File of a record; StorageError for a name that is no plain word."""
    if not _NAME.fullmatch(name):
        raise StorageError(
            f"record name '{name}'; expected lower-case letters, digits, '-' and '_'"
        )
    return measurements.FOLDER / f"{name}.json"


def add_arguments_of_measurements(parser: argparse.ArgumentParser, repeats: int) -> None:
    """Add ``--repeats`` and ``--record``; what :func:`finish` asks for besides, ``--json``, is
    among the common ones.
    """
    text = f"measurements; the median counts (default: {repeats})"
    parser.add_argument("--repeats", type=int, default=repeats, metavar="N", help=text)
    parser.add_argument(
        "--record", metavar="NAME", help="keep the result in the package's records under this name"
    )
