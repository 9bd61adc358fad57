"""``visthrow compare``: throw many times with each policy and print landing errors and
durations.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from visthrow.common.arguments import declare
from visthrow.common.errors import ConfigError
from visthrow.common.extras import load_extra
from visthrow.common.storage import atomic_write, writable, write_json
from visthrow.common.workers import status
from visthrow.onboard.shipped import find_policy
from visthrow.task.measurement import Entry

BASELINE = "baseline"  # name of trajectory optimisation and MPC among the policies
DEFAULT_POLICIES = ("state", "vision")
DEFAULT_TARGETS = (1.5, 2.0, 2.5)


@dataclass(frozen=True)
class Comparison:
    """Throws of several policies, with a table and a picture of the landing points."""

    plant: str  # used in file names; "runs" for throws of HIL runs
    title: str
    subtitle: str  # part of the picture's title
    entries: Sequence[Entry]
    note: str = ""  # note on the paper's figures; empty for the default one

    def table(self) -> str:
        """Return the table under its title, as Markdown."""
        from visthrow.view.tables import markdown

        return markdown(rows_of(self.entries), self.title)

    def text(self) -> str:
        """Return the table with its note on the paper's figures."""
        from visthrow.view.tables import PAPER_NOTE

        return f"{self.table()}\n{self.note or PAPER_NOTE}\n"

    def write(self, folder: Path) -> list[Path]:
        """Write Markdown, CSV and scatter plot; return their paths."""
        from visthrow.view import figures, tables

        paths = [folder / f"compare-{self.plant}.{ending}" for ending in ("md", "csv", "png")]
        atomic_write(paths[0], self.text())
        rows = [(entry.name, self.plant, row) for entry in self.entries for row in entry.throws]
        atomic_write(paths[1], tables.csv_text(rows))
        panels = [
            (f"target {column[0].target:.1f} m", list(map(_landings, self.entries, column)))
            for column in zip(*(entry.throws for entry in self.entries))
        ]
        heading = f"Landing points from above: {self.subtitle}"
        atomic_write(paths[2], figures.scatter(panels, heading=heading))
        return paths


def _landings(entry: Entry, throws: Any) -> tuple[str, np.ndarray]:
    """Return a policy's name and its landing points relative to the target [m], shape (N, 2)."""
    return entry.name, throws.landing_w[throws.success] - (throws.target, 0.0)


add_arguments = declare(__file__)


def run(args: argparse.Namespace) -> int:
    """Throw with each policy, print the table and write the files."""
    plant = args.plant
    if args.runs:
        return _compare_runs(args)
    check(args.targets)
    for name in args.policies or ():
        if name != BASELINE:
            find_policy(name)  # reports an unknown name before heavy imports
    from visthrow.common.compute_device import resolve
    from visthrow.throws.loading import load_policy, unique_names
    from visthrow.throws.plants import check_plant

    check_plant(plant)
    if args.calibrate and plant != "hybrid":
        raise ConfigError(
            f"--calibrate on plant '{plant}'; expected 'hybrid', whose cameras differ from"
            " throw to throw"
        )
    names = args.policies or DEFAULT_POLICIES
    loaded = [
        load_policy(name, args.config, args.overrides, args.allow)
        for name in names
        if name != BASELINE
    ]
    writable(Path(args.out))
    if BASELINE in names:  # report an error before the policies throw
        rival = load_extra(
            "visthrow.paper.baseline.rival", "paper", f"the policy '{BASELINE}'", ConfigError
        )
    if not loaded:
        throws = []
    elif plant == "hybrid":
        throws = throw_hybrid(
            loaded, args.targets, args.throws, resolve(args.device), args.seed, args.calibrate
        )
    else:
        from visthrow.throws.reference_protocol import Throwing

        with Throwing(loaded, args.targets, args.throws, plant, args.seed) as throwing:
            throws = throwing.results()
    entries = entries_of(loaded, unique_names(loaded), throws)
    if BASELINE in names:
        entries += rival.throw_baseline(args)
    departures = {item.name: item.departures for item in loaded if item.departures}
    notes = [
        f"; {name} flown with {', '.join(f'{key} = {value!r}' for key, value in departed.items())},"
        " trained otherwise"
        for name, departed in departures.items()
    ]
    comparison = label_throws(plant, args.seed, entries, "".join(notes))
    figures = {"plant": plant, "seed": args.seed, "departures": departures}
    return _publish(args, comparison, figures)


def _publish(args: argparse.Namespace, comparison: Comparison, figures: dict[str, Any]) -> int:
    """Print and write a comparison; ``figures``: further entries of its JSON besides the rows."""
    print(comparison.text())
    for path in comparison.write(Path(args.out)):
        print(path)
    if args.json:
        write_json(args.json, {**figures, "rows": rows_of(comparison.entries)})
    return 0


def _compare_runs(args: argparse.Namespace) -> int:
    """Print and write the table of the throws in folders of HIL runs.

    Raises ConfigError: policies are named as well.
    """
    from visthrow.throws import from_runs

    if args.policies:
        raise ConfigError(
            f"--from with policies {' '.join(args.policies)}; expected no policies, as the runs"
            " name theirs"
        )
    writable(Path(args.out))
    logs = from_runs.logs_of(args.runs)
    how = ", ".join(sorted({log.meta["plant_meaning"] for log in logs}))
    title = f"Throws from hover on {how}: {len(logs)} throws of {len(args.runs)} runs"
    entries = from_runs.entries(logs)
    subtitle = f"{len(logs)} throws of HIL runs"
    comparison = Comparison("runs", title, subtitle, entries, from_runs.note(logs))
    return _publish(args, comparison, {"plant": "runs", "runs": args.runs})


def entries_of(loaded: Sequence, names: Sequence[str], throws: Sequence[Sequence]) -> list[Entry]:
    """Return the entries of learnt policies."""
    layouts = (item.policy.contract["observation"]["layout"] for item in loaded)
    return [Entry(*parts) for parts in zip(names, layouts, throws)]


def check(targets: Sequence[float]) -> None:
    """Raise ConfigError if a target is given twice."""
    if len(set(targets)) < len(targets):
        raise ConfigError(f"--targets {' '.join(f'{x:g}' for x in targets)}: one is given twice")


def throw_hybrid(
    loaded: Sequence,
    targets: Sequence[float],
    count: int,
    device: str,
    seed: int,
    calibrate: bool = False,
) -> list[list]:
    """Throw in the training simulator, after a calibration in hover if ``calibrate`` is set; return
    for each policy one `Throws` for each target.
    """
    from visthrow.throws.calibrated import start_calibrated

    # refuse a policy that cannot be calibrated before the simulator is imported
    starts = [start_calibrated(item.experiment) if calibrate else None for item in loaded]
    from visthrow.training.env import ThrowEnv
    from visthrow.training.protocol import throw

    rows: list[list] = []
    for item, start in zip(loaded, starts):
        policy = item.policy.to(device)
        row = []
        rows.append(row)
        for target in targets:
            status(
                f"throws in the training simulator: {sum(map(len, rows))} of"
                f" {len(loaded) * len(targets)} sets"
            )
            begin = start or ThrowEnv.reset
            actor = policy.actor(count)
            row.append(throw(item.experiment, actor, target, count, device, seed, begin=begin))
    status("")
    return rows


def label_throws(plant: str, seed: int, entries: Sequence[Entry], notes: str = "") -> Comparison:
    """Return a comparison of throws on a plant with its title, to which ``notes`` are appended."""
    from visthrow.throws.plants import PLANTS

    short, long = PLANTS[plant]
    title = f"Throws from hover on {long} (`{plant}`, seed {seed}){notes}"
    subtitle = f"{len(entries[0].throws[0].success)} throws each, {short}"
    return Comparison(plant, title, subtitle, entries)


def rows_of(entries: Sequence[Entry]) -> list[dict]:
    """Return summaries of the throws, ordered by target and then by entry; omit empty ones."""
    columns = zip(*(entry.throws for entry in entries))
    rows = [
        {"policy": entry.name, "layout": entry.layout, **row.summary()}
        for column in columns
        for entry, row in zip(entries, column)
    ]
    return [row for row in rows if row["throws"]]
