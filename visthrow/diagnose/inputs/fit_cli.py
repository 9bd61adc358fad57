"""``visthrow diagnose fit``: fit a first configuration of a vehicle or motor to standalone flights
or tests.
"""

import argparse
from dataclasses import asdict

from visthrow.common.arguments import declare

add_arguments = declare(__file__)


def run(args: argparse.Namespace) -> int:
    """Read and check the logs, fit the effects, print and write the result."""
    from sim.params import VehicleParams
    from visthrow import config
    from visthrow.common.storage import write_json
    from visthrow.diagnose.inputs import fit as fitting
    from visthrow.diagnose.inputs import setup as setups
    from visthrow.logs.check.run import check

    setup = setups.load(args.config)
    logs = setups.read_logs(args.logs, args.config)
    for checked in check(logs):
        for row in checked.rows:
            if row.verdict == "bad":
                print(f"{checked.name}: {row.topic} {row.channel}: {row.text}")
    model = setups.model_of(setup, logs)
    free = args.free or [
        n for n in fitting.DEFAULT_FREE.get(setup.model, ()) if n in {e.name for e in model.effects}
    ]
    result = fitting.fit(model, free)
    print("\n".join(result.sentences))
    for channel, before in result.rms_before.items():
        print(f"residual of {channel}: {before:.4g} before, {result.rms_after[channel]:.4g} after")
    base = config.load(VehicleParams, config.find("vehicle", args.vehicle))
    for path in fitting.write(args.out, args.config, setup, result, logs, base):
        print(path)
    if args.json:
        write_json(args.json, asdict(result))
    return 0
