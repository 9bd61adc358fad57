"""``visthrow diagnose check``: whether logs can answer anything, before a model is asked."""

import argparse
from dataclasses import asdict
from pathlib import Path

from visthrow.common.arguments import add_out


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the action."""
    parser.epilog = (
        "examples:\n  visthrow diagnose check flight.npz                     a log of ours\n "
        " visthrow diagnose check LOG00001.BFL                   Betaflight's blackbox, as it"
        " comes\n  visthrow diagnose check flights/*.csv --config mine.toml    tables, with a"
        " mapping of their columns\n\nExit status: 0 all logs ok or with warnings, 1 at least one"
        " is bad.\n"
    )
    parser.add_argument("logs", metavar="LOG", nargs="+", help="files, or folders of runs")
    parser.add_argument(
        "--config",
        metavar="NAME",
        help="of configs/diagnose, or a file: how a table's columns are read",
    )
    parser.add_argument(
        "--plant",
        metavar="NAME",
        help="of configs/train, or a file: cable and mass that the logs must have",
    )
    parser.add_argument("--all", action="store_true", help="print every row, fine ones too")
    add_out(parser, "out/check", "of the pictures")
    parser.add_argument("--no-pictures", action="store_true", help="draw none")
    parser.add_argument("--json", metavar="FILE", help="write all rows to this file")


def run(args: argparse.Namespace) -> int:
    """Read, look, print."""
    from visthrow.common.storage import write_json
    from visthrow.diagnose.inputs.setup import known, read_logs
    from visthrow.diagnose.reporting.log_picture import draw
    from visthrow.logs.check.run import check, table

    logs = read_logs(
        args.logs, args.config, models=("flyer",)
    )  # whose cable and mass are looked at
    results = check(logs, known(args.config, args.plant))
    for number, (log, checked) in enumerate(zip(logs, results), start=1):
        print(table(checked, args.all) + "\n")
        if not args.no_pictures:
            name = "".join(c if c.isalnum() or c in "-_." else "_" for c in checked.name)
            draw(log, checked, Path(args.out) / f"{number:02d}-{name}.png")
    if not args.no_pictures:
        print(f"{len(logs)} picture(s) in {args.out}")
    if args.json:
        rows = [
            {"log": c.name, "verdict": c.verdict, "rows": [asdict(row) for row in c.rows]}
            for c in results
        ]
        write_json(args.json, {"logs": rows})
    return 1 if any(checked.verdict == "bad" for checked in results) else 0
