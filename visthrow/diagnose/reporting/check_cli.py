"""``visthrow diagnose check``: check logs for mistakes before they are diagnosed."""

import argparse
from dataclasses import asdict
from pathlib import Path

from visthrow.common.arguments import declare

add_arguments = declare(__file__)


def run(args: argparse.Namespace) -> int:
    """Read the logs, check them, print and draw the results."""
    from visthrow.common.storage import write_json
    from visthrow.diagnose.inputs.setup import describe_vehicle, read_logs
    from visthrow.diagnose.reporting.log_picture import draw
    from visthrow.logs.check.run import check, table

    # of the models, only the flyer states a cable and a mass to check
    logs = read_logs(args.logs, args.config, models=("flyer",))
    results = check(logs, describe_vehicle(args.config, args.plant))
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
